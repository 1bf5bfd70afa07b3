"""How sure a diagnosis is of each effect that it put into a model.

The search chooses by pixels that fit and pixels that select. What is said in the end is judged by a third
part, by which nothing was chosen. Each effect has to earn its grade there:

- *supported*: the measurement is away from the model without the effect, along the way that the effect goes,
  by more than chance and the misfit that stays could make, or so far that next to nothing of it is left with
  the effect; without it several times as much is left, however
  well the rest is fitted again; nothing else does nearly as well in its place; and of the error of the model
  before the search next to nothing is left.
- *either ... or*: the same, but another effect does nearly as well in its place, or so little was there to be
  explained that something which is not in the library could look like it, or it had to go to an end of what
  it can be, beyond all that is plausible: shot noise that is all ON is another effect. So is it with a dead
  time far shorter than the steps in which light is known: a memory that is set a little later looks like it.
  So is it with one shorter than a frame of a clip that holds its frames.
  A jitter or mismatch of less than 3 % is in doubt, too, and so is a larger one beside a dead time: a world
  that looks for crossings at steps of time makes it when a dead time ends, or by how far beyond the threshold
  a memory is set.

- *either* it *or* something unknown, too, where much is left of the error, if half of what is left without
  it at least goes with it.

An effect that earns none of these is a stand-in: it is named as what comes nearest, and not found.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.candidates import Candidate
from dase.diagnosis.directional_test import deviation_towards
from dase.diagnosis.settings import GradeSettings
from dase.diagnosis.state import DiagnosisTask, SearchPath, with_same_freedom
from dase.effects.optics_blur import OpticsBlur
from dase.fitting.early_stopping import CandidateRace
from dase.fitting.measurement import with_lens
from dase.fitting.model import FittedModel, refit_work
from dase.fitting.scene_doubt import misfit_beyond_chance
from dase.fitting.scheduler import run_side_by_side
from dase.fitting.subset import CalibratedSubset
from dase.probes.distance import LIMITS, Judgement, may_be_announced
from dase.probes.random_streams import SimulationStream
from dase.results import Estimate, Finding, Grade

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ModelOnReport:
    """A model and its error on the part that reports."""

    model: FittedModel
    judgement: Judgement


def judge_on_report(
    task: DiagnosisTask, models: Sequence[FittedModel], *, repeats: int
) -> list[ModelOnReport]:
    """Return the errors of models on the part by which nothing is chosen."""
    stream = SimulationStream.JUDGE.seed(task.seed)
    works = [m.judgement_work(task.evidence.report, repeats=repeats, seed=stream) for m in models]
    return [ModelOnReport(m, j) for m, j in zip(models, run_side_by_side(works), strict=True)]


def grade_effects(
    task: DiagnosisTask,
    path: SearchPath,
    model: FittedModel,
    found: Sequence[str],
    way: Mapping[frozenset[str], ModelOnReport],
    start: ModelOnReport,
    last: Judgement,
    *,
    report: CalibratedSubset,
    values: Mapping[str, Estimate],
    at_bounds: Sequence[str],
    complete: bool = True,
) -> dict[str, Finding]:
    """Return what is to be said of each effect that a search has added.

    Args:
        task: What the diagnosis is asked.
        path: What did nearly as well as an effect when it was added.
        model: With all effects.
        found: Their names, in the order in which they are announced.
        way: Models of the search by what they had added.
        start: The model before the search.
        last: The error of `model` on the part that reports.
        report: That part, with `model` as its present one.
        values: Estimates of its parameters.
        at_bounds: Sentences on parameters that ended where their search does.
        complete: Whether the library has what the events show: else what is left of a large error may be most
            of what the effect stands in for.
    """
    if not found:
        return {}
    settings = task.settings.grades
    mine = {n: {axis: v for axis, v in values.items() if axis.split(".")[0] == n} for n in found}
    if not leaves_little(start.judgement, last, settings):
        # whatever is left without them, none is found
        alone = _left_without(task, model, found, {frozenset(): start, **way})
        return {
            name: Finding(
                name, Grade.STAND_IN, error_without=alone[name], error_with=last.error, parameters=mine[name]
            ) for name in found
        }  # fmt: skip
    without = _models_without(task, model, found, {frozenset(): start, **way})
    misfit = misfit_beyond_chance(report)
    deviations = {
        name: deviation_towards(task, task.evidence.report, without[name].model, model, doubt=misfit)
        for name in found
    }

    def graded(name: str, has_rivals: bool) -> tuple[Grade, bool]:
        bare = without[name].judgement
        return grade_of(
            start.judgement, bare, last, deviations[name], has_rivals=has_rivals, complete=complete,
            settings=settings,
        )  # fmt: skip

    step = float(np.median(np.diff(task.evidence.when)))
    shortest = max(settings.shortest_time * step, task.frame_held)
    grades = {name: graded(name, False) for name in found}
    shown = [name for name, (grade, _) in grades.items() if grade is not Grade.STAND_IN]
    rivals = _equally_good_rivals(task, path, model, shown, {name for name in shown if grades[name][1]})
    out: dict[str, Finding] = {}
    for name in found:
        others = rivals.get(name, ())
        stopped = _has_stopped(name, at_bounds)
        grade, unknown = graded(name, bool(others))
        doubtful = any(
            is_strained(model, *one)
            or is_between_samples(model, *one, shortest=shortest)
            or is_too_small(model, *one, lens=task.lens)
            or is_below_black(model, *one, grey=settings.black_greys * task.grey_step)
            for one in mine[name].items()
        )
        if grade is Grade.SUPPORTED and doubtful:
            grade, unknown = Grade.EITHER, True
        out[name] = Finding(
            effect=name,
            grade=Grade.STAND_IN if stopped else grade,
            alternatives=others,
            unknown=unknown,
            error_without=without[name].judgement.error,
            error_with=last.error,
            deviation=deviations[name],
            parameters=mine[name],
        )
    return out


def offer_what_halves(
    task: DiagnosisTask, findings: Mapping[str, Finding], last: Judgement, at_bounds: Sequence[str]
) -> dict[str, Finding]:
    """Return findings with the stand-ins that explain half of what is left without them, at least, in doubt.

    Much is left of the error, and what else is missing nobody knows; but what explains so much is oftener
    there than not. Between a camera's frames a guess at the light may be as wrong, and none is offered.

    Args:
        task: What the diagnosis is asked.
        findings: Of each effect of the last model.
        last: Its error on the part that reports.
        at_bounds: Sentences on parameters that ended where their search does.
    """
    settings, out = task.settings.grades, dict(findings)
    if may_be_announced(last) or task.evidence.report.doubt is not None:
        return out
    for name, one in findings.items():
        left = _share_left(replace(last, error=one.error_without), last, settings)
        stopped = _has_stopped(name, at_bounds)
        if one.grade is Grade.STAND_IN and not stopped and left <= settings.half_left:
            out[name] = replace(one, grade=Grade.EITHER, unknown=True)
    return out


def _has_stopped(name: str, at_bounds: Sequence[str]) -> bool:
    """Return whether a value of an effect, or of the thresholds beside it, ended where its search does."""
    return any(text.startswith((f"{name}.", "threshold.")) for text in at_bounds)


def leaves_little(start: Judgement, last: Judgement, settings: GradeSettings) -> bool:
    """Return whether any effect can be found: the last model is right, or leaves little of the first error.

    Args:
        start: Error of the model before the search.
        last: Error of the last model.
        settings: Limits.
    """
    return may_be_announced(last) or _share_left(start, last, settings) <= settings.total_left


def is_far_off(start: Judgement, last: Judgement, settings: GradeSettings) -> bool:
    """Return whether no last steps of a model's parameters could make it leave little.

    Args:
        start: Error of the model before the search.
        last: Error of the last model.
        settings: Limits.
    """
    nearer = replace(last, error=last.error / settings.far_off)
    return nearer.error > nearer.gate and not leaves_little(start, nearer, settings)


def _share_left(other: Judgement, last: Judgement, settings: GradeSettings) -> float:
    """Return what the last model leaves, in units of what another does, above the level of chance."""
    level = max(last.level, settings.usual)
    return max(last.error - level, 0.0) / max(other.error - level, 1e-9)


def is_strained(model: FittedModel, name: str, value: Estimate) -> bool:
    """Return whether a value may be at an end of what it can be, and none of its interval is plausible."""
    fact = next((axis.fact for axis in model.space.axes if axis.name == name), None)
    if fact is None:  # read off the events, not fitted
        return False
    (least, most), (low, high) = fact.bounds, fact.plausible
    return (value.high >= most and value.low > high) or (value.low <= least and value.high < low)


def is_between_samples(model: FittedModel, name: str, value: Estimate, *, shortest: float) -> bool:
    """Return whether a time is so short that it is told by what light does between two samples.

    Args:
        model: Has the parameter.
        name: Of the parameter.
        value: Its estimate [s].
        shortest: That samples tell [s].
    """
    fact = next((axis.fact for axis in model.space.axes if axis.name == name), None)
    return fact is not None and fact.between_samples and value.high < shortest


def is_too_small(model: FittedModel, name: str, value: Estimate, *, lens: OpticsBlur | None = None) -> bool:
    """Return whether another world, or another way of an effect beside it, looks like one as weak as this.

    Args:
        model: Has the parameter.
        name: Of the parameter.
        value: Its estimate.
        lens: Beside it as well, where a clip is seen through one.
    """
    fact = next((axis.fact for axis in model.space.axes if axis.name == name), None)
    if fact is None:
        return False
    sensor = with_lens(model.sensor, lens)
    return value.value < fact.clear_from or any(
        other in sensor and not sensor[other].is_off() and value.value < least
        for other, least in fact.clear_beside
    )


def is_below_black(model: FittedModel, name: str, value: Estimate, *, grey: float = 0.0) -> bool:
    """Return whether an intensity is below what the logarithm adds to black: what black is nobody knows.

    A simulator adds a constant of its own there, such as one of 10,000 grey values, which acts in the darkest
    pixels as a dark current does. So does the rounding of a clip to 8 bits, up to a few greys.

    Args:
        model: Has the parameter.
        name: Of the parameter.
        value: Its estimate.
        grey: Below which the clip does not tell it either [intensity].
    """
    fact = next((axis.fact for axis in model.space.axes if axis.name == name), None)
    if fact is None or fact.off is None or fact.unit != "intensity":
        return False
    return value.high < max(model.sensor.log_eps, grey)


def grade_of(
    start: Judgement,
    without: Judgement,
    last: Judgement,
    deviation: float,
    *,
    has_rivals: bool,
    complete: bool = True,
    settings: GradeSettings,
) -> tuple[Grade, bool]:
    """Return the grade of an effect, and whether something unknown may look like it.

    Args:
        start: Error of the model before the search.
        without: Error of the last model without the effect, the rest fitted again.
        last: Error of the last model.
        deviation: Of the measurement from the model without the effect, along the effect's way.
        has_rivals: Whether another effect does nearly as well in its place.
        complete: Whether the library has what the events show.
        settings: Limits.
    """
    total, own = _share_left(start, last, settings), _share_left(without, last, settings)
    at_floor = may_be_announced(last)
    clear = without.error > last.gate and own <= settings.clear_left
    if without.error <= last.error or (deviation < settings.away and not clear):
        return Grade.STAND_IN, False
    chance = at_floor and last.error <= max(LIMITS.quiet, min(last.reach, settings.wide))
    explained = total <= settings.total_left and own <= settings.own_left
    if not (at_floor or explained):
        return Grade.STAND_IN, False
    # at the floor, but not within chance: what is left tells that the world is another than the model's
    sure = chance or (complete and explained and total <= settings.sure_left)
    level = max(last.level, settings.usual)
    least = settings.weak_exact if last.error <= settings.exact * level else settings.weak
    weak = without.error - level < least or deviation < settings.sure_away
    if has_rivals or weak or not sure:
        return Grade.EITHER, weak or not sure
    return Grade.SUPPORTED, False


def _models_without(
    task: DiagnosisTask,
    model: FittedModel,
    found: Sequence[str],
    way: Mapping[frozenset[str], ModelOnReport],
) -> dict[str, ModelOnReport]:
    """Return for each effect the best model without it: the last one, fitted again or not, or of the search.

    What is fitted anew has chance of its own: beside hot pixels, of which a dozen tell the share, a model
    without an effect that does nothing may end with half of them, and the effect would look needed.
    """
    wanted = {name: frozenset(found) - {name} for name in found}
    missing = [name for name in found if wanted[name] not in way]
    less = [with_same_freedom(model.sensor.without(name), model, ()) for name in missing]
    fitted = run_side_by_side([refit_work(task.evidence, one, seed=task.seed, rounds=2) for one in less])
    bare = [with_same_freedom(model.sensor.without(name), model, ()) for name in found]
    judged = judge_on_report(task, [*fitted, *bare], repeats=task.settings.grades.repeats)
    every = [*way.items(), *((wanted[n], one) for n, one in zip([*missing, *found], judged, strict=True))]
    return {
        name: min((one for names, one in every if names <= wanted[name]), key=lambda one: one.judgement.error)
        for name in found
    }


def _left_without(
    task: DiagnosisTask,
    model: FittedModel,
    found: Sequence[str],
    way: Mapping[frozenset[str], ModelOnReport],
) -> dict[str, float]:
    """Return for each effect of a model that leaves much the least error without it; NaN where nobody knows.

    Between a camera's frames nothing is said by that, and only what the search knows by the way is looked up.
    """
    if task.evidence.report.doubt is None:
        return {n: one.judgement.error for n, one in _models_without(task, model, found, way).items()}
    alone = {name: way.get(frozenset(found) - {name}) for name in found}
    return {name: one.judgement.error if one else math.nan for name, one in alone.items()}


def _rivals_to_try(
    task: DiagnosisTask, path: SearchPath, model: FittedModel, name: str, *, doubtful: bool
) -> list[Candidate]:
    """Return the candidates that did nearly as well when an effect was added.

    One that includes the effect as a special case is none, for the simpler of the two is said; but where
    something unknown may look like the simple one, that may well be the other, and so it may where the other
    left clearly less.

    Args:
        task: What the diagnosis is asked.
        path: What did nearly as well as an effect when it was added.
        model: With the effect.
        name: Of the effect.
        doubtful: Whether something unknown may look like it.
    """
    settings, out = task.settings.grades, list[Candidate]()
    for other in path.alternatives.get(name, []):
        includes = name in task.effects[other.name].includes if other.name in task.effects else False
        far_better = other.error < path.error_of.get(name, 0.0) - settings.includer_better
        simpler_is_said = includes and not doubtful and not far_better
        if other.name in model.space.sensor or simpler_is_said or other.judgement is None:
            continue
        level = max(other.judgement.level, settings.usual)
        near = settings.rival * max(path.error_of.get(name, 0.0) - level, 0.0) + settings.tie
        if other.error - level <= near:
            out.append(other)
    return out[: settings.rivals]


def _equally_good_rivals(
    task: DiagnosisTask,
    path: SearchPath,
    model: FittedModel,
    found: Sequence[str],
    doubtful: Collection[str],
) -> dict[str, tuple[str, ...]]:
    """Return for each effect those that do nearly as well in its place, all else fitted again, best first.

    Args:
        task: What the diagnosis is asked.
        path: What did nearly as well as an effect when it was added.
        model: With all effects.
        found: Names of those that are asked about.
        doubtful: Those of them that something unknown may look like, see `_rivals_to_try`.
    """
    settings, seed = task.settings.grades, task.seed
    asked: list[tuple[str, str, FittedModel]] = []
    for name in found:
        for other in _rivals_to_try(task, path, model, name, doubtful=name in doubtful):
            sensor = model.sensor.without(name).with_effect(other.model.sensor[other.name])
            asked.append((name, other.name, with_same_freedom(sensor, model, [other.name])))
    out: dict[str, list[tuple[float, str]]] = {name: [] for name in found}
    if asked:
        # one that will not come near the model in its fit is none; the slowest take longer than all else
        race = CandidateRace(1, settings.rival_loses, best={"": model.loss})
        fitted = run_side_by_side(
            [
                refit_work(task.evidence, one, seed=seed, rounds=2, over=race.over(f"{name} {other}"))
                for name, other, one in asked
            ]
        )
        stream = SimulationStream.JUDGE.seed(seed)
        works = [
            m.judgement_work(task.evidence.held, repeats=settings.repeats, seed=stream)
            for m in (model, *fitted)
        ]
        mine, *others = run_side_by_side(works)
        for (name, other_name, _), judged in zip(asked, others, strict=True):
            level = max(mine.level, settings.usual)
            left = max(mine.error - level, 0.0)
            if judged.error - level <= max(settings.tie_share * left, left + settings.tie):
                out[name].append((judged.error, other_name))
    return {name: tuple(other for _, other in sorted(others)) for name, others in out.items()}
