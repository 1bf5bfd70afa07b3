"""Current without light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.kernels.vector_math import exponential


@wp.func
def add_dark_current(intensity: float, current: float, spread: float, pixel_normal: float):
    """Intensity that would make photocurrent and dark current together."""
    return intensity + current * exponential(spread * pixel_normal)


@dataclass(frozen=True, kw_only=True)
class Dark(Effect):
    """Current without light.

    A photodiode leaks a little current in complete darkness. It adds to the photocurrent, so contrasts in
    the darkest parts of a scene shrink and make fewer events. Warmth doubles it every few degrees.

    The current is given as the intensity that makes as much photocurrent. It is log-normally distributed over
    pixels. Every later stage, such as the bandwidth, sees the sum; the parasitic photocurrent of `leak` flows
    in another junction.
    """

    name: ClassVar[str] = "dark"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008; "
        "Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017"
    )
    stages: ClassVar = {"current": add_dark_current}

    current: float = parameter(
        0.003,
        unit="intensity",
        off=0.0,
        bounds=(0.0, 10.0),
        plausible=(1e-4, 0.1),
        about="median dark current, as the intensity that makes as much",
    )
    spread: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 3.0),
        plausible=(0.0, 1.0),
        about="standard deviation of its natural logarithm over pixels",
    )
