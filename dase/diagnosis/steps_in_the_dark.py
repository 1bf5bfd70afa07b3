"""Whether light goes the farther from one event of a pixel to the next the darker it is, and by which law.

Between two events of a polarity a pixel's own signal goes by a threshold, in the dark as in the light. Where
a current without light adds to the photocurrent, or the response is linear below a knee, the logarithm of the
scene's light goes farther than that in the dark. So a current, or a knee, is sought with which the medians of
steps are the same at all levels of light. No model is fitted: thresholds may be any, and differ from pixel to
pixel and from event to event, and noise and leaks, which add some events to all, hardly move a median.

What else makes steps differ, frames in step with which all events come, a low-pass or a dead time, does so by
no such law: it counts only if next to nothing is left of what they differ by, and by one of the two alone.

Where corners get less light than the scene has, the same current is more of it there. So the current that a
ring of pixels around the middle needs tells how much light reaches it: nothing else of a pixel that sees the
logarithm does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps, StepSettings
from dase.effects.dark import Dark
from dase.effects.linlog import Linlog
from dase.effects.vignetting import Vignetting
from dase.errors import InputError
from dase.fitting.frame_steps import is_held
from dase.fitting.measurement import Measurement
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.signatures.chance import NINETY
from dase.signatures.kinds import CURRENT_AT_CORNERS, LARGER_STEPS_IN_THE_DARK
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

EFFECT_OF_WAY = {"current": (Dark.name, "current"), "knee": (Linlog.name, "knee")}
"""Detail of the signature to the effect that it tells of, and its parameter."""

MAKERS = tuple(effect for effect, _ in EFFECT_OF_WAY.values())

LOOKED_AT = StepSettings(darkest=0.015, samples=8_000_000, events=300_000)
"""Pixels, instants and events; light far below that of steps that count, or these would be the short ones."""


@dataclass(frozen=True)
class DarkStepSettings:
    """When steps are larger in the dark.

    Chosen on six sets of other simulators (development).
    """

    darkest: float = 0.06
    """Middle of a step that counts, relative to the brightest light, at least."""

    bins: int = 8
    """Levels of light, with as many steps in each."""

    least: float = 0.012
    """What the medians of steps differ by at different levels, relative, at least."""

    left: float = 0.25
    """Share of that which stays beside the current or the knee, at most."""

    decided: float = 2.0
    """Times as much that stays beside the other of the two, at least."""

    current: tuple[float, float] = (0.004, 2.0)
    """Currents that are looked for, relative to the brightest light."""

    knee: tuple[float, float] = (0.04, 0.8)
    """Knees that are."""

    looks: int = 24
    """At either, to begin with."""

    thinned: int = 24_000
    """Steps of either polarity for these, at most."""

    steps: int = 2000
    """Of either polarity, at least."""

    longest: float = 0.05
    """Time of one that counts, at most [s]: noise and leaks grow with time."""

    model: float = 0.5
    """What steps of a model without either may differ by, relative to what is seen."""

    groups: int = 8
    """Of blocks of pixels, which tell how well a size is known; half of them must have enough steps."""

    of_group: int = 200
    """Steps of either polarity that a group has, at least."""

    block: int = 8
    """[px] Neighbours see the same edges: blocks are independent, pixels are not."""

    ends: float = 0.02
    """Share by which a size must be away from the ends of what is looked for."""

    known: float = 0.08
    """Error of a size beside chance, relative: light between frames is a guess. Six were 1 to 6 % off."""

    rings: int = 5
    """Around the middle, with as many steps in each."""

    bins_of_ring: int = 6
    """Levels of light in each."""

    left_of_ring: float = 0.1
    """Share of what medians of a ring differ by that stays beside its current, at most: 0.003 to 0.07 where
    corners were darker, 0.32 in the middle of a scene in which something else made steps differ there
    (sealed: a loss of 0.7, certain and wrong)."""

    of_part: int = 60
    """Steps of either polarity of a group of a ring, at least."""

    current_of_ring: tuple[float, float] = (0.67, 5.0)
    """Currents of a ring that are looked for, relative to that of all."""

    sure: float = 0.02
    """Error of the current of a ring beside chance, relative: 0.1 to 0.6 % in five clips whose corners get
    all light."""

    by_chance: float = 0.013
    """Error of the current of a ring by chance, at most, relative, of half of the rings: where currents
    differ from pixel to pixel, the few that see most of the dark decide a ring."""

    deviations: float = 5.0
    """By which rings must differ as with corners that are darker."""

    losses: tuple[float, float] = (0.15, 0.86)
    """Of light in the corners that are told."""

    known_loss: float = 0.12
    """Error of a loss: one of 0.33 that grows with the fourth power of the distance was read as 0.26."""

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the least and the largest size of a law that is looked for."""
        return self.current if name == "current" else self.knee


DARK_STEPS = DarkStepSettings()


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of one polarity.

    Args:
        before: Log intensity less that of the brightest light, at the earlier event, shape (N,).
        after: The same at the later one.
        sign: 1 of ON events, -1 of OFF events.
        block: Of the pixel, shape (N,).
        square: Of the distance of the pixel from the middle, in units of the corner's, shape (N,).
    """

    before: Array
    after: Array
    sign: int
    block: NDArray[np.int64]
    square: Array
    _levels: dict[int, list[tuple[Array, Array]]] = field(default_factory=dict, init=False, repr=False)

    def select(self, some: NDArray[np.bool_] | slice) -> _Steps:
        """Return some of them."""
        return _Steps(self.before[some], self.after[some], self.sign, self.block[some], self.square[some])

    def part(self, group: int, groups: int) -> _Steps:
        """Return those of every so many blocks."""
        return self.select(self.block % groups == group)

    def thinned(self, most: int) -> _Steps:
        """Return so many of them at most, spread evenly."""
        return self.select(slice(None, None, max(1, -(-len(self.after) // most))))

    def differ(self, response: Callable[[Array], Array], bins: int) -> float:
        """Return what the medians of steps of a response differ by at different levels, relative.

        Infinite where a level has no steps: the light of many is the same.
        """
        levels = self._by_level(bins)
        if not levels:
            return math.inf
        medians = np.array(
            [np.median(self.sign * (response(after) - response(before))) for before, after in levels]
        )
        mean = float(medians.mean())
        return float(medians.std()) / mean if mean > 0 else math.inf

    def _by_level(self, bins: int) -> list[tuple[Array, Array]]:
        """Return the levels of light before and after the steps of each of some levels; none if one is empty.

        Found once, for the same steps are looked at with many responses.
        """
        if bins not in self._levels:
            level = self.before + self.after
            edges = np.quantile(level, np.arange(1, bins) / bins) if len(level) else np.zeros(bins - 1)
            at = np.searchsorted(edges, level)
            mine = [np.flatnonzero(at == n) for n in range(bins)]
            full = min(len(one) for one in mine) > 0
            self._levels[bins] = [(self.before[one], self.after[one]) for one in mine] if full else []
        return self._levels[bins]


@dataclass(frozen=True)
class _Law:
    """How the response departs from the logarithm.

    Args:
        name: One of `LAWS`.
        size: Of the current or the knee, relative to the brightest light.
        left: What steps of that response differ by at different levels, relative.
    """

    name: str
    size: float
    left: float


def _with_current(size: float) -> Callable[[Array], Array]:
    return lambda v: np.log(np.exp(v) + size)


def _with_knee(size: float) -> Callable[[Array], Array]:
    top = math.log(size)
    return lambda v: np.where(v > top, v, top + np.exp(np.minimum(v - top, 0.0)) - 1)


LAWS = {"current": _with_current, "knee": _with_knee}


def find_larger_steps_in_the_dark(
    measurement: Measurement,
    sensor: Sensor,
    *,
    seed: int,
    settings: DarkStepSettings = DARK_STEPS,
) -> Signature | None:
    """Return by which current or knee steps are larger in the dark; None where they are not, or by neither.

    Args:
        measurement: Its light is known, and not held.
        sensor: The model, taken without either.
        seed: Of its random numbers.
        settings: When steps are larger.
    """
    found = _DarkSteps.of(measurement, sensor, settings)
    if found is None or found.shown_by_model(sensor, seed, settings):
        return None
    law, differ, chance, unit = found.law, found.differ, found.chance, math.exp(found.light.brightest)
    # light is known with `log_eps` added to it: a current comes on top of that, a knee lies above it
    size = unit * law.size - (sensor.log_eps if law.name == "knee" else 0.0)
    error = math.hypot(NINETY * unit * chance, settings.known * size)
    what = "a current without light" if law.name == "current" else "a response that is linear below a knee"
    then, at_once = format_percent(law.left), format_percent(differ)
    sentence = (
        f"light goes the farther from one event of a pixel to the next the darker it is, as with {what} of "
        f"{size:.3g}: medians then differ by {then}, and by {at_once} without"
    )
    return Signature(
        name=LARGER_STEPS_IN_THE_DARK, answer=Answer.FOUND, p=0.0, size=size, low=max(size - error, 0.0),
        high=size + error, unit="intensity", least=settings.range_of(law.name)[0] * unit, sentence=sentence,
        details={law.name: size},
    )  # fmt: skip


@dataclass(frozen=True)
class _DarkSteps:
    """Steps that are larger in the dark.

    Args:
        light: Of the measurement.
        steps: Of either polarity.
        law: By which they are larger.
        differ: What their medians differ by at different levels, relative.
        chance: Standard error of the size of the law, relative to the brightest light.
    """

    light: LightBetweenEvents
    steps: list[_Steps]
    law: _Law
    differ: float
    chance: float

    @classmethod
    def of(cls, measurement: Measurement, sensor: Sensor, settings: DarkStepSettings) -> _DarkSteps | None:
        """Return those of a measurement; None where they are not larger, or by neither law."""
        if is_held(measurement.scene):
            return None
        light = LightBetweenEvents.of(measurement, log_eps=sensor.log_eps, settings=LOOKED_AT)
        if light is None:
            return None
        steps = _steps_of(light, light.seen, sensor, settings)
        law = _law_of(steps, settings)
        chance = None if law is None else _error_of(steps, law, settings)
        if law is None or chance is None:
            return None
        return cls(light, steps, law, _differ(steps, None, settings), chance)

    def shown_by_model(self, sensor: Sensor, seed: int, settings: DarkStepSettings) -> bool:
        """Return whether a model without current and knee shows half as much, or cannot be simulated."""
        for name in MAKERS:
            sensor = sensor.without(name) if name in sensor else sensor
        try:
            made = self.light.of_model(sensor, seed=SimulationStream.STEPS_IN_THE_DARK.seed(seed))
        except InputError:
            return True
        # steps of a model that sends too few, or that differ as much by whatever law, tell nothing
        modelled = _steps_of(self.light, made, sensor, settings)
        return not modelled or _differ(modelled, None, settings) > settings.model * self.differ


def find_current_at_corners(
    measurement: Measurement, sensor: Sensor, *, seed: int, settings: DarkStepSettings = DARK_STEPS
) -> Signature | None:
    """Return the loss of light at the corners by which the current is more of it there; None where it is not.

    Args:
        measurement: Its light is known, and not held.
        sensor: The model, without darker corners, a current and a knee.
        seed: Of its random numbers.
        settings: When it is.
    """
    found = _DarkSteps.of(measurement, sensor, settings)
    if found is None or found.law.name != "current" or found.shown_by_model(sensor, seed, settings):
        return None
    edges = np.quantile(
        np.concatenate([one.square for one in found.steps]), np.arange(1, settings.rings) / settings.rings
    )
    rings = [
        [one.select(np.searchsorted(edges, one.square) == ring) for one in found.steps]
        for ring in range(settings.rings)
    ]
    told = [_current_of(ring, found.law.size, settings) for ring in rings]
    currents = np.array([one for one in told if one is not None])
    if len(currents) < len(rings):
        return None
    square = np.array([np.concatenate([one.square for one in ring]).mean() for ring in rings])
    chance = currents[:, 1]
    loss, deviations = _loss_of(square, currents[:, 0], np.hypot(chance, settings.sure))
    low, high = settings.losses
    if not low <= loss <= high or deviations < settings.deviations or np.median(chance) > settings.by_chance:
        return None
    sentence = (
        f"a current without light is the more of the scene's light the nearer a corner is, as if "
        f"{format_percent(loss)} of it were lost there: {currents[-1, 0] / currents[0, 0]:.2f} times as much "
        "in the outermost fifth of the steps as in the innermost"
    )
    return Signature(
        name=CURRENT_AT_CORNERS, answer=Answer.FOUND, p=0.0, size=loss,
        low=max(loss - settings.known_loss, 0.0),
        high=min(loss + settings.known_loss, 1.0), unit="share of the light", least=low, sentence=sentence,
        details={"loss": loss},
    )  # fmt: skip


def _current_of(
    ring: Sequence[_Steps], current: float, settings: DarkStepSettings
) -> tuple[float, float] | None:
    """Return the current with which steps of a ring differ least, and its error, relative.

    None for too few, and where they differ by something else.

    Args:
        ring: Its steps, of either polarity.
        current: With which those of all rings do, relative to the brightest light.
        settings: How it is looked for.
    """
    ends = (current * settings.current_of_ring[0], current * settings.current_of_ring[1])
    parts = [[one.part(n, settings.groups) for one in ring] for n in range(settings.groups)]
    parts = [part for part in parts if min(len(one.after) for one in part) >= settings.of_part]
    if 2 * len(parts) < settings.groups:
        return None
    bins = settings.bins_of_ring
    whole, *found = (_fit(of, "current", settings, ends, bins) for of in (ring, *parts))
    if whole.left > settings.left_of_ring * _differ(ring, None, settings, bins):
        return None
    logs = np.log([one.size for one in found if math.isfinite(one.left)])
    if 2 * len(logs) < settings.groups:
        return None
    return whole.size, float(np.std(logs, ddof=1)) / math.sqrt(len(logs))


def _loss_of(square: Array, currents: Array, errors: Array) -> tuple[float, float]:
    """Return the loss of light in the corners that currents of rings tell, and by how much [deviations].

    Args:
        square: Of the distance of rings from the middle, in units of the corner's, shape (R,).
        currents: With which their steps are alike, shape (R,).
        errors: Of these, relative, shape (R,).
    """
    weights = errors**-2.0

    def off(loss: float) -> float:
        less = np.log(currents) + np.log(Vignetting(loss=loss).light_at(square))
        return float((weights * (less - np.average(less, weights=weights)) ** 2).sum())

    found = minimize_scalar(off, bounds=(0.0, 0.95), method="bounded")
    return float(found.x), math.sqrt(max(off(0.0) - float(found.fun), 0.0))


def _steps_of(
    light: LightBetweenEvents,
    steps: LightSteps,
    sensor: Sensor,
    settings: DarkStepSettings,
) -> list[_Steps]:
    """Return the steps that count, of ON and OFF events that follow one of the same polarity; none if few.

    Behind the corners of a sensor that has darker ones.
    """
    brightest, square = light.brightest, light.square_from_middle(steps)
    block = steps.blocks(light.measurement.scene.width, settings.block)
    less = np.zeros(len(square))
    for effect in sensor.effects:
        if isinstance(effect, Vignetting):
            less = np.log(effect.light_at(square))
    out = []
    for sign in (1, -1):
        counts = steps.counts & steps.again & (steps.gap < settings.longest) & (steps.on == (sign > 0))
        counts &= steps.level - 0.5 * steps.change > brightest + math.log(settings.darkest)
        after = steps.level[counts] - brightest + less[counts]
        if len(after) < settings.steps:
            return []
        out.append(_Steps(after - steps.change[counts], after, sign, block[counts], square[counts]))
    return out


def _differ(
    steps: Sequence[_Steps],
    response: Callable[[Array], Array] | None,
    s: DarkStepSettings,
    bins: int | None = None,
) -> float:
    """Return what steps of either polarity differ by at different levels, of a response or the logarithm."""
    if not steps:
        return 0.0
    return max(one.differ(response or (lambda v: v), bins or s.bins) for one in steps)


def _law_of(steps: list[_Steps], settings: DarkStepSettings) -> _Law | None:
    """Return the law by which steps are larger in the dark; None where they are not, or by neither of two."""
    differ = _differ(steps, None, settings)
    if not settings.least <= differ < math.inf:
        return None
    best, other = sorted((_fit(steps, name, settings) for name in LAWS), key=lambda one: one.left)
    if best.left > settings.left * differ or other.left < settings.decided * best.left:
        return None
    low, high = settings.range_of(best.name)
    return best if low * (1 + settings.ends) < best.size < high * (1 - settings.ends) else None


def _fit(
    steps: Sequence[_Steps],
    name: str,
    settings: DarkStepSettings,
    ends: tuple[float, float] | None = None,
    bins: int | None = None,
) -> _Law:
    """Return the size of a current or a knee with which steps differ least.

    Args:
        steps: Of either polarity.
        name: One of `LAWS`.
        settings: How it is looked for.
        ends: Sizes between which it is; None for those of the law.
        bins: Levels of light; None for as many as usual.
    """
    low, high = ends or settings.range_of(name)

    def left(log: float, of: Sequence[_Steps] = steps) -> float:
        return _differ(of, LAWS[name](math.exp(log)), settings, bins)

    # where the least is, few steps tell; what it is, all do
    few = [one.thinned(settings.thinned) for one in steps]
    tried = np.linspace(math.log(low), math.log(high), settings.looks)
    begin = int(np.argmin([left(one, few) for one in tried]))
    near = tried[max(begin - 1, 0)], tried[min(begin + 1, len(tried) - 1)]
    found = minimize_scalar(left, bounds=near, method="bounded", options={"xatol": 0.01})
    at, least = min((left(tried[begin]), float(tried[begin])), (float(found.fun), float(found.x)))[::-1]
    return _Law(name, math.exp(at), least)


def _error_of(steps: list[_Steps], law: _Law, settings: DarkStepSettings) -> float | None:
    """Return the standard error of a size, by those of groups of blocks, relative to the brightest light.

    None where too few groups have enough steps.
    """
    parts = ([one.part(n, settings.groups) for one in steps] for n in range(settings.groups))
    parts = (part for part in parts if min(len(one.after) for one in part) >= settings.of_group)
    found = [_fit(part, law.name, settings) for part in parts]
    sizes = [one.size for one in found if math.isfinite(one.left)]
    if 2 * len(sizes) < settings.groups:
        return None
    return float(np.std(sizes, ddof=1)) / math.sqrt(len(sizes))
