"""Thresholds that are drawn anew at each event are told by how far light goes from event to event."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import counted_between_frames, shaken_texture
from helpers.own_effects import effect_that_makes
from helpers.sensors import sensor_with

import dase
from dase.diagnosis import seen_beside_model
from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps
from dase.diagnosis.redrawn_thresholds import REDRAWN, find_redrawn_thresholds, runs_of
from dase.diagnosis.seen_beside_model import settle_jitter
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.state import EventsAlone
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.results import Finding, Grade
from dase.signatures.kinds import FULL_BUS, REDRAWN_THRESHOLDS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor


def found(scene, events, sensor=None, **more):
    sensor = sensor or Sensor()
    light = LightBetweenEvents.of(Measurement(events, scene), log_eps=sensor.log_eps)
    return light and find_redrawn_thresholds(light, sensor, seed=0, **more)


@pytest.fixture(scope="module")
def scene():
    return shaken_texture(gap=1e-3)


@pytest.mark.parametrize("spread", [0.1, 0.2, 0.35])
def test_the_spread_is_that_from_event_to_event(scene, spread):
    entry = found(scene, dase.simulate(scene, sensor_with(jitter={"spread": spread}), seed=1), right=True)
    assert entry.found
    assert entry.name == REDRAWN_THRESHOLDS
    assert entry.size == pytest.approx(spread, rel=0.2)
    assert entry.low < entry.size < entry.high


def test_where_most_runs_have_a_noise_event_nothing_is_said(scene):
    events = dase.simulate(scene, sensor_with(jitter={"spread": 0.2}, shot={"rate": 4.0}), seed=1)
    model = sensor_with(shot={"rate": 4.0})
    assert found(scene, events, model, right=True, noise=4.0) is not None
    # a run lasts 12 ms here
    assert found(scene, events, model, right=True, noise=100.0) is None


@pytest.mark.parametrize(
    "beside",
    [
        {"mismatch": {"spread": 0.2}},
        {"shot": {"rate": 5.0}},
        {"refractory": {"period": 2e-3}},
        {"row_scan": {"line": 1e-5}},
        {"bandwidth": {"cutoff": 300.0}},
    ],
    ids=lambda beside: next(iter(beside)),
)
def test_what_the_model_has_hides_it_not_and_is_not_taken_for_it(scene, beside):
    model = sensor_with(**beside)
    assert found(scene, dase.simulate(scene, model, seed=1), model, right=True) is None
    entry = found(
        scene, dase.simulate(scene, sensor_with(**beside, jitter={"spread": 0.25}), seed=1), model, right=True
    )
    assert entry is not None
    assert entry.size == pytest.approx(0.25, rel=0.35)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("dark", {"current": 0.05, "spread": 0.5}),
        ("dead", {"share": 0.03}),
        ("hot", {"share": 0.02, "rate": 200.0}),
        ("leak", {"rate": 4.0}),
        ("linlog", {"knee": 0.16, "slope": 2.5}),
        ("mismatch", {"spread": 0.3}),
        ("shot", {"rate": 5.0}),
        ("timestamp", {"step": 1e-3}),
    ],
)
def test_what_draws_no_thresholds_is_not_taken_for_it(scene, name, values):
    """Though the model lacks it; noise of the voltage, a low-pass or a dead time would look like it."""
    assert found(scene, dase.simulate(scene, sensor_with(**{name: values}), seed=1)) is None


@pytest.mark.parametrize("spread", [0.0, 0.12])
def test_another_simulator_without_it_does_not_show_it(scene, spread):
    assert found(scene, counted_between_frames(scene, spread)) is None


def steps_of(change: np.ndarray) -> LightSteps:
    """Return steps of pixels that send ON events alone, shape (pixels, steps), evenly in time."""
    pixel = np.arange(len(change)).repeat(change.shape[1])
    many = len(pixel)
    true = np.ones(many, bool)
    rng = np.random.default_rng(0)
    level, speed = rng.normal(size=many), rng.normal(1, 0.1, many)
    return LightSteps(pixel, change.reshape(-1), np.full(many, 0.01), level, speed, true, true, true)


def test_errors_of_single_events_and_thresholds_of_pixels_cancel():
    rng = np.random.default_rng(1)
    pixels, many = 4000, 12
    late = rng.normal(0, 0.15, (pixels, many + 1))
    own = rng.normal(0, 0.15, (pixels, 1))
    anew = rng.normal(0, 0.1, (pixels, many))

    def drawn(change):
        runs = runs_of(steps_of(0.2 * (1 + change)), 64, shortest=0.0, settings=replace(REDRAWN, reach=10.0))[
            1
        ]
        return runs.drawn.mean(), runs.whole.mean()

    for other in (np.diff(late), own + np.zeros((1, many)), np.diff(late) + own):
        alone, whole = drawn(other)
        assert abs(alone) < 0.05 * whole
        both, _ = drawn(other + anew)
        assert both == pytest.approx(0.01, rel=0.15)


def test_few_events_tell_nothing(scene):
    events = dase.simulate(scene, sensor_with(jitter={"spread": 0.3}), seed=1)
    assert found(scene, events.select((events.x < 8) & (events.y < 8))) is None
    assert found(scene, Events.empty(scene.width, scene.height)) is None


def test_one_of_the_users_own_may_make_it():
    own = Signature(name=REDRAWN_THRESHOLDS, answer=Answer.FOUND, sentence="own")
    (said,) = SeenEffects((own,)).findings([], ())
    assert (said.effect, said.grade, said.seen) == ("jitter", Grade.CERTAIN, "own")
    seen = SeenEffects((own,), library=EFFECTS | {"popping": effect_that_makes("popping")})
    assert not seen.may_name(REDRAWN_THRESHOLDS)
    mine = Finding("popping", Grade.SUPPORTED)
    assert seen.findings([mine], ()) == [mine]


def test_behind_a_full_bus_it_is_not_asked(scene, monkeypatch):
    """Light goes on while events wait: a jitter of 9 % was certain beside a bus of a small simulator."""
    told = Signature(name=REDRAWN_THRESHOLDS, answer=Answer.FOUND, sentence="drawn anew", size=0.09)
    monkeypatch.setattr(seen_beside_model, "find_jitter_beside", lambda *given, **more: told)
    task = SimpleNamespace(
        added_to=lambda model: ("jitter",), evidence=SimpleNamespace(frame_step=0.0), seed=0
    )
    full = Signature(name=FULL_BUS, answer=Answer.FOUND, sentence="full")
    model = SimpleNamespace(sensor=sensor_with(jitter={"spread": 0.1}))
    for entries, asked in (((), True), ((full,), False)):
        right = SimpleNamespace(error=0.5)
        seen = settle_jitter(task, EventsAlone(), SeenEffects(entries), None, model, right)
        assert (seen.entry_of(REDRAWN_THRESHOLDS) is told) is asked


@pytest.mark.parametrize(
    ("fitted", "error", "certain"),
    [(0.25, 0.5, True), (0.16, 0.5, True), (0.05, 0.5, False), (0.25, 0.95, True), (0.25, 1.1, False)],
)
def test_what_is_far_more_than_the_model_that_fits_has_is_no_jitter(monkeypatch, fitted, error, certain):
    """Events that are sent twice a quarter of a millisecond apart looked like a jitter of 29 %.

    A circuit without any was said to have one of 8 %, by a model that left 1.08.
    """
    told = Signature(name=REDRAWN_THRESHOLDS, answer=Answer.FOUND, sentence="drawn anew", size=0.29)
    monkeypatch.setattr(seen_beside_model, "find_jitter_beside", lambda *given, **more: told)
    task = SimpleNamespace(
        added_to=lambda model: ("jitter",), evidence=SimpleNamespace(frame_step=0.0), seed=0
    )
    model = SimpleNamespace(sensor=sensor_with(jitter={"spread": fitted}))
    last = SimpleNamespace(error=error)
    seen = settle_jitter(task, EventsAlone(), SeenEffects(()), None, model, last)
    assert (seen.entry_of(REDRAWN_THRESHOLDS) is told) is certain


@pytest.mark.slow
def test_a_diagnosis_names_it_where_the_error_hardly_shows_it(scene):
    """Beside noise its part of the error is below what chance leaves, or tells of something unknown."""
    true = sensor_with(shot={"rate": 5.0}, jitter={"spread": 0.1})
    events = dase.simulate(scene, true, seed=3)
    library = {name: EFFECTS[name] for name in ("threshold", "shot", "jitter", "mismatch")}
    noisy = sensor_with(shot={"rate": 4.0})
    diagnosis = dase.diagnose(events, noisy, scene=scene, effects=library, pixels=150, settings=NO_LIMITS)
    said = {one.effect: one for one in diagnosis.findings}
    assert said["jitter"].grade is Grade.CERTAIN
    assert "mismatch" not in said
    assert diagnosis.sensor["jitter"].spread == pytest.approx(0.1, rel=0.25)
