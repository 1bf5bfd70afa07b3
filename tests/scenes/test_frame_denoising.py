"""Frames without the noise of what rests: what changes is left alone."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.scenes.frame_denoising import denoise_resting_pixels

SIGMA = 0.006


def noisy(rng, light):
    """Frames of 8 bits with noise."""
    return np.clip(np.rint(255 * (light + SIGMA * rng.standard_normal(light.shape))), 0, 255).astype(np.uint8)


@pytest.fixture
def light(rng):
    """A still random picture over which a bright square moves by two pixels a frame."""
    still = 0.2 + 0.4 * rng.random((60, 80))
    out = np.tile(still, (12, 1, 1))
    for k in range(12):
        out[k, 20:32, 10 + 2 * k : 22 + 2 * k] = 0.9
    return out


def test_what_rests_keeps_one_value(rng, light):
    frames = noisy(rng, light)
    got = denoise_resting_pixels(frames)
    far = np.ones((60, 80), bool)
    far[12:40, 2:54] = False
    constant = np.ptp(got[:, far], axis=0) == 0
    assert constant.mean() > 0.97
    error = np.sqrt(np.mean((got - light)[:, far] ** 2))
    assert error < 1.3 * SIGMA / np.sqrt(12)
    assert np.sqrt(np.mean((frames / 255 - light)[:, far] ** 2)) > 0.9 * SIGMA


def test_what_moves_is_left_as_it_is(rng, light):
    frames = noisy(rng, light)
    got = denoise_resting_pixels(frames)
    changed = np.abs(np.diff(light, axis=0)) > 0.1
    after = changed.any(0)
    assert after.sum() > 200
    np.testing.assert_allclose(got[:, after], light[:, after], atol=5 * SIGMA)  # no ghost of what was there


def test_a_slow_drift_and_a_flicker_stay(rng):
    drift = 0.3 * np.exp(0.01 * np.arange(60))[:, None, None] * np.ones((40, 50))
    got = denoise_resting_pixels(noisy(rng, drift))
    assert np.abs(got.mean((1, 2)) - drift[:, 0, 0]).max() < 3 * SIGMA  # it comes in steps below that
    assert np.ptp(got.mean((1, 2))) > 0.9 * np.ptp(drift)
    flicker = np.tile(0.4, (10, 40, 50))
    flicker[::2] *= 1.1
    assert np.abs(np.diff(denoise_resting_pixels(noisy(rng, flicker)), axis=0)).mean() > 0.035


def test_saturation_stays_unknown(rng):
    light = np.tile(np.linspace(-0.05, 1.05, 60), (6, 30, 1))
    frames = noisy(rng, light)
    ends = (frames == 0).any(0), (frames == 255).any(0)
    got = denoise_resting_pixels(frames)
    assert got[:, ends[0]].max() == 0
    assert got[:, ends[1]].min() == 1
    scene = dase.CameraScene(got, np.arange(6) / 25)
    assert not scene.usable(0)[ends[0] | ends[1]].any()
    deep = np.rint(64 + 16 * frames.astype(float)).astype(np.uint16)
    np.testing.assert_allclose(denoise_resting_pixels(deep, black=64, white=64 + 16 * 255), got, atol=1e-6)


def test_a_still_scene_makes_no_events_of_its_own(rng):
    """Noise of frames is answered with events; without it a camera at rest is silent."""
    begin = np.arange(12) / 25
    frames = noisy(rng, np.tile(0.02 + 0.1 * rng.random((40, 50)), (12, 1, 1)))
    sensor = dase.Sensor((dase.EFFECTS["threshold"](on=0.15, off=0.15),))
    counts = [
        len(dase.simulate(dase.CameraScene(f, begin), sensor))
        for f in (frames, denoise_resting_pixels(frames))
    ]
    assert counts[0] > 1000
    assert counts[1] < 0.02 * counts[0]


def test_bad_input_gets_a_sentence():
    with pytest.raises(dase.InputError, match="at least 2 frames"):
        denoise_resting_pixels(np.zeros((4, 5), np.uint8))
