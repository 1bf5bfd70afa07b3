"""Thresholds drawn anew, leak and shot noise, hot and dead pixels, and the dead time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.event_comparison import KS, by_pixel, distance, tracks
from helpers.sensors import counts, every
from helpers.small_scenes import flicker, ramp, still
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.dead import Dead
from dase.effects.hot import Hot
from dase.effects.jitter import Jitter
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.simulation.pixel_array import PixelArray


@pytest.mark.parametrize("mode", ["drop", "delay"])
@pytest.mark.parametrize("spread", [0.05, 0.25, 0.5])
def test_thresholds_are_drawn_anew_after_each_event(device, spread, mode):
    pixels = 60
    sensor = every(Threshold(on=0.3, off=0.1, phase=0.0), Jitter(spread=spread), mode=mode)
    for sign, theta, name in ((1, 0.3, "normal"), (-1, 0.1, "normal_2")):
        events = dase.simulate(ramp(sign * 6.0, 1.0, pixels, samples=7), sensor, seed=5, device=device)
        for pixel, times in enumerate(tracks(events)):
            stream = reference.Stream(f"jitter_redraw_{name}", 5, pixel)
            want = [max(theta * (1 + spread * stream.normal(n)), 0.01) for n in range(len(times))]
            np.testing.assert_allclose(6.0 * times, np.cumsum(want), atol=2e-5)
    got = counts(ramp(-6.0, 1.0, pixels, samples=7), sensor, 1.0, device, seed=5)[0]
    np.testing.assert_array_equal(got, [len(t) for t in tracks(events)])


@pytest.mark.parametrize("noise", ["held", "passes"])
@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
@pytest.mark.parametrize("spread", [0.1, 0.4])
def test_thresholds_of_noisy_slow_pixels_are_drawn_anew(device, rng, spread, mode, noise):
    """Whenever the memory is set, be it by an event that a dead time loses."""
    scene = flicker(rng, size=(4, 5))
    times = scene.sample_times()
    others = Bandwidth(cutoff=90.0), Shot(rate=60.0), Refractory(period=3e-3, mode=mode, noise=noise)
    sensor = every(Threshold(on=0.17, off=0.23), Jitter(spread=spread), *others, mode=mode)
    got = by_pixel(PixelArray(sensor, 5, 4, seed=5, device=device).emit(scene, times)[0])
    want = reference.events(sensor, times, scene.frames(times).reshape(len(times), -1), 5)
    alike = [
        np.array_equal(g[:, 1], w[:, 2]) and np.allclose(g[:, 0], w[:, 1], atol=1e-5)
        for g, w in zip(got, want, strict=True)
    ]
    assert np.mean(alike) >= 0.9
    assert np.mean([len(w) for w in want]) > 10


@pytest.mark.parametrize("spread", [0.1, 0.2, 0.3])
def test_jitter_averages_out_and_mismatch_does_not(device, spread):
    scene = ramp(9.0, 1.0, 500)
    quiet = Threshold(on=0.1, off=0.1, phase=0.0)
    spreads = []
    for effect in (Jitter(spread=spread), Mismatch(spread=spread)):
        on = counts(scene, every(quiet, effect), 1.0, device)[1]
        spreads.append(on.std() / on.mean())
    # a sum of 90 intervals varies by spread / √90
    assert spreads[0] == pytest.approx(spread / np.sqrt(90), rel=0.15)
    assert spreads[1] > 0.75 * spread


def test_noise_events_draw_new_thresholds_too(device):
    # a memory reset by a noise event waits for the next threshold, not for the one it had
    sensor = every(Threshold(on=1.0, off=1.0, phase=0.0), Jitter(spread=0.3), Shot(rate=5.0, bright=1.0))
    array = PixelArray(sensor, 50, 1, seed=2, device=device)
    times = np.linspace(0, 2.0, 9)
    array.emit(still(np.full(50, 0.2), 2.0, 9), times)
    from dase.kernels import pixel_stages

    redraws = array._state.numpy()[pixel_stages.states(array.stages).index("redraws"), 0]
    assert redraws.sum() == counts(still(np.full(50, 0.2), 2.0, 9), sensor, 2.0, device, seed=2).sum()
    assert redraws.sum() > 300


def test_leak_grows_with_light(device):
    light = np.array([0.0, 0.25, 1.0])
    sensor = every(Leak(rate=0.5, spread=0.0, light=8.0))
    off, on = counts(still(np.repeat(light, 50), 40.0, 41), sensor, 40.0, device).reshape(2, 3, 50)
    assert off.sum() == 0
    np.testing.assert_allclose(on.mean(1) / 40.0, 0.5 * (1 + 8.0 * light), atol=0.03)


def test_leak_follows_the_inverse_of_a_pixels_threshold(device):
    sensor = every(Threshold(on=0.2, off=0.4), Leak(rate=2.0, spread=0.0), Mismatch(spread=0.2))
    theta = PixelArray(sensor, 40, 1, device=device).thresholds()[0, 1]
    on = counts(still(np.full(40, 0.1), 100.0, 101), sensor, 100.0, device)[1]
    np.testing.assert_allclose(on, 200 * 0.2 / theta, atol=1.5)
    assert on.max() > 1.5 * on.min()


def test_pixels_of_low_threshold_have_more_shot_noise(device):
    sensor = every(Shot(rate=20.0, balance=0.3), Mismatch(spread=0.2))
    theta = PixelArray(sensor, 300, 1, device=device).thresholds()[0].astype(float)
    got = counts(still(np.zeros(300), 20.0, 21), sensor, 20.0, device)
    for polarity, share in ((0, 0.7), (1, 0.3)):
        want = 20.0 * 20.0 * share * 0.2 / theta[polarity]
        deviation = (got[polarity] - want) / np.sqrt(want)
        assert abs(deviation.mean()) < 3 / np.sqrt(300)
        assert deviation.std() == pytest.approx(1, abs=3 / np.sqrt(600))


def test_leak_and_shot_superpose(device):
    rate, seconds, pixels = 0.5, 30.0, 900
    scene = still(np.zeros(pixels), seconds, 31)
    shot = Shot(rate=rate, balance=0.3)
    off, on = counts(scene, every(shot, Leak(rate=2.0, spread=0.0)), seconds, device).sum(1)
    alone_off, alone_on = counts(scene, every(shot), seconds, device).sum(1)
    leak = counts(scene, every(Leak(rate=2.0, spread=0.0)), seconds, device)[1].sum()
    assert off == alone_off  # the same random numbers
    # a shot event makes the memory anew, and the leak starts over: on average r / (e^(r T) - 1) remain
    total = rate * 0.5
    want = pixels * seconds * rate / np.expm1(total)
    assert on - alone_on == pytest.approx(want, rel=0.02)
    assert on - alone_on < leak


def test_hot_pixels_are_few_and_log_normal(device):
    share, rate, spread, seconds, pixels = 0.05, 30.0, 0.8, 40.0, 16_000
    sensor = every(Hot(share=share, rate=rate, spread=spread, balance=0.8))
    off, on = counts(still(np.full(pixels, 0.3), seconds, 3), sensor, seconds, device)
    hot = np.flatnonzero(on + off)
    assert len(hot) == pytest.approx(share * pixels, abs=3 * np.sqrt(share * pixels))
    assert on.sum() / (on + off).sum() == pytest.approx(0.8, abs=0.01)
    log_rate = np.log((on + off)[hot] / seconds)
    assert log_rate.mean() == pytest.approx(np.log(rate), abs=3 * spread / np.sqrt(len(hot)))
    assert log_rate.std() == pytest.approx(spread, rel=3 / np.sqrt(2 * len(hot)))
    assert abs(np.corrcoef(hot[:-1], hot[1:] - hot[:-1])[0, 1]) < 0.15  # scattered evenly


@pytest.mark.parametrize("others", [(), (Bandwidth(cutoff=50.0), Shot(rate=20.0, balance=0.3))])
@pytest.mark.parametrize(
    ("share", "rate", "spread", "balance"),
    [(0.1, 40.0, 1.0, 0.5), (0.5, 8.0, 0.4, 0.9), (1.0, 100.0, 0.0, 0.0)],
)
def test_each_pixel_has_the_rate_of_its_twin(device, share, rate, spread, balance, others):
    seconds, pixels = 20.0, 1000
    sensor = every(Hot(share=share, rate=rate, spread=spread, balance=balance), *others)
    got = counts(still(np.zeros(pixels), seconds, 3), sensor, seconds, device, seed=4)
    uniform, normal = (
        np.array([draw(reference.Stream(f"hot_noise_pixel_{name}", 4, i)) for i in range(pixels)])
        for name, draw in (("uniform", reference.Stream.uniform), ("normal", reference.Stream.normal))
    )
    total = np.where(uniform < share, rate * np.exp(spread * normal), 0.0)
    assert 0.8 * share * pixels < np.count_nonzero(total) <= pixels
    for on, mine in enumerate(got):
        noise = (0.3, 0.7)[1 - on] * 20.0 if others else 0.0
        want = seconds * (total * (balance if on else 1 - balance) + noise)
        assert mine[want == 0].sum() == 0
        deviation = (mine - want)[want > 0] / np.sqrt(want[want > 0])  # Poisson counts
        if len(deviation):
            assert abs(deviation.mean()) < 3.5 / np.sqrt(len(deviation))
            assert deviation.std() == pytest.approx(1, abs=3.5 / np.sqrt(2 * len(deviation)))


def test_hot_intervals_are_exponential(device):
    sensor = every(Hot(share=1.0, rate=100.0, spread=0.0))
    events = dase.simulate(still(np.full(100, 0.3), 2.0, 3), sensor, device=device)
    waits = np.sort(np.concatenate([np.diff(np.r_[0, t[:40]]) for t in tracks(events)]))
    assert distance(waits, 1 - np.exp(-100.0 * waits)) < KS


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_dead_pixels_never_fire(device, mode):
    share, pixels = 0.2, 5000
    scene = ramp(3.0, 0.1, pixels, samples=5)
    loud = (Shot(rate=100.0), Hot(share=1.0, rate=100.0), Leak(rate=100.0))
    got = counts(scene, every(Dead(share=share), *loud, mode=mode), 0.1, device).sum(0)
    alive = counts(scene, every(*loud, mode=mode), 0.1, device).sum(0)
    assert np.mean(got == 0) == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) / pixels))
    np.testing.assert_array_equal(got[got > 0], alive[got > 0])
    dead = counts(scene, every(Dead(share=1.0), *loud, mode=mode), 0.1, device)
    assert dead.sum() == 0


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_dead_time_that_delays_loses_nothing_and_one_that_drops_does(device, spread):
    # a fast rise, then rest: long enough for all crossings to be sent one dead time after the other
    level = np.r_[np.linspace(0, 4.0, 11), np.full(40, 4.0)] - 4.5
    times = np.r_[np.linspace(0, 0.01, 11), 0.01 + 0.01 * np.arange(1, 41)]
    scene = dase.VideoScene((np.exp(level) - 1e-3)[:, None, None] * np.ones((1, 30)), times)
    quiet = Threshold(on=0.19, off=0.19, phase=0.0), Jitter(spread=spread)
    ideal, late, lost = (
        counts(scene, every(*quiet, *others, mode=mode), 1.0, device)[1]
        for mode, others in (
            ("drop", ()),
            ("delay", (Refractory(period=4e-3, mode="delay"),)),
            ("drop", (Refractory(period=4e-3, mode="drop"),)),
        )
    )
    assert np.all(ideal == 21) if spread == 0 else len(np.unique(ideal)) > 3
    np.testing.assert_array_equal(late, ideal)
    assert np.all(lost <= 4)
