"""Every signature is found in a made recording that has its effect, and not in one that has not."""

from __future__ import annotations

import json
import re
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

import dase
from dase.cli import dase_group
from dase.effects import EFFECTS
from dase.effects.readout import Readout
from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence
from dase.signatures.frame_coupling import BurstClock, CouplingSettings, _find_period
from dase.signatures.result import Answer, Signature
from perf.experiments.signatures import run as experiment

NAMES = (
    "frame coupling", "flicker", "hot pixels", "opposite pairs", "fixed pattern", "grouping", "time stamps",
    "double events", "full bus", "rate limit",
)  # fmt: skip


def made(seed=3, kind="shake", **effects):
    """Events of a sensor with some effects."""
    sensor = dase.Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.22))
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    scene = experiment.draw_scene(np.random.default_rng(seed), kind, 1.0)
    return dase.simulate(scene, sensor, seed=seed)


@pytest.fixture(scope="module")
def plain():
    return made()


def found(source):
    return {entry.name for entry in dase.find_signatures(source).found}


def bursts(plain):
    return experiment.add_bursts(np.random.default_rng(1), plain, 0.003)


def with_frames(events):
    times = np.arange(0.003, 0.95, experiment.GAP)
    frames = np.zeros((len(times), events.height, events.width), np.uint8)
    return Sequence(events, frames, times + 0.005, frame_exposure=np.full(len(times), 0.01))


@pytest.mark.parametrize("seed", [3, 4])
def test_a_weak_lamp_is_found_in_less_than_a_second(seed):
    """One that swings 0.1 of the rate keeps its phase for too few blocks of 50 ms to be told from chance."""
    events = made(seed, flicker={"frequency": 120.0, "depth": 0.025})
    short = events.select(events.t < 0.6)
    entry = dase.find_signatures(short)["flicker"]
    assert entry.found
    assert entry.details["frequency"] == pytest.approx(120.0, abs=0.3)
    plain = made(seed)
    assert not dase.find_signatures(plain.select(plain.t < 0.6))["flicker"].found


def test_a_plain_sensor_shows_nothing(plain):
    looked = dase.find_signatures(with_frames(plain))
    assert not looked.found
    assert tuple(entry.name for entry in looked.entries) == NAMES
    assert found(plain) == set()


CASES = {
    "flicker": {"flicker": {"frequency": 100.14, "depth": 0.2, "phase": 0.3}},
    "hot pixels": {"hot": {"share": 0.003, "rate": 100.0}},
    "fixed pattern": {"mismatch": {"spread": 0.2}},
    "time stamps": {"timestamp": {"step": 1e-3}},
}


@pytest.mark.parametrize("name", CASES)
def test_an_effect_of_the_sensor_shows(name):
    assert name in found(made(**CASES[name]))


def test_a_few_late_events_do_not_turn_the_frequency_of_a_lamp():
    """As where a latency lets some come after the end, in a phase of their own."""
    lamp = made(**CASES["flicker"])
    late = np.flatnonzero(lamp.t > 0.85)[::50]
    some = np.concatenate([np.flatnonzero(lamp.t <= 0.85), late])
    shifted = np.where(lamp.t[some] > 0.85, 0.002, 0.0)
    events = Events(lamp.t[some] + shifted, lamp.x[some], lamp.y[some], lamp.p[some], lamp.width, lamp.height)
    entry = dase.find_signatures(events)["flicker"]
    assert entry.details["frequency"] == pytest.approx(100.14, abs=0.05)


def test_frequency_and_swing_of_a_lamp():
    entry = dase.find_signatures(made(**CASES["flicker"]))["flicker"]
    assert entry.details["frequency"] == pytest.approx(100.14, abs=0.15)
    assert entry.low <= entry.size <= entry.high
    assert entry.sentence.startswith("light at 100.")


@pytest.mark.parametrize("frequency", [50.0, 60.0])
def test_a_lamp_as_slow_as_frames_is_no_burst(frequency):
    """Most pixels send once a swing, near its end: it looks like bursts, but wide ones."""
    looked = dase.find_signatures(made(kind="objects", flicker={"frequency": frequency, "depth": 0.2}))
    assert not looked["frame coupling"].found
    assert looked["flicker"].details["frequency"] == pytest.approx(frequency, abs=0.1)


def test_noise_at_rest_shows_and_says_of_which_kind():
    still = made(kind="objects", shot={"rate": 3.0})
    entry = dase.find_signatures(still)["opposite pairs"]
    assert entry.found
    again = dase.find_signatures(made(kind="objects", voltage_noise={"sigma": 0.065, "cutoff": 80.0}))
    assert again["opposite pairs"].found
    assert again["opposite pairs"].details["returns"]


@pytest.mark.parametrize("times", ["any", "of a clock", "of a lamp"])
def test_pairs_in_step_with_a_tone_are_no_noise(rng, times):
    """That ON and OFF both come at the ticks of a clock is no tone, that ON comes when light rises is one."""
    count = 150
    off = rng.uniform(0.0, 3.0, count)
    on = off + rng.choice([-5e-3, 5e-3], count)
    if times == "of a lamp":
        off = rng.integers(1, 300, count) / 100 + rng.normal(0, 3e-4, count)
        on = off + rng.choice([-5e-3, 5e-3], count)
    elif times == "of a clock":
        off, on = np.round(off, 2), np.round(off, 2) + rng.choice([-1e-2, 1e-2], count)
    place = rng.permutation(20 * 15)[:count]  # 5 pixels apart, so that each is alone
    x, y = 5 * (place % 20) + 2, 5 * (place // 20) + 2
    t = np.concatenate([off, on]) + 0.1
    order = np.argsort(t, kind="stable")
    polarity = np.repeat([False, True], count)
    events = Events(t[order], np.tile(x, 2)[order], np.tile(y, 2)[order], polarity[order], 100, 75)
    entry = dase.find_signatures(events)["opposite pairs"]
    assert entry.found == (times != "of a lamp")
    if times == "of a lamp":
        assert re.search(r"in step with light that swings at (100|99\.\d+|100\.\d+) Hz", entry.sentence)


@pytest.mark.parametrize("framed", [False, True])
def test_bursts_with_the_frames_show_and_tell_their_times(plain, framed):
    events = bursts(plain)
    entry = dase.find_signatures(with_frames(events) if framed else events)["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(experiment.GAP, rel=2e-3)
    assert set(entry.details["phases"]) == {"ON", "OFF"}


@pytest.mark.parametrize("step", [1e-3, 1.6e-3])
def test_bursts_show_beside_events_of_a_simulator_at_its_own_steps(plain, step):
    """Most half milliseconds are empty: with their median for the usual rate all was a burst, or a lamp."""
    events = bursts(plain)
    t = step * np.floor(events.t / step)
    looked = dase.find_signatures(replace(events, t=t))
    assert looked["frame coupling"].found
    assert looked["frame coupling"].details["interval"] == pytest.approx(experiment.GAP, rel=5e-3)
    of_none = dase.find_signatures(replace(plain, t=step * np.floor(plain.t / step)))["frame coupling"]
    assert of_none.answer is Answer.NOT_SEEN


def test_few_bursts_that_all_keep_step_are_enough():
    """Fourteen of each polarity, where a statistic of their phases alone needs some twenty."""
    coupling = {"amplitude": 0.25, "spread": 0.3, "period": 0.05, "exposure": 0.0055, "begin": 0.01}
    events = made(exposure=coupling)
    entry = dase.find_signatures(events.select(events.t < 0.7))["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(0.05, rel=2e-3)


def pulses(rng, every, many, lasts=5e-4):
    """Times of events: each `every` seconds about `many` in a span."""
    begins = np.arange(0.004, 0.99, every)
    return np.concatenate([rng.uniform(t, t + lasts, rng.poisson(many)) for t in begins])


def anywhere(rng, times):
    """Events at times, at any pixel, of any polarity."""
    n = len(times)
    return dase.Events(
        np.sort(times), rng.integers(0, 100, n), rng.integers(0, 80, n), rng.random(n) < 0.5, 100, 80
    )


def test_bursts_of_three_times_the_usual_rate_are_seen(rng):
    """4 % of the pixels of a clip of ESIM's rules sent with each frame: below what is looked for at first."""
    usual = rng.uniform(0.0, 1.0, 300_000)
    entry = dase.find_signatures(anywhere(rng, np.concatenate([usual, pulses(rng, 0.02, 700, 1e-3)])))[
        "frame coupling"
    ]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(0.02, rel=2e-3)
    assert not dase.find_signatures(anywhere(rng, usual))["frame coupling"].found


def test_bursts_show_where_little_moves(rng):
    """7 % of the pixels send each 18 ms, less than twice the rate of what moves in a quarter of them."""
    busy = anywhere(rng, rng.uniform(0.0, 1.0, 400_000))
    busy = replace(busy, x=busy.x // 2, y=busy.y // 2)
    weak = anywhere(rng, pulses(rng, 0.018, 600, 2e-3))
    both = Events.concatenate([busy, weak])
    entry = dase.find_signatures(both.select(np.argsort(both.t, kind="stable")))["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(0.018, rel=3e-2)
    assert entry.details["share"] == pytest.approx(len(weak) / (len(busy) + len(weak)), rel=0.3)
    assert not dase.find_signatures(busy)["frame coupling"].found


def test_what_repeats_too_often_for_frames_is_not_asked_for_below_the_first_limit(rng):
    times = np.concatenate([rng.uniform(0.0, 1.0, 300_000), pulses(rng, 0.008, 700, 1e-3)])
    assert dase.find_signatures(anywhere(rng, times))["frame coupling"].answer is Answer.NOT_SEEN


def faint_bursts(rng, every, share, delay):
    """Of a share of the pixels one ON event in each frame, of the last row `delay` seconds later."""
    parts = []
    for begin in np.arange(0.004, 0.99 - abs(delay), every):
        pixel = rng.choice(8000, int(8000 * share), replace=False)
        x, y = pixel % 100, pixel // 100
        t = begin + delay * y / 80 + rng.uniform(0.0, 2e-4, len(pixel))
        parts.append(dase.Events(np.sort(t), *(a[np.argsort(t)] for a in (x, y, y >= 0)), 100, 80))
    return Events.concatenate(parts)


def over(parts):
    """Events of several, in order."""
    both = Events.concatenate(parts)
    return both.select(np.argsort(both.t, kind="stable"))


@pytest.mark.parametrize(("every", "delay"), [(0.0231, 0.0), (0.0161, 0.005), (0.0342, -0.005)])
def test_bursts_that_no_single_one_shows_are_told_by_all_of_them(rng, every, delay):
    """One per cent of the pixels, 80 events beside 150: six clips of other simulators were mute or wrong."""
    usual = anywhere(rng, rng.uniform(0.0, 1.0, 300_000))
    weak = faint_bursts(rng, every, 0.01, delay)
    entry = dase.find_signatures(over([usual, weak]))["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(every, rel=3e-3)
    assert entry.details["row_delay"] == pytest.approx(delay, abs=1.1e-3)
    assert ("row" in entry.sentence) == bool(delay)
    clock = BurstClock.of(entry.details)
    assert clock.contains(weak.t).mean() > 0.95
    assert entry.details["share"] == pytest.approx(len(weak) / (len(usual) + len(weak)), rel=0.3)


def test_bursts_that_go_from_row_to_row_are_no_bus_that_reads_rows(rng):
    usual, weak = anywhere(rng, rng.uniform(0.0, 1.0, 60_000)), faint_bursts(rng, 0.0161, 0.04, 0.005)
    looked = dase.find_signatures(over([usual, weak]))
    assert looked["frame coupling"].details["row_delay"] == pytest.approx(0.005, abs=1.1e-3)
    assert looked["grouping"].answer is Answer.CANNOT_SAY
    assert "rows of the bursts come one after the other" in looked["grouping"].sentence


def test_faint_bursts_show_beside_frames_of_a_clip(rng):
    """What comes again each 4 ms is far above them, and is taken out first."""
    frames = anywhere(rng, np.concatenate([rng.uniform(0.0, 1.0, 150_000), pulses(rng, 0.004, 300, 1e-3)]))
    entry = dase.find_signatures(over([frames, faint_bursts(rng, 0.0231, 0.02, 0.0)]))["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(0.0231, rel=3e-3)
    assert not dase.find_signatures(frames)["frame coupling"].found


def test_ticks_beat_with_the_clock_and_are_no_bursts(rng):
    times = 1.4675e-3 * np.floor(rng.uniform(0.0, 1.0, 700_000) / 1.4675e-3)
    assert not dase.find_signatures(anywhere(rng, times))["frame coupling"].found


def test_what_comes_again_in_a_part_of_the_array_is_no_coupling(rng):
    usual, weak = anywhere(rng, rng.uniform(0.0, 1.0, 300_000)), faint_bursts(rng, 0.0231, 0.03, 0.0)
    part = weak.select(weak.x < 60)
    assert dase.find_signatures(over([usual, weak]))["frame coupling"].found
    assert not dase.find_signatures(over([usual, part]))["frame coupling"].found


def test_what_lasts_as_long_as_a_scene_is_no_coupling(rng):
    """A wheel whose spokes pass all tiles at the same moments was above its usual rate for 4 ms and more."""
    slow = np.concatenate([rng.uniform(t, t + 6e-3, 400) for t in np.arange(0.004, 0.99, 0.0269)])
    wheel = over([anywhere(rng, rng.uniform(0.0, 1.0, 300_000)), anywhere(rng, slow)])
    assert not dase.find_signatures(wheel)["frame coupling"].found


@pytest.mark.parametrize(("every", "doubtful"), [(0.025, True), (0.04, True), (0.0231, False)])
def test_faint_bursts_as_often_as_some_cycles_of_a_lamp_may_be_of_it(rng, every, doubtful):
    usual = anywhere(rng, rng.uniform(0.0, 1.0, 300_000))
    entry = dase.find_signatures(over([usual, faint_bursts(rng, every, 0.01, 0.0)]))["frame coupling"]
    assert entry.found
    assert entry.details["doubtful"] is doubtful


def test_faint_bursts_as_often_as_a_screen_shows_pictures_may_be_its_own(rng):
    usual = anywhere(rng, rng.uniform(0.0, 1.0, 300_000))
    assert not dase.find_signatures(over([usual, faint_bursts(rng, 1 / 60, 0.01, 0.005)]))[
        "frame coupling"
    ].found


def test_bursts_above_a_lamp_keep_the_time_of_the_frames(rng):
    """A lamp as high as weak bursts would be looks like one of bursts that come too often for frames."""
    parts = rng.uniform(0.0, 1.0, 300_000), pulses(rng, 0.01, 400), pulses(rng, 0.046, 3000)
    entry = dase.find_signatures(anywhere(rng, np.concatenate(parts)))["frame coupling"]
    assert entry.found
    assert entry.details["interval"] == pytest.approx(0.046, rel=2e-3)


def test_bursts_keep_step_among_others(rng):
    others = np.sort(np.concatenate([0.007 + 0.05 * np.arange(16), rng.uniform(0.0, 0.8, 10)]))
    period, p = _find_period(np.round(others / 5e-4) * 5e-4, 5e-4, CouplingSettings())
    assert period == pytest.approx(0.05, rel=2e-3)
    assert p < 1e-6


def test_bursts_at_any_time_have_no_period(rng):
    """Chances of what has none are as small as they say, or less so."""
    chances = []
    for _ in range(100):
        times = np.unique(np.round(np.sort(rng.uniform(0.0, 0.8, 20)) / 5e-4)) * 5e-4
        chances.append(_find_period(times, 5e-4, CouplingSettings())[1])
    assert np.mean(np.array(chances) < 0.05) <= 0.05
    assert min(chances) > 1e-4


def test_bursts_go_on_after_the_clock_ends():
    clock = BurstClock(np.array([0.0, 1.0, 2.0]), 1.0, np.array([[0.2, 0.3]])).extend(7.5)
    assert clock.contains(np.array([0.25, 0.31, 6.25, 7.1, 7.25])).tolist() == [
        True,
        False,
        True,
        False,
        True,
    ]


def test_a_lamp_is_found_beside_bursts_of_frames():
    events = bursts(made(**CASES["flicker"] | {}))
    looked = dase.find_signatures(events)
    assert looked["flicker"].details["frequency"] == pytest.approx(100.14, abs=0.3)


@pytest.mark.parametrize(("corner", "there"), [((40, 30), True), ((0, 1), False)])
def test_pixels_at_the_edge_are_not_called_hot(plain, corner, there):
    """What passes outside nobody sees: an edge that comes no further looks calm."""
    x, y = np.repeat(corner[0] + np.array([0, 7, 14]), 20), np.repeat([corner[1]] * 3, 20)
    # each by itself: what three pixels do at the same times is no noise of theirs
    t = np.random.default_rng(4).uniform(plain.t[0], plain.t[-1], 60)
    calm = plain.select((plain.x > 80) & (plain.y > 60))
    t, x, y = (np.concatenate(pair) for pair in ((t, calm.t), (x, calm.x), (y, calm.y)))
    order = np.argsort(t)
    events = dase.Events(t[order], x[order], y[order], t[order] > 0.5, plain.width, plain.height)
    assert ("hot pixels" in found(events)) == there


@pytest.mark.parametrize(("rhythm", "there"), [(0.0, True), (100.0, False)])
def test_pixels_that_follow_a_lamp_which_is_not_found_are_not_hot(plain, rhythm, there):
    """Of a lamp in a corner of the view only pixels with low thresholds tell, in one rhythm."""
    rng = np.random.default_rng(6)
    calm = plain.select((plain.x > 80) & (plain.y > 60))
    places = np.array([(20, 20), (35, 30), (50, 20), (65, 40)])
    t = rng.uniform(plain.t[0], plain.t[-1], (len(places), 80))
    p = rng.random(t.shape) < 0.5
    if rhythm:
        turns = np.floor(t * rhythm) + 0.05 * rng.standard_normal(t.shape)
        t = np.clip((turns + np.where(p, 0.25, 0.75)) / rhythm, plain.t[0], plain.t[-1])
    x, y = (np.repeat(places[:, k], t.shape[1]) for k in (0, 1))
    t, x, y, p = (
        np.concatenate(pair) for pair in ((t.ravel(), calm.t), (x, calm.x), (y, calm.y), (p.ravel(), calm.p))
    )
    order = np.argsort(t)
    events = dase.Events(t[order], x[order], y[order], p[order], plain.width, plain.height)
    looked = dase.find_signatures(events)
    assert not looked["flicker"].found
    assert looked["hot pixels"].found == there
    assert ("follow light" in looked["hot pixels"].sentence) != there


def test_hot_pixels_that_are_read_in_rows_follow_no_lamp():
    """In step with the scan all are, and each has one polarity: that looked like light that swings."""
    hot = {"share": 0.003, "rate": 150.0, "balance": 0.97}
    looked = dase.find_signatures(made(kind="objects", hot=hot, row_scan={"line": 3e-5}))
    assert looked["time stamps"].found
    assert looked["hot pixels"].found


@pytest.mark.parametrize("seed", [1, 14, 36])
def test_pixels_that_send_at_even_times_of_their_own_follow_no_lamp(plain, seed):
    """Seen while all around them rests, some cycles at a time, they are near an overtone of two of them."""
    rng = np.random.default_rng(seed)
    calm = plain.select((plain.x > 80) & (plain.y > 60))
    trains = []
    for _ in range(13):
        rate = 50 * 10 ** rng.random()
        even = np.arange(rng.random() / rate, 0.8, 1 / rate)
        rests = [
            (begin := rng.uniform(0, 0.75), begin + rng.uniform(0.02, 0.1)) for _ in range(rng.integers(1, 4))
        ]
        trains.append(even[np.any([(even >= begin) & (even < end) for begin, end in rests], axis=0)])
    number = np.repeat(np.arange(13), [len(train) for train in trains])
    x, y = 8 + 10 * (number % 7), np.where(number < 7, 15, 40)
    t, x, y = (np.concatenate(pair) for pair in ((*trains, calm.t), (x, calm.x), (y, calm.y)))
    order = np.argsort(t)
    p = np.concatenate([np.ones(len(number), bool), calm.p])
    looked = dase.find_signatures(dase.Events(t[order], x[order], y[order], p[order], 120, 90))
    assert "follow" not in looked["hot pixels"].sentence


@pytest.fixture(scope="module")
def returning():
    """Sharp edges that go to and fro over the same pixels."""
    texture = cv2.GaussianBlur(np.random.default_rng(1).random((96, 808)), (0, 0), 1.2)
    texture = np.clip((texture - texture.min()) / np.ptp(texture), 0.03, 1)
    times = np.arange(0, 1.001, 0.001)
    places = 15 * np.sin(2 * np.pi * 1.3 * times) - 330
    frames = [cv2.warpAffine(texture, np.array([[1.0, 0, x], [0, 1.0, 0]]), (128, 96)) for x in places]
    return dase.VideoScene(np.stack(frames).astype(np.float32), times)


@pytest.mark.parametrize(
    ("effects", "answer"),
    [
        ({}, "not seen"),
        ({"mismatch": {"spread": 0.15}}, "found"),
    ],
)
def test_edges_that_come_back_are_no_pattern_of_the_pixels(returning, effects, answer):
    """They leave like counts in both halves, but as many thresholds up as down."""
    sensor = dase.Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    looked = dase.find_signatures(dase.simulate(returning, sensor, seed=2))
    assert looked["fixed pattern"].answer == answer


@pytest.mark.parametrize(("deaf", "answer"), [(0.0, "found"), (0.01, "cannot say")])
def test_a_pattern_beside_a_dead_time_that_many_events_wait_for_is_in_doubt(deaf, answer):
    rng = np.random.default_rng(5)
    gaps = deaf + rng.exponential(0.014 - deaf, (2304, 70))
    times = np.cumsum(gaps, axis=1)
    on = rng.random(times.shape) < np.clip(0.5 + 0.2 * rng.standard_normal((2304, 1)), 0.1, 0.9)
    kept = times < 1
    pixel = np.repeat(np.arange(2304), 70).reshape(times.shape)[kept]
    order = np.argsort(times[kept])
    x, y = (pixel % 48).astype(np.uint16), (pixel // 48).astype(np.uint16)
    events = dase.Events(times[kept][order], x[order], y[order], on[kept][order], 48, 48)
    assert dase.find_signatures(events)["fixed pattern"].answer == answer


def test_what_is_put_into_the_events_shows(plain):
    rng = np.random.default_rng(2)
    assert found(experiment.read_rows(rng, plain)) == {"grouping"}
    assert found(experiment.double_events(rng, plain)) == {"double events"}


def test_events_that_a_delay_lets_catch_up_are_not_double():
    """ON events catch up where the delay falls as light rises, OFF ones do not; doubles show beside them."""
    late = {"latency": {"delay": 8e-3}}
    events = made(**late)
    entry = dase.find_signatures(events)["double events"]
    assert entry.details["at_once"] > 0.005 * len(events)
    assert not entry.found
    # a bus sends those of one time one after the other, and stamps may differ
    for more in ({"readout": {"rate": 8e5}}, {"timestamp": {"jitter": 5e-6, "step": 1e-6}}):
        again = dase.find_signatures(made(**late, **more))["double events"]
        assert again.details["near"] > 0.005 * len(events)
        assert not again.found
    assert found(made(**late, double_events={"share": 0.02})) == {"double events"}


def in_turn(rng, share, most=4, frames=400, pixels=900):
    """Events of a simulator that gives those of a frame of 1 ms a few times, the same for all pixels.

    A `share` has a double 1 to 60 us later.
    """
    t, pixel = [], []
    for frame in range(frames):
        parts = int(rng.integers(2, most + 1))
        some = rng.permutation(pixels)[:150]
        for part in range(1, parts + 1):  # ever fewer pixels send once more
            t.append(np.full(len(some), np.round(1000 * (frame + part / parts))))
            pixel.append(some)
            some = some[: len(some) // 2]
    t, pixel = np.concatenate(t), np.concatenate(pixel)
    again = rng.random(len(t)) < share
    t = np.concatenate([t, t[again] + rng.integers(1, 61, np.count_nonzero(again))])
    pixel = np.concatenate([pixel, pixel[again]])
    order = np.argsort(t, kind="stable")
    x, y = ((pixel[order] % 30).astype(np.uint16), (pixel[order] // 30).astype(np.uint16))
    return Events(t[order] * 1e-6, x, y, np.zeros(len(t), bool), 30, 30)


def test_double_events_show_beside_events_that_a_simulator_gives_parts_of_a_frame(rng):
    entry = dase.find_signatures(in_turn(rng, 0.04))["double events"]
    assert entry.found
    assert entry.sentence.endswith("most of these where many pixels send at one time")
    assert 19 * entry.details["near"] < entry.details["later"]  # they would be no more than chance


@pytest.mark.parametrize("most", [4, 30, 100])
def test_events_at_parts_of_a_frame_are_not_double(rng, most):
    assert not dase.find_signatures(in_turn(rng, 0.0, most))["double events"].found


@pytest.mark.parametrize(
    ("after", "shown"), [((4,), True), ((12, 52), False), ((4, 40), False), ((33, 70), False)]
)
def test_doubles_show_that_come_as_soon_after_each_frame_for_all_pixels(rng, after, shown):
    """A simulator's pixels send at its frames of 2.5 ms alone; parts of a frame would go on after a first."""
    frame, pixel = np.repeat(np.arange(200), 150), rng.integers(0, 900, 200 * 150)
    t = 2500.0 * frame
    again = rng.permutation(np.flatnonzero(rng.random(len(t)) < 0.1))
    which = np.concatenate([np.arange(len(t)), *(again[: len(again) // 2**n] for n in range(len(after)))])
    late = np.concatenate([0 * t, *(np.full(len(again) // 2**n, late) for n, late in enumerate(after))])
    t, pixel, on = t[which] + late, pixel[which], pixel[which] % 3 > 0
    order = np.argsort(t, kind="stable")
    x, y = ((pixel[order] % 30).astype(np.uint16), (pixel[order] // 30).astype(np.uint16))
    events = Events(t[order] * 1e-6, x, y, on[order], 30, 30)
    assert dase.find_signatures(events)["double events"].found == shown


@pytest.mark.parametrize(("low", "slowest", "shown"), [(25, 75, True), (0, 300, False)])
def test_slow_doubles_show_where_nothing_is_later(rng, low, slowest, shown):
    """Of OFF events alone, at times of their own; the two events of a fast rise are as late as it is long."""
    t, pixel = rng.uniform(0, 20e6, 60_000), rng.integers(0, 900, 60_000)
    on = pixel % 3 > 0
    again = np.flatnonzero((rng.random(len(t)) < 0.05) & ~on)
    t = np.concatenate([t, t[again] + rng.uniform(low, slowest, len(again))])
    pixel, on = np.concatenate([pixel, pixel[again]]), np.concatenate([on, on[again]])
    order = np.argsort(t, kind="stable")
    x, y = ((pixel[order] % 30).astype(np.uint16), (pixel[order] // 30).astype(np.uint16))
    entry = dase.find_signatures(Events(t[order] * 1e-6, x, y, on[order], 30, 30))["double events"]
    assert entry.found == shown
    if shown:
        assert "within 80 µs" in entry.sentence
        assert entry.details["gap"] == pytest.approx(50e-6, rel=0.05)


@pytest.mark.parametrize(
    ("share", "gap", "third", "shown"),
    [(0.05, 260, 0, True), (0.05, 260, 4, False), (0.05, 260, 3.7, False), (0, 0, 0, False)],
)
def test_late_doubles_show_where_nothing_is_sooner_or_later(rng, share, gap, third, shown):
    """Some hundred microseconds late; where a third follows, however much later, they are of an edge."""
    t, pixel = rng.uniform(0, 20e6, 60_000), rng.integers(0, 900, 60_000)
    again = np.flatnonzero(rng.random(len(t)) < share)
    late = gap * rng.uniform(0.6, 1.4, len(again))
    seconds = [t[again] + late]
    if third == 4:
        seconds.append(t[again] + third * late)
    elif third:
        seconds.append(seconds[0] + third * gap)
    t = np.round(np.concatenate([t, *seconds]))
    pixel = np.concatenate([pixel, *(pixel[again] for _ in seconds)])
    order = np.argsort(t, kind="stable")
    x, y = ((pixel[order] % 30).astype(np.uint16), (pixel[order] // 30).astype(np.uint16))
    entry = dase.find_signatures(Events(t[order] * 1e-6, x, y, pixel[order] % 3 > 0, 30, 30))["double events"]
    assert entry.found == shown
    if shown:
        assert "after the same pixel's last" in entry.sentence
        assert entry.details["gap"] == pytest.approx(gap * 1e-6, rel=0.05)
        assert entry.size == pytest.approx(share / (1 + share), rel=0.05)


def test_times_that_events_share_by_twos_are_no_packets(rng):
    """Nor are irregular ones whose numbers of events do not depend on the gaps before them."""
    for many in (np.full(4000, 2), rng.integers(1, 30, 4000)):
        stamps = np.cumsum(np.rint(300 * rng.gamma(2, 0.5, len(many))) + 1)
        t = np.repeat(stamps, many)
        pixel = rng.integers(0, 900, len(t))
        x, y = (pixel % 30).astype(np.uint16), (pixel // 30).astype(np.uint16)
        entry = dase.find_signatures(Events(t * 1e-6, x, y, pixel % 3 > 0, 30, 30))["time stamps"]
        assert "packets" not in entry.details


@pytest.mark.parametrize(
    ("frames", "shown"),
    [(None, True), ([1000], False), ([250, 333, 500, 1000], False), ([120, 170, 260], False)],
)
def test_packets_of_a_clock_show_and_not_frames_or_parts_of_them(rng, frames, shown):
    """A packet has what was sent since the last one; the parts of a frame have gaps that come again."""
    gaps = 3500 * rng.gamma(2, 0.5, 700) if frames is None else rng.choice(frames, int(2e6 / np.mean(frames)))
    ends = np.cumsum(np.rint(gaps) + 1)
    t = np.sort(rng.uniform(0, ends[-1], 60_000))
    t = ends[np.searchsorted(ends, t)]
    pixel = rng.integers(0, 900, len(t))
    x, y = (pixel % 30).astype(np.uint16), (pixel // 30).astype(np.uint16)
    entry = dase.find_signatures(Events(t * 1e-6, x, y, pixel % 3 > 0, 30, 30))["time stamps"]
    assert ("packets" in entry.details) == shown
    assert not shown or (entry.found and entry.details["step"] == pytest.approx(2.9e-3, rel=0.15))


@pytest.mark.parametrize(("share", "noise", "shown"), [(0.05, 0, True), (0.0, 0, False), (0.0, 4, False)])
def test_doubles_show_that_leave_a_slow_clock(rng, share, noise, shown):
    """All stamps but those of the second of doubles are whole milliseconds; spread ticks tell nothing."""
    t = 1000.0 * rng.integers(0, 20_000, 60_000)
    pixel = rng.integers(0, 900, len(t))
    t += np.round(noise * rng.standard_normal(len(t)))
    again = np.flatnonzero(rng.random(len(t)) < share)
    gap = np.round(rng.uniform(8, 18, len(again)))
    t, pixel = np.concatenate([t, t[again] + gap]), np.concatenate([pixel, pixel[again]])
    order = np.argsort(t, kind="stable")
    t, pixel = t[order] - t.min(), pixel[order]
    x, y = (pixel % 30).astype(np.uint16), (pixel // 30).astype(np.uint16)
    signatures = dase.find_signatures(Events(t * 1e-6, x, y, pixel % 3 > 0, 30, 30))
    if not noise:
        assert signatures["time stamps"].found
    assert signatures["double events"].found == shown


@pytest.mark.parametrize("seed", range(4))
def test_noise_in_step_with_two_tones_is_no_lamp(seed):
    """A hash in place of random numbers gives noise times in common: 310 Hz, and 155 Hz half as strong."""

    rng = np.random.default_rng(seed)

    def noise(seconds, half):
        t = np.sort(rng.random(round(22_000 * seconds))) * seconds
        turn = 2 * np.pi * 154.945 * t
        on = rng.random(len(t)) < 0.5 + 0.09 * np.cos(2 * turn) + half * np.cos(turn)
        x, y = rng.integers(0, 96, len(t)), rng.integers(0, 72, len(t))
        return Events(t, x.astype(np.uint16), y.astype(np.uint16), on, 96, 72)

    entry = dase.find_signatures(noise(0.96, 0.04))["flicker"]
    assert entry.p < 1e-4
    assert not entry.found
    assert "of what repeats after 6.4" in entry.sentence
    lamp = dase.find_signatures(noise(1.8, 0.0))["flicker"]
    assert lamp.found
    assert lamp.details["frequency"] == pytest.approx(309.89, abs=0.2)


def test_weak_bursts_that_take_turns_are_no_lamp():
    """ON and OFF bursts half a frame's exposure apart are strongest at twice the frame rate."""
    events = made(kind="objects", exposure={"amplitude": 0.1, "period": 0.04, "exposure": 0.01})
    entry = dase.find_signatures(events)["flicker"]
    assert entry.p < 1e-6
    assert entry.details["frequency"] == pytest.approx(50, abs=0.2)
    assert entry.answer is Answer.CANNOT_SAY
    slow = made(kind="turn", exposure={"amplitude": 0.15, "period": 0.04}, latency={"delay": 8e-3})
    assert not dase.find_signatures(slow)["flicker"].found
    lamp = made(kind="objects", flicker={"frequency": 50.0, "depth": 0.1, "duty": 0.3})
    assert "flicker" in found(lamp)


def test_the_strongest_lamp_is_named_beside_weak_tones_of_another(rng):
    """Blocks of 50 ms see 100 Hz in step at 120 Hz, too, which with 240 and 360 Hz looked like one lamp."""
    t = np.sort(rng.uniform(0, 2, 60_000))
    tones = ((100.0, 0.4, 0.3), (240.0, 0.15, 1.0), (360.0, 0.15, 2.0))
    net = sum(swing * np.sin(2 * np.pi * frequency * t + phase) for frequency, swing, phase in tones)
    x, y = rng.integers(0, 64, (2, len(t)))
    entry = dase.find_signatures(dase.Events(t, x, y, rng.random(len(t)) < 0.5 + 0.5 * net, 64, 64))[
        "flicker"
    ]
    assert entry.found
    assert entry.details["frequency"] == pytest.approx(100, abs=0.05)


@pytest.mark.parametrize("turned", [False, True])
def test_bars_that_move_are_no_readout(turned):
    """Shot events set memories of pixels in even light: all those of an edge send at one instant."""
    times = np.arange(0, 0.4, 1e-3)
    phase = np.pi * (np.arange(96) - 300 * times[:, None]) / 40
    bars = 0.4 * (1 + 0.6 * np.tanh(18 * np.sin(phase)))[:, None, :].repeat(64, 1).astype(np.float32)
    scene = dase.VideoScene(bars.transpose(0, 2, 1) if turned else bars, times)
    events = dase.simulate(scene, dase.Sensor().with_effect(EFFECTS["shot"](rate=5.0)), seed=1)
    assert "grouping" not in found(events)
    assert "grouping" in found(experiment.read_rows(np.random.default_rng(2), events))


def test_a_full_bus_shows():
    events = made(kind="turn")
    rate = np.quantile(np.bincount((events.t / 1e-3).astype(int)), 0.5) * 1e3
    sent, _ = Readout(rate=rate).reader(events.width, events.height, 0).push(events, np.inf)
    entry = dase.find_signatures(sent)["full bus"]
    assert entry.found
    assert entry.details["rate"] == pytest.approx(rate, rel=0.05)
    assert not dase.find_signatures(events)["full bus"].found


@pytest.mark.parametrize(("share", "tick"), [(3.0, 0.0), (0.8, 0.0), (0.8, 1e-6), (3.0, 1e-6)])
def test_a_bus_shows_that_is_never_or_always_full(share, tick):
    """Independent pixels in even light: the rate tells nothing, the shortest intervals do."""
    rng = np.random.default_rng(5)
    rate, count = 2e5, 60_000

    def stamped(t):
        t = np.rint(t / tick) * tick if tick else t
        some = [rng.integers(0, size, len(t)).astype(np.uint16) for size in (64, 48)]
        return dase.Events(t, *some, rng.random(len(t)) < 0.5, 64, 48)

    wanted = stamped(np.sort(rng.uniform(0, count / (share * rate), count)))
    sent, _ = Readout(rate=rate).reader(64, 48, 0).push(wanted, np.inf)
    entry = dase.find_signatures(stamped(sent.t))["full bus"]
    assert entry.found
    assert entry.details["rate"] == pytest.approx(rate, rel=0.01 if not tick else 0.3)
    assert not dase.find_signatures(wanted)["full bus"].found


@pytest.mark.parametrize("service", [0.77e-6, 1.31e-6, 2.32e-6, 8.52e-6])
def test_events_come_as_evenly_as_a_bus_sends_them(service):
    """Steps of a simulator send many events at once; stamps are whole microseconds."""
    rng = np.random.default_rng(8)
    times = np.sort(5e-3 * rng.integers(0, 200, 60_000) + rng.uniform(0, 1e-4, 60_000))
    x, y = (rng.integers(0, size, len(times)).astype(np.uint16) for size in (64, 48))
    sent, free = [], 0.0
    for time in times:
        free = max(time, free) + service
        sent.append(free)
    on = rng.random(len(times)) < 0.5

    def signatures(t):
        return dase.find_signatures(dase.Events(np.floor(np.sort(t) * 1e6) * 1e-6, x, y, on, 64, 48))

    found = signatures(sent)
    assert found["full bus"].found
    assert found["full bus"].details["rate"] == pytest.approx(1 / service, rel=2e-3)
    assert not found["time stamps"].found
    # as many events in as long bursts, at random
    bursts = np.floor(np.asarray(sent) / 5e-3)
    longest = float(np.max(np.asarray(sent) - 5e-3 * bursts))
    assert not signatures(5e-3 * bursts + rng.uniform(0, longest, len(times)))["full bus"].found


def test_a_pixel_that_sends_evenly_is_no_bus(rng):
    """Behind a lens cap hardly another event comes between those of a hot pixel that is regular."""
    t = np.concatenate([np.arange(20_000) * 5e-4, rng.uniform(0, 10, 20)])
    pixel = np.concatenate([np.full(20_000, 700), rng.integers(0, 3072, 20)])
    order = np.argsort(t)
    x, y = ((pixel[order] % 64).astype(np.uint16), (pixel[order] // 64).astype(np.uint16))
    events = dase.Events(t[order], x, y, rng.random(len(t)) < 0.5, 64, 48)
    assert not dase.find_signatures(events)["full bus"].found


def test_stamps_made_to_increase_are_no_bus():
    """Some converters move equal stamps apart by one tick."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.uniform(0, 0.2, 60_000))
    ticks = np.maximum.accumulate(np.floor(t * 1e6) - np.arange(len(t))) + np.arange(len(t))
    x, y = (rng.integers(0, size, len(t)).astype(np.uint16) for size in (64, 48))
    events = dase.Events(ticks * 1e-6, x, y, rng.random(len(t)) < 0.5, 64, 48)
    assert not dase.find_signatures(events)["full bus"].found


def test_order_within_a_stamp_is_no_readout(plain):
    coarse = replace(plain, t=np.floor(plain.t / 5e-4) * 5e-4)
    order = np.lexsort((coarse.x, coarse.y, coarse.t))
    assert not dase.find_signatures(coarse.select(order))["grouping"].found


def test_pieces_and_files_give_what_the_whole_gives(plain, tmp_path):
    events = bursts(made(**CASES["hot pixels"]))
    events = replace(events, t=np.rint(events.t * 1e6) / 1e6)
    whole = dase.find_signatures(events)
    assert dase.find_signatures(events, chunk=1777) == whole
    path = tmp_path / "a.npz"
    with dase.io.create(path) as writer:
        writer.events(events)
    told = []
    assert dase.find_signatures(path, progress=told.append, size=(events.width, events.height)) == whole
    assert sum(told) == 2 * len(events)
    assert dase.find_signatures(dase.Recording.of(Sequence(events))) == whole


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(rng):
    def peak(seconds):
        count = int(5e5 * seconds)
        t = np.sort(rng.random(count)) * 70 * seconds
        x, y = (rng.integers(0, n, count, np.uint16) for n in (64, 48))
        events = Events(t, x, y, rng.random(count) < 0.5, 64, 48)
        tracemalloc.start()
        dase.find_signatures(events, chunk=1 << 16)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(4) < 1.25 * peak(2)


def test_what_is_not_known_equals_what_is_not_known():
    nothing = Signature(name="a", answer=Answer.NOT_SEEN, p=float("nan"))
    assert nothing == Signature(name="a", answer=Answer.NOT_SEEN, p=float("nan"))
    assert nothing != Signature(name="a", answer=Answer.NOT_SEEN, p=0.5)
    assert nothing != "a"


def test_the_answer_is_short_frozen_and_json(plain):
    looked = dase.find_signatures(plain)
    assert len(repr(looked).splitlines()) <= 20
    content = json.loads(json.dumps(looked.to_json(), allow_nan=False))
    assert [entry["name"] for entry in content["entries"]] == list(NAMES)
    assert {entry["answer"] for entry in content["entries"]} <= {"found", "not seen", "cannot say"}
    with pytest.raises(AttributeError):
        looked.events = 3
    with pytest.raises(KeyError, match="known are frame coupling"):
        looked["nonsense"]


def test_few_events_are_no_answer(plain):
    looked = dase.find_signatures(plain.select(slice(0, 300)))
    silent = {entry.name for entry in looked.entries if entry.answer == "cannot say"}
    assert {
        "frame coupling",
        "flicker",
        "fixed pattern",
        "grouping",
        "time stamps",
        "double events",
    } <= silent
    assert all(entry.sentence for entry in looked.entries)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.array([1.0, 0.5, 2.0])}, "sorted"),
        ({"t": np.array([0.0, 0.5, np.nan])}, "finite"),
        ({"x": np.array([0, 7, 1], np.uint16)}, "on the 4x3 sensor"),
    ],
)
def test_bad_events_are_refused(change, message):
    columns = np.zeros((3, 3), np.uint16)
    events = Events(np.arange(3.0), columns[0], columns[1], columns[2] > 0, 4, 3)
    with pytest.raises(InputError, match=message):
        dase.find_signatures(replace(events, **change))


def test_bad_arguments_are_refused(plain):
    with pytest.raises(InputError, match="there are no events"):
        dase.find_signatures(Events.empty(4, 3))
    with pytest.raises(InputError, match="got int"):
        dase.find_signatures(3)
    with pytest.raises(InputError, match="level"):
        dase.find_signatures(plain, level=1.0)
    with pytest.raises(InputError, match="chunk"):
        dase.find_signatures(plain, chunk=0)


def test_info_prints_signatures(plain, tmp_path):
    path = tmp_path / "a.npz"
    with dase.io.create(path) as writer:
        writer.events(plain)
    size = ["--size", f"{plain.width}x{plain.height}"]
    done = CliRunner().invoke(dase_group, ["info", str(path), "--signatures", *size])
    assert done.exit_code == 0, done.output
    assert "\nframe coupling  not seen" in done.output
    done = CliRunner().invoke(dase_group, ["info", str(path), "--signatures", "--json", "-", *size])
    assert len(json.loads(done.output)["signatures"]["entries"]) == len(NAMES)


def recorded(shared, name):
    looked = dase.find_signatures(shared / "recordings" / f"{name}.npz")
    return looked, {entry.name for entry in looked.found}


@pytest.mark.slow
def test_camera_shake(shared):
    looked, names = recorded(shared, "davis240c_camerashake")
    assert {"frame coupling", "flicker", "grouping"} <= names
    assert looked["flicker"].details["frequency"] == pytest.approx(100.14, abs=0.05)
    assert looked["frame coupling"].details["exposure"] == pytest.approx(0.0985, abs=0.002)
    assert looked["grouping"].details["line"] == "row"


def test_checkerboard_with_unknown_frame_times(shared):
    looked, names = recorded(shared, "davis240b_evbench1")
    assert {"frame coupling", "flicker", "hot pixels", "grouping", "double events"} <= names
    assert looked["frame coupling"].details["interval"] == pytest.approx(0.051, abs=2e-4)
    assert looked["flicker"].details["frequency"] == pytest.approx(120.1, abs=0.3)
    assert looked["hot pixels"].low <= 5 <= looked["hot pixels"].high + 1


def test_cradle(shared):
    looked, names = recorded(shared, "davis346_cuke_cradle")
    assert names == {"hot pixels", "opposite pairs"}
    assert looked["hot pixels"].size == 17
    assert looked["opposite pairs"].details["pairs"] == 101
    assert looked["opposite pairs"].details["independent"] == pytest.approx(26, abs=0.5)
    assert looked["grouping"].answer == "cannot say"  # edges of the balls could make it


def test_noise_of_a_still_scene(shared):
    looked, names = recorded(shared, "dvx_noise_static")
    assert names == {"hot pixels", "opposite pairs", "time stamps"}
    assert looked["time stamps"].details["period"] == pytest.approx(195e-6, rel=0.01)
    assert not looked["opposite pairs"].details["returns"]


def test_circling_dot(shared):
    looked, names = recorded(shared, "psee_gen31_dot")
    assert names == {"hot pixels"}
    assert looked["hot pixels"].size == 7
    assert looked["grouping"].answer == "cannot say"  # nothing is left beside the edge of the dot
    assert looked["fixed pattern"].answer == "cannot say"


def test_events_of_one_polarity_are_looked_at_as_all_others_are(rng):
    """Blocks without a phase divided zero by zero, of which tests make an error."""
    count = 60_000
    events = Events(
        t=np.sort(rng.uniform(0, 4, count)), x=rng.integers(0, 64, count).astype(np.uint16),
        y=rng.integers(0, 48, count).astype(np.uint16), p=np.ones(count, np.int8), width=64, height=48,
    )  # fmt: skip
    assert "flicker" not in found(events)
