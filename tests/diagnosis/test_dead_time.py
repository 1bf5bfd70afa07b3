"""A dead time is told by where intervals end, also where the error is blind to it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis import dead_time, seen_beside_model
from dase.diagnosis.dead_time import DEAD_TIME, end_of_intervals, find_dead_time, intervals_of
from dase.diagnosis.late_light import time_of_delay
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.state import EventsAlone
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.probes.distance import Judgement
from dase.probes.timestamp_patterns import TimestampStructure
from dase.results import Finding, Grade
from dase.scenes.video import VideoScene
from dase.signatures import kinds
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

NO_STRUCTURE = TimestampStructure()


def drifting_texture(seed: int = 0, gap: float = 1e-3, speed: float = 120.0) -> VideoScene:
    """Return a texture that drifts ever faster, from a speed [px/s] on, of 48x40 pixels."""
    rng = np.random.default_rng(seed)
    wide = rng.standard_normal((40, 400))
    kernel = np.hanning(9) / np.hanning(9).sum()
    smooth = np.apply_along_axis(np.convolve, 1, wide, kernel, "same")
    texture = np.exp(1.2 * smooth / smooth.std())
    times = np.arange(0.0, 0.6, gap)
    at = speed * (times + 1.5 * times**2)
    columns = np.arange(400.0)
    frames = np.stack([[np.interp(x + np.arange(48), columns, row) for row in texture] for x in at])
    return VideoScene(frames.astype(np.float32) / frames.max(), times)


def found(scene, events, sensor, **more):
    given = {"frame_step": 0.0, "structure": NO_STRUCTURE, "seed": 0} | more
    return find_dead_time(Measurement(events, scene), sensor, **given)


@pytest.fixture(scope="module")
def scene():
    return drifting_texture()


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_the_end_of_intervals_is_the_dead_time(scene, mode):
    period = 6e-3
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=period, mode=mode))
    entry = found(scene, dase.simulate(scene, sensor, seed=1), Sensor())
    assert entry is not None
    assert entry.found
    assert entry.details["period"] == pytest.approx(period, rel=0.05)
    assert entry.details["low"] <= period * 1.001
    # what the model has of itself is not compared with it
    assert found(scene, dase.simulate(scene, sensor, seed=1), sensor).details == entry.details


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("bandwidth", {"cutoff": 20.0}),
        ("mismatch", {"spread": 0.3}),
        ("shot", {"rate": 5.0}),
        ("jitter", {"spread": 0.3}),
        ("latency", {"delay": 5e-3}),
        ("linlog", {"knee": 0.1, "slope": 2.5}),
    ],
)
def test_what_makes_no_dead_time_has_no_end(scene, name, values):
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS[name](**values)), seed=1)
    assert found(scene, events, Sensor()) is None


def test_intervals_of_another_threshold_have_no_end(scene):
    """A model with lower thresholds has shorter intervals."""
    threshold = EFFECTS["threshold"]
    events = dase.simulate(scene, Sensor(effects=(threshold(on=0.4, off=0.4),)), seed=1)
    assert found(scene, events, Sensor(effects=(threshold(on=0.2, off=0.2),))) is None


def test_some_pixels_tell_as_well(scene):
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=6e-3, mode="drop"))
    events = dase.simulate(scene, sensor, seed=1)
    for some in (replace(DEAD_TIME, events=len(events) // 4), replace(DEAD_TIME, pixels=500)):
        entry = found(scene, events, Sensor(), settings=some)
        assert entry is not None
        assert entry.details["period"] == pytest.approx(6e-3, rel=0.01)
        whole = found(scene, events, Sensor())
        assert entry.details["without"] < 0.4 * whole.details["without"]


def test_an_end_at_frames_or_ticks_says_nothing(scene):
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=6e-3, mode="drop"))
    slow = drifting_texture(gap=5e-3)
    assert found(slow, dase.simulate(slow, sensor, seed=1), Sensor(), frame_step=5e-3) is None
    events = dase.simulate(scene, sensor, seed=1)
    assert found(scene, events, Sensor()) is not None
    assert found(scene, events, Sensor(), structure=TimestampStructure(step=5e-3)) is None
    assert found(scene, events, Sensor(), structure=TimestampStructure(line=5e-5)) is not None
    assert found(scene, events, Sensor(), structure=TimestampStructure(line=2e-4)) is None


def test_an_end_within_frames_is_told_where_intervals_are_cut_off():
    """A clip of OpenEB's rules at 600 fps had its dead time of 2.4 ms, 1.5 frames, told by no sign at all."""
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=6e-3, mode="drop"))
    slow = drifting_texture(gap=5e-3)
    entry = found(slow, dase.simulate(slow, sensor, seed=1), Sensor())
    assert entry is not None
    assert entry.details["period"] == pytest.approx(6e-3, rel=0.01)


@pytest.mark.parametrize(
    ("above", "doubtful", "told"),
    [
        (lambda rng: rng.uniform(5e-3, 8e-3, 5000), 7.5e-3, True),
        (lambda rng: 5e-3 + 3e-3 * rng.uniform(size=5000) ** 0.5, 7.5e-3, False),  # they thin out
        (lambda rng: 5e-3 + 3e-3 * rng.uniform(size=5000) ** 0.5, 4.5e-3, True),
        (lambda rng: np.append(np.full(2500, 5e-3), rng.uniform(5e-3, 8e-3, 2500)), 7.5e-3, False),  # a scan
        (lambda rng: rng.uniform(5e-3, 8e-3, 500), 7.5e-3, False),  # too few to tell
    ],
)
def test_intervals_are_cut_off_where_they_are_as_frequent_at_once(above, doubtful, told):
    rng = np.random.default_rng(1)
    seen = np.sort(above(rng))
    modelled = np.sort(rng.uniform(0, 8e-3, len(seen) * 8 // 3))
    entry = end_of_intervals(seen, modelled, doubtful=doubtful)
    assert (entry is not None) is told


def test_a_few_random_events_in_the_dead_time_hide_it_not():
    rng = np.random.default_rng(1)
    modelled = np.sort(rng.gamma(3.0, 4e-3, 20_000))
    seen = np.sort(np.concatenate([modelled[modelled > 5e-3], rng.uniform(0, 5e-3, 5)]))
    lost = np.searchsorted(modelled, 5e-3)
    entry = end_of_intervals(seen, modelled)
    assert entry is not None
    assert entry.details["period"] == pytest.approx(5e-3, rel=0.01)
    assert entry.details["here"] <= DEAD_TIME.left * lost
    many = np.sort(np.concatenate([seen, rng.uniform(0, 5e-3, int(0.05 * lost))]))
    assert end_of_intervals(many, modelled) is None


@pytest.mark.parametrize(("noisy", "told"), [(0.1, True), (0.0, False), (0.5, False)])
def test_as_many_as_noise_makes_may_be_in_the_dead_time(noisy, told):
    """v2e sends its noise in a dead time, too."""
    rng = np.random.default_rng(1)
    of_light = np.sort(rng.gamma(3.0, 4e-3, 20_000))
    lost = int(np.searchsorted(of_light, 5e-3))
    noise = rng.uniform(0, 5e-3, round(noisy / (1 - noisy) * lost))
    modelled = np.sort(np.concatenate([of_light, noise]))
    left = rng.uniform(0, 5e-3, round(0.08 * lost))
    seen = np.sort(np.concatenate([of_light[lost:], left]))
    assert (end_of_intervals(seen, modelled, of_light) is not None) is told
    assert end_of_intervals(seen, modelled) is None


def test_the_noise_of_a_model_is_left_in_a_dead_time(scene, monkeypatch):
    sensor = Sensor().with_effect(EFFECTS["shot"](rate=20.0))
    events = dase.simulate(scene, sensor, seed=1)
    asked = []
    monkeypatch.setattr(dead_time, "end_of_intervals", lambda *given, **more: asked.append(given))
    found(scene, events, sensor)
    found(scene, events, Sensor())
    noisy, quiet = asked
    assert len(noisy[2]) < 0.97 * len(noisy[1])
    assert quiet[2] is quiet[1]


def test_under_a_lamp_more_intervals_must_be_lost(scene, monkeypatch):
    """Of a thousand that are lost among a hundred thousand a pole under a lamp is as likely the cause."""
    rng = np.random.default_rng(1)
    modelled = np.sort(rng.gamma(3.0, 4e-3, 100_000))
    for end, told in ((1.7e-3, False), (5e-3, True)):
        lost = np.searchsorted(modelled, end)
        assert DEAD_TIME.lost < lost
        lists = iter([modelled[lost:], modelled] * 2)
        monkeypatch.setattr(dead_time, "intervals_of", lambda *given, some=lists: next(some))
        events = dase.simulate(scene, Sensor(), seed=1)
        assert found(scene, events, Sensor()) is not None
        assert (found(scene, events, Sensor(), lamp=True) is not None) is told


def test_an_end_later_than_any_dead_time_tells_nothing():
    rng = np.random.default_rng(1)
    modelled = np.sort(rng.gamma(3.0, 2e-2, 20_000))
    for end, told in ((0.02, True), (0.036, False)):
        assert (end_of_intervals(modelled[modelled > end], modelled) is not None) is told


def test_few_intervals_tell_nothing():
    rng = np.random.default_rng(1)
    modelled = np.sort(rng.gamma(3.0, 4e-3, 400))
    assert np.searchsorted(modelled, 5e-3) < DEAD_TIME.lost
    assert end_of_intervals(modelled[modelled > 5e-3], modelled) is None
    assert end_of_intervals(np.empty(0), modelled) is None


def test_in_step_with_frames_more_is_asked():
    rng = np.random.default_rng(1)
    modelled = np.sort(rng.gamma(3.0, 4e-3, 1_500))
    seen = modelled[modelled > 5e-3]
    assert DEAD_TIME.lost <= np.searchsorted(modelled, 5e-3) < DEAD_TIME.lost_in_step
    assert end_of_intervals(seen, modelled) is not None
    assert end_of_intervals(seen, modelled, in_step=True) is None


def test_intervals_are_those_of_each_pixel():
    events = Events(
        np.array([0.0, 0.1, 0.3, 0.35, 0.7]), np.array([0, 1, 0, 1, 0]), np.zeros(5, int),
        np.array([True, True, False, True, True]), 2, 1,
    )  # fmt: skip
    np.testing.assert_allclose(intervals_of(events), [0.25, 0.3, 0.4])
    np.testing.assert_allclose(intervals_of(events, np.array([1])), [0.25])


@pytest.mark.slow
def test_a_dead_time_that_hardly_loses_events_is_certain():
    """The error is blind to it: of 75,000 intervals some 700 are gone."""
    scene = drifting_texture(3, speed=20.0)
    base = Sensor().with_effect(EFFECTS["mismatch"](spread=0.12))
    period = 2.2e-3
    events = dase.simulate(scene, base.with_effect(EFFECTS["refractory"](period=period, mode="drop")), seed=1)
    assert abs(len(events) / len(dase.simulate(scene, base, seed=1)) - 1) < 0.02
    # the intervals of all pixels tell, however few are fitted
    diagnosis = dase.diagnose(events, base, scene=scene, pixels=400, seed=0, settings=NO_LIMITS)
    grades = {one.effect: one for one in diagnosis.findings}
    assert grades["refractory"].grade.value == "certain"
    assert "within" in grades["refractory"].seen
    assert diagnosis.sensor["refractory"].period == pytest.approx(period, rel=0.05)
    estimate = diagnosis.parameters["refractory.period"]
    assert estimate.low <= period * 1.001
    assert estimate.high >= period * 0.95
    assert "refractory" in diagnosis.finding()


@pytest.mark.parametrize(
    ("error", "ends", "dropped"), [(0.3, False, True), (0.3, True, False), (2.0, False, False)]
)
def test_a_dead_time_is_dropped_that_the_last_model_has_no_need_of(monkeypatch, error, ends, dropped):
    """Beside the model before the search, which lacked a slow low-pass, intervals looked as if cut off."""
    entry = Signature(name=kinds.DEAD_TIME, answer=Answer.FOUND, sentence="seen", details={"period": 2e-3})
    sensor = Sensor().with_effect(EFFECTS["bandwidth"](cutoff=40.0))
    model = model_of(sensor.with_effect(EFFECTS["refractory"](period=2e-3)), None)
    task = SimpleNamespace(
        added_to=lambda one: tuple(e.name for e in one.sensor.effects if e.name != "threshold"),
        judge=lambda one: judged(error),
    )
    asked = []

    def look(task, seen, measurement, one):
        asked.append(one.sensor)
        return replace(seen, entries=(*seen.entries, entry)) if ends else seen

    monkeypatch.setattr(seen_beside_model, "_look_for_dead_time", look)
    seen, last, judgement = seen_beside_model._without_needless_dead_time(
        task, SeenEffects((entry,)), None, model, judged(0.31)
    )
    assert ("refractory" not in last.sensor) == dropped
    assert (seen.entry_of(kinds.DEAD_TIME) is None) == dropped
    assert judgement.error == (error if dropped else 0.31)
    assert all("refractory" not in one and "bandwidth" in one for one in asked)


def judged(error: float) -> Judgement:
    return Judgement(error, 1.15, 0.4, 0.25, {}, {}, np.zeros(1), 1.0)


@pytest.mark.parametrize("added", [False, True])
def test_a_dead_time_that_was_put_off_is_asked_for_beside_the_last_model(monkeypatch, added):
    """Beside a model without a linear response in the dark 2,500 intervals were too short: no dead time."""
    entry = Signature(name=kinds.DEAD_TIME, answer=Answer.FOUND, sentence="seen", details={"period": 2e-3})
    sensor = Sensor().with_effect(EFFECTS["linlog"]())
    model = model_of(sensor.with_effect(EFFECTS["refractory"](period=2e-3)) if added else sensor, None)
    task = SimpleNamespace(
        added_to=lambda one: ("linlog",),
        effects=EFFECTS,
        judge=lambda one: judged(0.3),
        evidence=SimpleNamespace(frame_step=0.0),
    )
    put_off = EventsAlone(put_off=frozenset({"refractory"}))
    asked = []

    def look(task, seen, measurement, one):
        asked.append(one.sensor)
        assert seen.entry_of(kinds.DEAD_TIME) is None
        return seen

    monkeypatch.setattr(seen_beside_model, "_look_for_dead_time", look)
    seen, last = seen_beside_model.settle_dead_time(
        task, put_off, SeenEffects((entry,)), None, model, judged(0.3)
    )
    assert seen.entry_of(kinds.DEAD_TIME) is None
    assert last is model  # what the error asks for stays, and is graded by it
    assert [("refractory" in one, "linlog" in one) for one in asked] == [(False, True)]


@pytest.mark.parametrize("ends", [False, True])
def test_a_dead_time_that_the_search_has_dropped_is_asked_for_beside_the_last_model(monkeypatch, ends):
    """Behind a low-pass of 33 Hz, which the first model lacked, 72,000 intervals had been too short."""
    entry = Signature(name=kinds.DEAD_TIME, answer=Answer.FOUND, sentence="seen", details={"period": 2e-3})
    model = model_of(Sensor().with_effect(EFFECTS["bandwidth"](cutoff=33.0)), None)
    task = SimpleNamespace(
        added_to=lambda one: ("bandwidth",), effects=EFFECTS, evidence=SimpleNamespace(frame_step=0.0)
    )
    added, asked = [], []

    def look(task, seen, measurement, one):
        asked.append(one.sensor)
        assert seen.entry_of(kinds.DEAD_TIME) is None
        return replace(seen, entries=(*seen.entries, entry)) if ends else seen

    monkeypatch.setattr(seen_beside_model, "_look_for_dead_time", look)
    monkeypatch.setattr(
        seen_beside_model, "add_dead_time", lambda task, one, *rest: (added.append(one) or one, judged(0.3))
    )
    seen, _ = seen_beside_model.settle_dead_time(
        task, EventsAlone(), SeenEffects((entry,)), None, model, judged(0.3)
    )
    assert ["bandwidth" in one for one in asked] == [True]
    assert (seen.entry_of(kinds.DEAD_TIME) is not None) == ends
    assert len(added) == ends
    # no model took it: a triple with two poles left an error of 5.6 and had a dead time, certain, wrong
    said = [(one.effect, one.grade.value, one.unknown) for one in seen.findings((), ())]
    assert said == ([("refractory", "either", True)] if ends else [])


@pytest.mark.parametrize(
    ("cut_off", "error", "grade"),
    [(True, 1.8, Grade.CERTAIN), (False, 1.8, Grade.EITHER), (False, 0.3, Grade.CERTAIN)],
)
def test_an_end_that_comes_by_and_by_is_in_doubt_beside_a_model_that_lacks_something(cut_off, error, grade):
    """A low-pass of 18 Hz beside a limit of the rate that no model has: a dead time was certain."""
    details = {"period": 2e-3, "low": 1e-3, "high": 2e-3, "cut_off": cut_off}
    entry = Signature(name=kinds.DEAD_TIME, answer=Answer.FOUND, sentence="seen", details=details)
    model = model_of(Sensor().with_effect(EFFECTS["refractory"](period=2e-3)), None)
    task = SimpleNamespace(added_to=lambda one: (), effects=EFFECTS, evidence=SimpleNamespace(frame_step=0.0))
    seen, _ = seen_beside_model.settle_dead_time(
        task, EventsAlone(), SeenEffects((entry,)), None, model, judged(error)
    )
    said = seen.findings([Finding("refractory", Grade.STAND_IN)], ())
    assert [(one.effect, one.grade) for one in said] == [("refractory", grade)]


def test_an_end_says_whether_intervals_are_cut_off():
    modelled = np.sort(np.random.default_rng(1).gamma(3.0, 4e-3, 40_000))
    sharp = end_of_intervals(modelled[modelled > 5e-3], modelled)
    assert sharp is not None
    assert sharp.details["cut_off"]
    rare = np.random.default_rng(2).random(len(modelled)) < np.clip((modelled - 5e-3) / 1.5e-3, 0, 1)
    gradual = end_of_intervals(modelled[rare], modelled)
    assert gradual is not None
    assert not gradual.details["cut_off"]


@pytest.mark.parametrize(
    ("frame_step", "also", "kept"),
    [
        (1e-3, {}, [8e-3]),
        (0.0, {}, None),
        (1e-3, {"bandwidth": {"cutoff": 122.0}}, None),
    ],
)
@pytest.mark.parametrize("pole", [122.0, 60.0])
def test_what_a_dead_time_puts_off_to_the_next_frame_is_no_low_pass(
    monkeypatch, frame_step, also, kept, pole
):
    late = [
        Signature(name=kinds.LATE_EVENTS, answer=Answer.FOUND, p=0.0, size=size, unit=unit, sentence="late")
        for size, unit in ((pole, "Hz"), (8e-3, "s"))
    ]
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=1.2e-3))
    for name, values in also.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    task = SimpleNamespace(
        added_to=lambda one: ("refractory", *also),
        effects=EFFECTS,
        evidence=SimpleNamespace(frame_step=frame_step),
    )
    monkeypatch.setattr(seen_beside_model, "_look_for_dead_time", lambda task, seen, *rest: seen)
    monkeypatch.setattr(
        seen_beside_model, "_without_needless_dead_time", lambda task, seen, m, *rest: (seen, *rest)
    )
    seen, _ = seen_beside_model.settle_dead_time(
        task, EventsAlone(), SeenEffects(tuple(late)), None, model_of(sensor, None), judged(0.3)
    )
    times = [time_of_delay(one) for one in seen.entries]
    assert times == pytest.approx(kept or [1 / (2 * np.pi * pole), 8e-3])
