"""Frames that couple into the events, and slow changes that are forgotten: their laws and recorded shares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensors import counts
from reference import effects as reference
from scipy.stats import norm

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.base import Observations
from dase.effects.exposure import Exposure
from dase.effects.high_pass import HighPass
from dase.effects.leak import Leak
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from dase.fitting.parameter_space import axes_of
from dase.simulation.sensor import Sensor


def still(pixels: int, seconds: float, level: float = 0.3) -> dase.VideoScene:
    """Return a scene at rest, sampled each millisecond, of one row of pixels."""
    samples = round(seconds * 1000) + 1
    return dase.VideoScene(np.full((samples, 1, pixels), level, np.float32), np.arange(samples) * 1e-3)


def sensor(*effects: dase.Effect, on: float = 0.2, off: float = 0.2) -> dase.Sensor:
    out = dase.Sensor((Threshold(on=on, off=off, phase=0.0),))
    for effect in effects:
        out = out.with_effect(effect)
    return out


def test_bursts_come_at_the_begin_and_the_end_of_every_exposure(device):
    frames = Exposure(amplitude=0.45, spread=0.0, period=0.1, exposure=0.03, begin=0.0205)
    # the way back is two ON thresholds long, so that of OFF is a little smaller
    events = dase.simulate(still(64, 1.0), sensor(frames, off=0.199), device=device)
    on, off = events.t[events.p], events.t[~events.p]
    # two thresholds fit into the step; the last frame's end is seen, too
    assert len(on) == len(off) == 64 * 10 * 2
    for found, offset in ((on, 0.0205), (off, 0.0505)):
        late = (found - offset) % 0.1
        assert np.all(np.minimum(late, 0.1 - late) < 1.01e-3)


@pytest.mark.parametrize("spread", [0.1, 0.4, 1.0])
def test_the_share_of_pixels_that_fire_is_that_of_a_normal_coupling(device, spread):
    frames = Exposure(amplitude=0.2, spread=spread, period=0.1, exposure=0.05, begin=0.01)
    events = dase.simulate(still(10_000, 0.04), sensor(frames, on=0.25, off=0.25), seed=3, device=device)
    fire = len(np.unique(events.x[events.p])) / 10_000
    want = norm.sf((0.25 - 0.2) / (0.2 * spread))
    assert abs(fire - want) < 4 * np.sqrt(want * (1 - want) / 10_000) + 1e-4


def test_exposures_couple_behind_the_photoreceptor(device):
    """A slow photoreceptor does not smear the bursts."""
    frames = Exposure(amplitude=0.45, spread=0.0, period=0.1, exposure=0.03, begin=0.0205)
    alone = dase.simulate(still(16, 0.5), sensor(frames), device=device)
    slow = dase.simulate(still(16, 0.5), sensor(frames, Bandwidth(cutoff=3.0)), device=device)
    np.testing.assert_allclose(slow.t, alone.t, atol=1e-6)


def test_frames_hours_later_are_in_step(device):
    frames = Exposure(amplitude=0.45, spread=0.0, period=0.0511, exposure=0.0125, begin=0.0)
    start = 7200.0
    times = start + np.arange(301) * 1e-3
    scene = dase.VideoScene(np.full((301, 1, 4), 0.3, np.float32), times)
    events = dase.simulate(scene, sensor(frames), device=device)
    late = (events.t[events.p] - 0.0) % 0.0511
    assert len(late) > 0
    assert np.all(np.minimum(late, 0.0511 - late) < 1.1e-3)


@pytest.mark.parametrize(("period", "exposure"), [(40, 20), (20, 7), (33, 12)])  # rounded down, up, down
@pytest.mark.parametrize("start", [0, 60_000])
def test_edges_on_samples_lie_behind_them(device, period, exposure, start):
    """Integers of milliseconds say which samples are exposed; float32 knows none of these times."""
    at = start // period * period + np.arange(301)
    exposed = (at - 1) % period < exposure  # a sample at the begin is not yet, one at the end still is
    scene = dase.VideoScene(np.full((301, 1, 4), 0.3, np.float32), at * 1e-3)
    frames = Exposure(amplitude=0.3, spread=0.0, period=period * 1e-3, exposure=exposure * 1e-3)
    events = dase.simulate(scene, sensor(frames, off=0.199), device=device)
    for polarity, step in ((True, 1), (False, -1)):
        before = at[:-1][np.diff(exposed.astype(int)) == step]
        t = events.t[(events.x == 0) & (events.p == polarity)] * 1e3
        np.testing.assert_array_equal(np.floor(t + 1e-3), before)


def test_a_search_tries_the_frames_that_are_seen_and_none_where_none_are():
    seen = Observations(100.0, 0.0, 0.0, "down", 1e5, 0.1, 0.1)
    assert Exposure.candidates(seen) == []
    seen = replace(seen, frame_interval=0.1, frame_begin=7.23, frame_exposure=0.04)
    (found,) = Exposure.candidates(seen)
    assert (found.period, found.exposure) == (0.1, 0.04)
    assert found.begin == pytest.approx(0.03)
    moved = found.shifted(7.0)  # whole periods change nothing
    assert min(moved.begin - 0.03, 0.13 - moved.begin, key=abs) == pytest.approx(0.0, abs=1e-9)
    assert found.shifted(0.01).begin == pytest.approx(0.02)
    assert [axis.name for axis in axes_of(Sensor((Threshold(), found))) if axis.effect is Exposure] == [
        "exposure.amplitude",
        "exposure.spread",
    ]


def step_of(contrast: float, samples: int) -> dase.VideoScene:
    """Return three pixels that brighten by a contrast [log intensity] at sample 100, one each 0.2 ms."""
    frames = np.full((samples, 1, 3), 0.2, np.float32)
    frames[100:] *= np.exp(contrast)
    return dase.VideoScene(frames, np.arange(samples) * 2e-4)


@pytest.mark.parametrize("cutoff", [0.5, 5.0, 50.0])
def test_a_step_fades(device, cutoff):
    """After the step's ON events its decay makes as many OFF events, the n-th when n thresholds are gone."""
    contrast, theta = 1.05, 0.1
    scene = step_of(contrast, 4001)
    events = dase.simulate(scene, sensor(HighPass(cutoff=cutoff), on=theta, off=theta), device=device)
    mine = events.select(events.x == 1)
    rate = 2 * np.pi * cutoff
    kept = contrast * (1 - np.exp(-rate * 2e-4)) / (rate * 2e-4)  # of a step that takes one sample
    ups = int(kept / theta)
    assert mine.p.sum() == ups
    begin = 100 * 2e-4
    # the memory stands at ups thresholds; eps of the logarithm takes a little of the contrast
    level = theta * ups - theta * np.arange(1, ups + 1)
    want = np.array([begin + np.log(kept / left) / rate for left in level if left > 1e-9])
    want = want[want < scene.sample_times()[-1]]
    got = mine.t[~mine.p][: len(want)]
    assert len(got) == len(want)
    np.testing.assert_allclose(got, want, rtol=0, atol=0.03 / rate + 2e-4)


def test_slow_ramps_are_lost_and_fast_ones_stay(device):
    seconds, theta, cutoff = 2.0, 0.2, 1.0
    times = np.arange(2001) * 1e-3
    slopes = np.array(
        [0.5, 1.1, 1.4, 5.0]
    )  # a slope s ends at s / (2π): below the threshold for the first two
    frames = 0.05 * np.exp(0.5 * slopes[None, None] * times[:, None, None])
    scene = dase.VideoScene(frames.astype(np.float32), times)
    events = dase.simulate(scene, sensor(HighPass(cutoff=cutoff), on=theta, off=theta), device=device)
    counts = np.bincount(events.x, minlength=4)
    level = 0.5 * slopes / (2 * np.pi * cutoff) * (1 - np.exp(-2 * np.pi * cutoff * seconds))
    assert np.all((counts > 0) == (level > theta))
    assert np.all(counts <= np.floor(level / theta + 0.05))


def test_a_high_pass_cuts_what_is_slow_of_the_noise_and_leaves_what_is_fast(device):
    """Noise behind two poles far above the cutoff keeps its variance; far below, it loses nearly all."""
    noise = VoltageNoise(sigma=0.1, cutoff=200.0, knee=1.0, dark=1e-3)
    scene = still(400, 1.0, 0.5)
    rates = [
        len(dase.simulate(scene, sensor(noise, HighPass(cutoff=c), on=0.15, off=0.15), seed=5, device=device))
        for c in (0.0, 0.5, 20_000.0)
    ]
    assert rates[0] > 2000
    assert abs(rates[1] / rates[0] - 1) < 0.1
    assert rates[2] < 0.2 * rates[0]


def fading(cutoff: float) -> HighPass:
    """Return a high-pass at the memory of the change detector."""
    return HighPass(cutoff=cutoff, at="memory")


@pytest.mark.parametrize("cutoff", [0.5, 5.0, 50.0])
def test_what_a_step_leaves_below_a_threshold_fades_without_an_event(device, cutoff):
    contrast, theta = 1.05, 0.1
    scene = step_of(contrast, 2001)
    events = dase.simulate(scene, sensor(fading(cutoff), on=theta, off=theta), device=device)
    mine = events.select(events.x == 1)
    assert mine.p.all()
    # within the sample that the step takes a change fades as in the filter
    rate = 2 * np.pi * cutoff * 2e-4
    assert len(mine) == int(contrast * (1 - np.exp(-rate)) / rate / theta)


@pytest.mark.parametrize("theta", [0.1, 0.25])
@pytest.mark.parametrize("cutoff", [0.3, 1.0])
def test_a_ramp_sends_events_as_a_leaky_integrator_fires(device, theta, cutoff):
    """dd/dt = s - 2π f d from 0 reaches the threshold θ after -log(1 - 2π f θ / s) / (2π f)."""
    times = np.arange(4001) * 2.5e-4
    slopes = 2 * np.pi * cutoff * theta * np.array([0.5, 0.95, 1.1, 2.0, 6.0])
    slopes *= np.where(np.arange(5) == 3, -1, 1)
    frames = 0.9 * np.exp(slopes * (times[:, None] - np.where(slopes > 0, times[-1], 0.0)))[:, None]
    scene = dase.VideoScene(frames.astype(np.float32), times)
    plain = replace(sensor(fading(cutoff), on=theta, off=theta), log_eps=1e-9)
    events = dase.simulate(scene, plain, device=device)
    assert not np.isin(events.x, [0, 1]).any()
    rate = 2 * np.pi * cutoff
    for x in (2, 3, 4):
        want = -np.log(1 - rate * theta / abs(slopes[x])) / rate
        mine = events.select(events.x == x)
        assert np.all(mine.p == (slopes[x] > 0))
        assert len(mine) == pytest.approx(times[-1] / want, rel=0.01, abs=1)
        if len(mine) > 1:
            np.testing.assert_allclose(np.diff(mine.t), want, rtol=0.02)


def test_a_leak_slower_than_the_memory_forgets_sends_nothing(device):
    theta, rate = 0.2, 5.0
    for cutoff, fires in ((1.2, False), (0.4, True)):
        leaky = sensor(Leak(rate=rate, spread=0.0), fading(cutoff), on=theta, off=theta)
        events = dase.simulate(still(8, 4.0), leaky, device=device)
        # it fades faster than a threshold leaks: 2π cutoff > rate
        assert (2 * np.pi * cutoff < rate) == fires
        want = -np.log(1 - 2 * np.pi * cutoff / rate) / (2 * np.pi * cutoff) if fires else np.inf
        assert len(events) / 8 == pytest.approx(4.0 / want, abs=1.01 if fires else 0)


def test_bursts_of_frames_do_not_add_up_at_a_memory_that_forgets(device):
    frames = Exposure(amplitude=0.45, spread=0.0, period=0.1, exposure=0.03, begin=0.0205)
    plain, slow = (
        dase.simulate(still(64, 2.0), sensor(frames, *more, off=0.199), device=device)
        for more in ((), (fading(0.01),))
    )
    assert len(plain) > 1000
    assert len(slow) == pytest.approx(len(plain), rel=0.02)


def leaky_counts(level: np.ndarray, step: float, rate: float, on: float, off: float) -> np.ndarray:
    """Return ON and OFF events of pixels whose change fades, by small steps, shape (2, N).

    Args:
        level: Voltage, which runs straight between samples, shape (K, N).
        step: Between them [s].
        rate: 2π times the cutoff [1/s].
        on: Threshold.
        off: Threshold.
    """
    parts, out = 16, np.zeros((2, level.shape[1]), np.int64)
    change = np.zeros(level.shape[1])
    for ahead in np.diff(level, axis=0):
        for _ in range(parts):
            change += ahead / parts - rate * step / parts * (change + 0.5 * ahead / parts)
            many = np.where(change > 0, np.floor(change / on), -np.floor(-change / off)).astype(int)
            out[0] += np.maximum(many, 0)
            out[1] += np.maximum(-many, 0)
            change -= np.where(many > 0, many * on, many * off)
    return out


@pytest.mark.parametrize("cutoff", [0.3, 3.0, 20.0])
@pytest.mark.parametrize("noisy", [False, True])
def test_a_memory_that_forgets_is_that_of_small_steps(device, cutoff, noisy):
    """Before random light, alone, and behind a low-pass with noise of the voltage."""
    rng = np.random.default_rng(3)
    times = np.arange(1001) * 1e-3
    waves = sum(
        a * np.sin(2 * np.pi * f * times[:, None] + p)
        for a, f, p in zip(
            (0.8, 0.5, 0.25), (1.0, 4.0, 11.0), rng.uniform(0, 2 * np.pi, (3, 40)), strict=True
        )
    )
    frames = (0.2 * np.exp(waves - 0.3)).astype(np.float32)
    before = (Bandwidth(cutoff=60.0), VoltageNoise(sigma=0.05, cutoff=30.0)) if noisy else ()
    bare = sensor(*before, on=0.17, off=0.21)
    scene = dase.VideoScene(np.minimum(frames, 1.0)[:, None], times)
    level = reference.voltage(bare, times, np.minimum(frames, 1.0), 4)
    want = leaky_counts(level - level[0], 1e-3, 2 * np.pi * cutoff, 0.17, 0.21)
    got, filtered = (
        counts(scene, bare.with_effect(one), 1.0, device, seed=4)[::-1]
        for one in (fading(cutoff), HighPass(cutoff=cutoff))
    )
    assert want.sum() > 100
    assert got.sum() == pytest.approx(want.sum(), rel=0.01)
    assert np.abs(got - want).max() <= 2
    # a filter before the memory is another effect
    assert np.abs(filtered - want).sum() > 4 * np.abs(got - want).sum()


def test_off_is_off_at_the_memory_too(device):
    scene = dase.VideoScene(
        np.random.default_rng(0).uniform(0.1, 1, (50, 4, 6)).astype(np.float32), np.arange(50) * 1e-3
    )
    plain, off = (dase.simulate(scene, sensor(*more), device=device) for more in ((), (fading(0.0),)))
    assert len(plain) > 100
    np.testing.assert_array_equal(plain.t, off.t)
