"""Light that flickers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, choice, parameter
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import cosine_and_sine


@wp.func
def flickering_light(intensity: float, t64: wp.float64, frequency: float, depth: float, phase: float):
    """Intensity under a lamp whose flux is 1 + depth · sin."""
    # float32 resolves no more than a quarter of a millisecond after an hour
    turns = wp.float64(frequency) * t64
    turn = float(turns - wp.floor(turns)) + phase
    _cosine, sine = cosine_and_sine(turn - wp.floor(turn))
    return intensity * (1.0 + depth * sine)


@wp.func
def turn_of_lamp(
    t64: wp.float64, frequency: float, phase: float, region: float, apart: float, x: float, y: float
):
    """Part of a period that has passed at a pixel's lamp, 0 to 1."""
    turns = wp.float64(frequency) * t64
    lamp = wp.floor(x / region) + wp.floor(y / region)
    turn = float(turns - wp.floor(turns)) + phase + apart * lamp
    return turn - wp.floor(turn)


@wp.func
def light_of_lamps(
    intensity: float,
    t64: wp.float64,
    frequency: float,
    depth: float,
    phase: float,
    region: float,
    apart: float,
    x: float,
    y: float,
):
    """Intensity under lamps whose flux is 1 + depth · sin, each a region of its own."""
    _cosine, sine = cosine_and_sine(turn_of_lamp(t64, frequency, phase, region, apart, x, y))
    return intensity * (1.0 + depth * sine)


@wp.func
def rectified_light(
    intensity: float,
    t64: wp.float64,
    frequency: float,
    depth: float,
    phase: float,
    region: float,
    apart: float,
    x: float,
    y: float,
):
    """Intensity under lamps whose flux follows the rectified mains."""
    # half a turn of the mains is a period of the light
    half = 0.5 * turn_of_lamp(t64, frequency, phase, region, apart, x, y)
    _cosine, sine = cosine_and_sine(half)
    return intensity * (1.0 + depth * (2.0 * wp.abs(sine) - 1.0))


@wp.func
def switched_light(
    intensity: float,
    t64: wp.float64,
    frequency: float,
    depth: float,
    phase: float,
    region: float,
    apart: float,
    duty: float,
    x: float,
    y: float,
):
    """Intensity under lamps that are switched on for a share of each period."""
    turn = turn_of_lamp(t64, frequency, phase, region, apart, x, y)
    return intensity * (1.0 + wp.where(turn < duty, depth, -depth))


@dataclass(frozen=True, kw_only=True)
class Flicker(Effect):
    """Light that flickers.

    Lamps on alternating current brighten and dim with twice the frequency of the mains, 100 or 120 times per
    second; screens and dimmed LEDs flicker too. Pixels that see nothing move then send ON and OFF events in
    turns, all of them together.

    The intensity is multiplied by 1 + depth · w(frequency · t + phase), where w goes from -1 to 1 in each
    turn. With `shape = "sine"` it is sin(2π turn). With `"rectified"` it is 2 |sin(π turn)| - 1: an LED
    without a capacitor behind a bridge of diodes, with a sharp dip at each zero of the mains and a round
    top. With `"pwm"` it is 1 for the share `duty` of each period and -1 for the rest: a dimmed LED or a
    screen's backlight; all pixels send their ON events at one moment and their OFF events at another.
    Whatever the shape, the logarithm swings by log((1 + depth) / (1 - depth)), at every intensity alike.

    Where several lamps hang, each lights a region: squares of `region` pixels, of which neighbours to the
    right and below are `apart` turns later. Lamps on the three phases of the mains are 1/3 of a turn of the
    light apart. Lights do not mix at the borders.

    A scene must be sampled several times per period: moving textures and videos are, by themselves.
    """

    name: ClassVar[str] = "flicker"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "IEEE Std 1789: Recommended practices for modulating current in high-brightness LEDs, 2015 "
        "(depth, frequency and waveforms of lamps: rectified mains, pulse width modulation)"
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

    duty: float = parameter(
        0.5,
        unit="1",
        bounds=(0.001, 0.999),
        plausible=(0.05, 0.95),
        about="share of a period for which a lamp is on, in shape pwm",
        fitted=False,  # of other shapes nothing tells it
    )
    region: float = parameter(
        math.inf,
        unit="px",
        bounds=(1.0, math.inf),
        plausible=(20.0, 1000.0),
        about="side of the squares that one lamp lights; infinite for a single lamp",
        fitted=False,  # a border half a pixel off changes few pixels
    )
    apart: float = parameter(
        1 / 3,
        unit="turns",
        bounds=(-1.0, 1.0),
        plausible=(0.0, 1.0),
        about="by which the lamp of the next region is later",
        fitted=False,  # of a single lamp nothing tells it
    )
    shape: str = choice("sine", among=("sine", "rectified", "pwm"), about="how the light swings")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return lamps of the frequency at which the event rate swings most, as bulbs and LEDs have it.

        None where chance alone swings as much. All pixels see a lamp together, so what it does to any of them
        stands far above chance; and a search among lamps takes longest where events are few.
        """
        if observed.peak_chance > 0.01:
            return []
        return [cls(frequency=observed.peak_frequency, shape=shape) for shape in ("sine", "rectified")]

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know: the shape is a function of its own."""
        single = self.region == math.inf
        light = {
            "sine": flickering_light if single else light_of_lamps,
            "rectified": rectified_light,
            "pwm": switched_light,
        }[self.shape]
        return replace(super().compiled(), functions=(("light", light),))

    def shifted(self, seconds: float) -> Flicker:
        """Return the lamp on a clock that shows `seconds` less; its phase stays within the bounds."""
        return replace(self, phase=(self.phase + seconds * self.frequency + 1.0) % 2.0 - 1.0)

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        if not (self.depth and self.frequency):
            return math.inf
        # between samples the light runs straight, which is off by depth / samples² where it is round and by
        # depth / samples at the sharp dips of rectified light: 0.006 and 0.015 at most up to a depth of 0.3;
        # ten samples of a period keep 97 % of a sine's swing
        share = min(abs(self.depth) / 0.3, 1.0)
        if self.shape == "sine":
            part = 1 / max(10, 16 * share**0.5)
        elif self.shape == "rectified":
            part = 1 / 32 if share > 0.5 else 1 / 16
        else:  # the shorter part of a period is not to be missed
            part = min(1 / 16, self.duty / 4, (1 - self.duty) / 4)
        return part / self.frequency
