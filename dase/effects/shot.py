"""Random events of both polarities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def shot_rates(
    intensity: float,
    on: float,
    off: float,
    nominal_on: float,
    nominal_off: float,
    rate: float,
    bright: float,
    balance: float,
):
    """ON and OFF rates of noise events [Hz]."""
    total = rate * (1.0 - (1.0 - bright) * wp.clamp(intensity, 0.0, 1.0))
    return total * balance * (nominal_on / on), total * (1.0 - balance) * (nominal_off / off)


@dataclass(frozen=True, kw_only=True)
class Shot(Effect):
    """Random events of both polarities, most of all in the dark.

    Few photons arrive in the dark, and their number fluctuates. Now and then a fluctuation alone crosses a
    threshold. The events come at random times, independently in each pixel, and each makes the pixel
    remember the present log intensity, as any event does.

    The rate of both polarities together is `rate` at intensity 0 and falls linearly to `bright * rate` at
    intensity 1. A pixel whose threshold is lower than the nominal one is noisier, in proportion to
    nominal / threshold for each polarity, as in v2e. Real rates fall faster with the threshold, like the tail
    of a normal distribution, and depend on the bandwidth: `voltage_noise` makes both by itself, at the cost
    of fine sampling. `rate` belongs to the nominal thresholds, so changing those leaves it as it is.
    """

    name: ClassVar[str] = "shot"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (temporal noise)"
    )
    stages: ClassVar = {"noise": shot_rates}

    rate: float = parameter(
        1.0,
        unit="Hz",
        off=0.0,
        bounds=(0.0, 1e5),
        plausible=(0.02, 100.0),
        about="events per second in the dark of a pixel of nominal thresholds, both polarities together",
    )
    bright: float = parameter(
        0.25,
        unit="1",
        bounds=(0.0, 10.0),
        plausible=(0.0, 1.0),
        about="rate at intensity 1 relative to that in the dark",
    )
    balance: float = parameter(
        0.5,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.2, 0.8),
        about="share of ON events",
    )
