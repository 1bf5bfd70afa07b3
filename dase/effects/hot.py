"""Pixels that fire by themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import exponential


@wp.func
def hot_rates(
    share: float, rate: float, spread: float, balance: float, pixel_uniform: float, pixel_normal: float
):
    """ON and OFF rates [Hz], none for a sound pixel."""
    total = float(0.0)
    if pixel_uniform < share:
        total = rate * exponential(spread * pixel_normal)
    return total * balance, total * (1.0 - balance)


@wp.func
def hot_drift(
    nominal_on: float,
    nominal_off: float,
    share: float,
    rate: float,
    spread: float,
    balance: float,
    pixel_uniform: float,
    pixel_uniform_2: float,
    pixel_normal: float,
):
    """Speed at which the memory of a hot pixel drifts, towards ON or OFF [log intensity/s]."""
    speed = float(0.0)
    if pixel_uniform < share:
        speed = (
            rate
            * exponential(spread * pixel_normal)
            * wp.where(pixel_uniform_2 < balance, nominal_on, -nominal_off)
        )
    return speed


@dataclass(frozen=True, kw_only=True)
class Hot(Effect):
    """Pixels that fire by themselves.

    A few pixels of a chip have a faulty comparator or a switch that leaks strongly. They send events all the
    time, whatever they see, some of them thousands per second.

    Each pixel is hot with the probability `share`. Rates are log-normally distributed over hot pixels, with
    median `rate`. With `mode = "noise"` events come at random times, ON and OFF mixed, and each makes the
    pixel remember the present log intensity: the scatter of intervals is their mean. With `mode = "leak"` the
    pixel's memory drifts, by the nominal threshold in 1/rate seconds, towards ON in the share `balance` of
    hot pixels and towards OFF in the others: events of one polarity at even intervals, as far as the light
    rests. The hottest five pixels of a DAVIS240B recording are of this kind (one polarity each, intervals
    that scatter by 7 to 21 % of their mean; `jitter` makes them scatter), as is that of a DVXplorer; other
    hot pixels of the DVXplorer and those of a DAVIS346 are of the first. Drifts are labelled as leak.
    A dead time adds to each interval.
    """

    name: ClassVar[str] = "hot"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 "
        "(log-normal noise rates over pixels); Stoffregen et al.: Reducing the sim-to-real gap for event "
        "cameras, 2020 (shares of hot pixels)"
    )
    label: ClassVar[str] = "hot"
    rare: ClassVar[bool] = True
    stages: ClassVar = {"noise": hot_rates}
    signatures: ClassVar = (Makes("hot pixels", tells=True),)
    screen_limits: ClassVar = {
        "": "hot pixels are told best under a lens cap, for some seconds",
    }

    share: float = parameter(
        0.001,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-5, 0.02),
        about="share of pixels that are hot",
    )
    rate: float = parameter(
        50.0,
        unit="Hz",
        bounds=(0.0, 1e5),
        plausible=(5.0, 5000.0),
        about="median over hot pixels of the events per second, both polarities together",
        starts="ends",
    )
    spread: float = parameter(
        1.0,
        unit="1",
        bounds=(0.0, 3.0),
        plausible=(0.0, 2.5),
        about="standard deviation of the natural logarithm of the rate over hot pixels",
    )
    balance: float = parameter(
        0.5,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 1.0),
        about="share of ON events, in mode leak of pixels that send ON events",
    )
    mode: str = choice(
        "noise", among=("noise", "leak"), about="events at random times, or a drift that makes them"
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return noise: which of the two it is, the events of the few hot pixels tell without a search."""
        return [cls()]

    def share_that_tells(self, name: str) -> float:
        """Return the share of hot pixels for their median rate, which is that of as many logarithms."""
        return self.share if name == "rate" else 1.0

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know: each mode acts at a stage of its own."""
        stage = ("drift", hot_drift) if self.mode == "leak" else ("noise", hot_rates)
        return replace(super().compiled(), functions=(stage,))
