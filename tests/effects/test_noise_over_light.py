"""Noise over light: the law against its formula and against recordings of cameras, where they are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.sensors import counts, every
from helpers.small_scenes import still
from scipy.ndimage import maximum_filter

import dase
from dase.effects.dark import Dark
from dase.effects.leak import Leak
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from perf.data_folder import data_folder
from perf.experiments.noise.run import LEVELS, measured


def recording(name: str) -> Path:
    folder = data_folder()
    path = None if folder is None else folder / "recordings" / name
    if path is None or not path.is_file():
        pytest.skip(f"needs {name}, which is no part of the project: set DASE_DATA")
    return path


@pytest.mark.parametrize("knee", [0.01, 0.1, 1.0, np.inf])
@pytest.mark.parametrize("bright", [0.0, 0.3])
def test_shot_noise_falls_with_the_light(device, knee, bright):
    light, pixels, seconds, rate = np.array([0.0, 0.02, 0.1, 0.5, 1.0]), 300, 10.0, 20.0
    scene = still(np.repeat(light, pixels), seconds, 11)
    got = counts(scene, every(Shot(rate=rate, bright=bright, knee=knee)), seconds, device).sum(0)
    share = bright + (1 - bright) * (1 - light) / (1 + light / knee) ** 2
    want = rate * share * pixels * seconds
    assert np.all(np.abs(got.reshape(5, pixels).sum(1) - want) <= 4 * np.sqrt(want))


@pytest.mark.parametrize("spread", [0.0, 0.4, 0.8])
def test_some_pixels_are_noisier_than_others(device, spread):
    """Counts of a pixel are Poisson about its rate, so their moments tell those of a log-normal rate."""
    pixels, seconds, rate = 4000, 10.0, 2.0
    scene = still(np.full(pixels, 0.3), seconds, 11)
    shot = Shot(rate=rate, bright=1.0, balance=0.5, spread=spread)
    got = counts(scene, every(shot), seconds, device).sum(0).astype(float)
    mean, wide = rate * seconds, np.exp(spread**2) - 1
    assert got.mean() == pytest.approx(mean, abs=4 * np.sqrt((mean + mean**2 * wide) / pixels))
    assert (got.var() - got.mean()) / got.mean() ** 2 == pytest.approx(wide, rel=0.2, abs=0.005)
    halves = counts(scene, every(shot), seconds / 2, device).sum(0)
    assert np.corrcoef(halves, got - halves)[0, 1] == pytest.approx(
        mean / 2 * wide / (1 + mean / 2 * wide), abs=0.06
    )


@pytest.mark.parametrize("change", [0.5, 2.0])
def test_noise_follows_the_thresholds_of_biases(device, change):
    """Where the rate was measured at a threshold, lower thresholds of all pixels make it higher."""
    scene, seconds = still(np.zeros(600), 20.0, 21), 20.0
    theta = Threshold(on=0.2 * change, off=0.2 * change)
    for own, factor in ((0.0, 1.0), (0.2, 1 / change)):
        shot = counts(scene, every(theta, Shot(rate=4.0, threshold=own)), seconds, device).sum()
        assert shot == pytest.approx(4.0 * seconds * 600 * factor, rel=0.03)
        leak = counts(scene, every(theta, Leak(rate=4.0, spread=0.0, threshold=own)), seconds, device)
        assert leak[0].sum() == 0
        assert leak[1].mean() == pytest.approx(4.0 * seconds * factor, abs=0.6)


@pytest.mark.parametrize("name", ["davis240c", "davis346", "dvs128", "dvxplorer", "gen3", "gen41", "imx636"])
def test_noise_of_cameras_was_measured_at_their_own_thresholds(name):
    """So lower thresholds make more noise; one number cannot stand for two thresholds, as those of gen3."""
    sensor = dase.load_sensor(name)
    theta = sensor["threshold"]
    assert sensor["leak"].threshold == theta.on
    assert sensor["shot"].threshold == (theta.on if theta.on == theta.off else 0.0)


def test_parasitic_photocurrent_is_of_light_alone(device):
    """The photodiode's dark current flows in another junction than the leak; before, it raised the leak."""
    light = np.array([0.0, 0.3])
    scene, seconds = still(np.repeat(light, 50), 20.0, 21), 20.0
    sensor = every(Leak(rate=2.0, spread=0.0, light=5.0), Dark(current=0.3, spread=0.5))
    on = counts(scene, sensor, seconds, device)[1].reshape(2, 50)
    np.testing.assert_allclose(on.mean(1) / seconds, 2.0 * (1 + 5.0 * light), atol=0.05)


def test_resting_pixels_of_a_camera_have_the_noise_of_its_preset(device):
    with np.load(recording("davis346_cuke_cradle.npz")) as data:
        frames, t = data["frames"].astype(float), data["t_us"]
        seen = np.zeros(frames.shape[1:])
        np.add.at(seen, (data["y"], data["x"]), 1)
    seconds = float(t[-1] - t[0]) * 1e-6
    rest, grey = maximum_filter(np.ptp(frames, axis=0), 15) <= 6, frames.mean(0)
    bands = [rest & (grey >= low) & (grey < high) for low, high in ((0, 5), (5, 10), (10, 20), (30, 80))]
    light = np.repeat([grey[band].mean() / 255 for band in bands], 3000)
    events = counts(still(light, 10.0, 11), dase.load_sensor("davis346"), 10.0, device).sum(0)
    got = events.reshape(4, 3000).mean(1) / 10.0
    # the few hottest left out: they are not noise of all pixels
    rate = [np.mean(n[n <= np.quantile(n, 0.999)]) / seconds for n in (seen[band] for band in bands)]
    assert np.all(got[:3] / rate[:3] < 1.6)
    assert np.all(got[:3] / rate[:3] > 1 / 1.6)
    assert got[3] < 0.015
    assert rate[3] < 0.015
    # the straight line of v2e has noise where the camera has none
    assert 0.9 * (1 - 0.75 * light[-1]) > 30 * rate[3]


def test_a_knee_is_gone_at_161_lux_and_a_straight_line_is_not():
    """OFF events of three light levels: no leak among them."""
    off = {level: counted[0] for level, counted in measured(recording("noise_iebcs.npz")).items()}
    share = {level: np.mean(intervals.sum(-1) > 0) for level, intervals in off.items()}
    assert share["0.1lux"] > 0.99
    assert share["161lux"] < 0.01
    assert share["3klux"] == 0
    shot, straight = Shot(rate=10.5, balance=0.57, bright=0.0, knee=0.001), Shot(rate=10.5, bright=0.0)
    for level, (lux, seconds) in LEVELS.items():
        light = lux / 3000
        scene = still(np.full(2500, light), seconds, 11)
        for effect, holds in ((shot, True), (straight, level != "161lux")):
            n = counts(scene, every(effect, Threshold()), seconds, "cpu")[0]
            # a pixel has an interval where it has two events
            assert (abs(np.mean(n > 1) - share[level]) < 0.01) == holds
