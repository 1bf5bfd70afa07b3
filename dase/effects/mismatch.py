"""Thresholds that differ from pixel to pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.threshold import Threshold
from dase.kernels.pixel_stages import EffectStages

UNLIKE = 0.05
"""Share of the mean by which both thresholds must be away from it before either rule of a mismatch is seen to
be another than the other."""


@wp.func
def scatter_thresholds(on: float, off: float, spread: float, pixel_normal: float, pixel_normal_2: float):
    """Thresholds of one pixel; transistors differ independently for ON and OFF."""
    # the floor keeps a pixel far out in the tail from firing without end (the paper's epsilon)
    return wp.max(on * (1.0 + spread * pixel_normal), 0.01), wp.max(
        off * (1.0 + spread * pixel_normal_2), 0.01
    )


@wp.func
def scatter_alike(on: float, off: float, spread: float, pixel_normal: float, pixel_normal_2: float):
    """Thresholds of one pixel whose comparators are off by as much log intensity in either."""
    sigma = 0.5 * spread * (on + off)
    return wp.max(on + sigma * pixel_normal, 0.01), wp.max(off + sigma * pixel_normal_2, 0.01)


@dataclass(frozen=True, kw_only=True)
class Mismatch(Effect):
    """Thresholds that differ from pixel to pixel.

    No two transistors are made alike, so each pixel has an ON and an OFF threshold of its own, fixed for the
    life of the chip. Neighbours that see the same edge send different numbers of events: a fixed pattern.
    The thresholds are normally distributed about the nominal ones, and never below 0.01.

    With `relative_to = "own"` each threshold differs by the same share of itself, as capacitors do. With
    `relative_to = "mean"` ON and OFF thresholds differ by the same change of log intensity, `spread` times
    the mean of both, as offsets of comparators make it: cameras' data sheets give it so (2.1 % contrast), and
    other simulators have it so (v2e, ESIM, OpenEB). Where ON and OFF thresholds are alike it is the same.
    """

    name: ClassVar[str] = "mismatch"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008"
    )
    stages: ClassVar = {"threshold": scatter_thresholds}
    signatures: ClassVar = (Makes("unequal thresholds", tells=True), Makes("fixed pattern"))

    spread: float = parameter(
        0.15,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.02, 0.5),
        about="standard deviation over pixels, relative to the threshold",
        # steps of time and of grey make as much of any threshold
        clear_from=0.03,
        # a world that sets its memory at steps of time, beyond the threshold by chance, has such pixels; so
        # has a lens whose point spread is not quite that of the model, or a low-pass that goes step by step
        clear_beside=(
            ("refractory", 0.05),
            ("optics_blur", 0.06),
            ("bandwidth", 0.06),
            ("second_order", 0.06),
        ),
        over_pixels=True,
    )
    relative_to: str = choice(
        "own",
        among=("own", "mean"),
        about="each threshold itself, or the mean of both: then both differ alike",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the shares of each threshold: a fit asks for the other rule where it can be seen."""
        return [cls()]

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return the other rule where the thresholds are so unlike that the two can be told apart."""
        unlike = [
            one for one in beside
            if isinstance(one, Threshold) and abs(one.on - one.off) > UNLIKE * (one.on + one.off)
        ]  # fmt: skip
        return [replace(self, relative_to="own" if self.relative_to == "mean" else "mean")] if unlike else []

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know."""
        stages = super().compiled()
        if self.relative_to == "own":
            return stages
        return replace(stages, functions=(("threshold", scatter_alike),))
