"""Random events of both polarities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, parameter
from dase.effects.made_signatures import Makes
from dase.kernels.vector_math import exponential


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
    knee: float,
    threshold: float,
    spread: float,
    pixel_normal: float,
):
    """ON and OFF rates of noise events [Hz]."""
    light = wp.clamp(intensity, 0.0, 1.0)
    near = 1.0 / (1.0 + light / knee)
    total = rate * (bright + (1.0 - bright) * (1.0 - light) * near * near)
    # the half square keeps the mean over pixels at the rate; without a spread this is 1 to the bit
    total = total * exponential(spread * (pixel_normal - 0.5 * spread))
    way_on = wp.where(threshold > 0.0, threshold, nominal_on)
    way_off = wp.where(threshold > 0.0, threshold, nominal_off)
    return total * balance * (way_on / on), total * (1.0 - balance) * (way_off / off)


@dataclass(frozen=True, kw_only=True)
class Shot(Effect):
    """Random events of both polarities, most of all in the dark.

    Few photons arrive in the dark, and their number fluctuates. Now and then a fluctuation alone crosses a
    threshold. The events come at random times, independently in each pixel, and each makes the pixel
    remember the present log intensity, as any event does.

    The rate of both polarities together is `rate` at intensity 0, and falls to `bright * rate` at intensity 1
    as (1 - I) / (1 + I / knee)². With an infinite knee it falls in a straight line, as in v2e; cameras'
    noise is gone long before white. Resting pixels of a DAVIS346 have 0.32, 0.15, 0.05, 0.036, 0.025 and
    0.007 Hz at 0 to 1, 4 to 7, 7 to 10, 10 to 14, 14 to 20 and 20 to 30 of 255 grey levels: a knee of 0.025.
    A reciprocal alone falls too slowly.

    Some pixels are much noisier than others: rates are log-normally distributed over pixels with the mean
    `rate`. Of those resting pixels in the dark, 90 % sent nothing in half a second and 0.6 % four events and
    more, as many in one part of the time as in another: a spread of 1.4. Pixels of another camera with 60
    events per second in the dark differ by 0.5: the rarer noise crosses a threshold, the more a little
    mismatch matters.

    A pixel whose threshold is lower than the nominal one is noisier, in proportion to nominal / threshold
    for each polarity, as in v2e. Real rates fall faster with the threshold, like the tail of a normal
    distribution, and depend on the bandwidth: `voltage_noise` makes both by itself, at the cost of fine
    sampling. Thresholds that `jitter` draws count as well, so noise beside it is more than `rate`: 2 % for
    a spread of 0.2, 14 % for 0.5. `rate` belongs to the sensor's own thresholds, so changing those leaves
    it as it is, unless `threshold` says at which one it was measured.
    """

    name: ClassVar[str] = "shot"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (temporal noise)"
    )
    stages: ClassVar = {"noise": shot_rates}
    signatures: ClassVar = (
        # every camera has it in the dark
        Makes("noise at rest", tells=True, by="independent", usual=True),
        Makes("opposite pairs"),
    )
    screen_limits: ClassVar = {
        "rate": "shot noise wants darkness for seconds: a lens cap; a screen's black shows only part of it",
        "bright": (
            "how shot noise falls with light wants decades of light: grey filters, or an LED and a lens cap"
        ),
    }

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
    knee: float = parameter(
        math.inf,
        unit="intensity",
        bounds=(1e-6, math.inf),
        plausible=(1e-3, 10.0),
        about="where the rate has fallen to about a quarter; infinite for a straight line",
        fitted=False,  # tried at two values: most scenes hardly tell more
    )
    threshold: float = parameter(
        0.0,
        unit="log intensity",
        bounds=(0.0, 10.0),
        plausible=(0.0, 1.0),
        about="threshold of both polarities at which `rate` was measured; 0 for the sensor's own",
        fitted=False,
    )
    spread: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 3.0),
        plausible=(0.0, 1.5),
        about="standard deviation of the natural logarithm of the rate over pixels",
        fitted=False,  # rests on a few pixels far out, of which a fit sees some
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return noise that falls in a straight line, and noise that is gone long before white."""
        return [cls(), cls(knee=0.022, bright=0.0)]
