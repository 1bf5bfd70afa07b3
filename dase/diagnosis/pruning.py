"""Whether a diagnosis needs all that it added, and whether something simpler does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dase.diagnosis.candidates import scout_of
from dase.diagnosis.directional_test import lacks_effect_of
from dase.diagnosis.state import DiagnosisTask, SearchPath, explains_remainder, with_same_freedom
from dase.fitting.early_stopping import stop_unless_below
from dase.fitting.model import FittedModel, refit_model, refit_work
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import LIMITS, Judgement, leaves_nothing, may_be_announced, reaches_floor
from dase.probes.random_streams import SimulationStream


def prune_model(
    task: DiagnosisTask, path: SearchPath, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Drop effects that are not needed any more, put simpler ones in place of others, and drop again.

    Above the floor the first that does no more than a simpler one gives way to it, and nothing else is asked.

    Args:
        task: What the diagnosis is asked.
        path: What is certain, and what was judged with each effect.
        model: With all effects that were added.
        judgement: Its held-out error.
    """
    if judgement.error > task.settings.pruning.lost * judgement.gate:
        return model, judgement
    model, judgement = _drop_needless(task, path, model, judgement)
    before = model
    for name in (n for n in task.added_to(model) if n not in path.certain):
        rivals = _rival_models(task, path, model, name)
        # a rival has to reach the floor, however far off the present model is
        for other, swap in _keep_near_models(task, rivals, judgement.gate).items():
            much = _is_much_to_simulate(task, swap)
            swapped = swap if much else refit_model(task.evidence, swap, seed=task.seed)
            judged = task.judge(swapped)
            without = path.without.get(name)
            if not reaches_floor(judged):
                limit = judgement.error + task.settings.grades.includer_better
                if judged.error <= limit and _does_the_same(task, model, name, rivals[other], limit):
                    # what else is missing may only show beside the simple one
                    return swapped, judged
                continue
            # at the floor is not enough where chance is far below: dark current at 1.08 for leak at 0.35
            if judged.error > max(LIMITS.quiet, judged.reach, judgement.error + task.settings.tie):
                continue
            # the rival of what does not explain it either need not
            if (
                without is not None
                and explains_remainder(judgement, without, task.settings)
                and not explains_remainder(judged, without, task.settings)
            ):
                continue
            if lacks_effect_of(task, swapped, judged, model):
                continue
            if _is_no_better_than_a_part_of_it(task, name, other, judgement, judged):
                continue
            simpler = len(swapped.place) < len(model.place)
            if simpler or not reaches_floor(judgement):
                model, judgement = swapped, judged
                break
    return _drop_needless(task, path, model, judgement) if model is not before else (model, judgement)


def _does_the_same(
    task: DiagnosisTask, model: FittedModel, name: str, swap: FittedModel, limit: float
) -> bool:
    """Whether an effect does what a simpler one in its place does, before that is fitted.

    Args:
        task: Effects and settings.
        model: With the effect.
        name: Of the effect, as two poles of which one is too fast to be seen.
        swap: The model with another in its place.
        limit: Held-out error up to which it does.
    """
    simpler = [one.name for one in model.sensor[name].simpler() if one.name in swap.sensor]
    if not simpler or len(swap.place) >= len(model.place):
        return False
    return task.judge(swap).error <= limit


def _is_no_better_than_a_part_of_it(
    task: DiagnosisTask, name: str, other: str, mine: Judgement, others: Judgement
) -> bool:
    """Whether an effect does hardly better than one that it becomes at the end of its range.

    Before a slightly wrong world the simple one may stay above the floor, and the freedom of the other, which
    has no meaning there, may take it below.

    Args:
        task: Effects and settings.
        name: Of the simple one.
        other: Of the one that may include it.
        mine: Error of the model with the simple one.
        others: The same with the other in its place.
    """
    if other not in task.effects or name not in task.effects[other].includes:
        return False
    reach = max(task.settings.tie, task.settings.tie_share * others.error)
    return mine.error <= others.error + reach


def _drop_needless(
    task: DiagnosisTask, path: SearchPath, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Drop effects that are not needed any more; one alone is not asked for."""
    if len(task.added_to(model)) == 1:
        return model, judgement
    whole = model
    near = max(judgement.gate, judgement.error)
    ways = _keep_near_models(task, _droppable_models(task, model), near)
    # first what needs the finest steps: all else is fitted faster without it
    for name in sorted(ways, key=lambda name: model.sensor[name].longest_step()):
        less = ways[name]
        much = _is_much_to_simulate(task, less)
        if name not in model.sensor or name in path.certain or len(task.added_to(model)) == 1:
            continue
        bare = with_same_freedom(model.sensor.without(name), model, ())
        start = less if model is whole else bare
        fitted = start if much else refit_model(task.evidence, start, seed=task.seed)
        without = task.judge(fitted)
        # what is fitted anew has chance of its own: a share of hot pixels, known by a dozen of them
        as_it_was = task.judge(bare)
        if as_it_was.error < without.error:
            fitted, without = bare, as_it_was
        # what would not be added now is not kept
        needless = may_be_announced(without) and without.error < judgement.error + task.settings.material
        if reaches_floor(without):
            needless = leaves_nothing(without) or not explains_remainder(judgement, without, task.settings)
        needless = needless or without.error <= judgement.error
        if needless and not lacks_effect_of(task, fitted, without, model):
            model, judgement = fitted, without
    return model, judgement


def _is_much_to_simulate(task: DiagnosisTask, model: FittedModel) -> bool:
    """Whether a model needs so fine steps that fitting it in full takes minutes, as noise of some kHz does.

    What the scout has made of it then must do.
    """
    step = float(np.median(np.diff(task.evidence.when)))
    return bool(step > task.settings.pruning.finest * model.sensor.longest_step())


def _keep_near_models(
    task: DiagnosisTask, ways: Mapping[str, FittedModel], error: float
) -> dict[str, FittedModel]:
    """Return those models that are near an error, or that one descent takes there: worth a full fit.

    The descent sees the pixels of the scout alone: what more would tell is far less than the limit leaves.
    """
    evidence, seed, pruning = task.evidence, task.seed, task.settings.pruning
    stream, scout = SimulationStream.JUDGE.seed(seed), scout_of(evidence)
    ends = run_side_by_side([refit_work(scout, way, seed=seed, rounds=1) for way in ways.values()])
    judged = run_side_by_side(
        [
            m.judgement_work(evidence.held, repeats=pruning.repeats, seed=stream)
            for m in (*ways.values(), *ends)
        ]
    )
    begins, fitted = judged[: len(ends)], judged[len(ends) :]
    near = (min(a.error, b.error) < pruning.near * error for a, b in zip(begins, fitted, strict=True))
    return {name: m for name, m, keep in zip(ways, ends, near, strict=True) if keep}


def _droppable_models(task: DiagnosisTask, model: FittedModel) -> dict[str, FittedModel]:
    """Return the models without one effect that may do: not far off on the scout, quickly fitted.

    Fitting one in full takes as long as trying a dozen; most are far off.
    """
    seed, repeats = task.seed, task.settings.scout_repeats
    scout = model.calibrate(
        task.evidence.scout, repeats=repeats, seed=SimulationStream.CALIBRATE_SCOUT.seed(seed)
    )
    ways = {name: with_same_freedom(model.sensor.without(name), model, ()) for name in task.added_to(model)}
    quick = run_side_by_side([way.search_work(scout, seed=seed, iterations=2) for way in ways.values()])
    stream = SimulationStream.JUDGE.seed(seed)
    judged = run_side_by_side([way.judgement_work(scout, repeats=repeats, seed=stream) for way in quick])
    return {
        name: way for name, way, judgement in zip(ways, quick, judged, strict=True)
        if judgement.error < task.settings.pruning.droppable * judgement.gate
    }  # fmt: skip


def _keep_promising_models(
    task: DiagnosisTask, model: FittedModel, ways: Mapping[str, FittedModel]
) -> dict[str, FittedModel]:
    """Return those models that may do as well as the present one: simpler, or not far off on the scout.

    A simpler model may be long on its way: bandwidth after an overdamped second order had been fitted.
    """
    if not ways:
        return {}
    scout = model.calibrate(
        task.evidence.scout,
        repeats=task.settings.scout_repeats,
        seed=SimulationStream.CALIBRATE_SCOUT.seed(task.seed),
    )
    enough = task.settings.pruning.rival_loss * float(scout.scale.loss(scout.repeats).mean())
    simpler = {name: len(way.place) < len(model.place) for name, way in ways.items()}
    works = [
        way.search_work(
            scout, seed=task.seed, iterations=2, over=None if simpler[name] else stop_unless_below(enough)
        )
        for name, way in ways.items()
    ]
    quick = zip(ways, run_side_by_side(works), strict=True)
    return {name: ways[name] for name, found in quick if found.loss < enough or simpler[name]}


def _rival_models(
    task: DiagnosisTask, path: SearchPath, model: FittedModel, name: str
) -> dict[str, FittedModel]:
    """Return the models with an alternative in the place of an effect that may do as well."""
    pruning = task.settings.pruning
    limit, ways = pruning.rival_error * path.error_of.get(name, 0.0) + task.settings.tie, {}
    for other in path.alternatives.get(name, [])[: pruning.rivals]:
        if other.name not in model.space.sensor and other.error <= limit:
            sensor = model.sensor.without(name).with_effect(other.model.sensor[other.name])
            ways[other.name] = with_same_freedom(sensor, model, [other.name])
    # one that the effect becomes at the end of its range may have lost the race to it by a bad start
    for simple in model.sensor[name].simpler():
        if simple.name in task.effects and simple.name not in model.space.sensor:
            sensor = model.sensor.without(name).with_effect(simple)
            ways[simple.name] = with_same_freedom(sensor, model, [simple.name])
    return _keep_promising_models(task, model, ways)
