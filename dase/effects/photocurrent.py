"""The photocurrent that a photoreceptor's speed, its noise and its delay follow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from dase.effects.base import Effect, parameter

LEAST = wp.constant(1e-6)
"""Least current that is left in the dark, as intensity: a pixel without any would stand still."""


USUAL = 0.2
"""Light in which an effect by another law is alike where it takes the place of the present [intensity]."""


@wp.func
def relative_photocurrent(intensity: float, dark: float, dark_current: float):
    """Current of an intensity relative to that of intensity 1, at most 1.

    One dark current flows in a photodiode: that of the sensor, which is in the intensity, or where the sensor
    has none the share `dark`.
    """
    own = dark + (1.0 - dark) * wp.clamp(intensity, 0.0, 1.0)
    return wp.where(dark_current > 0.0, wp.clamp(intensity / (1.0 + dark_current), LEAST, 1.0), own)


@wp.func
def photocurrent(intensity: float, dark: float, dark_current: float):
    """Current of an intensity, as intensity; `dark` is that of the dark where the sensor has none."""
    own = wp.max(intensity, 0.0) + dark
    return wp.where(dark_current > 0.0, wp.max(intensity, LEAST), own)


def dark_share(about: str) -> Any:
    """Declare the share of the photocurrent at intensity 1 that flows without light.

    One default for all effects: a pixel has one photodiode.
    """
    about = f"{about}; unused beside `dark`"
    return parameter(
        20 / 275, unit="1", bounds=(1e-4, 1.0), plausible=(0.01, 1.0), about=about, starts="ends"
    )


def idle_beside(beside: Sequence[Effect]) -> tuple[str, ...]:
    """Return ("dark",) where an effect's own dark current changes nothing, as the sensor has one for all."""
    shared = any(e.name == "dark" and "current" in e.lends() and not e.is_off() for e in beside)
    return ("dark",) if shared else ()
