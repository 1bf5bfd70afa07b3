"""A leak of pixels that hardly rest is told by how far light goes from event to event."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.frame_simulator import HEIGHT, WIDTH, counted_between_frames, shaken_texture
from helpers.own_effects import effect_that_makes

import dase
from dase.diagnosis.drifting_memory import DRIFT, Drift, drift_of, find_drifting_memory
from dase.diagnosis.events_at_rest import find_events_at_rest
from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps
from dase.diagnosis.seen_beside_model import _look_at_thresholds
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.probes.timestamp_patterns import TimestampStructure
from dase.results import Grade
from dase.signatures.frame_coupling import BurstClock
from dase.signatures.kinds import DEAD_TIME, DRIFTING_MEMORY, FULL_BUS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

NO_STRUCTURE = TimestampStructure()


@pytest.fixture(scope="module")
def scene():
    return shaken_texture(length=1.2)


def found(scene, events, sensor=None, structure=NO_STRUCTURE):
    sensor = sensor or Sensor()
    light = LightBetweenEvents.of(Measurement(events, scene), log_eps=sensor.log_eps)
    return light and find_drifting_memory(light, sensor, structure=structure, seed=0)


@pytest.mark.parametrize("rate", [2.0, 4.0])
def test_the_drift_is_the_leak(scene, rate):
    for events in (
        dase.simulate(scene, Sensor().with_effect(EFFECTS["leak"](rate=rate)), seed=1),
        counted_between_frames(scene, 0.1, leak=rate),
    ):
        entry = found(scene, events)
        assert entry.name == DRIFTING_MEMORY
        assert entry.size == pytest.approx(rate, rel=0.35)
    # no pixel rests for long enough to tell it so
    rest = find_events_at_rest(Measurement(events, scene), Sensor(), thresholds=(0.2, 0.2), seed=0)
    assert rest is None


def test_noise_beside_it_hides_it_not(scene):
    entry = found(scene, counted_between_frames(scene, 0.1, leak=3.0, shot=3.0))
    assert entry is not None
    assert found(scene, counted_between_frames(scene, 0.1, shot=3.0)) is None


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("bandwidth", {"cutoff": 20.0}),
        ("dark", {"current": 0.05, "spread": 0.5}),
        ("high_pass", {"cutoff": 1.0}),
        ("hot", {"share": 0.02, "rate": 200.0}),
        ("jitter", {"spread": 0.3}),
        ("latency", {"delay": 5e-3}),
        ("linlog", {"knee": 0.16, "slope": 2.5}),
        ("mismatch", {"spread": 0.3}),
        ("refractory", {"period": 8e-3, "mode": "reset"}),
        ("refractory", {"period": 8e-3, "mode": "drop"}),
        ("shot", {"rate": 10.0}),
        ("voltage_noise", {"sigma": 0.1, "cutoff": 50.0}),
    ],
)
def test_what_is_no_leak_is_not_taken_for_it(scene, name, values):
    assert found(scene, dase.simulate(scene, Sensor().with_effect(EFFECTS[name](**values)), seed=1)) is None


def test_a_model_that_drifts_by_itself_says_it_is_no_leak(scene, monkeypatch):
    events = counted_between_frames(scene, 0.0, leak=2.0)
    assert found(scene, events) is not None
    monkeypatch.setattr("dase.diagnosis.light_between_events.simulate", lambda *_, **__: events)
    assert found(scene, events) is None


def test_what_saturates_or_is_slow_or_uncertain_is_no_drift():
    drift = Drift(rate=0.8, error=0.05, goes=0.4, from_none=0.75, bins=8, alike=0.8)
    assert drift.is_leak(DRIFT)
    assert replace(drift, rate=2.0, from_none=2.0, goes=0.1).is_leak(DRIFT)
    assert not replace(drift, from_none=0.1).is_leak(DRIFT)
    assert not replace(drift, goes=0.2).is_leak(DRIFT)
    assert not replace(drift, error=0.2).is_leak(DRIFT)
    assert not replace(drift, bins=3).is_leak(DRIFT)
    assert not replace(drift, alike=0.3).is_leak(DRIFT)
    assert not replace(drift, rate=0.3, from_none=0.3).is_leak(DRIFT)


@pytest.mark.parametrize("leak", [0.0, 1.0])
def test_long_waits_that_end_in_a_turn_are_no_drift(leak):
    """Behind a pole light that has turned goes farther, OFF more than ON, and few events of long waits follow
    one of their polarity."""
    rng = np.random.default_rng(0)
    many = 60_000
    gap = np.exp(rng.uniform(np.log(0.007), np.log(0.9), many))
    on = rng.random(many) < 0.5
    again = rng.random(many) < 0.95 - gap
    turned = np.where(again, 0.0, np.where(on, -0.4, 0.9))
    sign = np.where(on, 1, -1)
    change = sign * 0.2 * (1 + turned - sign * leak * gap + 0.1 * rng.standard_normal(many))
    zeros = np.zeros(many)
    steps = LightSteps(rng.integers(0, 6400, many), change, gap, zeros, zeros, on, again, np.ones(many, bool))
    drift = drift_of(steps, 80)
    assert drift.rate > DRIFT.rate
    assert drift.is_leak(DRIFT) == (leak > 0)
    assert drift.alike == pytest.approx(leak, abs=0.15)


@pytest.mark.parametrize("step", [2.58e-4, 9e-4])
def test_a_clock_makes_no_leak_whether_a_library_has_it_or_not(scene, monkeypatch, step):
    """One of 0.26 ms was called a leak of 2.5 thresholds per second where no effect of a clock was known."""
    clock = Sensor().with_effect(EFFECTS["timestamp"](step=step))
    models = []
    of_model = LightBetweenEvents.of_model
    monkeypatch.setattr(
        LightBetweenEvents, "of_model",
        lambda light, sensor, seed: models.append(sensor) or of_model(light, sensor, seed=seed),
    )  # fmt: skip
    monkeypatch.setattr(Drift, "is_leak", lambda drift, settings: True)
    structure = TimestampStructure(step=step)
    found(scene, dase.simulate(scene, clock, seed=1), structure=structure)
    assert [one["timestamp"].step for one in models] == [step]
    found(scene, dase.simulate(scene, clock, seed=1), clock, structure=structure)
    assert models[-1] == clock


def test_events_that_wait_for_their_row_tell_nothing(scene):
    """Meanwhile light goes on, one way before ON events and the other before OFF events."""
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["leak"](rate=3.0)), seed=1)
    slow, quick = (TimestampStructure(line=line) for line in (1.2e-3 / WIDTH, 0.5e-3 / WIDTH))
    assert found(scene, events, structure=slow) is None
    assert found(scene, events, structure=quick) is not None


def test_few_events_tell_nothing(scene):
    events = counted_between_frames(scene, 0.0, leak=2.0)
    assert found(scene, events.select(events.p)) is None
    assert found(scene, events.select((events.x < 6) & (events.y < 6))) is None
    assert found(scene, Events.empty(WIDTH, HEIGHT)) is None


def test_it_names_the_leak():
    entry = Signature(name=DRIFTING_MEMORY, answer=Answer.FOUND, sentence="drifts")
    (said,) = SeenEffects((entry,)).findings([], ())
    assert (said.effect, said.grade, said.seen) == ("leak", Grade.CERTAIN, "drifts")
    beside = SeenEffects((entry,), library=EFFECTS | {"popping": effect_that_makes("popping")})
    assert beside.named_by(entry) == ()


def test_beside_a_dead_time_it_is_not_asked(scene):
    """Light that goes on in a dead time counts for nothing: of long times between events it is a small part.

    So a strong dead time looked like a leak of 2.8 Hz in a scene of drifting waves.
    """
    events = counted_between_frames(scene, 0.0, leak=4.0)
    task = SimpleNamespace(
        evidence=SimpleNamespace(contradiction="", structure=NO_STRUCTURE), given=frozenset(), seed=0
    )
    measurement, model = Measurement(events, scene), SimpleNamespace(sensor=Sensor())
    ended = Signature(name=DEAD_TIME, answer=Answer.FOUND, sentence="ends")
    # nor beside bursts, which move the memory: one clip of DVS-Voltmeter's noise had a leak of 30 Hz
    clock = BurstClock(np.array([0.0]), 0.02, np.zeros((0, 2)))
    # nor behind a full bus, where events wait and are lost: one of IEBCS had a leak beside it
    full = replace(ended, name=FULL_BUS)
    ways = (((), None, True), ((ended,), None, False), ((), clock, False), ((full,), None, False))
    for entries, bursts, leaks in ways:
        seen = _look_at_thresholds(task, SeenEffects(entries, bursts=bursts), measurement, model)
        assert (seen.entry_of(DRIFTING_MEMORY) is not None) == leaks
