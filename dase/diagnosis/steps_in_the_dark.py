"""Whether light goes the farther from one event of a pixel to the next the darker it is, and by which law.

Between two events of a polarity a pixel's own signal goes by a threshold, in the dark as in the light. Where
a current without light adds to the photocurrent, or the response is linear below a knee, the logarithm of the
scene's light goes farther than that in the dark. So a current, or a knee, is sought with which the medians of
steps are the same at all levels of light. No model is fitted: thresholds may be any, and differ from pixel to
pixel and from event to event, and noise and leaks, which add some events to all, hardly move a median.

What else makes steps differ, frames in step with which all events come, a low-pass or a dead time, does so by
no such law: it counts only if next to nothing is left of what they differ by, and by one of the two alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps, StepSettings
from dase.effects.dark import Dark
from dase.effects.linlog import Linlog
from dase.errors import InputError
from dase.fitting.frame_steps import is_held
from dase.fitting.measurement import Measurement
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.signatures.chance import NINETY
from dase.signatures.kinds import LARGER_STEPS_IN_THE_DARK
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
    """

    before: Array
    after: Array
    sign: int
    block: NDArray[np.int64]
    _levels: dict[int, list[tuple[Array, Array]]] = field(default_factory=dict, init=False, repr=False)

    def part(self, group: int, groups: int) -> _Steps:
        """Return those of every so many blocks."""
        mine = self.block % groups == group
        return _Steps(self.before[mine], self.after[mine], self.sign, self.block[mine])

    def thinned(self, most: int) -> _Steps:
        """Return so many of them at most, spread evenly."""
        every = slice(None, None, max(1, -(-len(self.after) // most)))
        return _Steps(self.before[every], self.after[every], self.sign, self.block[every])

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
    if is_held(measurement.scene):
        return None
    light = LightBetweenEvents.of(measurement, log_eps=sensor.log_eps, settings=LOOKED_AT)
    if light is None:
        return None
    brightest = float(np.quantile(light.level(every=max(1, len(light.times) // 50)), 0.99))
    width = measurement.scene.width
    seen = _steps_of(light.seen, brightest, width, settings)
    law, differ = _law_of(seen, settings), _differ(seen, None, settings)
    chance = None if law is None else _error_of(seen, law, settings)
    if law is None or chance is None:
        return None
    for name in MAKERS:
        sensor = sensor.without(name) if name in sensor else sensor
    try:
        made = light.of_model(sensor, seed=SimulationStream.STEPS_IN_THE_DARK.seed(seed))
    except InputError:
        return None
    modelled = _steps_of(made, brightest, width, settings)
    # steps of a model that sends too few, or that differ as much by whatever law, tell nothing
    if not modelled or _differ(modelled, None, settings) > settings.model * differ:
        return None
    unit = math.exp(brightest)
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


def _steps_of(steps: LightSteps, brightest: float, width: int, settings: DarkStepSettings) -> list[_Steps]:
    """Return the steps that count, of ON and OFF events that follow one of the same polarity; none if few."""
    block = steps.blocks(width, settings.block)
    out = []
    for sign in (1, -1):
        counts = steps.counts & steps.again & (steps.gap < settings.longest) & (steps.on == (sign > 0))
        counts &= steps.level - 0.5 * steps.change > brightest + math.log(settings.darkest)
        after = steps.level[counts] - brightest
        if len(after) < settings.steps:
            return []
        out.append(_Steps(after - steps.change[counts], after, sign, block[counts]))
    return out


def _differ(steps: list[_Steps], response: Callable[[Array], Array] | None, s: DarkStepSettings) -> float:
    """Return what steps of either polarity differ by at different levels, of a response or the logarithm."""
    if not steps:
        return 0.0
    return max(one.differ(response or (lambda v: v), s.bins) for one in steps)


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


def _fit(steps: list[_Steps], name: str, settings: DarkStepSettings) -> _Law:
    """Return the size of a current or a knee with which steps differ least."""
    low, high = settings.range_of(name)

    def left(log: float, of: list[_Steps] = steps) -> float:
        return _differ(of, LAWS[name](math.exp(log)), settings)

    # where the least is, few steps tell; what it is, all do
    few = [one.thinned(settings.thinned) for one in steps]
    tried = np.linspace(math.log(low), math.log(high), settings.looks)
    begin = int(np.argmin([left(one, few) for one in tried]))
    ends = tried[max(begin - 1, 0)], tried[min(begin + 1, len(tried) - 1)]
    found = minimize_scalar(left, bounds=ends, method="bounded", options={"xatol": 0.01})
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
