"""ON events in the dark and at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def drift(on: float, rate: float, spread: float, pixel_normal: float):
    """Speed at which the pixel's memory leaks away, towards ON [log intensity/s]."""
    return wp.max(rate * (1.0 + spread * pixel_normal), 0.0) * on


@dataclass(frozen=True, kw_only=True)
class Leak(Effect):
    """ON events of pixels that see no change.

    A pixel keeps its memory on a capacitor whose reset switch leaks. The memory drifts down, so even in a
    static scene a pixel sends ON events at a regular, low rate, and moving scenes have slightly more ON than
    OFF events. The leak differs from pixel to pixel.
    """

    name: ClassVar[str] = "leak"
    source: ClassVar[str] = (
        "Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017"
    )
    stages: ClassVar = {"drift": drift}

    rate: float = parameter(
        0.1,
        unit="Hz",
        off=0.0,
        bounds=(0.0, 1e5),
        plausible=(0.01, 20.0),
        about="ON events per pixel and second in a static scene",
    )
    spread: float = parameter(
        0.1,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 0.5),
        about="standard deviation of the rate over pixels, relative to the rate",
    )
