"""Thresholds that differ from event to event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.effects.made_signatures import Makes


@wp.func
def redraw_thresholds(on: float, off: float, spread: float, normal: float, normal_2: float):
    """Thresholds until the next event."""
    return wp.max(on * (1.0 + spread * normal), 0.01), wp.max(off * (1.0 + spread * normal_2), 0.01)


@dataclass(frozen=True, kw_only=True)
class Jitter(Effect):
    """Thresholds that differ from event to event.

    The comparators of a pixel are noisy, and its reset leaves a random charge behind. So the change that
    makes the next event is never quite the same: a steady change sends events at uneven intervals. Unlike
    mismatch, it averages out over the events of a pixel.

    After each event of a pixel both thresholds are drawn anew, normally distributed about those of the
    pixel, and never below 0.01.
    """

    name: ClassVar[str] = "jitter"
    source: ClassVar[str] = "Rebecq, Gehrig, Scaramuzza: ESIM, an open event camera simulator, 2018"
    stages: ClassVar = {"redraw": redraw_thresholds}
    signatures: ClassVar = (Makes("redrawn thresholds", tells=True),)

    spread: float = parameter(
        0.1,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.02, 0.5),
        about="standard deviation over events, relative to the threshold of the pixel",
        # steps of time and of grey make as much of any threshold
        clear_from=0.03,
        # a world that looks for crossings at steps of time sends the first after a dead time a little late,
        # beyond the threshold by chance; the point spread of a lens is no Gaussian, nor known to a per cent;
        # a low-pass that goes step by step is not quite that of the model
        clear_beside=(
            ("refractory", 0.15),
            ("optics_blur", 0.06),
            ("bandwidth", 0.06),
            ("second_order", 0.06),
        ),
    )
