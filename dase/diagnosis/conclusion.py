"""What a diagnosis says in the end, by the part of the measurement by which nothing was chosen.

Each effect of the last model is graded there; the sensor of a diagnosis has those that are found. What stays
unexplained is said, and what would have been seen of all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dase.diagnosis.cell_descriptions import worst_cells
from dase.diagnosis.detection_limits import find_detection_limits
from dase.diagnosis.grading import (
    ModelOnReport,
    grade_effects,
    is_far_off,
    judge_on_report,
    leaves_little,
    offer_what_halves,
)
from dase.diagnosis.late_within_frames import doubt_delays_within_frames
from dase.diagnosis.ranking import values_of
from dase.diagnosis.remainder import describe_unexplained, share_of_scene, what_to_record
from dase.diagnosis.seen_effects import SeenEffects, part_to_simulate, without_the_explained
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, SearchPath, with_same_freedom
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.measurement import Measurement, with_lens
from dase.fitting.model import FittedModel, refit_model
from dase.fitting.plain_numbers import plain_numbers
from dase.fitting.search_ends import parameters_at_bounds
from dase.fitting.subset import CalibratedSubset
from dase.probes.distance import Judgement, may_be_announced
from dase.probes.random_streams import SimulationStream
from dase.results import DetectionLimit, Diagnosis, Estimate, Finding, Grade, Step, Unexplained


def conclude_diagnosis(
    state: DiagnosisState,
    start: FittedModel,
    model: FittedModel,
    before: float,
    seen: SeenEffects,
    names: frozenset[str],
    measurement: Measurement,
) -> Diagnosis:
    """Return what was found, judged by the part of the measurement by which nothing was chosen.

    Args:
        state: What the search has found.
        start: The model before the search.
        model: The last one.
        before: Error of the sensor as it was given.
        seen: What the events show.
        names: Effects that the sensor had before.
        measurement: The light and the events.
    """
    task, path = state.task, state.path
    order = _additions_in_order(task, path, model)
    stream, repeats = SimulationStream.JUDGE.seed(task.seed), task.settings.repeats
    way = _judged_way(task, path)
    first = way.get(frozenset()) or judge_on_report(task, [start], repeats=repeats)[0]
    mine = way.get(frozenset(order)) or judge_on_report(task, [model], repeats=repeats)[0]
    # what is far too wrong makes no claim about the camera, and steps nearer to it would lead nowhere
    if is_far_off(first.judgement, mine.judgement, task.settings.grades):
        values = values_of(model, [axis.effect.name for axis in model.space.axes])
        report = model.calibrate(task.evidence.report, repeats=repeats, seed=stream)
    else:
        model, values, report = _with_last_steps(task, model, mine.judgement)
    last = report.judge(stream)
    at_bounds = parameters_at_bounds(model, values)
    judged_effects: dict[str, Finding] = {}
    if not task.evidence.contradiction:
        judged_effects = grade_effects(
            task, path, model, order, way, first, last, report=report, values=values, at_bounds=at_bounds,
            complete=not seen.of_no_effect,
        )  # fmt: skip
        seen_through = with_lens(model.sensor, task.lens)
        judged_effects = doubt_delays_within_frames(judged_effects, seen_through, measurement.scene)
    explained = model.sensor
    for name, one in judged_effects.items():
        # a stand-in explains nothing that the events show
        explained = explained.without(name) if one.grade is Grade.STAND_IN else explained
    part = part_to_simulate(measurement, task.evidence.when)
    seen = without_the_explained(seen, part, explained, task.seed, before=start.sensor)
    judged_effects = offer_what_halves(task, judged_effects, last, at_bounds)
    seen = seen.without_ceiling_of_light(model.sensor)
    said = seen.findings(judged_effects.values(), names)
    findings = {one.effect: one for one in said if one.grade is not Grade.STAND_IN}
    kept = tuple(n for n in order if n in findings and findings[n].grade is not Grade.EITHER)
    limits = _limits_beside(task, model, report, first.judgement, last, seen, {*findings, *order})
    final, error, estimates, plain = model, last.error, values, plain_numbers(report)
    if set(kept) != set(order):
        final = _model_with_only(task, path, start, model, kept)
        final, estimates = estimate_parameters(task.evidence, final, seed=task.seed)
        bare = final.calibrate(task.evidence.report, repeats=repeats, seed=stream)
        error, plain = bare.judge(stream).error, plain_numbers(bare)
    unexplained = _what_is_left(task, model, order, findings, first.judgement, last, at_bounds)
    return Diagnosis(
        sensor=final.sensor,
        selected=kept,
        errors=_errors_after_additions(way, kept, first.judgement.error, error),
        before=before,
        floor=1.0,
        gate=last.gate,
        parameters=estimates,
        unexplained=unexplained,
        history=_with_reported_errors(task, path, way),
        notes=(*state.notes, *at_bounds, *task.evidence.notes),
        plain=plain,
        evaluations=state.evaluations,
        findings=tuple(findings.values()),
        stand_ins=tuple(one for one in said if one.grade is Grade.STAND_IN),
        not_seen=limits,
        record=what_to_record(
            measurement.scene,
            list(findings.values()),
            unexplained,
            task.effects,
            contradiction=bool(task.evidence.contradiction),
        ),
        level=last.level,
        reach=last.reach,
    )


def _with_last_steps(
    task: DiagnosisTask, model: FittedModel, reached: Judgement
) -> tuple[FittedModel, dict[str, Estimate], CalibratedSubset]:
    """Return a model with the last steps of its parameters, their estimates, and the part that reports.

    Steps that lead from the floor to far above it there are not taken: a clip of v2e behind a lens had an
    error of 0.58, and of 1.4 after them, in one answer. This is chosen by the part that reports, between two
    models with the same effects, where one of them is at the floor of it already.

    Args:
        task: What the diagnosis is asked.
        model: The last one of the search.
        reached: Its error on the part that reports.
    """
    stream, repeats = SimulationStream.JUDGE.seed(task.seed), task.settings.repeats
    improved, values = estimate_parameters(task.evidence, model, seed=task.seed)
    report = improved.calibrate(task.evidence.report, repeats=repeats, seed=stream)
    if may_be_announced(report.judge(stream)) or not may_be_announced(reached):
        return improved, values, report
    stays = values_of(model, [axis.effect.name for axis in model.space.axes])
    wide = {
        name: Estimate(one.value, min(one.value, values[name].low), max(one.value, values[name].high))
        for name, one in stays.items() if name in values
    }  # fmt: skip
    return model, wide, model.calibrate(task.evidence.report, repeats=repeats, seed=stream)


def _additions_in_order(task: DiagnosisTask, path: SearchPath, model: FittedModel) -> tuple[str, ...]:
    """Return the effects that were added to a model, in the order in which they were."""
    found = task.added_to(model)
    chosen = [n for s in path.history if s.chosen for n in s.chosen.split(" + ")]
    return tuple(dict.fromkeys([*(n for n in chosen if n in found), *found]))


def _judged_way(task: DiagnosisTask, path: SearchPath) -> dict[frozenset[str], ModelOnReport]:
    """Return the models of the search by what they had added, on the part that reports."""
    models = {frozenset(task.added_to(one)): one for one in path.models}
    judged = judge_on_report(task, list(models.values()), repeats=task.settings.repeats)
    return dict(zip(models, judged, strict=True))


def _limits_beside(
    task: DiagnosisTask,
    model: FittedModel,
    report: CalibratedSubset,
    first: Judgement,
    last: Judgement,
    seen: SeenEffects,
    found: set[str],
) -> tuple[DetectionLimit, ...]:
    """Return what would have been seen of effects that are neither found nor come nearest.

    Args:
        task: What the diagnosis is asked.
        model: The last one.
        report: The part that reports, with that as its present model.
        first: Error of the model before the search.
        last: Error of the last one.
        seen: What the events show.
        found: Effects that are found or come nearest.
    """
    if task.evidence.contradiction:
        return ()
    named, limits = {*task.given, *found}, tuple[DetectionLimit, ...]()
    if leaves_little(first, last, task.settings.grades):
        # beside a model that is too far off for any finding, nothing can be promised
        limits = find_detection_limits(task, model, report, first, last, named)
    return limits + seen.limits({*named, *(one.effect for one in limits)})


def _model_with_only(
    task: DiagnosisTask, path: SearchPath, start: FittedModel, model: FittedModel, names: tuple[str, ...]
) -> FittedModel:
    """Return the model with only some of the effects that were added, fitted."""
    for one in (start, *path.models):
        if set(task.added_to(one)) == set(names):
            return one
    sensor = model.sensor
    for name in task.added_to(model):
        sensor = sensor if name in names else sensor.without(name)
    return refit_model(task.evidence, with_same_freedom(sensor, model, ()), seed=task.seed)


def _what_is_left(
    task: DiagnosisTask,
    model: FittedModel,
    order: tuple[str, ...],
    findings: Mapping[str, Finding],
    first: Judgement,
    last: Judgement,
    at_bounds: list[str],
) -> Unexplained | None:
    """Return what stays unexplained, or why nothing is announced; None where all is explained.

    Args:
        task: What the diagnosis is asked.
        model: The last one.
        order: Effects that were added to it.
        findings: What was found.
        first: Error of the model before the search.
        last: Error of the last one.
        at_bounds: Sentences on parameters that ended where their search does.
    """
    cells, of_scene = worst_cells(task.evidence, last), share_of_scene(task, model, last)
    nearest = tuple(n for n in order if n not in findings)
    contradiction = task.evidence.contradiction
    doubts = [contradiction] if contradiction else at_bounds
    if (doubts and order and not findings) or contradiction:
        return replace(
            describe_unexplained(order, findings, first, last, cells, of_scene),
            sentence=_sentence_of_doubts(order, doubts, last),
        )
    if nearest or not may_be_announced(last):
        return describe_unexplained(nearest, findings, first, last, cells, of_scene)
    return None


def _sentence_of_doubts(found: tuple[str, ...], doubts: list[str], last: Judgement) -> str:
    fits = f"; with {' and '.join(found)} the error is {last.error:.2g}" if found else ""
    return f"nothing is announced: {'; '.join(doubts)}{fits}"


def _errors_after_additions(
    way: Mapping[frozenset[str], ModelOnReport], kept: tuple[str, ...], first: float, last: float
) -> tuple[float, ...]:
    """Return the error at the start and after each effect that was kept.

    Effects that came in at once, or in place of another, have no error of their own on the way: it is taken
    to fall to the last error with the first of them.
    """
    if not kept:
        return (first,)
    known = (way.get(frozenset(kept[: n + 1])) for n in range(len(kept) - 1))
    return (first, *(one.judgement.error if one else last for one in known), last)


def _with_reported_errors(
    task: DiagnosisTask, path: SearchPath, way: Mapping[frozenset[str], ModelOnReport]
) -> tuple[Step, ...]:
    """Return the steps of the search with the errors of the part that reports, so that each model has one."""
    out = []
    for step in path.history:
        mine = way.get(frozenset(step.model) - task.given)
        out.append(replace(step, error=mine.judgement.error, gate=mine.judgement.gate) if mine else step)
    return tuple(out)


def known_so_far(
    state: DiagnosisState, model: FittedModel, errors: list[float], before: float, seconds: float
) -> Diagnosis:
    """Return what a search knows after a step: the nearest model, nothing of which is announced yet.

    Args:
        state: What the search has found.
        model: The nearest one.
        errors: Held-out errors of the models of the search so far.
        before: Error of the sensor as it was given.
        seconds: Since the diagnosis began [s].
    """
    return Diagnosis(
        sensor=model.sensor,
        selected=(),
        errors=(errors[0],),
        before=before,
        floor=1.0,
        gate=state.path.history[-1].gate,
        parameters={},
        unexplained=None,
        history=state.path.history,
        notes=(*state.notes, *state.task.evidence.notes),
        evaluations=state.evaluations,
        seconds=seconds,
        finished=False,
    )
