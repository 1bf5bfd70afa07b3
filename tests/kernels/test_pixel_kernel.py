"""The pixel kernel against its twin, and what must hold whatever the effects."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from helpers.event_comparison import by_pixel, differing, rows, same
from helpers.sensors import full
from helpers.small_scenes import flicker, layers
from reference import pixel as reference
from reference import threshold_counts as reference_counts

import dase
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.kernels import launch, pixel_compile, pixel_stages
from dase.simulation.pixel_array import PixelArray


def walk(rng: np.random.Generator, kind: str) -> tuple[np.ndarray, float, float]:
    """Return log intensities, shape (K, 1, N), and the ON and OFF threshold."""
    samples, pixels = 200, 300
    if kind == "walk":
        return np.cumsum(rng.normal(0, 0.3, (samples, 1, pixels)), 0) - 3, 0.2, 0.2
    if kind == "ramp":
        return np.linspace(-6, 0, samples)[:, None, None] * rng.uniform(-1, 1, pixels), 0.11, 0.11
    if kind == "zero crossings":
        swing = np.sin(np.linspace(0, 60, samples))[:, None, None] * rng.uniform(0, 1, pixels)
        return swing, 0.2, 0.2
    if kind == "unequal thresholds":
        return np.cumsum(rng.normal(0, 0.3, (samples, 1, pixels)), 0) - 3, 0.13, 0.37
    # whole 2^-8: no operation rounds, and changes often meet a threshold exactly
    return np.cumsum(rng.integers(-90, 91, (samples, 1, pixels)), 0) / 256, 48 / 256, 80 / 256


@pytest.mark.parametrize("kind", ["walk", "ramp", "zero crossings", "unequal thresholds", "dyadic"])
def test_counts_are_the_recursion_of_the_paper(device, rng, kind):
    level, on, off = walk(rng, kind)
    scene = reference.LogScene(level, np.arange(len(level)) * 1e-3)
    sensor = dase.Sensor((Threshold(on=on, off=off, phase=0.0),))
    got = dase.count(scene, sensor, scene.times, device=device)[0]
    size = np.full(scene.values.shape[1:], 1, np.float32)
    want = reference_counts.recursion(scene.values, on * size, off * size, 0 * size)[:, :, 0]
    np.testing.assert_array_equal(got, want)
    assert want.sum((0, 2)).min() > 100
    if kind == "dyadic":
        for i in range(50):
            whole = (level[:, 0, i] * 256).astype(int).tolist()
            np.testing.assert_array_equal(got[:, :, i], reference_counts.exact(whole, 48, 80))


@pytest.mark.parametrize("noise", ["held", "passes"])
@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_emission_gives_the_counts_of_counting(device, rng, mode, noise):
    scene, sensor = flicker(rng), full(mode, noise)
    parts = list(dase.stream(scene, sensor, seed=3, device=device, chunk=1))[1:]
    emitted = np.stack([part.counts([0.0, 9.0])[0].reshape(2, -1) for part in parts])
    counted = dase.count(scene, sensor, scene.sample_times(), seed=3, device=device)[0]
    np.testing.assert_array_equal(emitted, counted)
    assert counted.max() > 1


def test_windows_sum_their_steps(device, rng):
    scene, sensor = flicker(rng, samples=150), full()
    times = scene.sample_times()
    fine = dase.count(scene, sensor, times, device=device)[0]
    edges = times[[3, 40, 41, 100]]  # a step is counted where it ends
    coarse = dase.count(scene, sensor, edges, device=device)[0]
    want = [fine[a:b].sum(0) for a, b in ((3, 40), (40, 41), (41, 100))]
    np.testing.assert_array_equal(coarse, want)


@pytest.mark.parametrize(("kind", "error"), [("dyadic", 2e-7), ("unequal thresholds", 1e-5)])
def test_times_are_linear_interpolations(device, rng, kind, error):
    level, on, off = walk(rng, kind)
    scene = reference.LogScene(level[:, :, :60], np.arange(len(level)) / 1024)
    sensor = dase.Sensor((Threshold(on=on, off=off, phase=0.0),))
    events = dase.simulate(scene, sensor, device=device)
    assert np.all(np.diff(events.t) >= 0)
    twin = reference.Detector(on=np.float32(on), off=np.float32(off))
    rates = np.zeros((len(level), 2))
    for i, got in enumerate(by_pixel(events)):
        want = twin.run(scene.times, scene.values[:, 0, i].astype(float), rates)
        np.testing.assert_array_equal(got[:, 1], want[:, 2])
        # `error` of the float32 memory after many events; 2 ns for whole nanoseconds and float32 shares
        assert np.all(np.abs(got[:, 0] - want[:, 1]) <= error / want[:, 3] + 2e-9)
        assert np.all(got[:, 0] <= scene.times[want[:, 0].astype(int)] + 1e-9)
        assert np.all(got[:, 0] >= scene.times[want[:, 0].astype(int) - 1] - 1e-9)


@pytest.mark.parametrize("noise", ["held", "passes"])
@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_all_effects_match_the_twin(device, rng, mode, noise):
    scene, sensor = flicker(rng), full(mode, noise)
    times = scene.sample_times()
    got = by_pixel(dase.simulate(scene, sensor, seed=11, device=device))
    want = reference.events(sensor, times, scene.frames(times).reshape(len(times), -1), seed=11)
    equal = [len(g) == len(w) and np.array_equal(g[:, 1], w[:, 2]) for g, w in zip(got, want, strict=True)]
    # a crossing on the verge of the dead time may fall on either side in float32, and then others follow
    assert np.mean(equal) >= 0.97
    assert min(len(w) for w in want) > 5
    near = []
    for g, w, alike in zip(got, want, equal, strict=True):
        if alike:
            error = np.abs(g[:, 0] - w[:, 1])
            near.append(np.where(np.isinf(w[:, 3]), error < 1e-6, error * w[:, 3] < 1e-5 + 3e-9 * w[:, 3]))
    assert np.mean(np.concatenate(near)) > 0.998


def test_a_delayed_crossing_is_sent_while_the_signal_returns(device):
    # crosses 0.2 at 0.36 s; dead until 1.26 s, when 0.47 still stands 0.27 above the memory; then 0.25
    level = np.array([0.0, 0.55, 0.25, 0.25])[:, None, None]
    sensor = reference.only(Threshold(phase=0.0), Refractory(period=0.9, mode="delay"), mode="delay")
    events = dase.simulate(reference.LogScene(level, np.arange(4.0)), sensor, device=device)
    np.testing.assert_allclose(events.t, [0.2 / 0.55, 0.2 / 0.55 + 0.9], rtol=1e-6)


def test_a_delayed_crossing_that_no_longer_stands_is_not_sent(device):
    level = np.array([0.0, 0.5, 0.15, 0.15])[:, None, None]
    sensor = reference.only(Threshold(phase=0.0), Refractory(period=0.9, mode="delay"), mode="delay")
    events = dase.simulate(reference.LogScene(level, np.arange(4.0)), sensor, device=device)
    np.testing.assert_allclose(events.t, [0.4], rtol=1e-6)


@pytest.mark.parametrize("kind", ["video", "layers"])
def test_chunks_do_not_matter(device, rng, kind):
    scene = flicker(rng) if kind == "video" else layers(rng)
    whole = dase.Events.concatenate(dase.stream(scene, full(), device=device, chunk=10**6))
    for chunk in (1, 2, 3, 7, 31, 59, 60, 64):
        parts = list(dase.stream(scene, full(), device=device, chunk=chunk))
        same(dase.Events.concatenate(parts), whole)
        assert len(parts) == -(-len(scene.sample_times()) // chunk)
    same(dase.simulate(scene, full(), device=device), whole)
    other = dase.simulate(scene, full(), seed=1, device=device)
    assert not np.array_equal(other.t, whole.t)


def test_time_never_goes_back_from_chunk_to_chunk(device):
    # float32 rounds a step of 33333335 ns up; pixel 0 fires at the very end of each
    times = np.arange(6) * 0.033333335
    level = np.arange(6)[:, None, None] * 0.25 + np.array([0.0, 0.24999])
    level[0, 0, 1] = 0.0
    sensor = dase.Sensor((Threshold(on=0.25, off=0.25, phase=0.0),))
    parts = list(dase.stream(reference.LogScene(level, times), sensor, device=device, chunk=1))
    for part, begin, end in zip(parts[1:], times, times[1:], strict=False):
        assert len(part) > 0
        assert part.t.min() >= begin - 1e-12
        assert part.t.max() <= end + 1e-12


def test_threads_do_not_matter(rng):
    scene, sensor = flicker(rng, samples=12, size=(90, 80)), full()
    before, streams, counts = launch.thread_count(), [], []
    try:
        for threads in (1, 2, 3):
            launch.set_threads(threads)
            streams.append(dase.simulate(scene, sensor))
            counts.append(dase.count(scene, sensor, [0, 1]))
    finally:
        launch.set_threads(before)
    for other in (1, 2):
        same(streams[other], streams[0])
        np.testing.assert_array_equal(counts[other], counts[0])


@pytest.mark.parametrize("kind", ["video", "layers"])
def test_pixels_are_independent(device, rng, kind):
    scene = flicker(rng) if kind == "video" else layers(rng)
    whole = rows(dase.simulate(scene, full(), device=device))
    chosen = rng.choice(scene.width * scene.height, 13, replace=False)
    part = rows(dase.simulate(scene, full(), device=device, pixels=chosen))
    want = whole[np.isin(whole[:, 2] * scene.width + whole[:, 1], chosen)]
    assert len(want) > 50
    np.testing.assert_array_equal(part[np.lexsort(part.T)], want[np.lexsort(want.T)])


@pytest.mark.parametrize("kind", ["video", "layers"])
def test_pixels_in_any_order(device, rng, kind):
    scene = flicker(rng) if kind == "video" else layers(rng)
    order = rng.permutation(scene.width * scene.height)
    whole = dase.count(scene, full(), [0, 1], device=device)
    np.testing.assert_array_equal(
        dase.count(scene, full(), [0, 1], device=device, pixels=order), whole[..., order]
    )


def test_a_batch_is_its_rows(device, rng):
    scene = flicker(rng)
    sensors = [full(), full().with_effect(Threshold(on=0.5, off=0.3)), reference.only(Shot(rate=50.0))]
    vectors = np.stack([sensor.parameters() for sensor in sensors])
    array = PixelArray(full(), scene.width, scene.height, parameters=vectors, seed=4, device=device)
    together, row = array.emit(scene, scene.sample_times())
    counts = dase.count(scene, full(), [0, 1], seed=4, device=device, parameters=vectors)
    for i, sensor in enumerate(sensors):
        alone = dase.simulate(scene, sensor, seed=4, device=device)
        np.testing.assert_array_equal(rows(together)[row == i], rows(alone))
        want = dase.count(scene, sensor, [0, 1], seed=4, device=device)
        np.testing.assert_array_equal(counts[i], want[0])


def test_small_buffers_lose_nothing(device, rng):
    scene = flicker(rng)
    small, large = (PixelArray(full(), scene.width, scene.height, device=device) for _ in range(2))
    small._capacity, large._capacity = 2, 10**5
    times = scene.sample_times()
    for part in (times[:20], times[20:]):
        same(small.emit(scene, part)[0], large.emit(scene, part)[0])
    assert 2 < small._capacity < 10**5


def test_nothing_happens(device):
    scene = dase.VideoScene(np.full((5, 3, 4), 0.5, np.float32), np.arange(5) * 0.1)
    events = dase.simulate(scene, reference.only(), device=device)
    assert len(events) == 0
    assert (events.width, events.height) == (4, 3)
    assert [len(part) for part in dase.stream(scene, reference.only(), device=device, chunk=2)] == [0, 0, 0]


def test_one_pixel_and_one_sample(device):
    one = dase.VideoScene(np.array([0.1, 0.9], np.float32)[:, None, None], [0.0, 1.0])
    events = dase.simulate(one, reference.only(Threshold(phase=0.0)), device=device)
    assert len(events) == int(np.log(0.901 / 0.101) / 0.2)
    assert events.p.all()
    single = dase.VideoScene(np.full((1, 3, 3), 0.5, np.float32), [2.0])
    assert len(dase.simulate(single, full(), device=device)) == 0
    assert dase.count(single, full(), [0, 5], device=device).sum() == 0


def test_the_order_of_events_is_time_then_place(device, rng):
    # 4500 events in 40 ns: neighbours in time are one nanosecond apart, or none
    level = np.stack([np.zeros((30, 30)), rng.uniform(0.75, 1.0, (30, 30)), np.zeros((30, 30))])
    sensor = dase.Sensor((Threshold(on=0.25, off=0.3, phase=0.0),))
    events = dase.simulate(reference.LogScene(level, [0.0, 2e-8, 4e-8]), sensor, device=device)
    got = rows(events)
    np.testing.assert_array_equal(got, got[np.lexsort((got[:, 3], got[:, 1], got[:, 2], got[:, 0]))])
    assert len(np.unique(got[:, 0])) > 10


def test_seeds_of_any_size_fit_the_reported_thresholds(device):
    level = np.linspace(0, 4, 50)[:, None, None] * np.ones((4, 4))
    scene = reference.LogScene(level, np.arange(50) * 0.1)
    sensor = reference.only(Threshold(phase=0.0), Mismatch(spread=0.3))
    for seed in (0, 2**31 - 1):
        on = PixelArray(sensor, 4, 4, seed=seed, device=device).thresholds()[0, 1]
        counts = dase.count(scene, sensor, [0, 5], seed=seed, device=device)[0, 0, 1]
        assert np.all(np.abs(counts - 4 / on) <= 1)


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.1], [0.0, 0.2, 0.1], [0.0, np.nan, 0.1], [0.0, 0.1, np.inf]])
def test_times_must_increase(times):
    with pytest.raises(dase.InputError, match="times must"):
        dase.VideoScene(np.ones((3, 2, 2)), times)


@pytest.mark.parametrize("pixels", [[], [-1], [4], [[0, 1]]])
def test_pixels_must_be_of_the_sensor(pixels):
    with pytest.raises(dase.InputError, match="2x2 sensor"):
        PixelArray(dase.Sensor(), 2, 2, pixels=pixels)


def test_parameters_must_fit_the_sensor():
    with pytest.raises(dase.InputError, match=r"parameters must have shape \(B, 4\), got \(1, 5\)"):
        PixelArray(dase.Sensor(), 2, 2, parameters=np.ones((1, 5)))


def test_the_composer_names_what_it_does_not_know():
    @wp.func
    def odd(voltage: float, temperature: float):
        return voltage

    stages = (pixel_stages.EffectStages("odd", (("respond", odd),)),)
    with pytest.raises(ValueError, match="effect 'odd': stage 'respond' has no quantity 'temperature'"):
        pixel_compile.source_text(stages, "frames", "keys")


def test_cpu_and_cuda_agree(rng):
    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    scene = flicker(rng, samples=100, size=(60, 80))
    times = scene.sample_times()
    cpu, cuda = (dase.count(scene, full(), times, seed=2, device=d) for d in ("cpu", "cuda"))
    assert differing(cpu, cuda) < 1e-4
    here, there = (by_pixel(dase.simulate(scene, full(), seed=2, device=d)) for d in ("cpu", "cuda"))
    alike = [(a, b) for a, b in zip(here, there, strict=True) if np.array_equal(a[:, 1], b[:, 1])]
    assert len(alike) > 0.98 * len(here)
    error = np.concatenate([np.abs(a[:, 0] - b[:, 0]) for a, b in alike])
    assert np.mean(error < 1e-6) > 0.999
