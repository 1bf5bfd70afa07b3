"""Which physical effect a model lacks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike

from dase.diagnosis.blurred_lens import EFFECT as LENS
from dase.diagnosis.blurred_lens import lens_between_events, with_blurred_lens
from dase.diagnosis.compared_measurement import ComparedMeasurement, choose_compared
from dase.diagnosis.conclusion import conclude_diagnosis, known_so_far
from dase.diagnosis.dead_time import EFFECT as REFRACTORY
from dase.diagnosis.dead_time import with_dead_time
from dase.diagnosis.direct_readings import (
    with_direct_readings,
    with_drawn_thresholds,
    with_jitter_of_events,
)
from dase.diagnosis.effect_search import search_effects
from dase.diagnosis.few_hot_pixels import with_hot_pixels
from dase.diagnosis.frame_memory import with_memory_of_frames
from dase.diagnosis.held_frames import (
    held_behind_low_pass,
    with_frame_as_memory,
    with_longer_dead_time,
)
from dase.diagnosis.kink_in_model import put_kink_in_model
from dase.diagnosis.lamp_in_part import LampInPart, find_lamp_in_part
from dase.diagnosis.mostly_bursts import bursts_of_all_events, with_bursts_of_all_events
from dase.diagnosis.rate_limited import limit_of_rate, with_limit_of_rate
from dase.diagnosis.seen_beside_model import (
    look_beside_model,
    settle_dead_time,
    settle_doubles,
    settle_jitter,
    settle_leak,
)
from dase.diagnosis.seen_effects import (
    SeenEffects,
    part_to_simulate,
    with_effect_of_bursts,
    with_size_that_was_seen,
    without_the_scene,
)
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.diagnosis.silent_pixels import with_dead_pixels, without_the_explained_silence
from dase.diagnosis.state import DiagnosisState, DiagnosisTask
from dase.diagnosis.steps_in_the_dark import EFFECT_OF_WAY
from dase.diagnosis.unequal_thresholds import EFFECT as MISMATCH
from dase.effects import EFFECTS, Effect
from dase.effects.jitter import Jitter
from dase.effects.made_signatures import makers_of, told_by
from dase.effects.optics_blur import OpticsBlur
from dase.fitting.burst_strength import BurstStrength, put_in_step
from dase.fitting.data_split import SPLIT
from dase.fitting.measurement import Measured, SceneChoice, as_measurement, lens_of, with_lens
from dase.fitting.model import (
    FittedModel,
    fit_present_model,
    free_where_measured,
    model_of,
    with_fixed_effect,
)
from dase.fitting.parameter_space import axes_of, refuse_idle
from dase.fitting.scene_doubt import with_scene_doubt
from dase.probes.random_streams import SimulationStream
from dase.probes.stimulus import Trust
from dase.results import Diagnosis, Progress, is_worse
from dase.scenes.grey_steps import grey_step_of
from dase.signatures.kinds import (
    DEAD_TIME,
    DOUBLE_EVENTS,
    FLICKER,
    LARGER_STEPS_IN_THE_DARK,
    OPPOSITE_PAIRS,
    UNEQUAL_THRESHOLDS,
)
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor

JITTER = Jitter.name


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
        pixels: In each part of the measurement; up to ten times as many where these have too few events.
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
    measurement = as_measurement(measured, scene, trust).through_lens_of(given)
    lens = lens_of(given)
    given = given.without(OpticsBlur.name).bound_to(measurement.scene)
    tell("looking at the events alone", 0.0, float("nan"))
    if most > 0 and LENS in effects:
        behind = lens_between_events(measurement, log_eps=given.log_eps)
        measurement = measurement if behind is None else behind.measurement
    compared = choose_compared(
        measurement, given, effects, pixels=pixels, seed=seed, device=device, settings=settings
    )
    lamp = _lamp_in_part(compared, effects) if most > 0 else None
    if lamp is not None and lamp.lights_all():
        entries = (*compared.seen.entries, lamp.entry)
        compared = replace(compared, seen=replace(compared.seen, entries=entries))
    elif lamp is not None:
        lamps = told_by(lamp.entry, effects)
        rest = {name: one for name, one in effects.items() if name not in lamps}
        found = lamp.added_to(again(lamp.rest_of(measurement), sensor=given, effects=rest), effects)
        found = replace(found, sensor=with_lens(found.sensor, None if measurement.lens else lens))
        return replace(found, seconds=time.perf_counter() - begin)
    limit = limit_of_rate(compared, effects) if most > 0 else None
    if limit is not None:
        found = with_limit_of_rate(again(measurement, sensor=given.with_effect(limit)), compared, limit)
        found = replace(found, sensor=with_lens(found.sensor, None if measurement.lens else lens))
        return replace(found, seconds=time.perf_counter() - begin)
    bursts = bursts_of_all_events(compared, effects)
    if bursts is not None:
        found = again(measurement, sensor=given.with_effect(bursts.effect))
        found = with_bursts_of_all_events(found, compared, bursts)
        found = replace(found, sensor=with_lens(found.sensor, None if measurement.lens else lens))
        return replace(found, seconds=time.perf_counter() - begin)
    state, given, free = _begin_search(compared, effects, free, tell, settings)
    names = state.task.given
    before, start = _error_as_given(state.task, given, free), _fitted_unless_worse(state, given, free)
    shown = held_behind_low_pass(measurement, state.task.evidence, start, compared.split, seed=seed)
    if shown is not None:
        return replace(again(shown), seconds=time.perf_counter() - begin)
    start, kink = put_kink_in_model(state, compared, start)
    part = part_to_simulate(measurement, state.task.evidence.when)
    in_step = state.task.evidence.frame_step > 0
    seen = without_the_scene(compared.seen, part, start.sensor, seed, in_step=in_step)
    doubles = seen.entry_of(DOUBLE_EVENTS)
    if doubles is not None:
        known = doubles.details
        state.try_doubles(
            known["gap"], spread=known.get("spread", 0.0), opposite=known.get("opposite", False)
        )
    if compared.guessed is not None:
        tell("how well the scene is known", 0.0, before)
        state.doubt_scene(with_scene_doubt(state.task.evidence, compared.guessed, start, seed=seed))
        before = _error_as_given(state.task, given, free)
        start = _fitted_unless_worse(state, start.sensor, free)
    if kink is not None:
        seen = replace(seen, entries=(*seen.entries, *kink.seen))
    seen = look_beside_model(state, seen, measurement, start)
    state.notes += compared.notes
    start, strength = _with_bursts(state, compared, seen, start)
    if so_far is not None:
        state.after_step = lambda model, errors: so_far(
            measurement.noted(known_so_far(state, model, errors, before, time.perf_counter() - begin))
        )
    model, judgement = search_effects(state, compared, start, most)
    if state.other_scene is not None:
        return replace(again(state.other_scene), seconds=time.perf_counter() - begin)
    seen, model = settle_dead_time(state.task, state.events_alone, seen, measurement, model, judgement)
    seen = settle_jitter(state.task, state.events_alone, seen, measurement, model, judgement)
    seen = settle_doubles(state.task, seen, model)
    seen = settle_leak(state.task, seen, measurement, model)
    found = conclude_diagnosis(state, start, model, before, seen, names, measurement)
    if kink is not None:
        found = kink.added_to(found, state.task)
    found = _with_what_pixels_show(found, state.task, compared, seen, model, strength)
    if measurement.lens is not None:
        found = with_blurred_lens(found, state.task, compared, start, model)
    else:  # one that was given and is off is no lens that was found
        found = replace(found, sensor=with_lens(found.sensor, lens))
    return measurement.noted(replace(found, seconds=time.perf_counter() - begin))


def _lamp_in_part(compared: ComparedMeasurement, effects: Mapping[str, type[Effect]]) -> LampInPart | None:
    """Return the lamp that lights a part of the array; None where none is seen or can be named.

    Bursts of frames have tones, too, and a lamp over all of the array is seen already.
    """
    seen, given = compared.seen, compared.given
    kinds = makers_of(FLICKER, effects)
    if not kinds or any(name in given for name in makers_of(FLICKER, {**EFFECTS, **effects})):
        return None
    if seen.bursts is not None or seen.entry_of(FLICKER) is not None:
        return None
    return find_lamp_in_part(compared.measurement, log_eps=given.log_eps)


def _begin_search(
    compared: ComparedMeasurement,
    effects: Mapping[str, type[Effect]],
    free: Sequence[str] | None,
    tell: Progress,
    settings: DiagnosisSettings,
) -> tuple[DiagnosisState, Sensor, Sequence[str] | None]:
    """Split the measurement, and put the sensor into it: at the times of its frames, with its held frames.

    Args:
        compared: The measurement and the sensor as it was given.
        effects: Candidates, name to class.
        free: Parameters of the sensor that may be refitted; None for all.
        tell: Told how far it is.
        settings: Numbers by which effects are added and dropped.

    Returns:
        The state of a diagnosis before its search, the sensor, and which parameters of it are fitted.
    """
    evidence, notes = compared.split(), list[str]()
    all_time = evidence.parts_differ
    if all_time:
        evidence = compared.split(all_time=True)
        notes.append(
            "light rests in one part of the time and not in the other: all of it is fitted, and other pixels "
            "judge"
        )
    bare = put_in_step(compared.given, evidence)
    free = free_where_measured(evidence, bare, free)
    given = with_frame_as_memory(bare, compared.measurement, evidence, free, seed=compared.seed)
    if given is not bare and JITTER in effects:
        given = with_drawn_thresholds(given, compared.measurement)
    given, more = with_memory_of_frames(given, compared.measurement, evidence, free, seed=compared.seed)
    notes += more
    if given is not bare:
        # how often a held frame makes pixels send is counted, and what they forget is known, not fitted
        free = [axis.name for axis in axes_of(bare, free)]
    tell("fitting the present model", 0.0, float("nan"))
    task = DiagnosisTask(
        evidence, compared.candidates(effects), compared.seed, tell,
        frozenset(effect.name for effect in given.effects), settings,
        frame_held=compared.measurement.held, grey_step=grey_step_of(compared.measurement.scene),
        all_time=all_time, lens=compared.measurement.lens,
    )  # fmt: skip
    return DiagnosisState(task, notes=notes), given, free


def _error_as_given(task: DiagnosisTask, given: Sensor, free: Sequence[str] | None) -> float:
    """Return the error of a sensor before any fit, on the part that reports."""
    repeats, stream = task.settings.repeats // 2, SimulationStream.JUDGE.seed(task.seed)
    return model_of(given, free).judge(task.evidence.report, repeats=repeats, seed=stream).error


def _fitted_unless_worse(state: DiagnosisState, given: Sensor, free: Sequence[str] | None) -> FittedModel:
    """Return the sensor as it was given, fitted; as it is where the fit does not generalise.

    Args:
        state: Gets a note of a fit that was not kept.
        given: The sensor.
        free: Its parameters that may be refitted; None for all.
    """
    evidence, seed = state.task.evidence, state.task.seed
    fitted = fit_present_model(evidence, given, free, seed=seed)
    stream = SimulationStream.JUDGE.seed(seed)
    asked = model_of(given, free)
    judged, as_given = (
        one.judge(evidence.held, repeats=state.task.settings.repeats // 2, seed=stream)
        for one in (fitted, asked)
    )
    if not is_worse(judged.error, as_given.error, judged.gate):
        return fitted
    state.notes.append(
        f"fitted again, the sensor as given is worse on pixels and time that no fit has seen (error "
        f"{judged.error:.2f} instead of {as_given.error:.2f}): the search began from the sensor as given"
    )
    return asked


def _with_bursts(
    state: DiagnosisState, compared: ComparedMeasurement, seen: SeenEffects, model: FittedModel
) -> tuple[FittedModel, BurstStrength | None]:
    """Return a model with the effect that makes the bursts, as they tell it, and that; None without any."""
    if state.task.evidence.contradiction:
        return model, None
    strength = compared.strength_of_bursts(seen, model.sensor, state.task.effects)
    if strength is None:
        return model, None
    # pixels remember the bursts between them, too
    state.count_as_given(strength.effect.name)
    return with_fixed_effect(model, strength.effect), strength


def _with_what_pixels_show(
    found: Diagnosis,
    task: DiagnosisTask,
    compared: ComparedMeasurement,
    seen: SeenEffects,
    model: FittedModel,
    strength: BurstStrength | None,
) -> Diagnosis:
    """Return a diagnosis with what no fit to some pixels tells, or tells as well.

    Args:
        found: By the fits alone.
        task: What the diagnosis is asked.
        compared: The measurement, and which pixels were left out.
        seen: What the events show beside the last model.
        model: The last one.
        strength: What the bursts told before the search; None without bursts.
    """
    measurement, contradicted = compared.measurement, bool(task.evidence.contradiction)
    ended, unequal = seen.entry_of(DEAD_TIME), seen.entry_of(UNEQUAL_THRESHOLDS)
    if ended is not None and REFRACTORY in task.effects:
        found = with_dead_time(found, ended)
    forgets = REFRACTORY in task.given and REFRACTORY not in compared.given
    if forgets and REFRACTORY in task.effects and not contradicted:
        found = with_longer_dead_time(found, task, measurement, model)
    if JITTER in task.given and JITTER not in compared.given:
        found = with_jitter_of_events(found, model.sensor, noisy=seen.entry_of(OPPOSITE_PAIRS) is not None)
    if not contradicted:
        found = with_direct_readings(found, task, measurement)
    if unequal is not None and MISMATCH in task.effects:
        found = with_size_that_was_seen(found, unequal, f"{MISMATCH}.spread")
    darker = seen.entry_of(LARGER_STEPS_IN_THE_DARK)
    for way, (effect, parameter) in EFFECT_OF_WAY.items():
        if darker is not None and way in darker.details and effect in task.effects:
            found = with_size_that_was_seen(found, darker, f"{effect}.{parameter}")
    silent = compared.silent
    if silent is not None and silent.decides and not contradicted:
        silent = without_the_explained_silence(silent, measurement, model.sensor, seed=task.seed)
        found = with_dead_pixels(found, silent)
    if compared.hot is not None:
        found = with_hot_pixels(found, measurement, compared.hot, seed=task.seed)
    if strength is not None:
        task.progress("how strong the bursts are", 0.95, found.errors[-1])
        # beside other effects it may be another
        bare = found.sensor.without(strength.effect.name)
        last = compared.strength_of_bursts(seen, bare, task.effects, strength.effect)
        found = with_effect_of_bursts(found, last or strength)
    return found
