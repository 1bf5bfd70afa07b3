"""What the events show beside a model over the scene, however badly that fits.

Noise and leaks show by what pixels send while their light rests, a dead time by where the intervals of pixels
end, thresholds that differ or drift, a dark current and a knee by how far light goes from one event to the
next: each against a simulation of the model. What events show without any model is in
`dase.diagnosis.seen_effects`.
"""

from __future__ import annotations

from dataclasses import replace

from scipy import stats

from dase.diagnosis.alike_steps import find_alike_steps
from dase.diagnosis.dead_time import EFFECT as REFRACTORY
from dase.diagnosis.dead_time import add_dead_time, find_dead_time
from dase.diagnosis.doubles_of_jumps import JUMPS
from dase.diagnosis.drifting_memory import EFFECT as LEAKING
from dase.diagnosis.drifting_memory import find_drifting_memory
from dase.diagnosis.events_at_rest import find_events_at_rest, noise_is_a_pattern
from dase.diagnosis.late_light import find_late_events, time_of_delay, unlike_poles_of
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.diagnosis.redrawn_thresholds import EFFECT as JITTER
from dase.diagnosis.redrawn_thresholds import REDRAWN, find_jitter_beside, is_unlike_fit
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, EventsAlone, with_same_freedom
from dase.diagnosis.steps_in_the_dark import MAKERS as MAKERS_OF_DARK_STEPS
from dase.diagnosis.steps_in_the_dark import find_larger_steps_in_the_dark
from dase.diagnosis.unequal_thresholds import EFFECT as MISMATCH
from dase.diagnosis.unequal_thresholds import find_unequal_thresholds
from dase.effects import EFFECTS
from dase.effects.high_pass import HighPass
from dase.effects.jitter import Jitter
from dase.effects.made_signatures import makers_of
from dase.effects.refractory import Refractory
from dase.effects.threshold import Threshold
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel
from dase.probes.distance import Judgement
from dase.results import is_worse
from dase.signatures.kinds import (
    DEAD_TIME,
    DOUBLE_EVENTS,
    DRIFTING_MEMORY,
    FIXED_PATTERN,
    LATE_EVENTS,
    LEAK_EVENTS,
    NOISE_AT_REST,
    UNEQUAL_THRESHOLDS,
)
from dase.signatures.result import Signature
from dase.simulation.sensor import Sensor

LATE_IN_DEAD_TIME = 1.5
"""Times of a dead time and a frame up to which what events wait for may look like a pole: one of 6.2 ms of
v2e, beside frames each 1.6 ms, looked like one of 10.5 ms."""


def look_beside_model(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with what the events show that a model before the search has not.

    Args:
        state: Its path begins with the certain effects: those that are seen, may be added and are not in the
            sensor.
        seen: What the events show by themselves.
        measurement: Its light and its events are looked at.
        model: The one before the search.
    """
    task = state.task
    seen = _look_where_light_rests(task, seen, measurement, model)
    seen = _look_for_dead_time(task, seen, measurement, model)
    seen = _look_at_thresholds(task, seen, measurement, model)
    seen = _look_at_steps_in_the_dark(task, seen, measurement, model)
    seen = _look_for_late_events(state, seen, measurement, model)
    seen = _without_pattern_of_noise(state, seen, measurement, model)
    certain = frozenset(seen.effects) & frozenset(task.effects) - task.given
    noise = seen.entry_of(NOISE_AT_REST)
    state.begin_path(
        certain=certain,
        shown=certain & seen.shown_whatever_fits,
        noise=0.0 if noise is None else noise.size,
    )
    return seen


def settle_dead_time(
    task: DiagnosisTask,
    events_alone: EventsAlone,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> tuple[SeenEffects, FittedModel]:
    """Return what is seen, and the last model, with a dead time if the intervals end beside that, too.

    What that dead time delays to the next frame is no longer seen as late.

    Args:
        task: What the diagnosis is asked.
        events_alone: Whether the dead time was put off.
        seen: What the events show beside the model before the search.
        measurement: Its intervals are looked at.
        model: The last one.
        judgement: Its held-out error.
    """
    if REFRACTORY in events_alone.put_off:
        # beside what was found instead of it the intervals may end nowhere
        seen = seen.without(DEAD_TIME)
        bare = with_same_freedom(model.sensor.without(REFRACTORY), model, ())
        seen = _look_for_dead_time(task, seen, measurement, bare)
    elif task.added_to(model):  # else it was asked before
        if REFRACTORY not in model.sensor:  # what the search has dropped since is asked beside its last model
            seen = seen.without(DEAD_TIME)
        seen = _look_for_dead_time(task, seen, measurement, model)
        seen, model, judgement = _without_needless_dead_time(task, seen, measurement, model, judgement)
    ended = seen.entry_of(DEAD_TIME)
    if ended is not None and REFRACTORY in task.effects and REFRACTORY not in model.sensor:
        model, judgement = add_dead_time(task, model, judgement, ended)
        if REFRACTORY not in model.sensor:  # no model has it: what the last one lacks may end intervals so
            seen = seen.with_doubt(DEAD_TIME)
    if ended is not None and judgement.error > judgement.gate and not ended.details.get("cut_off", True):
        # a model that lacks something else has other short intervals, and these become rare by and by
        seen = seen.with_doubt(DEAD_TIME)
    return _without_delays_of_dead_time(task, seen, model), model


def _without_delays_of_dead_time(task: DiagnosisTask, seen: SeenEffects, model: FittedModel) -> SeenEffects:
    """Return what is seen, less the late events that the dead time of the last model makes.

    Of a simulator that knows frames alone, what is due in a dead time comes with the first frame after it. A
    dead time of no more than a frame ends no intervals, so that it is not seen before the search: one of
    1.14 ms of v2e, with frames each 1 ms, looked like a pole of 1.3 ms.

    Args:
        task: What the diagnosis is asked.
        seen: What the events show.
        model: The last one; a low-pass or latency of its own needs no delays to be found.
    """
    frame_step = task.evidence.frame_step
    if not frame_step or REFRACTORY not in task.added_to(model):
        return seen
    if any(name in model.sensor for name in makers_of(LATE_EVENTS, {**EFFECTS, **task.effects})):
        return seen
    dead_time = model.sensor[REFRACTORY]
    assert isinstance(dead_time, Refractory)
    longest = LATE_IN_DEAD_TIME * (dead_time.period + frame_step)
    kept = (one for one in seen.entries if one.name != LATE_EVENTS or time_of_delay(one) > longest)
    return replace(seen, entries=tuple(kept))


def settle_jitter(
    task: DiagnosisTask,
    events_alone: EventsAlone,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> SeenEffects:
    """Return what is seen, with thresholds that are drawn anew at each event if the last model needs that.

    Not with far more than its jitter, nor where much is left: what looks so is something else.

    Args:
        task: What the diagnosis is asked.
        events_alone: Which noise was seen.
        seen: What the events show beside other models.
        measurement: The light between its events is looked at.
        model: The last one; a jitter of its own is left out.
        judgement: Its held-out error.
    """
    if JITTER not in task.added_to(model) or seen.lamp or task.evidence.frame_step or seen.full_bus:
        return seen
    if judgement.error > REDRAWN.sure:
        return seen
    found = find_jitter_beside(measurement, model, judgement, noise=events_alone.noise, seed=task.seed)
    if found is None or is_unlike_fit(found, model.sensor):
        return seen
    return replace(seen, entries=(*seen.entries, found))


def settle_doubles(task: DiagnosisTask, seen: SeenEffects, model: FittedModel) -> SeenEffects:
    """Return what is seen, less double events of which thresholds that are drawn anew make as many.

    After a small jump a second event needs a threshold below half of the usual one, which a wide jitter draws
    as often as that: one of 47 % of IEBCS sent 0.9 % of the events so.

    Args:
        task: What the diagnosis is asked.
        seen: What the events show beside the model before the search.
        model: The last one.
    """
    entry = seen.entry_of(DOUBLE_EVENTS)
    if entry is None or JITTER not in task.added_to(model):
        return seen
    jitter = model.sensor[JITTER]
    assert isinstance(jitter, Jitter)
    below_half = stats.norm.cdf(-JUMPS.small / max(jitter.spread, 1e-9))
    return seen.without(DOUBLE_EVENTS) if below_half >= entry.size else seen


def settle_leak(
    task: DiagnosisTask, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, less a leak that the last model shows without one because its pixels forget.

    Voltages that go back after each change send ON events after things darker than what is around them: a
    high-pass of 0.6 Hz looked like a leak of 5.8 Hz beside a model without it.

    Args:
        task: What the diagnosis is asked.
        seen: What the events show beside the model before the search.
        measurement: Its light and its events are looked at.
        model: The last one.
    """
    if HighPass.name not in task.added_to(model):
        return seen
    sensor = model.sensor.without(LEAKING) if LEAKING in model.sensor else model.sensor
    gone = set()
    if seen.entry_of(LEAK_EVENTS) is not None:
        found = _events_at_rest(task, measurement, sensor)
        gone |= {LEAK_EVENTS} - {found.name if found is not None else ""}
    if seen.entry_of(DRIFTING_MEMORY) is not None:
        light = LightBetweenEvents.of(measurement, log_eps=sensor.log_eps)
        structure = task.evidence.structure
        if light is None or not find_drifting_memory(light, sensor, structure=structure, seed=task.seed):
            gone.add(DRIFTING_MEMORY)
    return replace(seen, entries=tuple(one for one in seen.entries if one.name not in gone))


def _events_at_rest(task: DiagnosisTask, measurement: Measurement, sensor: Sensor) -> Signature | None:
    """Return the noise or the leak of pixels at rest that a sensor has not; None where it lacks neither."""
    threshold = sensor["threshold"]
    assert isinstance(threshold, Threshold)
    return find_events_at_rest(measurement, sensor, thresholds=(threshold.on, threshold.off), seed=task.seed)


def _look_where_light_rests(
    task: DiagnosisTask, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with the noise or the leak of pixels at rest that a model has not."""
    if task.evidence.contradiction or seen.lamp or seen.bursts is not None:
        return seen
    found = _events_at_rest(task, measurement, model.sensor)
    return seen if found is None else replace(seen, entries=(*seen.entries, found))


def _look_for_dead_time(
    task: DiagnosisTask, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with the end of the intervals if there is one that a model has not."""
    if seen.entry_of(DEAD_TIME) or REFRACTORY in task.given or task.evidence.contradiction:
        return seen
    found = find_dead_time(
        measurement, model.sensor,
        frame_step=task.evidence.frame_step or 0.0, structure=task.evidence.structure,
        lamp=seen.lamp is not None, seed=task.seed,
    )  # fmt: skip
    return seen if found is None else replace(seen, entries=(*seen.entries, found))


def _look_at_thresholds(
    task: DiagnosisTask, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with how much the thresholds of pixels differ, or drift, if they do."""
    if task.evidence.contradiction or seen.lamp:
        return seen
    light = LightBetweenEvents.of(measurement, log_eps=model.sensor.log_eps)
    if light is None:
        return seen
    found = []
    if MISMATCH not in task.given:
        found.append(find_unequal_thresholds(light, model.sensor, seed=task.seed))
    # light that goes on in a dead time counts for nothing, and the less the longer the time between events is
    # (noise of the voltage, with one threshold lower than the other, goes to that one meanwhile)
    noise = seen.entry_of(NOISE_AT_REST)
    returns = noise is not None and "returning" in noise.details
    hidden = seen.entry_of(LEAK_EVENTS) or seen.entry_of(DEAD_TIME) or returns
    # a burst moves the memory, of pixels that have been silent for longest the likelier
    hidden = hidden or seen.bursts is not None or seen.full_bus
    if LEAKING not in task.given and not hidden:
        structure = task.evidence.structure
        found.append(find_drifting_memory(light, model.sensor, structure=structure, seed=task.seed))
    return replace(seen, entries=(*seen.entries, *(one for one in found if one is not None)))


def _look_at_steps_in_the_dark(
    task: DiagnosisTask, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with by how much farther light goes between two events in the dark, if it does."""
    if task.evidence.contradiction or seen.lamp or seen.stamped_late:
        return seen
    if task.given.intersection(MAKERS_OF_DARK_STEPS):
        return seen
    found = find_larger_steps_in_the_dark(measurement, model.sensor, seed=task.seed)
    if found is None:
        alike = find_alike_steps(measurement, model.sensor, seed=task.seed)
        found = None if alike is None else alike.in_the_dark()
    return seen if found is None else replace(seen, entries=(*seen.entries, found))


def _look_for_late_events(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with the ways in which events are late."""
    task = state.task
    known = makers_of(LATE_EVENTS, {**EFFECTS, **task.effects})
    # a bus makes events late, too, and a lamp and bursts make some that light does not
    hidden = seen.lamp or seen.bursts is not None or seen.full_bus
    if task.evidence.contradiction or hidden or task.given.intersection(known):
        return seen
    frame_step = task.evidence.frame_step or 0.0
    dead = seen.entry_of(DEAD_TIME)
    found = find_late_events(
        measurement,
        log_eps=model.sensor.log_eps,
        frame_step=frame_step,
        dead_time=float(dead.details["period"]) if dead else 0.0,
        device=str(task.evidence.train.trials.device),
    )
    unlike = next((poles for one in found if (poles := unlike_poles_of(one))), ())
    if unlike:
        state.try_unlike_poles(unlike)
    return replace(seen, entries=(*seen.entries, *found))


def _without_pattern_of_noise(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, without a pattern of ON and OFF events that noise at rest may make.

    Thresholds that differ are told by what light does between events, too.
    """
    both = seen.entry_of(FIXED_PATTERN) and seen.entry_of(NOISE_AT_REST)
    if not both or seen.entry_of(UNEQUAL_THRESHOLDS):
        return seen
    if not noise_is_a_pattern(measurement, model.sensor, seed=state.task.seed):
        return seen
    state.notes.append(
        "pixels at rest send ON and OFF noise at rates of their own: that they differ tells nothing of their "
        "thresholds"
    )
    return replace(seen, entries=tuple(one for one in seen.entries if one.name != FIXED_PATTERN))


def _without_needless_dead_time(
    task: DiagnosisTask,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> tuple[SeenEffects, FittedModel, Judgement]:
    """Return what is seen, and the last model, without a dead time that this has no need of.

    A model before the search that lacks a slow low-pass has bursts of events that are not there, and their
    intervals look as if they were cut off. What was found since may leave none.

    Args:
        task: What the diagnosis is asked.
        seen: With the end of the intervals beside the model before the search, if there is one.
        measurement: Its intervals are looked at.
        model: The last one.
        judgement: Its held-out error.
    """
    if seen.entry_of(DEAD_TIME) is None or REFRACTORY not in task.added_to(model):
        return seen, model, judgement
    bare = with_same_freedom(model.sensor.without(REFRACTORY), model, ())
    without = task.judge(bare)
    if is_worse(without.error, judgement.error, judgement.gate):
        return seen, model, judgement
    again = _look_for_dead_time(task, seen.without(DEAD_TIME), measurement, bare)
    if again.entry_of(DEAD_TIME) is not None:
        return seen, model, judgement
    return again, bare, without
