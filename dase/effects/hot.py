"""Pixels that fire by themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def hot_rates(
    share: float, rate: float, spread: float, balance: float, pixel_uniform: float, pixel_normal: float
):
    """ON and OFF rates [Hz], none for a sound pixel."""
    total = float(0.0)
    if pixel_uniform < share:
        total = rate * wp.exp(spread * pixel_normal)
    return total * balance, total * (1.0 - balance)


@dataclass(frozen=True, kw_only=True)
class Hot(Effect):
    """Pixels that fire by themselves.

    A few pixels of a chip have a faulty comparator or a switch that leaks strongly. They send events all the
    time, whatever they see, some of them thousands per second.

    Each pixel is hot with the probability `share`. Rates are log-normally distributed over hot pixels, with
    median `rate`; events come at random times, and each makes the pixel remember the present log intensity.
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
        about="share of ON events",
    )
