"""What changes nothing in a pixel, or what it must: effects switched off, swapped signs, shifted times."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.event_comparison import differing, rows, same
from helpers.sensors import full
from helpers.small_scenes import flicker
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.simulation.pixel_array import PixelArray

OPTIONAL = (Mismatch, Bandwidth, Leak, Shot, Refractory)


@pytest.mark.parametrize("effect", OPTIONAL, ids=lambda effect: effect.name)
def test_an_effect_switched_off_changes_nothing(device, rng, effect):
    scene, plain = flicker(rng), dase.Sensor((Threshold(),))
    want = dase.simulate(scene, plain, device=device)
    same(dase.simulate(scene, plain.with_effect(effect.identity()), device=device), want)
    on = dase.simulate(scene, reference.only(effect()), device=device)
    assert len(on) != len(want) or not np.array_equal(on.t, want.t)


def test_all_effects_switched_off_change_nothing(device, rng):
    scene = flicker(rng)
    want = dase.simulate(scene, dase.Sensor((Threshold(),)), device=device)
    for mode in ("reset", "drop", "delay"):
        same(dase.simulate(scene, reference.only(Threshold(), mode=mode), device=device), want)


def test_an_effect_leaves_the_random_numbers_of_others(device):
    # noise events of a static scene stay where they are when leak events join in
    scene = dase.VideoScene(np.full((20, 6, 7), 0.2, np.float32), np.arange(20) * 0.25)
    alone = rows(dase.simulate(scene, reference.only(Shot(rate=3.0)), device=device))
    others = (Mismatch(spread=0.3), Leak(rate=5.0), Bandwidth())
    # not mismatch, which makes pixels of low threshold noisier
    among = rows(dase.simulate(scene, reference.only(Shot(rate=3.0), *others[1:]), device=device))
    assert len(alone) > 100
    assert len(among) > 2 * len(alone)
    assert {tuple(row) for row in alone} <= {tuple(row) for row in among}
    few = PixelArray(dase.Sensor((Threshold(), Mismatch())), 7, 6, device=device).thresholds()
    many = PixelArray(reference.only(Mismatch(), *others[1:], Shot()), 7, 6, device=device).thresholds()
    np.testing.assert_array_equal(few, many)


def test_polarities_swap_with_intensities_and_thresholds(device, rng):
    values = np.cumsum(rng.normal(0, 0.3, (120, 12, 10)), 0)
    times = np.arange(120) / 1024
    for trial in range(4):
        on, off, phase = *rng.uniform(0.05, 0.6, 2), trial % 2
        there = dase.Sensor((Threshold(on=on, off=off, phase=phase),))
        back = dase.Sensor((Threshold(on=off, off=on, phase=phase),))
        a = rows(dase.simulate(reference.LogScene(values, times), there, device=device))
        b = rows(dase.simulate(reference.LogScene(-values, times), back, device=device))
        b[:, 3] = 1 - b[:, 3]
        np.testing.assert_array_equal(a, b)


def test_polarities_swap_behind_the_photoreceptor(device, rng):
    eps = 1e-3
    scene = flicker(rng)
    times = scene.sample_times()
    # log(inverse + eps) = const - log(frames + eps), and both lie in [0, 1]
    inverse = eps * (1 + eps) / (scene.frames(times).astype(float) + eps) - eps
    slow = (Bandwidth(cutoff=200.0, dark=1.0), Refractory(period=2e-3))
    there = reference.only(Threshold(on=0.17, off=0.26), *slow)
    back = reference.only(Threshold(on=0.26, off=0.17), *slow)
    a = dase.count(scene, there, times, device=device)
    b = dase.count(dase.VideoScene(np.maximum(inverse, 0), times), back, times, device=device)
    # the two logarithms are rounded differently
    assert differing(a, b[:, :, ::-1]) < 1e-3


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_time_shifts(device, rng, mode):
    scene = flicker(rng)
    times = scene.sample_times()
    a = rows(dase.simulate(scene, full(mode), device=device))
    later = dase.VideoScene(scene.frames(times), times + 64.0)
    b = rows(dase.simulate(later, full(mode), device=device))
    b[:, 0] -= 64 * 10**9
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_a_sample_on_the_straight_line_adds_nothing(device, rng, mode):
    scene = flicker(rng)
    times, level = scene.sample_times(), np.log(scene.frames(scene.sample_times()).astype(float) + 1e-3)
    share = rng.uniform(0.1, 0.9, (len(times) - 1, 1, 1))
    between = level[:-1] + share * np.diff(level, axis=0)
    when = times[:-1] + share[:, 0, 0] * np.diff(times)
    order = np.argsort(np.concatenate([times, when]))
    both = np.exp(np.concatenate([level, between])[order]) - 1e-3
    split = dase.VideoScene(both, np.concatenate([times, when])[order])
    # at bright = 1 the noise rate does not depend on the intensity, so noise events stay where they are;
    # a low-pass has no straight line between samples
    sensor = full(mode).with_effect(Shot(rate=60.0, bright=1.0)).with_effect(Bandwidth.identity())
    a = dase.count(scene, sensor, times, device=device)
    b = dase.count(split, sensor, times, device=device)
    # rounding moves an event across the verge of a sample or of the dead time
    assert differing(a, b) < 2e-3
