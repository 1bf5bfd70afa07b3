"""Pictures between the frames of a clip that a simulator held are told by its thresholds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import shaken_texture
from helpers.held_pixels import held_with_low_pass
from helpers.sensors import sensor_with

import dase
from dase.fitting.held_parts import HELD_PARTS, come_together_at_pictures, parts_that_are_held
from dase.fitting.measurement import as_measurement
from dase.scenes.static import StaticScene
from dase.scenes.video import VideoScene

GAP = 4e-3


@pytest.fixture(scope="module")
def clip() -> VideoScene:
    return shaken_texture(gap=GAP, length=0.4)


@pytest.mark.parametrize("levels", [False, True])
def test_pictures_between_frames_are_straight_in_intensity(rng, levels):
    frames = rng.integers(0, 256, (5, 3, 4), dtype=np.uint8)
    times = np.array([0.0, 0.1, 0.2, 0.4, 0.5])
    clip = VideoScene(frames if levels else frames / np.float32(255), times, gamma=2.0)
    shown, light = clip.in_parts(4), clip.frames(times)
    assert shown.sample_times() == pytest.approx(np.interp(np.arange(17) / 4, np.arange(5), times))
    found = shown.frames(shown.sample_times())
    np.testing.assert_allclose(found[::4], light, rtol=1e-6)
    np.testing.assert_allclose(found[5], 0.75 * light[1] + 0.25 * light[2], rtol=1e-5)
    np.testing.assert_array_equal(clip.of_rows(1, 3).frames(times), light[:, 1:3])


@pytest.mark.parametrize("parts", [2, 4, 5])
def test_pictures_that_are_held_are_counted(clip, parts):
    events = held_with_low_pass(clip.in_parts(parts), cutoff=2e4, late=8e-5, stamps=1e-5, threshold=0.1)
    assert parts_that_are_held(events, clip) == parts
    seen = as_measurement(events, clip)
    assert seen.held == pytest.approx(GAP / parts)
    assert f"{parts} pictures" in seen.notes[-1]


def test_light_that_goes_straight_is_not_held(clip):
    assert parts_that_are_held(dase.simulate(clip, "ideal"), clip) == 0
    # by a slow clock, too
    clock = dase.Sensor().with_effect(dase.EFFECTS["timestamp"](step=1e-3))
    assert parts_that_are_held(dase.simulate(clip, clock), clip) == 0


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_events_of_held_pictures_come_together(clip, parts):
    shown = clip.in_parts(parts) if parts > 1 else clip
    events = held_with_low_pass(shown, cutoff=2e4, late=8e-5, stamps=1e-5, threshold=0.1)
    assert come_together_at_pictures(events, clip)
    assert not come_together_at_pictures(events, clip, replace(HELD_PARTS, least=len(events) + 1))
    assert not come_together_at_pictures(events, StaticScene(72, 48, duration=0.4))


def test_events_of_light_that_goes_straight_come_at_any_time(clip):
    for more in ({}, {"jitter": {"spread": 0.2}}, {"latency": {"delay": 1e-3}}):
        assert not come_together_at_pictures(dase.simulate(clip, sensor_with(**more), seed=2), clip)


def test_frames_that_are_held_are_of_one_part(clip):
    events = held_with_low_pass(clip, cutoff=2e4, late=8e-5, stamps=1e-5)
    seen = as_measurement(events, clip)
    assert seen.held == pytest.approx(GAP)
    assert parts_that_are_held(events, seen.scene) == 0
