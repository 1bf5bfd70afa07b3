"""Current without light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.kernels.vector_math import exponential

Array = NDArray[np.float64]


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
    pixels.

    It is the dark current of the whole pixel: the node of the photoreceptor is charged by all that flows in
    the photodiode, so the speed of `bandwidth` and `second_order`, the delay of `latency`, and corner and
    variance of `voltage_noise` follow intensity + current, too, as C dV/dt = I + current - what the feedback
    takes away has it. Their own `dark`, the dark current of a sensor without this effect, then changes
    nothing. A pole of them has its cutoff at intensity 1, and in complete darkness current / (1 + current) of
    it. (`log_eps` of a sensor is no current: it keeps the logarithm of black finite, which this does, too.)
    The parasitic photocurrent of `leak` flows in another junction.

    With `speed = "own"` the poles keep a floor of their own, `dark`, beneath the sum: two numbers for one
    current, as other simulators have it whose light and whose cutoff have each a floor.
    """

    name: ClassVar[str] = "dark"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008; Delbruck, Mead: Analog VLSI adaptive, logarithmic, "
        "wide-dynamic-range photoreceptor, 1994 (the node's time constant goes as 1 / current); "
        "Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017"
    )
    stages: ClassVar = {"current": add_dark_current}
    signatures: ClassVar = (Makes("larger steps in the dark", tells=True, by="current", absence=False),)
    screen_limits: ClassVar = {
        "": (
            "dark current wants a lens cap: black of a screen is some 0.1 % of white, and the room adds to it"
        ),
    }

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
        over_pixels=True,
    )
    speed: str = choice(
        "shared",
        among=("shared", "own"),
        about="poles, latency and noise of the voltage follow it, or have a dark current of their own beside",
    )

    @property
    def share(self) -> float:
        """Share of the current at intensity 1 that flows without light, as poles by themselves have it."""
        return self.current / (1.0 + self.current)

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the current that all share; of a simulator that works frame by frame, that of the light."""
        return [cls(speed="own" if observed.clip_step else "shared")]

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return the current that all share for that of the light, where there is anything to share it."""
        shared = replace(self, speed="shared")
        follow = any(set(e.idle([shared])) > set(e.idle([self])) for e in beside)
        return [shared] if self.speed == "own" and follow else []

    def stood_in_for(self, beside: Sequence[Effect]) -> dict[str, float]:
        """Return the current that has the share with which others were slow in the dark."""
        shares = [
            float(getattr(e, p.name)) for e in beside for p in e.parameters()
            if p.unit == "1" and p.name in set(e.idle([self])) - set(e.idle([]))
        ]  # fmt: skip
        share = next((share for share in shares if share < 0.5), None)
        return {} if share is None else {"current": share / (1 - share)}

    def swing_left(self, light: Array) -> float:
        """Return the share of the changes of log light that are left beside the current.

        Args:
            light: Intensities, and what is added before the logarithm, of some pixels on a grid of time,
                shape (N, T).
        """
        without, beside = (float(np.abs(np.diff(np.log(light + more))).sum()) for more in (0.0, self.current))
        return beside / without if without > 0 else 1.0

    def lends(self) -> tuple[str, ...]:
        """Return the current, which poles, latency and noise of the voltage follow."""
        return ("current",) if self.speed == "shared" else ()
