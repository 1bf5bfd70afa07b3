"""Stamps of held frames that a clock rounds, and those that are the frames' own."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.diagnosis.seen_effects import find_seen_effects
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.probes.timestamp_patterns import clock_period, common_divisor
from dase.scenes.video import VideoScene
from dase.signatures.kinds import TIME_STAMPS


def of_frames(step, frames=300, late=0.0, seed=3):
    """Events that all come at the times of frames, some a bit after each, and their scene, which is held."""
    rng = np.random.default_rng(seed)
    times = step * np.arange(frames)
    count = rng.integers(20, 60, frames)
    t = np.repeat(times + late, count)
    x, y = (rng.integers(0, size, len(t)).astype(np.uint16) for size in (64, 48))
    light = np.cumsum(rng.uniform(-0.05, 0.05, (frames, 48, 64)), 0)
    scene = VideoScene(np.clip(0.5 + light, 0.02, 1).astype(np.float32), times)
    return Events(t, x, y, rng.random(len(t)) < 0.5, 64, 48), scene.held(1e-4)


def rounded(events, tick):
    return Events(np.rint(events.t / tick) * tick, events.x, events.y, events.p, 64, 48)


@pytest.mark.parametrize(("step", "tick"), [(2.5e-3, 181e-6), (1e-3, 77e-6), (2e-3, 150e-6)])
def test_a_clock_shows_that_rounds_the_times_of_frames(step, tick):
    events, scene = of_frames(step)
    stamped = rounded(events, tick)
    assert clock_period(stamped.t) == pytest.approx(tick, abs=1e-9)
    entry = find_seen_effects(Measurement(stamped, scene), EFFECTS).entry_of(TIME_STAMPS)
    assert entry is not None
    assert entry.details["step"] == pytest.approx(tick, abs=1e-9)


@pytest.mark.parametrize("late", [0.0, 3.4e-4])
def test_times_of_frames_are_no_clock(late):
    events, scene = of_frames(2.5e-3, late=late)
    assert find_seen_effects(Measurement(events, scene), EFFECTS).entry_of(TIME_STAMPS) is None


def test_what_gaps_have_in_common():
    assert common_divisor(np.array([2353e-6, 2534e-6, 2353e-6, 4887e-6])) == pytest.approx(181e-6)
    # frames that files round, frames some of which are missing, a single gap, gaps of all kinds
    assert common_divisor(np.array([33333e-6, 33334e-6])) == 0
    assert common_divisor(np.array([2500e-6, 5000e-6, 7500e-6])) == 0
    assert common_divisor(np.array([2500e-6, 2500e-6])) == 0
    assert common_divisor(1e-6 * np.random.default_rng(1).integers(4, 4000, 900)) == 0


def test_a_sensor_whose_clock_ticks_shows_as_before():
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 1, 30_000))
    x, y = (rng.integers(0, size, len(t)).astype(np.uint16) for size in (64, 48))
    events = Events(np.floor(t / 1e-4) * 1e-4, x, y, rng.random(len(t)) < 0.5, 64, 48)
    assert dase.find_signatures(events)["time stamps"].details["step"] == pytest.approx(1e-4)
