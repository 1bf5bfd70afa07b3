"""Pairs of effects, and all of them, together: what each says must still hold, and what only both can do."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.event_comparison import same, tracks
from helpers.sensors import STRONG, every
from helpers.small_scenes import flicker, still

import dase
from dase.effects.anti_flicker import AntiFlicker
from dase.effects.bandwidth import Bandwidth
from dase.effects.bayer import Bayer
from dase.effects.dark import Dark
from dase.effects.double_events import DoubleEvents
from dase.effects.flicker import Flicker
from dase.effects.latency import Latency
from dase.effects.leak import Leak
from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.mismatch import Mismatch
from dase.effects.optics_blur import OpticsBlur
from dase.effects.rate_control import RateControl
from dase.effects.readout import Readout
from dase.effects.refractory import Refractory
from dase.effects.row_scan import RowScan
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.effects.trail_filter import TrailFilter
from dase.effects.vignetting import Vignetting

FINE = Threshold(on=0.01, off=0.01, phase=0.0)


def all_on(mode: str) -> dase.Sensor:
    """Return a sensor on which every effect there is is on, and seen."""
    more = (
        OpticsBlur(sigma=0.4),
        Bayer(purity=0.8),
        Bandwidth(cutoff=400.0),
        LearnedThreshold(
            weights="stands for a file", bound=np.full((2, 8, 10), [[[1.1]], [[0.2]]], np.float32)
        ),
        Mismatch(spread=0.1),
        Leak(rate=30.0, light=3.0),
        Shot(rate=60.0),
        Refractory(period=3e-3, mode=mode),
        Latency(delay=4e-3, light=0.7),
        RowScan(line=1e-4),
        Readout(rate=3e4, depth=20),
        Timestamp(jitter=2e-3, step=1e-5),
        DoubleEvents(share=0.1, delay=2e-6),
        AntiFlicker(low=30.0, high=100.0, start=1.0, stop=1.0),
        TrailFilter(threshold=2e-4),
        RateControl(rate=1e4, period=1e-3),
    )
    sensor = every(Threshold(), *STRONG.values(), *more, mode=mode)
    assert not any(effect.is_off() for effect in sensor.effects if effect.name != "threshold")
    assert len(sensor.effects) == len(dase.EFFECTS)
    return sensor


@pytest.mark.parametrize(
    "mode", ["reset", *(pytest.param(m, marks=pytest.mark.slow) for m in ("drop", "delay"))]
)
def test_all_effects_on(device, rng, mode):
    grey, sensor = flicker(rng), all_on(mode)
    times = grey.sample_times()
    tint = np.float32([1.0, 0.8, 0.5])
    scene = dase.VideoScene(grey.frames(times)[..., None] * tint, times)
    whole = dase.Events.concatenate(dase.stream(scene, sensor, seed=3, device=device, chunk=10**6))
    for chunk in (7, 64):
        same(dase.Events.concatenate(dase.stream(scene, sensor, seed=3, device=device, chunk=chunk)), whole)
    labelled = dase.simulate(scene, sensor, seed=3, device=device, labels=True)
    same(labelled, whole)
    assert len(np.unique(labelled.label)) == 4  # signal, leak, shot and hot pixels, all of them seen
    # counts are what pixels send, before what they share
    before = dase.Sensor(
        tuple(e for e in sensor.effects if e.name not in ("readout", "anti_flicker", "rate_control"))
    )
    sent = dase.simulate(scene, before, seed=3, device=device)
    edges = np.linspace(0, sent.t[-1], 5)
    got = dase.count(scene, sensor, edges, seed=3, device=device)[0]
    inside = (sent.t > edges[0]) & (sent.t <= edges[-1])
    assert got.sum() == inside.sum() > 500
    # taking any one of them away is noticed
    for effect in sensor.effects:
        if effect.name != "threshold":
            other = dase.simulate(scene, sensor.with_effect(without(effect)), seed=3, device=device)
            assert len(other) != len(whole) or not np.array_equal(other.t, whole.t), effect.name


def without(effect: dase.Effect) -> dase.Effect:
    """Return the effect switched off, in its mode."""
    choices = {name: getattr(effect, name) for name in effect.choices()}
    off = {p.name: p.off for p in effect.parameters() if p.off is not None}
    return type(effect)(**off, **choices)


@pytest.mark.parametrize("share", [0.25, 1.0, 3.0])
def test_a_slow_photoreceptor_damps_a_lamp(device, share):
    frequency, depth, periods = 20.0, 0.3, 8
    scene = still([0.3, 0.7], 0.5, 4001)
    slow = Bandwidth(cutoff=frequency / share, dark=1.0)
    sensor = every(FINE, Flicker(frequency=frequency, depth=depth), slow, log_eps=1e-6)
    got = dase.count(scene, sensor, [0.1, 0.1 + periods / frequency], device=device)[0, 0]
    # the fundamental of log(1 + depth sin); harmonics of its own hardly pass
    fundamental = 2 * (1 - np.sqrt(1 - depth**2)) / depth
    swing = 2 * fundamental / np.sqrt(1 + share**2)
    # a pixel that turns round loses up to a threshold
    np.testing.assert_allclose(got / periods, swing / 0.01, rtol=0.03, atol=1.5)


def test_corners_are_slow_where_the_photoreceptor_needs_light(device):
    loss, cutoff, dark, width, height = 0.8, 50.0, 0.01, 41, 31
    times = np.r_[0.0, 0.01, 0.01001, 0.01001 + 2e-5 * np.arange(1, 2001)]
    light = np.where(times > 0.01, 0.8, 0.4)
    scene = dase.VideoScene(light[:, None, None] * np.ones((1, height, width), np.float32), times)
    slow = Vignetting(loss=loss), Bandwidth(cutoff=cutoff, dark=dark)
    events = dase.simulate(scene, every(FINE, *slow, log_eps=1e-6), device=device)
    square = (((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2) * 4 / (width**2 + height**2)
    falloff = (1 + (1 / np.sqrt(1 - loss) - 1) * square) ** -2
    for x, y, share in ((width // 2, height // 2, 1.0), (0, 0, falloff), (width - 1, 0, falloff)):
        tau = 1 / (2 * np.pi * cutoff * (dark + (1 - dark) * 0.8 * share))
        at = events.t[(events.x == x) & (events.y == y)] - 0.01
        levels = 0.01 * np.arange(1, len(at) + 1)
        half = levels < 0.6 * np.log(2)
        want = -tau * np.log(1 - levels[half] / np.log(2))
        np.testing.assert_allclose(at[half], want, rtol=0.01, atol=2e-5)
    assert falloff < 0.25


def test_dark_current_keeps_dark_pixels_quick(device):
    # the photoreceptor sees the photocurrent and the dark current together
    times = np.r_[0.0, 0.01, 0.01001, 0.01001 + 5e-5 * np.arange(1, 4001)]
    scene = dase.VideoScene(np.where(times > 0.01, 0.02, 0.01)[:, None, None] * np.ones((1, 1, 4)), times)
    lags = []
    for current in (0.0, 0.2):
        effects = Dark(current=current, spread=0.0), Bandwidth(cutoff=100.0, dark=1e-3)
        events = dase.simulate(scene, every(FINE, *effects, log_eps=1e-6), device=device)
        final = np.log((0.02 + current) / (0.01 + current))
        left = (0.02 + current) / (1 + current) if current else 1e-3 + (1 - 1e-3) * 0.02
        tau = 1 / (2 * np.pi * 100.0 * left)
        (at, *_) = tracks(events)
        number = int(0.5 * final / 0.01)
        lags.append(at[number - 1] - 0.01)
        assert lags[-1] == pytest.approx(-tau * np.log(1 - 0.01 * number / final), rel=0.02)
    assert lags[0] > 5 * lags[1]


def test_noise_in_the_dead_time_is_lost(device):
    # a counter that is blind for a while after each count, and counts at a rate λ else: λ / (1 + λ τ)
    rate, dead, pixels, seconds = 300.0, 2e-3, 400, 2.0
    scene = still(np.full(pixels, 0.0), seconds, 41)
    got = dase.count(
        scene, every(Threshold(), Shot(rate=rate), Refractory(period=dead)), [0, seconds], device=device
    )
    want = rate / (1 + rate * dead) * seconds * pixels
    assert got.sum() == pytest.approx(want, abs=4 * np.sqrt(want))


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_a_constant_latency_keeps_the_dead_time(device, rng, mode):
    scene, dead = flicker(rng), Refractory(period=4e-3, mode=mode)
    alone = dase.simulate(scene, every(Threshold(), dead, mode=mode), device=device)
    late = Latency(delay=6e-3, light=0.0)
    both = dase.simulate(scene, every(Threshold(), dead, late, mode=mode), device=device)
    np.testing.assert_allclose(both.t, alone.t + 6e-3, atol=2e-9)
    np.testing.assert_array_equal(both.x, alone.x)
    assert min(np.diff(track).min() for track in tracks(both) if len(track) > 1) > 4e-3 - 1e-8


def test_a_scan_waits_for_late_events(device, rng):
    scene, line = flicker(rng), 2e-5
    scan = RowScan(line=line)
    late = Latency(delay=3e-3, light=0.0)
    events = dase.simulate(scene, every(Threshold(), late, scan), device=device)
    t = np.rint(events.t * 1e9).astype(int)
    np.testing.assert_array_equal(t % (8 * 20_000), events.y.astype(int) * 20_000)
    assert set(np.diff(np.unique(t)) % 20_000) == {0}
    # a pixel sends at most one event in a scan, and none before its latency
    first = [track[0] for track in tracks(dase.simulate(scene, every(Threshold()), device=device))]
    seen = [track[0] for track in tracks(events)]
    wait = np.array(seen) - np.array(first) - 3e-3
    assert np.all(wait >= -2e-9)
    assert np.all(wait <= 8 * line + 2e-9)


def test_a_bus_shared_with_hot_pixels_loses_signal(device, rng):
    # the bus takes events as they come, so noise takes its share of it from the signal
    scene = flicker(rng)
    bus = Readout(rate=1.5e4, mode="drop")
    kept = []
    for rate in (0.0, 3000.0):
        noisy = every(Threshold(), Shot(rate=rate, bright=1.0), log_eps=1e-3)
        ample, narrow = (
            dase.simulate(scene, sensor, device=device, labels=True)
            for sensor in (noisy, noisy.with_effect(bus))
        )
        kept.append((narrow.label == 0).sum() / (ample.label == 0).sum())
        assert np.diff(narrow.t).min() >= 1 / bus.rate - 2e-9
    assert kept[1] < 0.6 * kept[0]
