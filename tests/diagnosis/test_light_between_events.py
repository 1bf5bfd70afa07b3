"""How far light goes from event to event, where it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dase.diagnosis.light_between_events import (
    STEPS,
    LightBetweenEvents,
    busiest_rows,
    times_that_are_compared,
)
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene


def brightening(width: int = 3, height: int = 2) -> VideoScene:
    """Return a scene whose log intensity rises by the number of the pixel each second."""
    times = np.arange(5) * 0.25
    rise = np.arange(width * height).reshape(height, width)
    return VideoScene(np.exp(rise * times[:, None, None] - 5).astype(np.float32), times)


def test_light_goes_as_far_as_the_scene_says():
    scene = brightening()
    events = Events(
        np.array([0.1, 0.2, 0.3, 0.7, 0.9]), np.array([1, 2, 1, 2, 1]), np.array([0, 1, 0, 1, 0]),
        np.array([True, True, True, False, False]), 3, 2,
    )  # fmt: skip
    light = LightBetweenEvents(Measurement(events, scene), scene.sample_times(), (0, 2), 0.0)
    steps = light.seen
    same = steps.gap > 0  # from one pixel to the next time goes back here
    np.testing.assert_array_equal(steps.pixel[same], [1, 1, 5])
    np.testing.assert_allclose(steps.change[same], [0.2, 0.6, 2.5], atol=1e-5)
    np.testing.assert_allclose(steps.gap[same], [0.2, 0.6, 0.5])
    np.testing.assert_allclose(steps.speed[same], [1, 1, 5], atol=1e-4)
    np.testing.assert_array_equal(steps.on[same], [True, False, False])
    np.testing.assert_array_equal(steps.again[same], [True, False, False])
    part = replace(light, rows=(1, 2)).seen
    np.testing.assert_array_equal(part.pixel, [2])
    np.testing.assert_allclose(part.change, [2.5], atol=1e-5)


def test_light_in_the_dark_does_not_count():
    scene = brightening()
    t = np.array([0.1, 0.2, 0.7, 0.9])
    x, y = np.array([2, 0, 2, 0]), np.array([1, 0, 1, 0])
    events = Events(t, x, y, np.ones(4, bool), 3, 2)
    light = LightBetweenEvents(Measurement(events, scene), scene.sample_times(), (0, 2), 0.0)
    np.testing.assert_array_equal(light.seen.pixel[light.seen.counts], [])
    bright = replace(light, settings=replace(STEPS, darkest=1e-9)).seen
    np.testing.assert_array_equal(bright.pixel[bright.counts], [0, 5])


def test_the_rows_with_most_events_are_looked_at():
    y = np.repeat(np.arange(40), np.r_[np.ones(20), np.full(10, 50), np.ones(10)].astype(int))
    events = Events(np.linspace(0, 1, len(y)), np.zeros(len(y), int), y, np.ones(len(y), bool), 4, 40)
    assert busiest_rows(events, 100, replace(STEPS, samples=100 * 4 * 10)) == (20, 30)
    assert busiest_rows(events, 100) == (0, 40)
    first, after = busiest_rows(events, 100, replace(STEPS, events=1))
    assert after - first == 8


def test_times_are_those_that_are_compared():
    scene = brightening()
    measurement = Measurement(Events.empty(3, 2), scene)
    np.testing.assert_array_equal(times_that_are_compared(measurement), scene.sample_times())
    np.testing.assert_array_equal(times_that_are_compared(measurement.part(0.2, 0.6)), [0.25, 0.5])


def test_light_that_is_known_in_part_or_sends_nothing_tells_nothing():
    scene = brightening()
    events = Events(np.array([0.1, 0.9]), np.array([1, 1]), np.array([0, 1]), np.ones(2, bool), 3, 2)
    light = LightBetweenEvents.of(Measurement(events, scene), log_eps=0.0)
    assert light.rows == (0, 2)
    np.testing.assert_allclose(light.level(), light.times[:, None] * np.arange(6) - 5, atol=1e-5)
    assert LightBetweenEvents.of(Measurement(Events.empty(3, 2), scene), log_eps=0.0) is None
    assert LightBetweenEvents.of(Measurement(events, scene).part(0.1, 0.3), log_eps=0.0) is None
