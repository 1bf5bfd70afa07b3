"""Noise and leak are told by what pixels send while their light rests."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.own_effects import effect_that_makes

import dase
from dase.diagnosis import seen_beside_model
from dase.diagnosis.events_at_rest import (
    AT_REST,
    Rests,
    differ_by_polarity,
    find_events_at_rest,
    find_rests,
    judge_events_at_rest,
    longest_rest,
)
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.effects.made_signatures import told_by
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.results import Finding, Grade
from dase.scenes.video import VideoScene
from dase.signatures.kinds import DEAD_TIME, FIXED_PATTERN, LEAK_EVENTS, NOISE_AT_REST, OPPOSITE_PAIRS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

SIDE = 40


def passing_bar(seconds: float = 0.8, gap: float = 2e-3) -> VideoScene:
    """Return a bar that passes before a wall that rests, of 40x40 pixels."""
    rng = np.random.default_rng(4)
    wall = rng.uniform(0.2, 0.8, (SIDE, SIDE))
    times = np.arange(0.0, seconds, gap)
    columns = np.arange(SIDE)
    frames = []
    for t in times:
        bar = np.clip(4 - np.abs(columns - 60 * t), 0, 1)
        frames.append(wall * (1 - 0.8 * bar))
    return VideoScene(np.array(frames, np.float32), times)


@pytest.fixture(scope="module")
def scene():
    return passing_bar()


def found(scene, events, sensor=None, **more):
    given = {"thresholds": (0.2, 0.2), "seed": 0, "settings": replace(AT_REST, **more)}
    return find_events_at_rest(Measurement(events, scene), sensor or Sensor(), **given)


def seen_by(scene, **effects):
    sensor = Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    return dase.simulate(scene, sensor, seed=3)


def test_shot_noise_is_noise_whose_events_know_nothing_of_each_other(scene):
    entry = found(scene, seen_by(scene, shot=dict(rate=3.0)))
    assert entry.name == NOISE_AT_REST
    assert told_by(entry, EFFECTS) == ("shot",)
    assert entry.details["independent"] == pytest.approx(0.5, abs=0.05)
    assert entry.low < entry.size < entry.high


def test_noise_of_the_voltage_takes_turns(scene):
    entry = found(scene, seen_by(scene, voltage_noise=dict(sigma=0.1, cutoff=50.0)))
    assert entry.name == NOISE_AT_REST
    assert told_by(entry, EFFECTS) == ("voltage_noise",)
    assert entry.details["returning"] > 0.8


@pytest.mark.parametrize(("rate", "told"), [(4.0, ("shot",)), (0.2, ())])
def test_polarities_at_even_intervals_each_do_not_return(scene, rate, told):
    """IEBCS's noise: in a short time there is one of each at most, and it was noise of the voltage."""
    rng = np.random.default_rng(6)
    one, end = SIDE * SIDE, float(scene.sample_times()[-1])
    t, pixel, p = [], [], []
    for sign in (0, 1):
        turns = np.arange(int(rate * end) + 2)
        when = (turns + rng.random((one, 1))) / rate
        t.append(when.ravel())
        pixel.append(np.repeat(np.arange(one), len(turns)))
        p.append(np.full(when.size, sign, bool))
    t, pixel, p = (np.concatenate(part) for part in (t, pixel, p))
    order = np.flatnonzero(t < end)[np.argsort(t[t < end], kind="stable")]
    events = Events(t[order], pixel[order] % SIDE, pixel[order] // SIDE, p[order], SIDE, SIDE)
    entry = found(scene, events)
    assert entry.name == NOISE_AT_REST
    assert told_by(entry, EFFECTS) == told


def test_few_pairs_do_not_tell_which_noise_it_is(scene):
    entry = found(scene, seen_by(scene, shot=dict(rate=0.4)))
    assert entry.name == NOISE_AT_REST
    assert told_by(entry, EFFECTS) == ()


def test_a_leak_sends_on_events_alone(scene):
    entry = found(scene, seen_by(scene, leak=dict(rate=1.0)))
    assert entry.name == LEAK_EVENTS
    assert entry.details["off"] == 0


def test_hot_pixels_hide_no_leak(scene):
    """Their OFF events would be too many for one."""
    hot = dict(share=0.01, rate=100.0)
    entry = found(scene, seen_by(scene, leak=dict(rate=1.0), hot=hot))
    assert entry.name == LEAK_EVENTS
    both = found(scene, seen_by(scene, leak=dict(rate=1.0), hot=hot), hot_count=AT_REST.events * 1000)
    assert both.name == NOISE_AT_REST


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("bandwidth", {"cutoff": 8.0}),
        ("hot", {"share": 0.01, "rate": 100.0}),
        ("flicker", {"frequency": 100.0, "depth": 0.4}),
        ("mismatch", {"spread": 0.3}),
        ("jitter", {"spread": 0.3}),
        ("latency", {"delay": 8e-3}),
        ("refractory", {"period": 15e-3}),
        ("high_pass", {"cutoff": 0.5}),
    ],
)
def test_what_is_no_noise_is_not_taken_for_it(scene, name, values):
    assert found(scene, seen_by(scene, **{name: values})) is None


def test_noise_that_the_model_has_is_not_missing(scene):
    noisy = Sensor().with_effect(EFFECTS["shot"](rate=3.0))
    assert found(scene, dase.simulate(scene, noisy, seed=3), noisy) is None


def test_a_rest_is_the_longest_time_within_a_range():
    times = np.arange(8.0)
    level = np.array([[0, 0, 1, 1.05, 1.1, 1.15, 3, 3], [0, 1, 2, 3, 4, 5, 6, 7]], np.float32).T
    first, last = longest_rest(level, times, 0.2)
    assert (first[0], last[0]) == (2, 5)
    assert first[1] == last[1]


def test_rests_leave_out_what_comes_soon_after_motion(scene):
    rests = find_rests(Measurement(Events.empty(SIDE, SIDE), scene), still=0.02, log_eps=1e-3, seed=0)
    assert len(rests.pixels) > SIDE * SIDE // 2
    columns = rests.pixels % SIDE
    late = rests.begin > 0.1  # begins after the bar has passed
    passed = (columns[late] + 4) / 60
    assert (rests.begin[late] > passed + 0.05).all()


def at_random(count: int, on: float, seed: int = 0, together: int = 1) -> tuple[Events, Rests]:
    """Return events of 1,000 pixels that rest for a second, so many together at a time."""
    rng = np.random.default_rng(seed)
    t = np.sort(np.repeat(rng.uniform(0, 1, count // together), together))
    pixels = rng.integers(0, 1000, len(t))
    events = Events(t, pixels % 50, pixels // 50, rng.random(len(t)) < on, 50, 20)
    return events, Rests(np.arange(1000, dtype=np.int32), np.zeros(1000), np.ones(1000), np.zeros(1000))


def test_events_of_all_pixels_at_once_are_a_lamp_and_no_noise():
    events, rests = at_random(2000, 0.5)
    assert judge_events_at_rest(rests, events, 0).name == NOISE_AT_REST
    events, rests = at_random(2000, 0.5, together=20)
    assert judge_events_at_rest(rests, events, 0) is None


@pytest.mark.parametrize("goes_on", [False, True])
def test_what_a_slow_pixel_sends_late_in_short_rests_is_no_leak(goes_on):
    """Poles of 60 Hz that ring in the dark send ON events 0.1 s after motion, late in short rests."""
    rng = np.random.default_rng(5)
    pixels = np.arange(1000, dtype=np.int32)
    begin = rng.uniform(0.1, 0.4, 1000)
    rests = Rests(pixels, begin, np.where(pixels < 700, begin + 0.15, 1.0), np.zeros(1000))
    at = rng.integers(0, 1000, 3000)
    since = rng.uniform(0, 1 if goes_on else 0.15, 3000)
    inside = since < (rests.end - rests.begin)[at]
    t, at = (begin[at] + since)[inside], at[inside]
    order = np.argsort(t)
    t, at = t[order], at[order]
    events = Events(t, at % 50, at // 50, np.ones(len(t), bool), 50, 20)
    later = rests.events_in(events)[3]
    assert later.mean() > AT_REST.goes_on
    assert (judge_events_at_rest(rests, events, 0) is not None) is goes_on


@pytest.mark.parametrize("everywhere", [False, True])
def test_what_pixels_beside_moving_ones_send_is_no_leak(everywhere):
    """A lens that is less sharp than the scene shows them their neighbours, up to two pixels away."""
    rng = np.random.default_rng(6)
    pixels = np.arange(2000, dtype=np.int32)
    still = pixels[(pixels % 50) % 25 > 4]  # strips of five columns move
    rests = Rests(still, np.zeros(len(still)), np.ones(len(still)), np.zeros(len(still)))
    beside = np.isin((still % 50) % 25, (5, 6, 23, 24))
    senders = still if everywhere else still[beside]
    at = rng.choice(senders, 3000)
    events = Events(np.sort(rng.uniform(0, 1, 3000)), at % 50, at // 50, np.ones(3000, bool), 50, 40)
    settings = replace(AT_REST, spread=0.1)
    entry = judge_events_at_rest(rests, events, 0, settings=settings)
    assert (entry is not None) is everywhere


@pytest.mark.parametrize(("way", "asked"), [("returning", False), ("independent", True), ("", True)])
def test_no_leak_is_read_off_the_light_beside_noise_that_returns(monkeypatch, way, asked):
    """Between unequal thresholds it goes to the lower one, the longer the more: as a memory that drifts."""
    noise = Signature(
        name=NOISE_AT_REST, answer=Answer.FOUND, sentence="seen", details={way: 0.9} if way else {}
    )
    drifts = Signature(name=LEAK_EVENTS, answer=Answer.FOUND, sentence="drifts")
    monkeypatch.setattr(seen_beside_model.LightBetweenEvents, "of", lambda *args, **more: object())
    monkeypatch.setattr(seen_beside_model, "find_unequal_thresholds", lambda *args, **more: None)
    monkeypatch.setattr(seen_beside_model, "find_drifting_memory", lambda *args, **more: drifts)
    task = SimpleNamespace(
        evidence=SimpleNamespace(contradiction="", structure=None), given=frozenset(), seed=0
    )
    model = SimpleNamespace(sensor=Sensor())
    seen = seen_beside_model._look_at_thresholds(task, SeenEffects((noise,)), None, model)
    assert (seen.entry_of(LEAK_EVENTS) is not None) is asked


def test_noise_that_is_drawn_for_some_frames_more_than_for_others_is_told_by_its_polarities():
    events, rests = at_random(2000, 0.5, together=8)
    assert judge_events_at_rest(rests, events, 0, frame_gap=1e-4).name == NOISE_AT_REST
    alike = (np.unique(events.t, return_inverse=True)[1] % 2).astype(bool)  # of one time, of one polarity
    lamp = Events(events.t, events.x, events.y, alike, 50, 20)
    assert judge_events_at_rest(rests, lamp, 0, frame_gap=1e-4) is None


def test_bursts_of_frames_of_both_polarities_are_no_noise():
    """Thirteen in 0.65 s, of 4 % of the pixels each, had been *shot* noise, certain, in a clip of IEBCS."""
    events, rests = at_random(2000, 0.5, together=100)
    assert judge_events_at_rest(rests, events, 0, frame_gap=1e-4) is None


@pytest.mark.parametrize("bright", [0.5, 0.7, 0.9])
def test_noise_that_grows_with_light_is_in_doubt(bright):
    """Of shot noise a camera sends less in bright light; nothing that dase knows sends more there."""
    rng = np.random.default_rng(7)
    events, rests = at_random(2000, 0.5)
    rests = replace(rests, level=np.arange(1000) / 1000)
    pixels = np.where(rng.random(2000) < bright, 500, 0) + rng.integers(0, 500, 2000)
    events = Events(events.t, pixels % 50, pixels // 50, events.p, 50, 20)
    entry = judge_events_at_rest(rests, events, 0, settings=replace(AT_REST, pairs=10))
    assert entry.details.get("doubtful", False) is (bright == 0.9)
    assert ("bright pixels send" in entry.sentence) is (bright == 0.9)
    told = replace(entry, details={**entry.details, "independent": 0.5})
    (said,) = SeenEffects((told,)).findings([Finding("shot", Grade.SUPPORTED)], ())
    sure = bright != 0.9
    assert (said.grade, said.unknown) == (Grade.CERTAIN if sure else Grade.EITHER, not sure)
    dimmer = replace(rests, level=-rests.level)  # which shot noise does
    assert "doubtful" not in judge_events_at_rest(dimmer, events, 0).details
    assert "doubtful" not in judge_events_at_rest(replace(rests, level=np.zeros(1000)), events, 0).details


def test_polarities_that_are_neither_both_nor_one_tell_nothing():
    events, rests = at_random(2000, 0.9)
    assert judge_events_at_rest(rests, events, 0) is None


@pytest.mark.parametrize("own", [False, True])
def test_noise_of_either_polarity_may_be_a_pattern_of_its_own(own):
    """IEBCS gives each pixel a rate for ON and one for OFF: a fixed pattern was certain of its thresholds."""
    rng = np.random.default_rng(4)
    rates = np.exp(0.55 * rng.standard_normal((2, 1000)))
    on, off = rng.poisson(5 * rates[0]), rng.poisson(4 * rates[int(own)])
    at = np.repeat(np.tile(np.arange(1000), 2), np.concatenate([on, off]))
    p = np.repeat([True, False], [on.sum(), off.sum()])
    rests = Rests(np.arange(1000, dtype=np.int32), np.zeros(1000), np.ones(1000), np.zeros(1000))
    assert differ_by_polarity(p, at, rests) is own


@pytest.mark.parametrize(("differs", "unequal", "kept"), [
    (True, False, False), (False, False, True), (True, True, True),
])  # fmt: skip
def test_a_pattern_that_noise_makes_is_none_of_thresholds(monkeypatch, differs, unequal, kept):
    names = (FIXED_PATTERN, NOISE_AT_REST, *(["unequal thresholds"] if unequal else []))
    seen = SeenEffects(tuple(Signature(name=name, answer=Answer.FOUND, sentence="") for name in names))
    monkeypatch.setattr(seen_beside_model, "noise_is_a_pattern", lambda *args, **more: differs)
    state = SimpleNamespace(notes=[], task=SimpleNamespace(seed=0))
    left = seen_beside_model._without_pattern_of_noise(state, seen, None, SimpleNamespace(sensor=Sensor()))
    assert (left.entry_of(FIXED_PATTERN) is not None) is kept
    assert bool(state.notes) is not kept


def test_noise_of_two_kinds_is_said_to_be_either():
    entry = Signature(name=NOISE_AT_REST, answer=Answer.FOUND, sentence="pixels at rest send")
    seen = SeenEffects((entry,))
    (said,) = seen.findings([], ())
    assert (said.effect, said.grade, said.alternatives, said.unknown) == (
        "shot", Grade.EITHER, ("voltage_noise",), False,
    )  # fmt: skip
    assert said.words() == "either shot or voltage_noise"
    # what the search came nearest with is named first
    (said,) = seen.findings([Finding("voltage_noise", Grade.STAND_IN, error_with=1.0)], ())
    assert (said.effect, said.alternatives, said.error_with) == ("voltage_noise", ("shot",), 1.0)
    # and what it announced stays
    sure = Finding("voltage_noise", Grade.SUPPORTED)
    assert seen.findings([sure], ()) == [sure]
    (said,) = SeenEffects((entry,), library={"shot": EFFECTS["shot"]}).findings([], ())
    assert said.words() == "either shot or something that is not in the library"
    (said,) = SeenEffects((entry,), library={}).findings([], ())
    assert (said.effect, said.grade) == (NOISE_AT_REST, Grade.CERTAIN)


def test_noise_that_events_name_is_certain_if_the_search_agrees():
    entry = Signature(
        name=NOISE_AT_REST, answer=Answer.FOUND, sentence="at rest", details={"independent": 0.5}
    )
    # a model with shot noise that explains little: another noise may come so
    for search in ([Finding("shot", Grade.STAND_IN)], []):
        (said,) = SeenEffects((entry,)).findings(search, ())
        assert said.words() == "either shot or something that is not in the library"
    (said,) = SeenEffects((entry,), library={"voltage_noise": EFFECTS["voltage_noise"]}).findings([], ())
    assert (said.effect, said.grade) == (NOISE_AT_REST, Grade.CERTAIN)
    (said,) = SeenEffects((entry,)).findings([Finding("shot", Grade.EITHER, unknown=True)], ())
    assert (said.effect, said.grade, said.unknown) == ("shot", Grade.CERTAIN, False)


def test_what_a_slow_clock_stamps_early_is_no_leak(scene):
    """The tick before an event may be before its light began to move."""
    ticks = seen_by(scene, timestamp=dict(step=5e-3))
    rests = find_rests(Measurement(ticks, scene), still=0.02, log_eps=1e-3, seed=0)
    late = Rests(rests.pixels, rests.begin, rests.end + AT_REST.lead, rests.level)
    assert len(late.events_in(ticks)[0]) > len(rests.events_in(ticks)[0]) + AT_REST.events
    assert found(scene, ticks) is None


@pytest.mark.parametrize("name", [NOISE_AT_REST, LEAK_EVENTS, DEAD_TIME])
def test_what_an_effect_of_the_user_may_make_is_not_called_after_one_of_dase(name):
    entry = Signature(name=name, answer=Answer.FOUND, sentence="seen", details={})
    seen = SeenEffects((entry,), library=EFFECTS | {"popping": effect_that_makes("popping")})
    assert seen.named_by(entry) == ()
    mine = Finding("popping", Grade.SUPPORTED)
    assert seen.findings([mine], ()) == [mine]


def test_pairs_are_said_with_the_noise_that_sends_them():
    noise = Signature(name=NOISE_AT_REST, answer=Answer.FOUND, sentence="at rest")
    pairs = Signature(name=OPPOSITE_PAIRS, answer=Answer.FOUND, sentence="pairs")
    (said,) = SeenEffects((pairs, noise)).findings([], ())
    assert said.words() == "either shot or voltage_noise"
    offered, said = SeenEffects((pairs,)).findings([], ())
    assert offered.words() == "either voltage_noise or shot or something that is not in the library"
    assert (said.effect, said.grade) == (OPPOSITE_PAIRS, Grade.CERTAIN)


@pytest.mark.parametrize(
    ("way", "grade"), [("returning", Grade.CERTAIN), ("independent", Grade.EITHER), ("", Grade.SUPPORTED)]
)
def test_noise_is_not_supported_that_its_events_contradict(way, grade):
    """Successive events know nothing of each other: that is no noise of the voltage, however well it fits."""
    details = {way: 0.5} if way else {}
    entry = Signature(name=NOISE_AT_REST, answer=Answer.FOUND, sentence="seen", details=details)
    seen = SeenEffects((entry,), library={n: e for n, e in EFFECTS.items() if n != "shot"})
    (mine, *_) = seen.findings([Finding("voltage_noise", Grade.SUPPORTED)], ())
    assert (mine.effect, mine.grade) == ("voltage_noise", grade)
    assert mine.unknown == (grade is Grade.EITHER)
