"""Light that flickers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import cosine_and_sine, exponential, logarithm


@wp.func
def shown_turn(turn: float, brightest: float, frequency: float, dt: float):
    """Part of a period that a sample shows: the brightest or the darkest within half a step, else its own.

    Of even samples that is the one next to it. Between samples light runs straight, so what it reaches
    between two of them would be cut off, and events come of the extremes. The darkest is half a turn from
    the brightest. `dt` is the step before [s].
    """
    half = 0.5 * frequency * dt
    away = turn - brightest
    away -= wp.floor(away + 0.5)
    # of two samples just as near both are
    near = 1.0001 * half
    shown = wp.where(wp.abs(away) <= near, brightest, turn)
    shown = wp.where(0.5 - wp.abs(away) <= near, brightest + 0.5, shown)
    # fewer than two samples per period show none of it, and the first of all has no step
    shown = wp.where(half <= 0.25, shown, turn)
    return shown - wp.floor(shown)


@wp.func
def flickering_light(
    intensity: float, t64: wp.float64, dt: float, frequency: float, depth: float, phase: float
):
    """Intensity under a lamp whose flux is 1 + depth · sin."""
    # float32 resolves no more than a quarter of a millisecond after an hour
    turns = wp.float64(frequency) * t64
    turn = float(turns - wp.floor(turns)) + phase
    _cosine, sine = cosine_and_sine(shown_turn(turn - wp.floor(turn), 0.25, frequency, dt))
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
    dt: float,
    frequency: float,
    depth: float,
    phase: float,
    region: float,
    apart: float,
    x: float,
    y: float,
):
    """Intensity under lamps whose flux is 1 + depth · sin, each a region of its own."""
    turn = turn_of_lamp(t64, frequency, phase, region, apart, x, y)
    _cosine, sine = cosine_and_sine(shown_turn(turn, 0.25, frequency, dt))
    return intensity * (1.0 + depth * sine)


@wp.func
def rectified_light(
    intensity: float,
    t64: wp.float64,
    dt: float,
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
    turn = turn_of_lamp(t64, frequency, phase, region, apart, x, y)
    half = 0.5 * shown_turn(turn, 0.5, frequency, dt)
    _cosine, sine = cosine_and_sine(half)
    return intensity * (1.0 + depth * (2.0 * wp.abs(sine) - 1.0))


@wp.func
def switched_light(
    intensity: float,
    t64: wp.float64,
    dt: float,
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
    # the middle of a part, so that the shorter one is not missed
    shown = shown_turn(turn, 0.5 * duty, frequency, dt)
    light = 1.0 + wp.where(shown < duty, depth, -depth)
    # of a part with few samples one more or less would be much to what smooths it: those at its ends show the
    # share of on and off that lies around them, in the logarithm, and those in between it alone
    step = frequency * dt
    shorter = wp.min(duty, 1.0 - duty)
    away = turn - 0.5 * duty
    on = (0.5 * duty - wp.abs(away - wp.floor(away + 0.5))) / step + 0.5
    if 2.0 * step <= shorter and shorter < 7.5 * step and on > 0.0 and on < 1.0:
        least = wp.max((1.0 - depth) / (1.0 + depth), 1.0e-6)
        light = (1.0 + depth) * exponential((1.0 - on) * logarithm(least))
    return intensity * light


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

    A scene must be sampled several times per period: moving textures and videos are, by themselves. The
    samples next to the brightest and to the darkest moment of a period show that moment: events come of the
    extremes, and are as many as in light that is sampled without end. Of a part of a period that has few
    samples, those at its ends show the share of it that lies around them.
    """

    name: ClassVar[str] = "flicker"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "IEEE Std 1789: Recommended practices for modulating current in high-brightness LEDs, 2015 "
        "(depth, frequency and waveforms of lamps: rectified mains, pulse width modulation)"
    )
    stages: ClassVar = {"light": flickering_light}
    signatures: ClassVar = (Makes("flicker", tells=True),)
    screen_limits: ClassVar = {
        "": "flicker found before a screen may be that of its backlight: it is light, and not of the camera",
    }

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
        plausible=(-0.5, 0.5),  # half a turn from both bounds, which no descent can leave
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
        # extremes are shown whatever the sampling, see `shown_turn`; in between the light runs straight, and
        # what smooths it behind feels that: the fundamental is within 3 % of the true one, 5 % where shallow
        depth = abs(self.depth)
        if self.shape == "sine":
            part = 1 / max(10, 16 * min(depth / 0.3, 1.0) ** 0.5)
        elif self.shape == "rectified":
            # of its logarithm the dip is the narrower, the deeper
            part = 1 / 16 if depth <= 0.15 else max(1 - depth, 0.05) ** 0.5 / 20
        else:  # the shorter part of a period is not to be missed
            part = min(1 / 16, self.duty / 4, (1 - self.duty) / 4)
        return part / self.frequency
