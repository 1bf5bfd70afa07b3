"""Of a long recording windows over its length are compared, laid end to end on one clock."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.effects import EFFECTS
from dase.fitting.compared_time import choose_compared_time
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.spliced_time import SplicedScene, SplicedTime
from dase.fitting.time_window import WindowSettings, choose_windows
from dase.probes.stimulus import MASKED, Grid
from dase.scenes.static import StaticScene

STEP = 1e-3
SHORT = WindowSettings(longest=4000, shortest=0.5)


class Ramp(dase.Scene):
    """Light that tells the time: its intensity is t / 100 s everywhere."""

    width, height, duration, anytime = 8, 6, 60.0, True

    def sample_times(self):
        return STEP * np.arange(60_001)

    def source(self, times, pixels, device):
        return dase.VideoScene(self.frames(times), times).source(times, pixels, device)

    def frames(self, times, device="cpu"):
        return np.repeat(times / 100, 48).reshape(-1, 6, 8).astype(np.float32)


def events_at(t: np.ndarray) -> dase.Events:
    n = np.arange(len(t))
    return dase.Events(np.sort(t), n % 8, n % 6, n % 2 == 0, 8, 6)


def test_windows_lie_over_the_length_and_leave_out_flashes_and_pauses(rng):
    grid = Grid(0.0, STEP, 60_000)
    # nothing from 20 to 35 s, a flash at 50 s
    t = rng.uniform(0, 60, 40_000)
    t = np.concatenate([t[(t < 20) | (t > 35)], rng.normal(50, 0.05, 30_000)])
    chosen = choose_windows(events_at(t), Ramp(), grid, 10, settings=SHORT)
    assert [one.steps for one in chosen] == [1000] * 4
    begin = np.array([one.begin for one in chosen])
    end = begin + 1.0
    assert np.all(begin[1:] >= end[:-1])
    assert begin[0] < 2
    assert end[-1] > 55
    assert not np.any((end > 20.6) & (begin < 34.4))
    assert not np.any((end > 49.8) & (begin < 50.2))


def test_a_short_recording_is_compared_whole_and_a_clock_is_not_broken(rng):
    events = events_at(rng.uniform(0, 60, 10_000))
    short, long = Grid(0.0, STEP, 5000), Grid(0.0, STEP, 60_000)
    assert choose_windows(events, Ramp(), short, 10, settings=SHORT) == (short,)
    (one,) = choose_windows(events, Ramp(), long, 10, unbroken=True, settings=SHORT)
    assert one.steps == SHORT.longest


def test_no_longer_time_is_compared_than_has_plenty_of_events(rng):
    events, long = events_at(rng.uniform(0, 60, 48_000)), Grid(0.0, STEP, 60_000)
    # 48 pixels send 800 events per second; 12 of them, trusted for half of the events, 100
    (one,) = choose_windows(events, Ramp(), long, 12, unbroken=True, compared=0.5, plenty=150, settings=SHORT)
    assert one.steps == pytest.approx(1500, abs=1)
    windows = choose_windows(events, Ramp(), long, 12, compared=0.5, plenty=150, settings=SHORT)
    assert sum(each.steps for each in windows) == pytest.approx(1500, abs=2)
    # never shorter than what is slow needs, nor longer than without
    (one,) = choose_windows(events, Ramp(), long, 12, unbroken=True, plenty=1, settings=SHORT)
    assert one.steps == SHORT.shortest / STEP
    (one,) = choose_windows(events, Ramp(), long, 12, unbroken=True, plenty=1e9, settings=SHORT)
    assert one.steps == SHORT.longest


def spliced(*begins: float, steps: int = 500) -> SplicedTime:
    windows = tuple(Grid(begin, STEP, steps) for begin in begins)
    return SplicedTime(windows, np.concatenate([one.times for one in windows]), 100)


def test_events_and_light_keep_their_places_on_the_spliced_clock(rng):
    time = spliced(3.0, 10.0, 40.0)
    t = np.sort(rng.uniform(0, 60, 20_000))
    inside = [(t >= begin) & (t <= begin + 499 * STEP) for begin in (3.0, 10.0, 40.0)]
    events = time.events(events_at(t))
    np.testing.assert_allclose(time.real(events.t), t[np.any(inside, 0)], atol=1e-9)
    assert np.all(np.diff(events.t) >= 0)
    scene = SplicedScene(Ramp(), time)
    seen = scene.frames(scene.sample_times())[:, 0, 0]
    np.testing.assert_allclose(100 * seen, time.moments, atol=1e-5)
    settled = time.settled(scene.sample_times())
    assert settled[:500].all()
    assert settled.sum() == 1500 - 2 * 100
    assert not settled[500:600].any()
    assert settled[600]


def test_memory_does_not_grow_with_the_recording_and_no_pair_reaches_over_a_seam():
    sensor = dase.Sensor().with_effect(EFFECTS["shot"](rate=8.0))
    sizes = []
    for length in (60.0, 120.0):
        scene = StaticScene(16, 16, length)
        events = dase.simulate(scene, sensor, seed=3)
        evidence = split_measurement(Measurement(events, scene), pixels=80)
        sizes.append(evidence.held.trials.stimulus.grid.steps)
        assert evidence.notes[0].count(", from ") == 3
        cell = evidence.held.trials.stimulus.cell
        seams = np.flatnonzero((cell == MASKED).all(0))
        assert len(seams[seams > evidence.held.frame.first]) >= 2
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_the_true_sensor_is_right_over_several_windows(rng):
    """The light leaps from window to window, of which a model must know nothing."""
    times = 1e-3 * np.arange(28_000)
    turn = np.cumsum(rng.normal(0, 0.02, (28_000, 14, 14)), 0) + rng.uniform(0, 6, (1, 14, 14))
    scene = dase.VideoScene((0.5 + 0.4 * np.sin(turn)).astype(np.float32), times)
    true = dase.Sensor().with_effect(EFFECTS["mismatch"]())
    events = dase.simulate(scene, true, seed=4)
    found = dase.compare(events, true, scene=scene, pixels=60)
    assert found.notes[0].count(", from ") == 4
    assert found.error < found.gate


def test_a_long_clip_whose_frames_are_held_is_one_over_several_windows(rng):
    times = np.arange(0, 60, 0.01)
    scene = dase.VideoScene(rng.random((len(times), 6, 8), np.float32), times).held(STEP)
    events = events_at(rng.uniform(0, 59, 20_000))
    time = choose_compared_time(Measurement(events, scene), unbroken=False, pixels=10)
    assert time.held
    assert len(time.windows) > 1
