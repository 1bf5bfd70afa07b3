"""Light that does not change costs next to nothing, and means the same as light stored step by step."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import dase
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.probes.stimulus import (
    STIMULUS,
    Grid,
    Stimulus,
    band_edges,
    light_of,
    log_light_beside,
    log_light_of,
    sort_into_cells,
)


@pytest.fixture
def light(rng):
    """Intensities of 300 pixels that rest, as a view, (N, T)."""
    return np.broadcast_to(rng.random((300, 1)).astype(np.float32), (300, 500))


def stimulus_of(light):
    cell = sort_into_cells(light, 1e-3, np.array([0.2, 0.5, 0.8]), 1e-3)
    pixels = np.arange(len(light), dtype=np.int32)
    return Stimulus(pixels, 20, 15, Grid(0.0, 1e-3, light.shape[1]), light, cell, 1e-3, "cpu")


def test_a_view_of_one_column_means_the_same_as_all_steps(light):
    one, all_steps = stimulus_of(light), stimulus_of(light.copy())
    np.testing.assert_array_equal(one.cell, all_steps.cell)
    np.testing.assert_array_equal(np.broadcast_to(one.level, light.shape), all_steps.level)
    np.testing.assert_array_equal(one.exposure(), all_steps.exposure())
    for finer in (0, 1, 2):
        for name in ("start", "stamp", "intensity", "voltage"):
            got, want = (getattr(each.history(finer), name).numpy() for each in (one, all_steps))
            np.testing.assert_array_equal(got, want)
    compared = np.ones(light.shape, np.bool_)
    np.testing.assert_allclose(band_edges(light, compared), band_edges(light.copy(), compared), atol=1e-2)


def test_samples_are_those_of_a_plain_loop(rng):
    steps = np.repeat(rng.random((150, 40)).astype(np.float32), 5, axis=1)
    steps[3:9] = 0.5
    stimulus = stimulus_of(steps)
    history = stimulus.history()
    start, stamp = history.start.numpy(), history.stamp.numpy()
    for i in range(len(steps)):
        kept, gaps = {0, 1, steps.shape[1] - 1}, [0]
        while gaps[-1] < steps.shape[1]:
            gaps.append(gaps[-1] + max(1, int(STIMULUS.growth * gaps[-1])))
        changed = 0
        for k in range(steps.shape[1]):
            if k and steps[i, k] != steps[i, k - 1]:
                changed = k
                kept.add(k - 1)
            if k - changed in gaps:
                kept.add(k)
        assert stamp[start[i] : start[i + 1]].tolist() == sorted(kept)
    np.testing.assert_array_equal(history.intensity.numpy()[: start[1]], steps[0][stamp[: start[1]]])


def test_samples_of_a_rest_are_dense_enough_for_whatever_settles():
    """Events lie on straight lines between them: what is left of a step of the light bends by 0.1 % of it."""
    light = np.full((1, 2000), 0.5, np.float32)
    light[:, 0] = 0.1
    stamp = stimulus_of(light).history().stamp.numpy().astype(float)
    assert len(stamp) < 100
    time = np.arange(1, 2000)
    for constant in (5.0, 20.0, 80.0, 320.0):
        left = np.exp(-(time - 1) / constant)
        lines = np.interp(time, stamp[1:], np.exp(-(stamp[1:] - 1) / constant))
        assert np.abs(lines - left).max() < 1e-3


def test_memory_of_a_long_rest_is_that_of_its_cells_and_levels():
    scene = dase.StaticScene(24, 24, 40.0, 0.5)
    events = dase.simulate(scene, dase.Sensor().with_effect(dase.EFFECTS["shot"](rate=0.5)), seed=2)
    tracemalloc.start()
    evidence = split_measurement(Measurement(events, scene), pixels=250, seed=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    stored = sum(len(half.trials.stimulus.pixels) * half.trials.stimulus.grid.steps
                 for half in (evidence.train, evidence.held, evidence.scout))  # fmt: skip
    assert evidence.held.trials.stimulus.grid.steps > 10_000
    # a byte of cells, a part of them twice while they are cut, and the events
    assert peak < 4 * stored
    light = light_of(scene, np.array([0.0]), evidence.train.trials.stimulus.pixels)
    np.testing.assert_array_equal(evidence.train.trials.stimulus.intensity[:, :1], light)


@pytest.mark.parametrize("kind", ["levels", "numbers", "rendered"])
def test_light_beside_instants_is_that_of_all_light(rng, kind):
    times = np.arange(40) * 1e-3
    levels = rng.integers(0, 256, (40, 9, 12), dtype=np.uint8)
    if kind == "rendered":
        picture = dase.Picture(rng.random((12, 16)).astype(np.float32))
        layer = dase.Layer(picture, dase.Motion(x=(-0.3, 0.3)))
        scene = dase.LayerScene([layer], width=12, height=9, duration=0.04)
    else:
        scene = dase.VideoScene(levels if kind == "levels" else levels / np.float32(255), times)
    pixels = np.arange(24, 72, dtype=np.int32)
    at, which = np.sort(rng.integers(0, 40, 500)), rng.integers(0, len(pixels), 500)
    level = log_light_of(scene, times, pixels, log_eps=0.01)
    found = log_light_beside(scene, times, pixels, at, which, log_eps=0.01, reach=3, at_once=7)
    expected = [level[np.clip(at + n, 0, 39), which] for n in range(-2, 4)]
    np.testing.assert_array_equal(found, expected)
