"""Several pixels at once: the same bits as one pixel at a time, and accurate logarithms and exponentials."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from helpers.stored_scenes import Stored, scene_of

import dase
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.threshold import Threshold
from dase.kernels import launch
from dase.kernels.vector_math import exponential, lane_functions
from dase.simulation.pixel_array import PixelArray


def counted(sensor, scene, device, *, chunk=1000, pixels=None, parameters=None):
    """Return counts in windows of 7 samples, what the pixels remember, and whether lanes counted."""
    array = PixelArray(
        sensor, scene.width, scene.height, pixels=pixels, parameters=parameters, seed=5, device=device
    )
    times = scene.sample_times()
    total = np.zeros((array.batch, len(times) // 7 + 1, 2, array.count), np.int64)
    for begin in range(0, len(times), chunk):
        part = times[begin : begin + chunk]
        windows = (np.arange(begin, begin + len(part)) // 7).astype(np.int32)
        low = windows[0]
        new = array.count_events(scene, part, windows - low, windows[-1] - low + 1).numpy()
        total[:, low : windows[-1] + 1] += new
    return total, array._state.numpy()[:2], array._thresholds_only


@pytest.mark.parametrize("kind", ["log", "frames", "background", "layers"])
@pytest.mark.parametrize("on", [0.2, 0.31])
@pytest.mark.parametrize("mismatch", [0.0, 0.1])
def test_lanes_count_as_composed_pixels_do(kind, on, mismatch, device, rng):
    scene = scene_of(kind, rng, device)
    plain = dase.Sensor((Threshold(on=on, off=0.2),))
    if mismatch:
        plain = plain.with_effect(Mismatch(spread=mismatch))
    composed = plain.with_effect(Leak.identity())
    got, state, lanes = counted(plain, scene, device)
    want, other, pixels = counted(composed, scene, device)
    assert lanes
    assert not pixels
    assert want.sum() > 300
    np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(state, other)


@pytest.mark.parametrize("kind", ["log", "frames", "background", "layers"])
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_lanes_emit_what_composed_pixels_do(kind, chunk, device, rng):
    scene = scene_of(kind, rng, device)
    plain = dase.Sensor((Threshold(on=0.11, off=0.07),))
    composed = plain.with_effect(Leak.identity())
    got, want = (
        dase.Events.concatenate(dase.stream(scene, sensor, seed=5, device=device, chunk=chunk))
        for sensor in (plain, composed)
    )
    assert len(got) > 1000
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("chunk", [1, 2, 9])
def test_chunks_and_subsets_count_as_the_whole(chunk, device, rng):
    scene = Stored("frames", rng, device)
    sensor = dase.Sensor()
    whole = counted(sensor, scene, device)[0]
    some = rng.permutation(scene.width * scene.height)[:21]
    np.testing.assert_array_equal(counted(sensor, scene, device, chunk=chunk)[0], whole)
    np.testing.assert_array_equal(
        counted(sensor, scene, device, chunk=chunk, pixels=some)[0], whole[..., some]
    )


def test_a_batch_counts_as_one_by_one(device, rng):
    scene = Stored("frames", rng, device)
    vectors = np.array([[0.2, 0.2, 1.0, 1e-3], [0.1, 0.3, 0.0, 1e-2], [0.4, 0.4, 0.5, 1e-3]], np.float32)
    together = counted(dase.Sensor(), scene, device, parameters=vectors)[0]
    for row, vector in zip(together, vectors, strict=True):
        np.testing.assert_array_equal(
            row, counted(dase.Sensor(), scene, device, parameters=vector[None])[0][0]
        )


def apply(function, values, device):
    """Return a function of the kernels at `values`."""

    @wp.kernel(enable_backward=False, module="unique", module_options={"fuse_fp": False})
    def at(first: int, x: wp.array[float], out: wp.array[float]):
        _, i = wp.tid()
        out[i + first] = function(x[i + first])

    where = launch.find_device(device)
    out = wp.zeros(len(values), dtype=float, device=where)
    launch.run_kernel(at, len(values), [wp.array(values, dtype=float, device=where), out], where)
    return out.numpy()


def test_exponential_is_within_two_units_of_the_last_place(device):
    x = np.linspace(-87, 88, 100_001, dtype=np.float32)
    want = np.exp(x.astype(np.float64))
    error = np.abs(apply(exponential, x, device) - want) / np.spacing(want.astype(np.float32))
    assert error.max() < 2
    np.testing.assert_array_equal(apply(exponential, np.float32([-1e30, -np.inf, 0]), device), [0, 0, 1])


@pytest.mark.parametrize("lanes", [1, 4, 16])
def test_logarithm_is_accurate(lanes, device):
    near, far = np.linspace(0.5, 2, 50_000), np.geomspace(1e-30, 1e30, 50_000)
    x = np.concatenate([near, far]).astype(np.float32)[None]
    where = launch.find_device(device)
    out = wp.zeros(x.size, dtype=float, device=where)
    f = lane_functions(lanes)
    load, store, logarithm = f.load, f.store, f.logarithm

    @wp.kernel(enable_backward=False, module="unique", module_options={"fuse_fp": False})
    def at(first: int, x: wp.array2d[float], out: wp.array[float]):
        _, i = wp.tid()
        n = wp.static(lanes) * (i + first)
        store(out, n, logarithm(load(x, 0, n), 0.0))

    launch.run_kernel(at, x.size // lanes, [wp.array(x, dtype=float, device=where), out], where)
    want = np.log(x.astype(np.float64))
    error = np.abs(out.numpy() - want[0])
    unit = np.spacing(np.abs(want[0]).astype(np.float32))
    if where.is_cpu:
        assert (error / unit).max() < 1
    else:
        away = np.abs(want[0]) > np.log(2)
        assert error[~away].max() < 5e-7
        assert (error / unit)[away].max() < 4
