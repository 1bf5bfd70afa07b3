"""What the events show beside a model over the scene, however badly that fits.

Noise and leaks show by what pixels send while their light rests, a dead time by where the intervals of pixels
end, thresholds that differ or drift by how far light goes from one event to the next: each against a
simulation of the model. What events show without any model is in `dase.diagnosis.seen_effects`.
"""

from __future__ import annotations

from dataclasses import replace

from dase.diagnosis.dead_time import EFFECT as REFRACTORY
from dase.diagnosis.dead_time import add_dead_time, find_dead_time
from dase.diagnosis.drifting_memory import EFFECT as LEAKING
from dase.diagnosis.drifting_memory import find_drifting_memory
from dase.diagnosis.events_at_rest import find_events_at_rest, noise_is_a_pattern
from dase.diagnosis.redrawn_thresholds import EFFECT as JITTER
from dase.diagnosis.redrawn_thresholds import find_jitter_beside
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.state import DiagnosisState, with_same_freedom
from dase.diagnosis.unequal_thresholds import EFFECT as MISMATCH
from dase.diagnosis.unequal_thresholds import find_unequal_thresholds
from dase.effects.threshold import Threshold
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel
from dase.probes.distance import Judgement
from dase.results import is_worse
from dase.signatures.kinds import (
    DEAD_TIME,
    FIXED_PATTERN,
    LEAK_EVENTS,
    NOISE_AT_REST,
    UNEQUAL_THRESHOLDS,
)


def look_beside_model(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with what the events show that a model before the search has not.

    Args:
        state: Gets which effects are certain: those that are seen, may be added and are not in the sensor.
        seen: What the events show by themselves.
        measurement: Its light and its events are looked at.
        model: The one before the search.
    """
    seen = _look_where_light_rests(state, seen, measurement, model)
    seen = _look_for_dead_time(state, seen, measurement, model)
    seen = _look_at_thresholds(state, seen, measurement, model)
    seen = _without_pattern_of_noise(state, seen, measurement, model)
    state.certain = frozenset(seen.effects) & frozenset(state.effects) - state.given
    state.shown = state.certain & seen.shown_whatever_fits
    return seen


def settle_dead_time(
    state: DiagnosisState,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> tuple[SeenEffects, FittedModel]:
    """Return what is seen, and the last model, with a dead time if the intervals end beside that, too.

    Args:
        state: Gets that the dead time is certain, or forgets it.
        seen: What the events show beside the model before the search.
        measurement: Its intervals are looked at.
        model: The last one.
        judgement: Its held-out error.
    """
    if REFRACTORY in state.put_off:
        # beside what was found instead of it the intervals may end nowhere
        seen = replace(seen, entries=tuple(one for one in seen.entries if one.name != DEAD_TIME))
        bare = with_same_freedom(model.sensor.without(REFRACTORY), model, ())
        seen = _look_for_dead_time(state, seen, measurement, bare)
    elif state.added_to(model):  # else it was asked before
        seen = _look_for_dead_time(state, seen, measurement, model)
        seen, model, judgement = _without_needless_dead_time(state, seen, measurement, model, judgement)
    ended = seen.entry_of(DEAD_TIME)
    if ended is not None and REFRACTORY in state.effects and REFRACTORY not in model.sensor:
        state.certain |= {REFRACTORY}
        model, _ = add_dead_time(state, model, judgement, ended)
    return seen, model


def settle_jitter(
    state: DiagnosisState,
    seen: SeenEffects,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
) -> SeenEffects:
    """Return what is seen, with thresholds that are drawn anew at each event if the last model needs that.

    Args:
        state: Gets that the jitter is certain, or forgets it.
        seen: What the events show beside other models.
        measurement: The light between its events is looked at.
        model: The last one; a jitter of its own is left out.
        judgement: Its held-out error.
    """
    if JITTER not in state.added_to(model) or seen.lamp or state.evidence.frame_step:
        return seen
    found = find_jitter_beside(state, measurement, model, judgement)
    if found is None:
        state.certain -= {JITTER}
        return seen
    state.certain |= {JITTER}
    return replace(seen, entries=(*seen.entries, found))


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
    state.noise = found.size if found is not None and found.name == NOISE_AT_REST else 0.0
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


def _look_at_thresholds(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, with how much the thresholds of pixels differ, or drift, if they do."""
    if state.evidence.contradiction or seen.lamp:
        return seen
    found = []
    if MISMATCH not in state.given:
        found.append(find_unequal_thresholds(measurement, model.sensor, seed=state.seed))
    # light that goes on in a dead time counts for nothing, and the less the longer the time between events is
    if LEAKING not in state.given and not (seen.entry_of(LEAK_EVENTS) or seen.entry_of(DEAD_TIME)):
        structure = state.evidence.structure
        found.append(find_drifting_memory(measurement, model.sensor, structure=structure, seed=state.seed))
    return replace(seen, entries=(*seen.entries, *(one for one in found if one is not None)))


def _without_pattern_of_noise(
    state: DiagnosisState, seen: SeenEffects, measurement: Measurement, model: FittedModel
) -> SeenEffects:
    """Return what is seen, without a pattern of ON and OFF events that noise at rest may make.

    Thresholds that differ are told by what light does between events, too.
    """
    both = seen.entry_of(FIXED_PATTERN) and seen.entry_of(NOISE_AT_REST)
    if not both or seen.entry_of(UNEQUAL_THRESHOLDS):
        return seen
    if not noise_is_a_pattern(measurement, model.sensor, seed=state.seed):
        return seen
    state.notes.append(
        "pixels at rest send ON and OFF noise at rates of their own: that they differ tells nothing of their "
        "thresholds"
    )
    return replace(seen, entries=tuple(one for one in seen.entries if one.name != FIXED_PATTERN))


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
