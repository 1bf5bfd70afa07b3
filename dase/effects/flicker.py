"""Light that flickers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, parameter
from dase.kernels.vector_math import cosine_and_sine


@wp.func
def flickering_light(intensity: float, t64: wp.float64, frequency: float, depth: float, phase: float):
    """Intensity under a lamp whose flux is 1 + depth · sin."""
    # float32 resolves no more than a quarter of a millisecond after an hour
    turns = wp.float64(frequency) * t64
    turn = float(turns - wp.floor(turns)) + phase
    _cosine, sine = cosine_and_sine(turn - wp.floor(turn))
    return intensity * (1.0 + depth * sine)


@dataclass(frozen=True, kw_only=True)
class Flicker(Effect):
    """Light that flickers.

    Lamps on alternating current brighten and dim with twice the frequency of the mains, 100 or 120 times per
    second; screens and dimmed LEDs flicker too. Pixels that see nothing move then send ON and OFF events in
    turns, all of them together.

    The intensity is multiplied by 1 + depth · sin(2π (frequency · t + phase)). The modulation multiplies, so
    in the logarithm it is the same at every intensity. A scene must be sampled several times per period:
    moving textures and videos are, by themselves.
    """

    name: ClassVar[str] = "flicker"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "IEEE Std 1789: Recommended practices for modulating current in high-brightness LEDs, 2015 "
        "(depth and frequency of lamps)"
    )
    stages: ClassVar = {"light": flickering_light}

    frequency: float = parameter(
        100.0,
        unit="Hz",
        bounds=(0.0, 1e5),
        plausible=(50.0, 1000.0),
        about="of the light, twice that of the mains",
        nearby=0.01,  # farther off, the phase turns within the measurement
    )
    depth: float = parameter(
        0.1,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.005, 0.9),
        about="(brightest - darkest) / (brightest + darkest)",
    )
    phase: float = parameter(
        0.0,
        unit="turns",
        bounds=(-1.0, 1.0),
        plausible=(0.0, 1.0),
        about="of the sine at time 0",
        starts="turn",
        periodic=True,
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return a lamp of the frequency at which the event rate swings most."""
        return [cls(frequency=observed.peak_frequency)]

    def shifted(self, seconds: float) -> Flicker:
        """Return the lamp on a clock that shows `seconds` less; its phase stays within the bounds."""
        return replace(self, phase=(self.phase + seconds * self.frequency + 1.0) % 2.0 - 1.0)

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return 1 / (16 * self.frequency) if self.depth and self.frequency else math.inf
