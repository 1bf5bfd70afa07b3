"""Whether another effect does as well in the place of one that was found beside others.

A search that adds one effect after the other judges each beside what it had then. What was added or dropped
since may be what tells it from another, or what told it from another.
"""

from __future__ import annotations

from collections.abc import Sequence

from dase.diagnosis.candidates import (
    Candidate,
    calibrate_split,
    effects_to_try,
    is_rare,
    refit_and_judge,
    screen_variants,
    variants_to_try,
)
from dase.diagnosis.cell_descriptions import worst_cells
from dase.diagnosis.ranking import rank_of
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, SearchPath, with_same_freedom
from dase.fitting.model import FittedModel, refit_model
from dase.probes.distance import Judgement, reaches_floor
from dase.results import Step


def exchange_effects(
    state: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Try all others in the place of each effect that was added to less, or to more, than is left now.

    Args:
        state: Gets what does nearly as well as each effect, and a step for one that takes the place of
            another.
        model: The last one.
        judgement: Its held-out error.

    Returns:
        The model with what does better, and its held-out error.
    """
    task = state.task
    if judgement.error > task.settings.pruning.lost * judgement.gate:
        return model, judgement
    asked = set(state.path.certain)
    while True:
        left = [name for name in task.added_to(model) if name not in asked]
        if not left:
            return model, judgement
        name = left[0]
        asked.add(name)
        if _was_added_to_all_others(state.path, model, name):
            continue
        bare = with_same_freedom(model.sensor.without(name), model, ())
        finalists = _in_its_place(task, model, bare, name, judgement)
        if not finalists:
            continue
        state.note_rivals(name, finalists, judgement.error)
        best = finalists[0]
        if best.error >= judgement.error - task.settings.material:
            continue
        swapped = refit_model(task.evidence, best.model, seed=task.seed, rounds=1)
        judged = task.judge(swapped)
        if judged.error < judgement.error and reaches_floor(judged) >= reaches_floor(judgement):
            without = task.judge(bare)
            state.note_addition(best, finalists, without)
            state.add_step(_step_of(task, bare, without, finalists))
            asked.add(best.name)
            model, judgement = swapped, judged


def _step_of(
    task: DiagnosisTask, bare: FittedModel, without: Judgement, finalists: Sequence[Candidate]
) -> Step:
    """Return the step by which the best of some candidates is added to a model."""
    return Step(
        model=tuple(effect.name for effect in bare.sensor.effects), error=without.error, gate=without.gate,
        families=without.families, ranking=tuple(rank_of(one, without) for one in finalists),
        chosen=finalists[0].name, ties=(), cells=worst_cells(task.evidence, without),
    )  # fmt: skip


def _was_added_to_all_others(path: SearchPath, model: FittedModel, name: str) -> bool:
    """Whether an effect was added to all others that a model has, so that its rivals are known."""
    others = {effect.name for effect in model.space.sensor.effects} - {name}
    return any(set(step.model) == others and step.chosen == name for step in path.history)


def _in_its_place(
    task: DiagnosisTask, model: FittedModel, bare: FittedModel, name: str, judgement: Judgement
) -> list[Candidate]:
    """Return what comes near a model in the place of one of its effects, fitted and judged, the best first.

    Args:
        task: What the diagnosis is asked.
        model: With the effect.
        bare: Without it, where all else is as it was.
        name: Of the effect.
        judgement: The held-out error of the model with it.
    """
    evidence, settings, seed = task.evidence, task.settings, task.seed
    # in units of what chance does to the model with the effect, which all others are to come near
    with_it = calibrate_split(
        evidence, model, repeats=settings.candidates.few_repeats, scout_repeats=settings.scout_repeats,
        seed=seed,
    )  # fmt: skip
    goal = settings.exchange.near * with_it.scout.scale.loss(
        with_it.scout.run(model.space, model.place[None], seed=seed)[0]
    )
    others = [other for other in effects_to_try(task.effects, bare) if other != name]
    variants = [
        one for other in others
        for one in variants_to_try(evidence, task.effects[other], idle_bus=settings.candidates.idle_bus)
    ]  # fmt: skip
    tried, _ = screen_variants(
        with_it, bare, variants, seed=seed, settings=settings.candidates, goal=float(goal),
        report=lambda text, share: task.progress(text, share, judgement.error),
    )  # fmt: skip
    near = [one for one in tried if one.training_loss <= goal and not is_rare(one)]
    done = refit_and_judge(
        evidence, near[: settings.exchange.fitted], seed=seed, settings=settings.candidates
    )
    return sorted((one for one in done if one.judgement), key=lambda one: one.error)
