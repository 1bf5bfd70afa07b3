"""Pictures of 8 bits that kernels look at as they are, against the same pictures as numbers."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.effects import EFFECTS
from dase.events import Events
from dase.kernels import launch, stored_levels, threshold_levels
from dase.probes.stimulus import light_of
from dase.scenes.light import to_light
from dase.simulation.pixel_array import PixelArray

CHANGE_DETECTORS = {
    "equal": dict(threshold=dict(on=0.2, off=0.2, phase=0.0)),
    "uneven": dict(threshold=dict(on=0.31, off=0.12, phase=1.0)),
    "dense": dict(threshold=dict(on=0.01, off=0.012, phase=0.5)),
    "own": dict(threshold=dict(on=0.2, off=0.25), mismatch=dict(spread=0.3)),
}
"""Sensors that are nothing but a change detector, the third with events at almost every step."""

BEHIND = dict(bandwidth=dict(cutoff=100.0), leak=dict(rate=2.0), shot=dict(rate=9.0))


def sensor_of(effects):
    return dase.Sensor(tuple(EFFECTS[name](**values) for name, values in effects.items()))


def pictures(rng, samples, height, width):
    """Return random walks of levels that reach black and white, and pixels that hardly ever change."""
    step = rng.normal(0, 12, (samples, height, width)) * (rng.random((height, width)) < 0.7)
    walk = np.cumsum(step, 0) + rng.uniform(-30, 285, (height, width))
    return np.clip(np.rint(walk), 0, 255).astype(np.uint8)


def run(frames, times, sensor, device, *, gamma=1.0, pixels=None, parameters=None):
    """Return events of chunks of 17 samples, counts in windows, and the last states of both."""
    scene, (height, width) = dase.VideoScene(frames, times, gamma=gamma), frames.shape[1:]
    options = dict(pixels=pixels, parameters=parameters, seed=3, device=device)
    array, other = (PixelArray(sensor, width, height, **options) for _ in range(2))
    parts = [array.emit(scene, times[k : k + 17]) for k in range(0, len(times), 17)]
    rows = np.concatenate([row for _, row in parts]) if parts[0][1] is not None else np.zeros(0)
    windows = (np.arange(len(times)) // 7 - 1).astype(np.int32)
    counts = [
        other.count_events(scene, times[:5], windows[:5], 1).numpy(),
        other.count_events(scene, times[5:], windows[5:], int(windows[-1]) + 1).numpy(),
    ]
    e = Events.concatenate([part for part, _ in parts])
    return [e.t, e.x, e.y, e.p, rows, *counts, array._state.numpy(), other._state.numpy()]


def assert_same_bits(got, want):
    for a, b in zip(got, want, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("size", [(9, 15), (8, 16), (5, 7)], ids=str)
@pytest.mark.parametrize("name", CHANGE_DETECTORS)
def test_events_are_those_of_the_same_pictures_as_numbers(name, size, device, rng):
    """Blocks of 64 pixels, with one that overlaps, without, and fewer pixels than a block has."""
    frames, times = pictures(rng, 60, *size), 1e-3 * np.arange(60)
    sensor = sensor_of(CHANGE_DETECTORS[name])
    for gamma in (1.0, 2.2):
        got = run(frames, times, sensor, device, gamma=gamma)
        assert len(got[0]) > 200
        assert_same_bits(got, run(to_light(frames, gamma=gamma), times, sensor, device))


def test_some_pixels_and_several_models_at_once(device, rng):
    frames, times = pictures(rng, 40, 20, 11), 2e-3 * np.arange(40)
    sensor = sensor_of(CHANGE_DETECTORS["uneven"])
    pixels = np.sort(rng.choice(220, 101, replace=False))
    parameters = np.array([[0.2, 0.2, 1.0, 1e-3], [0.1, 0.4, 0.5, 0.1], [0.05, 0.05, 0.0, 1e-6]])
    got = run(frames, times, sensor, device, pixels=pixels, parameters=parameters)
    assert_same_bits(got, run(to_light(frames), times, sensor, device, pixels=pixels, parameters=parameters))


@pytest.mark.parametrize("more", [{}, dict(optics_blur=dict(sigma=0.7))], ids=["sharp", "blurred"])
def test_sensors_with_more_effects(more, device, rng):
    frames, times = pictures(rng, 40, 9, 15), 1e-3 * np.arange(40)
    sensor = sensor_of(CHANGE_DETECTORS["own"] | BEHIND | more)
    got = run(frames, times, sensor, device)
    assert len(got[0]) > 100
    assert_same_bits(got, run(to_light(frames), times, sensor, device))


def test_levels_whose_logarithms_fall_are_not_compared_with_intervals(device, rng, monkeypatch):
    if device != "cpu":
        pytest.skip("levels are for the CPU")
    frames, times = pictures(rng, 40, 9, 15), 1e-3 * np.arange(40)
    sensor = sensor_of(CHANGE_DETECTORS["equal"])
    want = run(frames, times, sensor, device)
    monkeypatch.setattr(threshold_levels, "have_intervals", lambda logs: False)
    assert_same_bits(run(frames, times, sensor, device), want)


def test_logarithms_that_fall_are_found(rng):
    device = launch.find_device("cpu")
    logs = np.sort(rng.normal(size=(2, 256)).astype(np.float32), axis=1)
    logs[1, 7] = logs[1, 8]
    array = stored_levels.wp.array
    assert threshold_levels.have_intervals(array(logs, dtype=float, device=device))
    logs[1, 100] = np.nextafter(logs[1, 99], np.float32(-np.inf))
    assert not threshold_levels.have_intervals(array(logs, dtype=float, device=device))


def test_levels_become_light_by_one_table(device, rng):
    levels = rng.integers(0, 256, (5, 33), dtype=np.uint8)
    light = to_light(np.arange(256, dtype=np.uint8), gamma=2.2)
    where = launch.find_device(device)
    got = stored_levels.light_of_levels(stored_levels.upload_levels(levels, light, where), where)
    np.testing.assert_array_equal(got.numpy(), to_light(levels, gamma=2.2))


def test_probes_see_the_light_of_levels(rng):
    frames = pictures(rng, 12, 4, 5)
    pixels = np.array([3, 8, 19], np.int32)
    got = light_of(dase.VideoScene(frames, np.arange(12.0), gamma=2.2), np.arange(12.0), pixels)
    np.testing.assert_array_equal(got, to_light(frames, gamma=2.2).reshape(12, -1)[:, pixels].T)
