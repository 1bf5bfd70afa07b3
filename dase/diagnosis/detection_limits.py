"""What a recording would have shown: the smallest strength of each effect that was not found.

"Not found" says nothing without it: a recording of half a second at rest shows no refractory period, however
long. So the effect is simulated in the last model at strengths that close in on the least one that is seen,
where what the free parameters could do as well is taken out, and what the last model leaves stays in: the
error and the deviation that the measurement would have had then go through the rules by which effects are
graded.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.candidates import effects_to_try, variants_to_try
from dase.diagnosis.directional_test import RepeatCloud
from dase.diagnosis.grading import grade_of
from dase.diagnosis.settings import DiagnosisSettings
from dase.diagnosis.state import DiagnosisTask, explains_remainder
from dase.effects.base import Effect
from dase.fitting.model import FittedModel, with_effect_added
from dase.fitting.parameter_space import SearchAxis
from dase.fitting.scene_doubt import misfit_beyond_chance
from dase.fitting.scheduler import SimulationRequest, Work, run_side_by_side
from dase.fitting.subset import CalibratedSubset
from dase.fitting.trial_sampling import samples_of_screening, samples_per_step
from dase.formatting import format_metric
from dase.probes.distance import (
    Judgement,
    compared_in_standard_errors,
    in_standard_errors,
    leaves_nothing,
    pseudo_huber,
    reaches_floor,
)
from dase.probes.random_streams import SimulationStream
from dase.probes.statistics import LAYOUT
from dase.results import DetectionLimit, Grade

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ReportedModel:
    """The last model on the part that reports, and what makes a synthetic measurement of it.

    Args:
        half: With the model as its present one.
        model: The last one of the search.
        start: Error of the model before the search.
        last: Error of the last model.
        absorbed: An orthonormal base of what the free parameters can do, in standard errors, shape (J, P).
        misfit: What the model is off by beyond chance, with its sign, shape (J,).
        cloud: Repeats of the model, of the statistics that are compared, with the doubt of the scene.
    """

    half: CalibratedSubset
    model: FittedModel
    start: Judgement
    last: Judgement
    absorbed: Array
    misfit: Array
    cloud: RepeatCloud

    @cached_property
    def compared(self) -> dict[str, NDArray[np.int64]]:
        """Places of the statistics that are compared, by family, shape (K,) each; only families with any."""
        used = self.half.seen.used
        places = {name: part.start + np.flatnonzero(used[part]) for name, part in LAYOUT.items()}
        return {name: at for name, at in places.items() if len(at)}


def find_detection_limits(
    task: DiagnosisTask,
    model: FittedModel,
    report: CalibratedSubset,
    start: Judgement,
    last: Judgement,
    named: Collection[str],
) -> tuple[DetectionLimit, ...]:
    """Return for each effect that is not found the smallest strength that would have been.

    Args:
        task: What the diagnosis is asked.
        model: The last one.
        report: The part that reports, with `model` as its present one.
        start: Error of the model before the search.
        last: Error of the last model.
        named: Effects that are found, or named as what comes nearest.
    """
    asked = list[tuple[Effect, SearchAxis, str]]()
    for name in effects_to_try(task.effects, model):
        if name in named:
            continue
        tried = variants_to_try(task.evidence, task.effects[name], idle_bus=task.settings.candidates.idle_bus)
        # the events show by themselves that there is none
        if not tried or (axis := main_axis(model, tried[0])) is None:
            continue
        # event by event through a readout, one effect would take as long as the whole search
        if report.streams(with_effect_added(model, tried[0]).space):
            continue
        asked.append((tried[0], axis, _rule_of_first(tried)))
    if not asked:
        return ()
    known = _reported_model(task, model, report, start, last)
    works = [_limit_work(task, known, effect, axis) for effect, axis, _ in asked]
    # a few at a time: all of them side by side would hold the events of hundreds of simulations
    size, places = task.settings.detection.side_by_side, list[float | None]()
    for n in range(0, len(works), size):
        task.progress("what would have been seen", n / len(works), last.error)
        places += run_side_by_side(works[n : n + size])
    return tuple(
        describe_limit(effect, axis, place, rule)
        for (effect, axis, rule), place in zip(asked, places, strict=True)
    )


def main_axis(model: FittedModel, effect: Effect) -> SearchAxis | None:
    """Return the parameter that makes an effect strong; None where that is not fitted."""
    axes = with_effect_added(model, effect).space.axes
    mine = [axis for axis in axes if axis.effect is type(effect) and axis.main]
    return mine[0] if mine else None


def _rule_of_first(variants: Sequence[Effect]) -> str:
    """Return which of the rules of an effect the first of its variants follows; empty where it has one only.

    A limit holds for that rule alone: a dead time in which the memory follows the light is seen far less.
    """
    first = variants[0]
    names = [name for name in first.choices() if len({getattr(one, name) for one in variants}) > 1]
    return ", ".join(getattr(first, name) for name in names)


def describe_limit(effect: Effect, axis: SearchAxis, place: float | None, rule: str = "") -> DetectionLimit:
    """Return a limit in words.

    Args:
        effect: Which one.
        axis: Of its strength.
        place: Of the smallest strength that would have been seen; None for none.
        rule: Of the effect for which that holds; empty where it has one only.
    """
    above = _rises(axis)
    weak, strong = _range_of(axis)
    unit = "" if axis.fact.unit == "1" else axis.fact.unit
    words = axis.name.replace(".", " ") + (f" ({rule})" if rule else "")
    side = "above" if above else "below"
    end = _number(float(axis.to_value(strong)), unit)
    if place is None:
        sentence = f"no {words} up to {end} would have been seen" if above else (
            f"no {words} down to {end} would have been seen"
        )  # fmt: skip
        return DetectionLimit(effect.name, axis.name, None, axis.fact.unit, above, sentence)
    value = float(axis.to_value(place))
    least = " (the least that was tried)" if place == weak else ""
    sentence = f"{words} {side} {_number(value, unit)} would have been seen{least}"
    return DetectionLimit(effect.name, axis.name, value, axis.fact.unit, above, sentence)


def _number(value: float, unit: str) -> str:
    return format_metric(value, unit) if unit in ("Hz", "s") else f"{value:.2g} {unit}".strip()


def _rises(axis: SearchAxis) -> bool:
    """Whether the effect is stronger where the value is higher."""
    off = axis.fact.off
    return off is not None and off <= axis.low


def _range_of(axis: SearchAxis) -> tuple[float, float]:
    """Return the places of the weakest strength that is tried and of the strongest."""
    low, high = axis.bounds()
    far = float(axis.to_place(axis.fact.plausible[1])), float(axis.to_place(axis.fact.plausible[0]))
    return (low, far[0]) if _rises(axis) else (high, far[1])


def _reported_model(
    task: DiagnosisTask, model: FittedModel, half: CalibratedSubset, start: Judgement, last: Judgement
) -> ReportedModel:
    hidden, count = task.settings.hidden, task.settings.hidden.repeats_of_mean
    tight = [axis.of_threshold for axis in model.space.axes]
    reach = np.diag(np.where(tight, hidden.threshold_reach, hidden.reach))
    sides = np.concatenate([model.place + reach, model.place - reach])
    frame = np.zeros((len(half.scale.target), 0))
    if tight:  # something is free
        seeds = [SimulationStream.DIRECTIONS.seed(task.seed, n) for n in range(count)]
        plus, minus = np.split(np.mean([half.run(model.space, sides, seed=one) for one in seeds], 0), 2)
        frame = np.linalg.qr(in_standard_errors(plus - minus, half.seen).T)[0]
    off = half.scale.target - half.repeats.mean(0)
    doubt = misfit_beyond_chance(half)
    misfit = np.where(half.seen.used, np.sign(off) * np.minimum(np.abs(off), doubt), 0.0)
    cloud = RepeatCloud(
        compared_in_standard_errors(half.repeats - half.repeats.mean(0), half.chance),
        hidden.most_of_one,
        doubt=compared_in_standard_errors(doubt, half.chance),
        drift=None if half.drift is None else compared_in_standard_errors(half.drift, half.chance),
    )
    return ReportedModel(half, model, start, last, frame, misfit, cloud)


def _limit_work(
    task: DiagnosisTask, known: ReportedModel, effect: Effect, axis: SearchAxis
) -> Work[float | None]:
    """Return the place of the smallest strength that is seen; None where not even the largest is."""
    settings = task.settings.detection
    other = with_effect_added(known.model, effect)
    column = [a.name for a in other.space.axes].index(axis.name)
    weak, strong = _range_of(axis)
    seeds = [SimulationStream.DETECTION.seed(task.seed, n) for n in range(settings.repeats)]
    # models that need more samples than the last one share them with no others: they fill a CPU's lanes alone
    slow = known.half.slow(other.space) and not known.half.slow(known.model.space)
    places = np.linspace(weak, strong, (settings.strengths_at_once if slow else settings.strengths) + 1)
    # what an effect does is a difference between two strengths that are sampled alike
    step = known.half.frame.step
    strongest = other.place.copy()
    strongest[column] = strong
    most = samples_of_screening(known.model.sensor, step)
    finer = min(samples_per_step(other.space.at(strongest), step), most) or None

    def simulated_work(strengths: Array) -> Work[Array]:
        """Return the statistics at some strengths, shape (S, R, J) for R repeats."""
        places = np.repeat(other.place[None], len(strengths), 0)
        places[:, column] = strengths
        # all strengths see the same random numbers, so that few repeats tell them apart
        values = yield [
            SimulationRequest(known.half, other.space, places, seed, most=most, finer=finer) for seed in seeds
        ]
        return np.stack(values, 1)

    # measurements are repeats of the last model, to which what the effect did in one repeat is added: which
    # pixels are hot is chance, too
    chance = known.half.repeats[: settings.measurements]
    mine = np.arange(len(chance)) % settings.repeats

    def is_seen(done: Array) -> bool:
        return float(np.mean(would_be_seen(known, chance + done[mine], task.settings))) >= settings.power

    # what the effect does to events by its place in the kernel alone, however weak it is, is not its strength
    nothing, *found = yield from simulated_work(places if slow else places[:2])
    first = 1
    # the strongest send most events, and take longest
    while not is_seen(found[first - 1] - nothing):
        first += 1
        if first == len(places):
            return None
        if first > len(found):
            found += list((yield from simulated_work(places[first : first + 1])))
    done = [nothing - nothing, *(one - nothing for one in found)]
    low, high, below, above = places[first - 1], places[first], done[first - 1], done[first]
    turns = 1 if slow else settings.turns
    for turn in range(turns):
        share = _least_share(is_seen, below, above, settings.halvings)
        middle = float(low + share * (high - low))
        if turn == turns - 1 or share == 1.0:
            return middle
        # between two strengths what they do hardly bends; where it does, the next look tells
        here = (yield from simulated_work(np.array([middle])))[0] - nothing
        if is_seen(here):
            high, above = middle, here
        else:
            low, below = middle, here
    return float(high)


def _least_share(is_seen: Callable[[Array], bool], below: Array, above: Array, halvings: int) -> float:
    """Return the least share of the way between what two strengths do that is seen; the whole way is."""
    low, high = 0.0, 1.0
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_seen(below + middle * (above - below)) else (middle, high)
    return high


def would_be_seen(known: ReportedModel, values: Array, settings: DiagnosisSettings) -> NDArray[np.bool_]:
    """Return whether a diagnosis would have named an effect in measurements with these statistics, (R,).

    Args:
        known: The last model.
        values: Of simulations with the effect, shape (R, J).
        settings: Of the diagnosis.
    """
    half, last, cloud = known.half, known.last, known.cloud
    apart = in_standard_errors(values - half.repeats.mean(0), half.seen)
    # the free parameters give way to the effect before anything is missing
    apart = apart - (apart @ known.absorbed) @ known.absorbed.T
    used = half.chance.used
    ratio = half.seen.sigma / half.chance.sigma
    weights = half.seen.weights()
    rho = pseudo_huber(apart + in_standard_errors(known.misfit, half.seen))
    errors = rho @ weights / last.unit
    families = {name: rho[:, at].mean(1) / last.unit for name, at in known.compared.items()}
    # the way is that of the other measurements: its own chance would make each lie on it
    ways = (apart.sum(0) - apart) / max(len(apart) - 1, 1)
    deviations = cloud.deviations_along(cloud.clipped((ways * ratio)[:, used]), (apart * ratio)[:, used])
    out = np.zeros(len(values), np.bool_)
    for n, deviation in enumerate(deviations.tolist()):
        without = replace(
            last, error=float(errors[n]), families={name: float(of[n]) for name, of in families.items()}
        )
        # where the scene is guessed a closer look is always taken
        closer = half.doubt is not None and deviation >= settings.hidden.away
        looked = closer or would_be_added(last, without, settings)
        start = max(known.start, without, key=lambda judged: judged.error)
        grade, _ = grade_of(start, without, last, deviation, has_rivals=False, settings=settings.grades)
        out[n] = looked and grade is not Grade.STAND_IN
    return out


def would_be_added(last: Judgement, without: Judgement, settings: DiagnosisSettings) -> bool:
    """Whether a search would add an effect: the same rules by which it adds the best of its candidates.

    Args:
        last: Error of the model with the effect.
        without: Error of the model without it.
        settings: Of the diagnosis.
    """
    if leaves_nothing(without):
        return False
    if reaches_floor(without):
        return explains_remainder(last, without, settings)
    fall = without.error - last.error
    return fall >= settings.material and fall >= settings.share * (without.error - 1.0)
