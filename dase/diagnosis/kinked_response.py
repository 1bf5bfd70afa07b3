"""Whether light goes far less far between two events below a grey: the response of v2e has a kink there.

v2e takes the logarithm of grey values of 8 bits down to 20, and below it a straight line to log(1) at 0. At
the kink that line is three times as steep as the logarithm, so just below it light goes a third as far from
one event of a pixel to the next. Nothing else makes steps smaller in the dark at once and by as much. With
the line, steps are the same on either side; no model is fitted, so that holds whatever else a simulator does.

Where corners are darker than the middle, the kink lies at the more light of the clip the nearer a corner is.
That tells a loss of light there, which nothing else shows where pixels see the logarithm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps, StepSettings
from dase.effects.linlog import Linlog
from dase.effects.vignetting import Vignetting, square_from_middle
from dase.errors import InputError
from dase.fitting.frame_steps import is_held
from dase.fitting.measurement import Measurement
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.signatures.kinds import KINK_AT_CORNERS, KINKED_RESPONSE
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

KNEE = 20 / 255
"""Grey of the kink: v2e's own, which its users do not choose."""

LOOKED_AT = StepSettings(darkest=0.005, samples=8_000_000, events=300_000)
"""Pixels, instants and events; nearly all light, for the kink is in the dark."""


@dataclass(frozen=True)
class KinkSettings:
    """When a response has a kink.

    Chosen on 23 sets of other simulators (development): it is told in 34 of 147 clips of v2e, and in none of
    681 others, of which in 174 no line left less than 0.38 of what steps differed by without it (two, through
    a lens).
    """

    levels: tuple[float, ...] = (0.25, 0.4, 0.55, 0.7, 0.85, 1.2, 1.6, 2.2, 3.0, 4.5)
    """Edges of levels of light, relative to the kink."""

    of_level: float = 100
    """Steps of a polarity at a level that count, at least."""

    dark: float = 0.85
    """Levels below that are below the kink."""

    steps: float = 200
    """Steps below the kink, at least, of both polarities."""

    longest: float = 0.05
    """Time of one that counts, at most [s]: noise and leaks grow with time."""

    ends: float = 0.1
    """Share of the steps of a level, at either end, that count as the longest and the shortest beside them in
    its mean."""

    thinned: int = 40_000
    """Steps of a polarity that tell about which loss leaves least, at most."""

    differ: float = 0.15
    """What the logarithms of means or medians of steps differ by at different levels, at least."""

    left: float = 0.33
    """Share of that which the line leaves, at most."""

    beside: float = 1.4
    """Times as bright or as dark a kink that leaves more than v2e's own."""

    losses: tuple[float, float, float] = (0.9, 0.1, 0.02)
    """Of light in the corners that are tried: from 0 to, in steps of, and in steps of about the best."""

    loss: float = 0.2
    """Loss that is told, at least: half of that seemed to be there where exposures blur edges."""

    even: float = 0.5
    """Share that the line leaves without a loss, at least, where there is one."""

    better: float = 2.5
    """Times as much as with the loss that is, at least."""

    model: float = 0.5
    """What steps of a model without either may differ by, relative to what is seen."""


KINK = KinkSettings()


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of one polarity.

    Args:
        before: Log intensity at the earlier event, shape (N,).
        after: The same at the later one.
        sign: 1 of ON events, -1 of OFF events.
        square: Of the distance of the pixel from the middle, in units of the corner's, shape (N,).
    """

    before: Array
    after: Array
    sign: int
    square: Array

    def darker_by(self, loss: float) -> _Steps:
        """Return the steps of light that is less towards the corners, see `Vignetting`."""
        less = np.log(Vignetting(loss=loss).light_at(self.square))
        return _Steps(self.before + less, self.after + less, self.sign, self.square)

    def thinned(self, most: float) -> _Steps:
        """Return so many of them at most, spread evenly."""
        every = slice(None, None, max(1, math.ceil(len(self.after) / most)))
        return _Steps(self.before[every], self.after[every], self.sign, self.square[every])


@dataclass(frozen=True)
class _Kink:
    """What steps differ by at different levels of light, the less different of the polarities.

    By means or by medians, of which the line leaves less. Steps of 8 bits are as large as a threshold in the
    dark, so that medians are not those of smooth light, and dead times and noise move means.

    Args:
        loss: Of light in the corners.
        differ: Standard deviation of the logarithms; 0 where too few steps tell.
        left: Share of that which the line leaves, of the polarity of which it leaves more.
    """

    loss: float
    differ: float
    left: float


def find_kinked_response(
    measurement: Measurement, sensor: Sensor, *, seed: int, settings: KinkSettings = KINK
) -> tuple[Signature, ...]:
    """Return the kink of the response, and that it lies at more light at the corners; nothing without one.

    Args:
        measurement: Its light is known, and not held.
        sensor: The model, taken without a knee.
        seed: Of its random numbers.
        settings: When there is a kink.
    """
    if is_held(measurement.scene):
        return ()
    light = LightBetweenEvents.of(measurement, log_eps=sensor.log_eps, settings=LOOKED_AT)
    if light is None:
        return ()
    kink_of = _kinks_of(light, light.seen, sensor.log_eps, settings)
    even = kink_of(KNEE, 0.0)
    most, step, fine = settings.losses
    rough = _kinks_of(light, light.seen, sensor.log_eps, settings, most=settings.thinned)
    best = _least(rough, np.arange(0.0, most + fine, step))
    if best.left > 2 * settings.left:
        return ()
    low, high = max(best.loss - step, 0.0), min(best.loss + step, most)
    best = _least(kink_of, np.arange(low, high + 0.5 * fine, fine))
    if best.left > settings.left:
        return ()
    beside = (kink_of(KNEE * ratio, best.loss) for ratio in (1 / settings.beside, settings.beside))
    if min(one.left for one in beside) < best.left:
        return ()
    without = sensor.without(Linlog.name) if Linlog.name in sensor else sensor
    try:
        made = light.of_model(without, seed=SimulationStream.KINKED_RESPONSE.seed(seed))
    except InputError:
        return ()
    of_model = _kinks_of(light, made, sensor.log_eps, settings)(KNEE, best.loss)
    # a model that sends too little in the dark says nothing against it
    if of_model.differ > settings.model * best.differ:
        return ()
    grey, left = round(255 * KNEE), format_percent(best.left)
    sentence = (
        f"below a grey of {grey} of 255 light goes far less far from one event of a pixel to the next, as by "
        f"the response of v2e, a line from there to 0: with it {left} is left of what steps differ by"
    )
    out = [
        Signature(
            name=KINKED_RESPONSE, answer=Answer.FOUND, p=0.0, size=KNEE, low=KNEE, high=KNEE,
            unit="intensity", sentence=sentence, details={"knee": KNEE},
        )
    ]  # fmt: skip
    is_uneven = (
        best.loss >= settings.loss
        and settings.even <= even.left < math.inf
        and even.left >= settings.better * best.left
    )
    if is_uneven and Vignetting.name not in sensor:
        out.append(_at_corners(best, even, settings))
    return tuple(out)


def _least(kink_of: Callable[[float, float], _Kink], losses: Array) -> _Kink:
    """Return the kink with the loss of light in the corners that leaves least."""
    return min((kink_of(KNEE, float(loss)) for loss in losses), key=lambda one: one.left)


def _at_corners(best: _Kink, even: _Kink, settings: KinkSettings) -> Signature:
    """Return that the kink lies at more light of the scene the nearer a corner is."""
    step = settings.losses[-1]
    lost, left, without = (format_percent(one) for one in (best.loss, best.left, even.left))
    sentence = (
        f"that grey lies at the more light of the scene the nearer a corner is, as if {lost} of it were lost "
        f"there: {left} is left then, and {without} without"
    )
    return Signature(
        name=KINK_AT_CORNERS, answer=Answer.FOUND, p=0.0, size=best.loss,
        low=max(best.loss - step, 0.0), high=min(best.loss + step, 1.0),
        unit="share of the light", least=settings.loss, sentence=sentence, details={"loss": best.loss},
    )  # fmt: skip


def _kinks_of(
    light: LightBetweenEvents,
    steps: LightSteps,
    log_eps: float,
    settings: KinkSettings,
    *,
    most: float = math.inf,
) -> Callable[[float, float], _Kink]:
    """Return what tells what is left of a kink at a grey and with a loss of light in the corners.

    Args:
        light: Of the rows that are looked at.
        steps: Between the events of these.
        log_eps: Added to intensities before the logarithm.
        settings: Which steps count.
        most: Of either polarity.
    """
    scene = light.measurement.scene
    row, column = np.divmod(steps.pixel, scene.width)
    square = square_from_middle(column, row + light.rows[0], scene.width, scene.height)
    counts = steps.counts & steps.again & (steps.gap < settings.longest)
    both, share = [], 1.0
    for sign in (1, -1):
        mine = counts & (steps.on == (sign > 0))
        after = steps.level[mine]
        whole = _Steps(after - steps.change[mine], after, sign, square[mine])
        both.append(whole.thinned(most))
        share = min(share, len(both[-1].after) / max(len(after), 1))
    few = replace(settings, steps=share * settings.steps, of_level=max(20.0, share * settings.of_level))

    def kink(knee: float, loss: float) -> _Kink:
        told = [_Levels.of(one.darker_by(loss) if loss else one, knee, log_eps, few) for one in both]
        out = _Kink(loss, 0.0, math.inf)
        if sum(one.dark for one in told) < few.steps:
            return out
        for way in range(2):
            differ = min(one.differ[way] for one in told)
            if differ < settings.differ:
                continue
            left = max(one.left[way] / one.differ[way] for one in told)
            out = min(out, _Kink(loss, differ, left), key=lambda one: one.left)
        return out

    return kink


@dataclass(frozen=True)
class _Levels:
    """What steps of a polarity differ by at different levels of light.

    Args:
        dark: How many lie below the kink.
        differ: Standard deviation of the logarithms of their means and of their medians; 0 where too few
            levels have steps.
        left: The same with the line.
    """

    dark: int
    differ: tuple[float, float]
    left: tuple[float, float]

    @classmethod
    def of(cls, steps: _Steps, knee: float, log_eps: float, settings: KinkSettings) -> _Levels:
        """Return those of steps.

        Args:
            steps: Of one polarity.
            knee: Grey of the kink.
            log_eps: Added to intensities before the logarithm.
            settings: Which count.
        """
        top, slope = math.log(knee + log_eps), math.log(max(255 * knee, 1.01))

        def line(level: Array) -> Array:
            return np.where(level > top, level, top + slope * (np.exp(np.minimum(level - top, 0.0)) - 1.0))

        edges = np.log(settings.levels)
        at = np.searchsorted(edges, 0.5 * (steps.before + steps.after) - top)
        dark, found = 0, []
        for n in range(1, len(edges)):
            mine = np.flatnonzero(at == n)
            if len(mine) < settings.of_level:
                continue
            dark += len(mine) if settings.levels[n] <= settings.dark else 0
            before, after = steps.before[mine], steps.after[mine]
            far, bent = steps.sign * (after - before), steps.sign * (line(after) - line(before))
            found.append([_typical(one, settings.ends) for one in (far, bent)])
        if len(found) < 3:
            return cls(dark, (0.0, 0.0), (0.0, 0.0))
        (far, other_far), (bent, other_bent) = np.log(np.maximum(found, 1e-3)).std(axis=0)
        return cls(dark, (float(far), float(other_far)), (float(bent), float(other_bent)))


def _typical(steps: Array, ends: float) -> tuple[float, float]:
    """Return the mean of steps whose ends count as what is beside them, and the median."""
    low, middle, high = np.quantile(steps, (ends, 0.5, 1.0 - ends))
    return float(np.clip(steps, low, high).mean()), float(middle)
