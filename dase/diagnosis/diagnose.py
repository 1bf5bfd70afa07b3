"""Which physical effect a model lacks."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from os import PathLike

import numpy as np
from numpy.typing import NDArray

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
from dase.diagnosis.dead_time import EFFECT as REFRACTORY
from dase.diagnosis.dead_time import NAME as DEAD_TIME
from dase.diagnosis.dead_time import add_dead_time, find_dead_time, with_dead_time
from dase.diagnosis.detection_limits import find_detection_limits
from dase.diagnosis.directional_test import find_hidden_effect
from dase.diagnosis.drifting_memory import EFFECT as LEAKING
from dase.diagnosis.drifting_memory import find_drifting_memory
from dase.diagnosis.events_at_rest import LEAK, find_events_at_rest
from dase.diagnosis.few_hot_pixels import NAME as HOT
from dase.diagnosis.few_hot_pixels import few_hot_pixels, hot_effect_of, with_hot_pixels
from dase.diagnosis.grading import ModelOnReport, grade_effects, is_far_off, judge_on_report, leaves_little
from dase.diagnosis.held_frames import (
    held_behind_low_pass,
    known_at_frames_alone,
    with_frame_as_memory,
    with_longer_dead_time,
)
from dase.diagnosis.pruning import prune_model
from dase.diagnosis.remainder import describe_unexplained, share_of_scene, what_to_record
from dase.diagnosis.seen_effects import (
    SeenEffects,
    find_seen_effects,
    part_to_simulate,
    strength_of_bursts,
    with_effect_of_bursts,
    without_the_explained,
    without_the_scene,
)
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.diagnosis.silent_pixels import NAME as DEAD
from dase.diagnosis.silent_pixels import (
    SilentPixels,
    find_silent_pixels,
    with_dead_pixels,
    without_the_explained_silence,
)
from dase.diagnosis.state import DiagnosisState, explains_remainder, with_same_freedom
from dase.diagnosis.unequal_thresholds import EFFECT as MISMATCH
from dase.diagnosis.unequal_thresholds import NAME as UNEQUAL
from dase.diagnosis.unequal_thresholds import find_unequal_thresholds, with_unequal_thresholds
from dase.effects import EFFECTS, Effect
from dase.effects.threshold import Threshold
from dase.fitting.burst_strength import follows_frames, put_in_step
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.data_split import SPLIT, split_measurement
from dase.fitting.early_stopping import CandidateRace
from dase.fitting.measurement import Measured, Measurement, SceneChoice, as_measurement
from dase.fitting.model import (
    FittedModel,
    fit_present_model,
    free_where_measured,
    model_of,
    refit_model,
    refit_work,
    ways_otherwise,
    with_fixed_effect,
)
from dase.fitting.parameter_space import axes_of, refuse_idle
from dase.fitting.plain_numbers import plain_numbers
from dase.fitting.scene_doubt import is_guessed, with_scene_doubt
from dase.fitting.scheduler import run_side_by_side
from dase.fitting.search_ends import parameters_at_bounds
from dase.probes.distance import Judgement, leaves_nothing, may_be_announced, reaches_floor, worst_families
from dase.probes.random_streams import SimulationStream
from dase.probes.stimulus import Trust
from dase.results import (
    DetectionLimit,
    Diagnosis,
    Estimate,
    Finding,
    Grade,
    Progress,
    Rank,
    Step,
    Unexplained,
    is_worse,
)
from dase.scenes.between_frames import CameraScene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor


def diagnose(
    measured: Measured,
    sensor: Sensor | str | PathLike[str] | None = None,
    *,
    scene: SceneChoice | None = None,
    effects: Mapping[str, type[Effect]] = EFFECTS,
    free: Sequence[str] | None = None,
    trust: Trust | None = None,
    most: int = 4,
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
    so_far: Callable[[Diagnosis], None] | None = None,
    settings: DiagnosisSettings = DEFAULTS,
) -> Diagnosis:
    """Find the effects that a model of a camera lacks.

    Args:
        measured: A recording or its path, a `Measurement`, or events; see `as_measurement`.
        sensor: The model, a preset's name, or the path of a sensor file; None for thresholds alone.
        scene: What the camera saw, on the clock of the events: a scene, a clip's path, or `static` for light
            that does not change. None for the frames of the recording; events alone need one.
        effects: Candidates, name to class; those of the sensor are left out.
        free: Parameters of the sensor that may be refitted; None for all.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        most: Effects that are added at most.
        pixels: In each part of the measurement.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.
        so_far: Given what is known after each step of the search, before it is finished.
        settings: Numbers by which effects are added and dropped.

    Raises:
        InputError: Measurement and scene do not fit, or there is too little to say anything.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text, share, error: None)
    again = partial(
        diagnose, sensor=sensor, effects=effects, free=free, most=most, pixels=pixels, seed=seed,
        device=device, progress=progress, so_far=so_far, settings=settings,
    )  # fmt: skip
    given = Sensor() if sensor is None else as_sensor(sensor)
    refuse_idle(given, free)
    measurement = as_measurement(measured, scene, trust)
    given = given.bound_to(measurement.scene)
    scene = measurement.scene
    guessed = scene if isinstance(scene, CameraScene) and is_guessed(scene) else None
    plenty, parts = settings.plenty, SPLIT
    if guessed is not None and pixels > settings.guessed_pixels:
        # fewer pixels over the same time
        fewer = settings.guessed_pixels / pixels
        plenty, pixels = fewer * plenty, settings.guessed_pixels
        parts = replace(parts, scouts=round(fewer * parts.scouts))
    tell("looking at the events alone", 0.0, float("nan"))
    seen = find_seen_effects(measurement, effects)
    # a sensor that has them already is compared with them
    frames = seen.times_of_bursts(measurement) if follows_frames(given) else None
    bursts = None if "exposure" in given else seen.bursts
    hot = few_hot_pixels(seen, measurement.events, pixels) if HOT not in given else None
    asked = DEAD in effects and DEAD not in given
    silent = find_silent_pixels(measurement, log_eps=given.log_eps) if asked else None
    dead = silent if silent is not None and silent.found else None
    split_of = partial(
        split_measurement, measurement.events, log_eps=given.log_eps,
        trust=measurement.trust, span=measurement.span, left_out=bursts.contains if bursts else None,
        odd_pixels=_odd_pixels(hot, dead), lamp=seen.lamp, frames=frames, unbroken=given.unbroken,
        plenty=plenty, pixels=pixels, seed=seed, device=device, settings=parts,
    )  # fmt: skip
    split = partial(split_of, measurement.scene)
    evidence = split()
    notes = list[str]()
    all_time = evidence.parts_differ
    if all_time:
        evidence = split(all_time=True)
        notes.append(
            "light rests in one part of the time and not in the other: all of it is fitted, and other pixels "
            "judge"
        )
    given = put_in_step(given, evidence)
    free = free_where_measured(evidence, given, free)
    bare, given = given, with_frame_as_memory(given, measurement, evidence, free, seed=seed)
    forgets = given is not bare
    if forgets:
        # how often a held frame makes pixels send is counted, and no fit tells it better
        free = [axis.name for axis in axes_of(bare, free)]
    tell("fitting the present model", 0.0, float("nan"))
    names = frozenset(effect.name for effect in given.effects)
    # what is left out of all that is compared cannot be tried, nor what all pixels contradict
    known = {HOT} if hot is not None else set[str]()
    known |= {DEAD} if silent is not None and silent.decides else set()
    tried = {name: effect for name, effect in effects.items() if name not in known}
    state = DiagnosisState(
        evidence, tried, seed, tell, names, settings, notes=notes, held=measurement.held
    )  # fmt: skip
    if so_far is not None:
        state.after_step = lambda model, errors: so_far(
            measurement.noted(_known_so_far(state, model, errors, before, time.perf_counter() - begin))
        )
    before = (
        model_of(given, free)
        .judge(evidence.report, repeats=settings.repeats // 2, seed=SimulationStream.JUDGE.seed(seed))
        .error
    )
    start = _fitted_unless_worse(state, given, free)
    shown = held_behind_low_pass(measurement, evidence, start, split_of, seed=seed)
    if shown is not None:
        found = again(shown)
        return replace(found, seconds=time.perf_counter() - begin)
    seen = without_the_scene(seen, part_to_simulate(measurement, evidence.when), start.sensor, seed)
    if guessed is not None:
        tell("how well the scene is known", 0.0, before)
        state.evidence = evidence = with_scene_doubt(evidence, guessed, start, seed=seed)
        before = (
            model_of(given, free)
            .judge(evidence.report, repeats=settings.repeats // 2, seed=SimulationStream.JUDGE.seed(seed))
            .error
        )
        start = _fitted_unless_worse(state, start.sensor, free)
    seen = _look_where_light_rests(state, seen, measurement, start)
    seen = _look_for_dead_time(state, seen, measurement, start)
    seen = _look_at_thresholds(state, seen, measurement, start)
    state.certain = frozenset(seen.effects) & frozenset(tried) - names
    state.shown = state.certain & seen.shown_whatever_fits
    if hot is not None:
        state.notes.append(
            f"{len(hot)} hot pixels are left out of all that is compared, and counted among all pixels"
        )
    strength = None if evidence.contradiction else strength_of_bursts(
        seen, measurement, start.sensor, effects, pixels=pixels, plenty=plenty, seed=seed, device=device,
    )  # fmt: skip
    if strength is not None:
        # pixels remember the bursts between them, too
        start = with_fixed_effect(start, strength.effect)
        state.given |= {strength.effect.name}
    if dead is not None:
        state.notes.append(f"{len(dead.pixels)} dead pixels are left out of all that is compared")
    if bursts is not None:
        state.notes.append("the bursts that come with the frames are left out of all that is compared")
    # what is not of this scene has no effects to be found
    limit = 0 if evidence.contradiction else most
    model, judgement = _add_one_by_one(state, start, limit)
    run = 0  # models before the measurement was split anew
    if limit > 0 and not all_time and _shows_later_alone(state, model, judgement):
        tell("fitting all of the time", 0.0, judgement.error)
        run, evidence = evidence.evaluations, split(all_time=True)
        if guessed is not None:
            evidence = with_scene_doubt(evidence, guessed, model, seed=seed)
        state.evidence = evidence
        state.notes.append(
            "what is left comes late in the recording: all of its time is fitted, and other pixels judge"
        )
        model = refit_model(evidence, model, seed=seed)
        model, judgement = _add_one_by_one(state, model, limit - len(state.added_to(model)))
    if not reaches_floor(judgement) and limit > 0:
        single = model
        model, judgement = _add_pair(state, model, judgement)
        if model is not single and not leaves_nothing(judgement):
            # beside a right pair shows what no effect alone did
            model, judgement = _add_one_by_one(state, model, limit - len(state.added_to(model)))
    if len(state.added_to(model)) > 1:
        whole = model
        model, judgement = prune_model(state, model, judgement)
        if model is not whole and not leaves_nothing(judgement) and not state.has_asked(model):
            # a stand-in that was dropped may have hidden what it stood for
            model, judgement = _add_one_by_one(state, model, limit - len(state.added_to(model)))
    shown = known_at_frames_alone(measurement, evidence, model, judgement.error, split_of, seed=seed)
    if shown is not None:
        return replace(again(shown), seconds=time.perf_counter() - begin)
    if state.added_to(model):  # else it was asked before
        seen = _look_for_dead_time(state, seen, measurement, model)
        seen, model, judgement = _without_needless_dead_time(state, seen, measurement, model, judgement)
    ended = seen.entry_of(DEAD_TIME)
    if ended is not None and REFRACTORY in tried and REFRACTORY not in model.sensor:
        state.certain |= {REFRACTORY}
        model, judgement = add_dead_time(state, model, judgement, ended)
    found = _conclude_diagnosis(state, start, model, before, seen, names, measurement)
    found = replace(found, evaluations=found.evaluations + run)
    if ended is not None and REFRACTORY in tried:
        found = with_dead_time(found, ended)
    if forgets and REFRACTORY in tried and not evidence.contradiction:
        found = with_longer_dead_time(found, state, measurement, model)
    if (unequal := seen.entry_of(UNEQUAL)) is not None and MISMATCH in tried:
        found = with_unequal_thresholds(found, unequal)
    if silent is not None and silent.decides and not evidence.contradiction:
        silent = without_the_explained_silence(silent, measurement, model.sensor, seed=seed)
        found = with_dead_pixels(found, silent)
    if hot is not None:
        found = with_hot_pixels(found, *hot_effect_of(measurement.events, hot))
    if strength is not None:
        tell("how strong the bursts are", 0.95, found.errors[-1])
        # beside other effects it may be another
        last = strength_of_bursts(
            seen, measurement, found.sensor.without(strength.effect.name), effects,
            pixels=pixels, plenty=plenty, seed=seed, device=device,
        )  # fmt: skip
        found = with_effect_of_bursts(found, last or strength)
    return measurement.noted(replace(found, seconds=time.perf_counter() - begin))


def _look_where_light_rests(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with the noise or the leak of pixels at rest that a model has not."""
    if state.evidence.contradiction or seen.lamp or seen.bursts is not None:
        return seen
    threshold = model.sensor["threshold"]
    assert isinstance(threshold, Threshold)
    found = find_events_at_rest(
        measurement, model.sensor, thresholds=(threshold.on, threshold.off), seed=state.seed
    )
    return seen if found is None else replace(seen, entries=(*seen.entries, found))


def _look_for_dead_time(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with the end of the intervals if there is one that a model has not."""
    if seen.entry_of(DEAD_TIME) or REFRACTORY in state.given or state.evidence.contradiction:
        return seen
    found = find_dead_time(
        measurement, model.sensor,
        frame_step=state.evidence.frame_step or 0.0, structure=state.evidence.structure, seed=state.seed,
    )  # fmt: skip
    return seen if found is None else replace(seen, entries=(*seen.entries, found))


def _without_needless_dead_time(
    state: DiagnosisState,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> tuple[SeenEffects, FittedModel, Judgement]:
    """Return what is seen, and the last model, without a dead time that this has no need of.

    A model before the search that lacks a slow low-pass has bursts of events that are not there, and their
    intervals look as if they were cut off. What was found since may leave none.

    Args:
        state: Forgets that the dead time is certain, if it is not.
        seen: With the end of the intervals beside the model before the search, if there is one.
        measurement: Its intervals are looked at.
        model: The last one.
        judgement: Its held-out error.
    """
    if seen.entry_of(DEAD_TIME) is None or REFRACTORY not in state.added_to(model):
        return seen, model, judgement
    bare = with_same_freedom(model.sensor.without(REFRACTORY), model, ())
    without = state.judge(bare)
    if is_worse(without.error, judgement.error, judgement.gate):
        return seen, model, judgement
    entries = tuple(one for one in seen.entries if one.name != DEAD_TIME)
    again = _look_for_dead_time(state, replace(seen, entries=entries), measurement, bare)
    if again.entry_of(DEAD_TIME) is not None:
        return seen, model, judgement
    state.certain -= {REFRACTORY}
    return again, bare, without


def _look_at_thresholds(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with how much the thresholds of pixels differ, or drift, if they do."""
    if state.evidence.contradiction or seen.lamp:
        return seen
    found = []
    if MISMATCH not in state.given:
        found.append(find_unequal_thresholds(measurement, model.sensor, seed=state.seed))
    if LEAKING not in state.given and not seen.entry_of(LEAK):
        structure = state.evidence.structure
        found.append(find_drifting_memory(measurement, model.sensor, structure=structure, seed=state.seed))
    return replace(seen, entries=(*seen.entries, *(one for one in found if one is not None)))


def _odd_pixels(hot: NDArray[np.int64] | None, dead: SilentPixels | None) -> NDArray[np.int64] | None:
    """Return the pixels that are left out of all that is compared, row-major, shape (K,); None for none."""
    some = [*([] if hot is None else [hot]), *([] if dead is None else [dead.pixels])]
    return np.unique(np.concatenate(some)) if some else None


def _fitted_unless_worse(state: DiagnosisState, given: Sensor, free: Sequence[str] | None) -> FittedModel:
    """Return the sensor as it was given, fitted; as it is where the fit does not generalise.

    Args:
        state: Gets a note of a fit that was not kept.
        given: The sensor.
        free: Its parameters that may be refitted; None for all.
    """
    evidence, seed = state.evidence, state.seed
    fitted = fit_present_model(evidence, given, free, seed=seed)
    stream = SimulationStream.JUDGE.seed(seed)
    asked = model_of(given, free)
    judged, as_given = (
        one.judge(evidence.held, repeats=state.settings.repeats // 2, seed=stream) for one in (fitted, asked)
    )
    if not is_worse(judged.error, as_given.error, judged.gate):
        return fitted
    state.notes.append(
        f"fitted again, the sensor as given is worse on pixels and time that no fit has seen (error "
        f"{judged.error:.2f} instead of {as_given.error:.2f}): the search began from the sensor as given"
    )
    return asked


def _add_one_by_one(state: DiagnosisState, model: FittedModel, most: int) -> tuple[FittedModel, Judgement]:
    """Add the best effect as long as one is missing; return the model and its held-out error."""
    errors, far = list[float](), False
    for _ in range(most + 1):
        state.path.append(model)
        # what is far from the floor needs no exact error
        judgement = state.judge(model, repeats=state.settings.candidates.few_repeats if far else None)
        errors.append(judgement.error)
        more = len(errors) <= most
        step, better, far = _look_for_effect(state, model, judgement, more)
        if better is None and more and (hidden := find_hidden_effect(state, model, judgement)) is not None:
            step, better = _note_hidden_effect(state, *hidden, step, judgement), hidden[0].model
        state.history.append(step)
        state.after_step(model if better is None else better, errors)
        if better is None:
            break
        model = better
    return model, judgement


def _shows_later_alone(state: DiagnosisState, model: FittedModel, judgement: Judgement) -> bool:
    """Whether a model that fails where it is judged is nearly right where it was fitted.

    What comes late in a recording, as the first events of a slow leak do, no fit to its first part can find.
    """
    if reaches_floor(judgement):
        return False
    repeats, stream = state.settings.candidates.few_repeats, SimulationStream.JUDGE.seed(state.seed)
    fitted = model.judge(state.evidence.train, repeats=repeats, seed=stream)
    excess = max(fitted.error - fitted.level, 0.0) / max(judgement.error - judgement.level, 1e-9)
    return excess < state.settings.later


def _look_for_effect(
    state: DiagnosisState, model: FittedModel, judgement: Judgement, more: bool
) -> tuple[Step, FittedModel | None, bool]:
    """Try all effects.

    Returns:
        What was found, the model with the best of them, None if there is none, and whether that is still far
        from the floor.
    """
    evidence, seed, settings = state.evidence, state.seed, state.settings
    names = tuple(e.name for e in model.space.sensor.effects)
    cells = worst_cells(evidence, judgement)
    step = Step(names, judgement.error, judgement.gate, judgement.families, (), None, (), cells)
    if leaves_nothing(judgement) or not more:
        return step, None, False
    open_names = effects_to_try(state.effects, model)
    # what is certain comes first, and by itself: everything else is judged beside it
    certain = [
        name for name in open_names
        if name in state.certain - state.tried_alone
        and variants_to_try(evidence, state.effects[name], idle_bus=settings.candidates.idle_bus)
    ]  # fmt: skip
    state.tried_alone |= frozenset(certain)
    open_names = certain or open_names
    if not open_names:
        return step, None, False
    far = judgement.error > settings.far * judgement.gate
    present = calibrate_split(
        evidence, model, repeats=settings.scout_repeats if far else settings.repeats,
        scout_repeats=settings.scout_repeats, seed=seed,
    )  # fmt: skip
    tried = try_effects(
        present, model, state.effects, open_names, worst=worst_families(judgement), far=far,
        seed=seed, report=lambda text, share: state.progress(text, share, state.error),
        settings=settings.candidates,
    )  # fmt: skip
    step = replace(step, ranking=tuple(_rank_of(one, judgement) for one in tried))
    if not state.first and not certain:
        state.first, state.first_step = sorted(tried, key=lambda one: one.screened_loss), len(state.history)
    best, ties = _best_candidate(state, tried, judgement)
    if best is None and certain:
        best = _shown_whatever_fits(state, tried, judgement)
        if best is None:
            return _look_for_effect(state, model, judgement, more)
    if best is None:
        return step, None, False
    state.note_addition(best, [one for one in tried if one.judgement], ties, judgement)
    step = replace(step, chosen=best.name, ties=ties)
    on_its_way = best.error > settings.on_its_way * judgement.gate
    # what is added next moves all of it again
    enough = far and best.error > settings.far * judgement.gate and not is_rare(best)
    fitted = scout_of(evidence) if enough else evidence
    return step, refit_model(fitted, best.model, seed=seed, rounds=1), on_its_way


def _shown_whatever_fits(
    state: DiagnosisState, tried: Sequence[Candidate], judgement: Judgement
) -> Candidate | None:
    """Return the noise, leak or mismatch that is there, if the model is no worse with it.

    However little the error falls, it is there, and all else is to be judged beside it.
    """
    shown = [one for one in tried if one.name in state.shown]
    if not shown:
        return None
    judged = [one for one in shown if one.judgement] or refit_and_judge(
        state.evidence, shown, seed=state.seed, settings=state.settings.candidates
    )
    best = min(judged, key=lambda one: one.error)
    return best if best.judgement and best.error <= judgement.error else None


def _best_candidate(
    state: DiagnosisState, tried: Sequence[Candidate], judgement: Judgement
) -> tuple[Candidate | None, tuple[str, ...]]:
    """Return the candidate that is to be added, None if there is none, and those not told apart from it."""
    settings = state.settings
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
    rank = _rank_of(best, judgement)
    if not right and (rank.fall < settings.material or rank.share < settings.share):
        return None, ()
    return best, ties


def _note_hidden_effect(
    state: DiagnosisState, hidden: Candidate, p_value: float, step: Step, judgement: Judgement
) -> Step:
    """Return a step with an effect that only a closer look shows as the chosen one."""
    state.note_addition(hidden, [hidden], (), judgement)
    rank = _rank_of(replace(hidden, p_value=p_value), judgement)
    others = tuple(r for r in step.ranking if r.effect != hidden.name)
    return replace(step, ranking=(rank, *others), chosen=hidden.name)


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
    best = min(like, key=lambda one: (len(one.model.place), one.error))
    return best, tuple(one.name for one in like if one.name != best.name)


def _rank_of(candidate: Candidate, judgement: Judgement) -> Rank:
    """Return a candidate as the user sees it."""
    fall = judgement.error - candidate.error
    share = fall / max(judgement.error - 1.0, 1e-9)
    # before it is the model, an effect has values without intervals
    mine = _values_of(candidate.model, candidate.name.split(" + "))
    refined = candidate.judgement is not None
    return Rank(candidate.name, candidate.error, fall, min(share, 1.0), candidate.p_value, mine, refined)


def _add_pair(
    state: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Where adding one after the other does not reach the floor, try two at once."""
    evidence, seed, settings = state.evidence, state.seed, state.settings
    if not state.first:
        return model, judgement
    before, start = state.history[state.first_step], state.path[state.first_step]
    singles = [one for one in state.first if one.screened_loss < settings.pair_helps_alone][: settings.paired]
    scout = start.calibrate(
        evidence.scout, repeats=settings.scout_repeats, seed=SimulationStream.CALIBRATE_SCOUT.seed(seed)
    )
    pairs = list(combinations(singles, 2))
    # a pair has to do better than what was found one by one
    present = scout.run(model.space, model.place[None], seed=seed)[0]
    goal = settings.pair_behind * float(scout.scale.loss(present))
    # only the first are fitted to all pixels
    race, works, names = CandidateRace(settings.fitted_pairs, goal=goal), [], []
    for one, two in pairs:
        both = one.model.sensor.with_effect(two.model.sensor[two.name])
        pair = with_same_freedom(both, start, (one.name, two.name))
        name = f"{one.name} + {two.name}"
        # which rule is best for an effect alone need not be best beside the other
        for way in (pair, *ways_otherwise(pair, (one.name, two.name))):
            works.append(way.search_work(scout, seed=seed, iterations=4, radius=0.3, over=race.over(name)))
            names.append(name)
    ends = run_side_by_side(works, lambda share: state.progress("trying pairs", share, state.error))
    best = dict[str, FittedModel]()
    for name, pair in sorted(zip(names, ends, strict=True), key=lambda named: named[1].loss):
        best.setdefault(name, pair)
    first = [(name, pair) for name, pair in best.items() if pair.loss <= goal][: settings.fitted_pairs]
    settled = run_side_by_side([refit_work(evidence, pair, seed=seed) for _, pair in first])
    ranking: list[Rank] = []
    for (name, _), pair in zip(first, settled, strict=True):
        judged = state.judge(pair)
        ranking = sorted([*ranking, _rank_of_pair(name, pair, judged, before)], key=_error_of_rank)
        if judged.error < judgement.error * (1.0 if reaches_floor(judged) else settings.pair_gain):
            model, judgement = pair, judged
            state.history.append(replace(before, chosen=name, ties=(), ranking=tuple(ranking), cells=()))
    return model, judgement


def _rank_of_pair(name: str, pair: FittedModel, judged: Judgement, first: Step) -> Rank:
    """Return two effects that came in at once as the user sees them; there is no null of pairs, so no p."""
    fall = first.error - judged.error
    share = min(fall / max(first.error - 1.0, 1e-9), 1.0)
    return Rank(name, judged.error, fall, share, float("nan"), _values_of(pair, name.split(" + ")))


def _values_of(model: FittedModel, effects: Collection[str]) -> dict[str, Estimate]:
    """Return the fitted values of some effects, without intervals."""
    return {
        axis.name: Estimate(*(3 * (float(axis.to_value(place)),)))
        for axis, place in zip(model.space.axes, model.place, strict=True)
        if axis.effect.name in effects
    }


def _error_of_rank(rank: Rank) -> float:
    return rank.error


def _known_so_far(
    state: DiagnosisState, model: FittedModel, errors: list[float], before: float, seconds: float
) -> Diagnosis:
    """Return what a search knows after a step: the nearest model, nothing of which is announced yet."""
    return Diagnosis(
        sensor=model.sensor,
        selected=(),
        errors=(errors[0],),
        before=before,
        floor=1.0,
        gate=state.history[-1].gate,
        parameters={},
        unexplained=None,
        history=tuple(state.history),
        notes=(*state.notes, *state.evidence.notes),
        evaluations=state.evidence.evaluations,
        seconds=seconds,
        finished=False,
    )


def _conclude_diagnosis(
    state: DiagnosisState,
    start: FittedModel,
    model: FittedModel,
    before: float,
    seen: SeenEffects,
    names: frozenset[str],
    measurement: Measurement,
) -> Diagnosis:
    """Return what was found, judged by the part of the measurement by which nothing was chosen."""
    found = state.added_to(model)
    chosen = [n for s in state.history if s.chosen for n in s.chosen.split(" + ")]
    order = tuple(dict.fromkeys([*(n for n in chosen if n in found), *found]))
    stream, repeats = SimulationStream.JUDGE.seed(state.seed), state.settings.repeats
    way = _judged_way(state)
    first = way.get(frozenset()) or judge_on_report(state, [start], repeats=repeats)[0]
    mine = way.get(frozenset(found)) or judge_on_report(state, [model], repeats=repeats)[0]
    # what is far too wrong makes no claim about the camera, and steps nearer to it would lead nowhere
    if is_far_off(first.judgement, mine.judgement, state.settings.grades):
        values = _values_of(model, [axis.effect.name for axis in model.space.axes])
    else:
        model, values = estimate_parameters(state.evidence, model, seed=state.seed)
    report = model.calibrate(state.evidence.report, repeats=repeats, seed=stream)
    last = report.judge(stream)
    at_bounds = parameters_at_bounds(model, values)
    judged_effects: dict[str, Finding] = {}
    if not state.evidence.contradiction:
        judged_effects = grade_effects(
            state, model, order, way, first, last, report=report, values=values, at_bounds=at_bounds
        )
    explained = model.sensor
    for name, one in judged_effects.items():
        # a stand-in explains nothing that the events show
        explained = explained.without(name) if one.grade is Grade.STAND_IN else explained
    part = part_to_simulate(measurement, state.evidence.when)
    seen = without_the_explained(seen, part, explained, state.seed, before=start.sensor)
    said = seen.findings(judged_effects.values(), names)
    findings = {one.effect: one for one in said if one.grade is not Grade.STAND_IN}
    kept = tuple(n for n in order if n in findings and findings[n].grade is not Grade.EITHER)
    nearest = tuple(n for n in order if n not in findings)
    limits: tuple[DetectionLimit, ...] = ()
    if not state.evidence.contradiction:
        named = {*state.given, *findings, *nearest}
        if leaves_little(first.judgement, last, state.settings.grades):
            # beside a model that is too far off for any finding, nothing can be promised
            limits = find_detection_limits(state, model, report, first.judgement, last, named)
        limits += seen.limits({*named, *(one.effect for one in limits)})
    final, error, estimates, plain = model, last.error, values, plain_numbers(report)
    if set(kept) != set(order):
        final = _model_with_only(state, start, model, kept)
        final, estimates = estimate_parameters(state.evidence, final, seed=state.seed)
        bare = final.calibrate(state.evidence.report, repeats=repeats, seed=stream)
        judged = bare.judge(stream)
        error, plain = judged.error, plain_numbers(bare)
    cells = worst_cells(state.evidence, last)
    unexplained: Unexplained | None = None
    of_scene = share_of_scene(state, model, last)
    doubts = [state.evidence.contradiction] if state.evidence.contradiction else at_bounds
    if (doubts and order and not findings) or state.evidence.contradiction:
        unexplained = replace(
            describe_unexplained(order, findings, first.judgement, last, cells, of_scene),
            sentence=_sentence_of_doubts(order, doubts, last),
        )
    elif nearest or not may_be_announced(last):
        unexplained = describe_unexplained(nearest, findings, first.judgement, last, cells, of_scene)
    return Diagnosis(
        sensor=final.sensor,
        selected=kept,
        errors=_errors_after_additions(way, kept, first.judgement.error, error),
        before=before,
        floor=1.0,
        gate=last.gate,
        parameters=estimates,
        unexplained=unexplained,
        history=_with_reported_errors(state, way),
        notes=(*state.notes, *at_bounds, *state.evidence.notes),
        plain=plain,
        evaluations=state.evidence.evaluations,
        findings=tuple(findings.values()),
        stand_ins=tuple(one for one in said if one.grade is Grade.STAND_IN),
        not_seen=limits,
        record=what_to_record(
            measurement.scene,
            list(findings.values()),
            unexplained,
            contradiction=bool(state.evidence.contradiction),
        ),
        level=last.level,
        reach=last.reach,
    )


def _judged_way(state: DiagnosisState) -> dict[frozenset[str], ModelOnReport]:
    """Return the models of the search by what they had added, on the part that reports."""
    models = {frozenset(state.added_to(one)): one for one in state.path}
    judged = judge_on_report(state, list(models.values()), repeats=state.settings.repeats)
    return dict(zip(models, judged, strict=True))


def _model_with_only(
    state: DiagnosisState, start: FittedModel, model: FittedModel, names: tuple[str, ...]
) -> FittedModel:
    """Return the model with only some of the effects that were added, fitted."""
    for one in (start, *state.path):
        if set(state.added_to(one)) == set(names):
            return one
    sensor = model.sensor
    for name in state.added_to(model):
        sensor = sensor if name in names else sensor.without(name)
    return refit_model(state.evidence, with_same_freedom(sensor, model, ()), seed=state.seed)


def _with_reported_errors(
    state: DiagnosisState, way: Mapping[frozenset[str], ModelOnReport]
) -> tuple[Step, ...]:
    """Return the steps of the search with the errors of the part that reports, so that each model has one."""
    out = []
    for step in state.history:
        mine = way.get(frozenset(step.model) - state.given)
        out.append(replace(step, error=mine.judgement.error, gate=mine.judgement.gate) if mine else step)
    return tuple(out)


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
