"""Pixels that never fire."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def silence_pixel(share: float, pixel_uniform: float):
    """Time the pixel stays dead [s]: for ever, or not at all."""
    return wp.where(pixel_uniform < share, 1.0e30, 0.0)


@dataclass(frozen=True, kw_only=True)
class Dead(Effect):
    """Pixels that never fire.

    A few pixels of a chip are broken, or switched off by the user because they were hot. They send no event,
    whatever they see.
    """

    name: ClassVar[str] = "dead"
    source: ClassVar[str] = "Gallego et al.: Event-based vision, a survey, 2022 (non-idealities)"
    stages: ClassVar = {"gate": silence_pixel}
    rare: ClassVar[bool] = True
    signatures: ClassVar = ()

    share: float = parameter(
        0.001,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-5, 0.02),
        about="share of pixels that are dead",
    )
