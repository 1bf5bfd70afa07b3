"""Thresholds that differ from pixel to pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def scatter_thresholds(on: float, off: float, spread: float, pixel_normal: float, pixel_normal_2: float):
    """Thresholds of one pixel; transistors differ independently for ON and OFF."""
    # the floor keeps a pixel far out in the tail from firing without end (the paper's epsilon)
    return wp.max(on * (1.0 + spread * pixel_normal), 0.01), wp.max(
        off * (1.0 + spread * pixel_normal_2), 0.01
    )


@dataclass(frozen=True, kw_only=True)
class Mismatch(Effect):
    """Thresholds that differ from pixel to pixel.

    No two transistors are made alike, so each pixel has an ON and an OFF threshold of its own, fixed for the
    life of the chip. Neighbours that see the same edge send different numbers of events: a fixed pattern.
    The thresholds are normally distributed about the nominal ones, and never below 0.01.
    """

    name: ClassVar[str] = "mismatch"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008"
    )
    stages: ClassVar = {"threshold": scatter_thresholds}

    spread: float = parameter(
        0.15,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.02, 0.5),
        about="standard deviation over pixels, relative to the threshold",
    )
