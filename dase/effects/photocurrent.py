"""The photocurrent that a photoreceptor's speed and delay follow."""

from __future__ import annotations

from typing import Any

import warp as wp

from dase.effects.base import parameter


@wp.func
def relative_photocurrent(intensity: float, dark: float):
    """Photocurrent of an intensity relative to that of intensity 1: `dark` in the dark, at most 1."""
    return dark + (1.0 - dark) * wp.clamp(intensity, 0.0, 1.0)


def dark_share(about: str) -> Any:
    """Declare the share of the photocurrent at intensity 1 that flows without light.

    One default for all effects: a pixel has one photodiode.
    """
    return parameter(
        20 / 275, unit="1", bounds=(1e-4, 1.0), plausible=(0.01, 1.0), about=about, starts="ends"
    )
