"""The search for effects that a model lacks: one by one, two at once, and which of them are needed.

What is added on the way is provisional, see `dase.diagnosis.conclusion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dase.diagnosis.blurred_lens import EFFECT as LENS
from dase.diagnosis.blurred_lens import rules_out_lens, seen_through_a_lens
from dase.diagnosis.candidates import (
    Candidate,
    calibrate_split,
    effects_to_try,
    is_rare,
    refit_and_judge,
    scout_of,
    try_effects,
    variants_to_try,
)
from dase.diagnosis.cell_descriptions import worst_cells
from dase.diagnosis.compared_measurement import ComparedMeasurement
from dase.diagnosis.dead_time import EFFECT as REFRACTORY
from dase.diagnosis.directional_test import find_hidden_effect
from dase.diagnosis.effect_pairs import add_pair
from dase.diagnosis.exchange import exchange_effects
from dase.diagnosis.frame_memory import forgets_at_frames
from dase.diagnosis.held_frames import known_at_frames_alone, low_pass_of
from dase.diagnosis.pole_and_delay import put_pole_and_delay
from dase.diagnosis.pruning import prune_model
from dase.diagnosis.ranking import rank_of
from dase.diagnosis.redrawn_thresholds import EFFECT as JITTER
from dase.diagnosis.redrawn_thresholds import add_jitter, find_jitter_beside
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.diagnosis.state import (
    DiagnosisState,
    DiagnosisTask,
    SearchPath,
    explains_remainder,
    with_same_freedom,
)
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, refit_model, with_full_range
from dase.fitting.scene_doubt import with_scene_doubt
from dase.probes.distance import Judgement, leaves_nothing, reaches_floor, worst_families
from dase.probes.random_streams import SimulationStream
from dase.results import Step
from dase.signatures.kinds import REDRAWN_THRESHOLDS


def search_effects(
    state: DiagnosisState, compared: ComparedMeasurement, start: FittedModel, most: int
) -> tuple[FittedModel, Judgement]:
    """Add effects to a model until none is missing, and drop those that are not needed.

    Args:
        state: Its path grows; the measurement is split anew where what is left comes late.
        compared: The measurement.
        start: The model before the search.
        most: Effects that are added at most; 0 for none.

    Returns:
        The last model and its held-out error; where the state has another scene, the search ended there.
    """
    # what is not of this scene has no effects to be found
    most = 0 if state.task.evidence.contradiction else most
    model, judgement = _add_one_by_one(state, compared, start, most, asks=state.task.settings.frames_asked)
    if most > 0 and state.other_scene is None:
        state.other_scene = forgets_at_frames(state.task, state.path, compared.measurement, model, judgement)
    if state.other_scene is not None:
        return model, judgement
    if most > 0 and not state.task.all_time and _shows_later_alone(state.task, model, judgement):
        model = _fit_all_of_the_time(state, compared, model, judgement)
        model, judgement = _add_one_by_one(state, compared, model, _left_to_add(state.task, model, most))
    task = state.task  # the measurement is split no more
    if most > 0 and not reaches_floor(judgement) and LENS in task.effects:
        task.progress("looking at the lens", 0.0, judgement.error)
        state.other_scene = _through_a_lens(state, compared, model, judgement)
        if state.other_scene is not None:
            return model, judgement
    if most > 0 and not reaches_floor(judgement):
        model, judgement = _begin_as_given(state, compared, start, model, judgement, most)
    if not reaches_floor(judgement) and most > 1:
        model, judgement = _go_the_other_way(state, compared, model, judgement, most)
    if not reaches_floor(judgement) and most > 1:
        single = model
        model, judgement = add_pair(state, model, judgement)
        if model is not single and not leaves_nothing(judgement):
            # beside a right pair shows what no effect alone did
            model, judgement = _add_one_by_one(state, compared, model, _left_to_add(task, model, most))
    added = task.added_to(model)
    # one alone is needed; whether what it becomes at the end of its range does as well is asked all the same
    if len(added) > 1 or any(model.sensor[name].simpler() for name in added):
        whole = model
        model, judgement = prune_model(task, state.path, model, judgement)
        if model is not whole and not leaves_nothing(judgement) and not state.path.has_asked(model):
            # a stand-in that was dropped may have hidden what it stood for
            model, judgement = _add_one_by_one(state, compared, model, _left_to_add(task, model, most))
    whole = model
    model, judgement = put_pole_and_delay(state, model, judgement)
    if model is not whole:
        model, judgement = prune_model(task, state.path, model, judgement)
    model, judgement = exchange_effects(state, model, judgement)
    model, judgement = _fit_beyond_the_search(task, model, judgement)
    state.other_scene = _known_at_frames(state, compared, model, judgement)
    return model, judgement


def _through_a_lens(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, judgement: Judgement
) -> Measurement | None:
    """Return the measurement with its clip behind a lens, if that explains more of it."""
    task = state.task
    if rules_out_lens(compared.measurement, log_eps=compared.given.log_eps):
        return None
    known, first = task.given | state.path.certain, [one.model for one in state.path.first]
    return seen_through_a_lens(
        compared.measurement, model, judgement.error, known, first, compared.split, seed=task.seed
    )


def _known_at_frames(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, judgement: Judgement
) -> Measurement | None:
    """Return the measurement with its clip known at its frames alone, if that explains more of it."""
    if leaves_nothing(judgement) or model is state.asked_at_frames:
        return None
    state.asked_at_frames = model
    evidence, seed = state.task.evidence, state.task.seed
    return known_at_frames_alone(
        compared.measurement, evidence, model, judgement.error, compared.split, seed=seed
    )


def _begin_as_given(
    state: DiagnosisState,
    compared: ComparedMeasurement,
    start: FittedModel,
    model: FittedModel,
    judgement: Judgement,
    most: int,
) -> tuple[FittedModel, Judgement]:
    """Search once more from the values that were given of effects which took what another one makes.

    All that is given is fitted before anything is added. Bandwidth, spread and thresholds then stand in for a
    lin-log response in part, and from there no descent comes back.

    Args:
        state: Its path becomes that of this search, where it is the better one.
        compared: The measurement, and the sensor as it was given.
        start: What is given, fitted.
        model: The last one, above the floor.
        judgement: Its held-out error.
        most: Effects that are added at most.
    """
    task, path, settings = state.task, state.path, state.task.settings
    near = judgement.error < settings.far * judgement.gate
    others = {axis.effect.name for axis in start.space.axes} - {"threshold"}
    if not near or not path.first or others.isdisjoint(e.name for e in compared.given.effects):
        return model, judgement
    sensor = start.sensor
    for effect in compared.given.effects:
        if effect.name in sensor:
            sensor = sensor.with_effect(effect)
    given = with_same_freedom(sensor, start, ())
    first = task.judge(given, repeats=settings.candidates.few_repeats)
    if first.error < judgement.error + settings.material:
        return model, judgement  # what was given has taken nothing
    far = first.error > settings.far * first.gate
    present = calibrate_split(
        task.evidence, given, repeats=settings.scout_repeats if far else settings.repeats,
        scout_repeats=settings.scout_repeats, seed=task.seed,
    )  # fmt: skip
    tried = try_effects(
        present, given, task.effects, effects_to_try(task.effects, given), worst=worst_families(first),
        far=far, seed=task.seed, report=lambda text, share: task.progress(text, share, judgement.error),
        settings=settings.candidates,
    )  # fmt: skip
    best, ties = _best_candidate(settings, tried, judgement)
    if best is None:
        return model, judgement
    without = path.models[path.first_step]
    state.leave_at_first_step()
    step = path.history[path.first_step]
    fitted = task.judge(without)
    ranking = tuple(rank_of(one, fitted) for one in tried)
    state.add_step(replace(step, ranking=ranking, chosen=best.name, ties=ties))
    state.note_addition(best, [one for one in tried if one.judgement], fitted)
    found = _search_beside(state, compared, best, most)
    return _better_way(state, path, (model, judgement), found)


def _go_the_other_way(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, judgement: Judgement, most: int
) -> tuple[FittedModel, Judgement]:
    """Add one effect after the other once more, beginning with the one that came next in the first step.

    What stands in for two effects may leave less than either, and hides what shows beside the right one.

    Args:
        state: Its path becomes that of this way, where it is the better one.
        compared: The measurement.
        model: The last one of the first way, above the floor.
        judgement: Its held-out error.
        most: Effects that are added at most.
    """
    task, path, settings = state.task, state.path, state.task.settings
    # a number of samples and no time, so that what is found does not hang on the machine
    if not path.first or state.samples > settings.other_way_samples:
        return model, judgement
    first, start = path.history[path.first_step], path.models[path.first_step]
    reach = settings.other_way * path.first[0].screened_loss
    open_ = [
        one for one in path.first
        if one.name != first.chosen and one.name not in task.added_to(model)
        and one.screened_loss < min(reach, settings.pair_helps_alone)
    ]  # fmt: skip
    if not open_:
        return model, judgement
    other = open_[0]
    state.leave_at_first_step()
    state.add_step(replace(first, chosen=other.name, ties=()))
    state.note_addition(other, [one for one in path.first if one.judgement], task.judge(start))
    found = _search_beside(state, compared, other, most)
    return _better_way(state, path, (model, judgement), found)


def _search_beside(
    state: DiagnosisState, compared: ComparedMeasurement, first: Candidate, most: int
) -> tuple[FittedModel, Judgement]:
    """Return what adding one effect after the other beside a first one comes to, and its held-out error."""
    task = state.task
    begin = refit_model(task.evidence, first.model, seed=task.seed, rounds=1)
    return _add_one_by_one(state, compared, begin, _left_to_add(task, begin, most))


def _better_way(
    state: DiagnosisState,
    path: SearchPath,
    before: tuple[FittedModel, Judgement],
    found: tuple[FittedModel, Judgement],
) -> tuple[FittedModel, Judgement]:
    """Return what another way found if that is the better one; else go back.

    Args:
        state: Has the path of the other way, and gets the first one back.
        path: Of the first way.
        before: The last model of the first way, above the floor, and its held-out error.
        found: The same of the other way.
    """
    gain = 1.0 if reaches_floor(found[1]) else state.task.settings.pair_gain
    if found[1].error < gain * before[1].error:
        return found
    state.go_back(path)
    return before


def _fit_beyond_the_search(
    task: DiagnosisTask, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Return a model fitted over all of the range, if a value ended where the search for it does; else it.

    Args:
        task: The measurement.
        model: The last one.
        judgement: Its held-out error.
    """
    wide = None if leaves_nothing(judgement) else with_full_range(model)
    if wide is None:
        return model, judgement
    task.progress("fitting beyond the search", 0.9, judgement.error)
    found = refit_model(task.evidence, wide, seed=task.seed)
    judged = task.judge(found)
    return (found, judged) if judged.error < judgement.error else (model, judgement)


def _left_to_add(task: DiagnosisTask, model: FittedModel, most: int) -> int:
    """Return how many effects may be added yet; a pair beside what is certain may have taken one too many."""
    return max(most - len(task.added_to(model)), 0)


def _add_one_by_one(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, most: int, *, asks: int = 0
) -> tuple[FittedModel, Judgement]:
    """Add the best effect as long as one is missing.

    Args:
        state: Its path grows.
        compared: The measurement.
        model: The last one.
        most: Effects that are added at most.
        asks: How often a low-pass that leaves too much is taken for one from frame to frame of the clip, at
            most; the state has that scene then, and nothing more is added.

    Returns:
        The model and its held-out error.
    """
    task, errors, far = state.task, list[float](), False
    for _ in range(most + 1):
        state.add_model(model)
        # what is far from the floor needs no exact error
        judgement = task.judge(model, repeats=task.settings.candidates.few_repeats if far else None)
        errors.append(judgement.error)
        near = not leaves_nothing(judgement) and judgement.error < task.settings.far * judgement.gate
        if asks and near and low_pass_of(model.sensor) is not None:
            # what is added beside a low-pass of another law stands in for the difference
            asks -= 1
            state.other_scene = _known_at_frames(state, compared, model, judgement)
            if state.other_scene is not None:
                break
        more = len(errors) <= most
        step, better, far = _look_for_effect(state, model, judgement, more)
        if better is None and more:
            hidden = find_hidden_effect(task, model, judgement)
            hidden = hidden or _find_jitter(state, compared, model, judgement)
            if hidden is not None:
                step, better = _note_hidden_effect(state, *hidden, step, judgement), hidden[0].model
        state.add_step(step)
        state.after_step(model if better is None else better, errors)
        if better is None:
            break
        model = better
    return model, judgement


def _find_jitter(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, judgement: Judgement
) -> tuple[Candidate, float] | None:
    """Return the jitter that light shows from event to event, fitted and judged, and its p-value.

    It is little of an error, and what is the error's is more than it where anything else is missing.

    Args:
        state: Gets that the jitter is certain, if it is found.
        compared: The measurement.
        model: The last one.
        judgement: Its held-out error.
    """
    task = state.task
    if JITTER not in effects_to_try(task.effects, model) or compared.seen.lamp:
        return None
    # where events come at fractions of frames or wait for a bus, light between them says little of thresholds
    if task.evidence.frame_step or compared.seen.full_bus:
        return None
    if not compared.seen.may_name(REDRAWN_THRESHOLDS):
        return None
    task.progress("looking at thresholds", 0.0, judgement.error)
    noise = state.events_alone.noise
    found = find_jitter_beside(compared.measurement, model, judgement, noise=noise, seed=task.seed)
    better = None if found is None else add_jitter(task, model, judgement, found)
    if found is None or better is None:
        return None
    state.make_certain(JITTER)
    return better, found.p


def _shows_later_alone(task: DiagnosisTask, model: FittedModel, judgement: Judgement) -> bool:
    """Whether a model that fails where it is judged is nearly right where it was fitted.

    What comes late in a recording, as the first events of a slow leak do, no fit to its first part can find.
    """
    if reaches_floor(judgement):
        return False
    repeats, stream = task.settings.candidates.few_repeats, SimulationStream.JUDGE.seed(task.seed)
    fitted = model.judge(task.evidence.train, repeats=repeats, seed=stream)
    excess = max(fitted.error - fitted.level, 0.0) / max(judgement.error - judgement.level, 1e-9)
    return excess < task.settings.later


def _fit_all_of_the_time(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel, judgement: Judgement
) -> FittedModel:
    """Split the measurement anew, so that all of its time is fitted; return the model, fitted to that."""
    seed = state.task.seed
    state.task.progress("fitting all of the time", 0.0, judgement.error)
    evidence = compared.split(all_time=True)
    if compared.guessed is not None:
        evidence = with_scene_doubt(evidence, compared.guessed, model, seed=seed)
    state.split_anew(evidence)
    state.notes.append(
        "what is left comes late in the recording: all of its time is fitted, and other pixels judge"
    )
    return refit_model(evidence, model, seed=seed)


def _look_for_effect(
    state: DiagnosisState, model: FittedModel, judgement: Judgement, more: bool
) -> tuple[Step, FittedModel | None, bool]:
    """Try all effects.

    Args:
        state: Gets which effects were tried alone or put off, the first candidates, and what pruning needs to
            know of the effect that is added.
        model: The last one.
        judgement: Its held-out error.
        more: Whether any may be added yet.

    Returns:
        What was found, the model with the best of them, None if there is none, and whether that is still far
        from the floor.
    """
    task = state.task
    evidence, seed, settings = task.evidence, task.seed, task.settings
    names = tuple(e.name for e in model.space.sensor.effects)
    cells = worst_cells(evidence, judgement)
    step = Step(names, judgement.error, judgement.gate, judgement.families, (), None, (), cells)
    if leaves_nothing(judgement) or not more:
        return step, None, False
    open_names = effects_to_try(task.effects, model)
    # what is certain comes first, and by itself: everything else is judged beside it
    certain = [
        name for name in open_names
        if name in state.path.certain - state.events_alone.tried_alone
        and variants_to_try(evidence, task.effects[name], idle_bus=settings.candidates.idle_bus)
    ]  # fmt: skip
    state.try_alone(certain)
    open_names = certain or open_names
    if not open_names:
        return step, None, False
    far = judgement.error > settings.far * judgement.gate
    present = calibrate_split(
        evidence, model, repeats=settings.scout_repeats if far else settings.repeats,
        scout_repeats=settings.scout_repeats, seed=seed,
    )  # fmt: skip
    tried = try_effects(
        present, model, task.effects, open_names, worst=worst_families(judgement), far=far,
        seed=seed, report=lambda text, share: task.progress(text, share, judgement.error),
        settings=settings.candidates,
    )  # fmt: skip
    step = replace(step, ranking=tuple(rank_of(one, judgement) for one in tried))
    if not certain:
        state.keep_first_candidates(tried)
    best, ties = _best_candidate(settings, tried, judgement)
    if certain == [REFRACTORY] and not reaches_floor(judgement):
        share = rank_of(best, judgement).share if best is not None else 0.0
        if share < settings.dead_time_share:
            state.put_off(REFRACTORY)
            return _look_for_effect(state, model, judgement, more)
    if best is None and certain:
        shown = [one for one in tried if one.name in state.events_alone.shown]
        best = _shown_unless_worse(task, shown, judgement)
        if best is None:
            return _look_for_effect(state, model, judgement, more)
    if best is None:
        return step, None, False
    state.note_addition(best, [one for one in tried if one.judgement], judgement)
    step = replace(step, chosen=best.name, ties=ties)
    on_its_way = best.error > settings.on_its_way * judgement.gate
    # what is added next moves all of it again
    enough = far and best.error > settings.far * judgement.gate and not is_rare(best)
    fitted = scout_of(evidence) if enough else evidence
    return step, refit_model(fitted, best.model, seed=seed, rounds=1), on_its_way


def _shown_unless_worse(
    task: DiagnosisTask, shown: Sequence[Candidate], judgement: Judgement
) -> Candidate | None:
    """Return the noise, leak or mismatch that is there, if the model is no worse with it.

    However little the error falls, it is there, and all else is to be judged beside it.

    Args:
        task: What the diagnosis is asked.
        shown: Candidates that are there whatever fits.
        judgement: Held-out error of the model without them.
    """
    if not shown:
        return None
    judged = [one for one in shown if one.judgement] or refit_and_judge(
        task.evidence, shown, seed=task.seed, settings=task.settings.candidates
    )
    best = min(judged, key=lambda one: one.error)
    return best if best.judgement and best.error <= judgement.error else None


def _best_candidate(
    settings: DiagnosisSettings, tried: Sequence[Candidate], judgement: Judgement
) -> tuple[Candidate | None, tuple[str, ...]]:
    """Return the candidate that is to be added, None if there is none, and those not told apart from it."""
    finalists = [one for one in tried if one.judgement]
    right = reaches_floor(judgement)
    if right:
        finalists = [
            one for one in finalists
            if one.judgement and explains_remainder(one.judgement, judgement, settings)
        ]  # fmt: skip
    if not finalists:
        return None, ()
    best, ties = _simplest_of_the_best(finalists, settings)
    rank = rank_of(best, judgement)
    if not right and (rank.fall < settings.material or rank.share < settings.share):
        return None, ()
    return best, ties


def _simplest_of_the_best(
    finalists: Sequence[Candidate], settings: DiagnosisSettings = DEFAULTS
) -> tuple[Candidate, tuple[str, ...]]:
    """Return the best candidate, the simplest of those that are not told apart, and the others of those."""
    first = finalists[0]
    reach = max(settings.tie, settings.tie_share * first.error)
    good = first.judgement is not None and reaches_floor(first.judgement)
    like = [
        one for one in finalists
        if one.error <= first.error + reach and one.judgement and (reaches_floor(one.judgement) or not good)
    ]  # fmt: skip
    names = {one.name for one in like}

    def complexity(one: Candidate) -> tuple[int, bool, float]:
        """Return by what the simplest comes first: freedom, whether it includes another, its error."""
        return len(one.model.place), not names.isdisjoint(one.includes), one.error

    best = min(like, key=complexity)
    return best, tuple(one.name for one in like if one.name != best.name)


def _note_hidden_effect(
    state: DiagnosisState, hidden: Candidate, p_value: float, step: Step, judgement: Judgement
) -> Step:
    """Return a step with an effect that only a closer look shows as the chosen one."""
    state.note_addition(hidden, [hidden], judgement)
    rank = rank_of(replace(hidden, p_value=p_value), judgement)
    others = tuple(r for r in step.ranking if r.effect != hidden.name)
    return replace(step, ranking=(rank, *others), chosen=hidden.name)
