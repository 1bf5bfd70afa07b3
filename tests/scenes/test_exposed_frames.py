"""Frames with an exposure: their blur is a mean over it, and the frame coupling is in step with them."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from helpers import command_line, small_scenes

import dase
from dase import io
from dase.datasets import generate
from dase.effects.exposure import Exposure
from dase.effects.threshold import Threshold
from dase.scenes.scene import LOG_EPS, Scene
from dase.simulation.sensor_file import dump_sensor


def test_blur_of_layers_is_a_dense_mean(device, rng):
    scene = small_scenes.layers(rng)
    begins = np.array([0.0, 0.03, 0.15])
    got = scene.exposed_frames(begins, 0.05, device)
    for frame, begin in zip(got, begins, strict=True):
        dense = begin + (np.arange(2000) + 0.5) / 2000 * 0.05
        want = np.mean([scene.frames(part, device).mean(0) for part in np.split(dense, 20)], axis=0)
        assert np.abs(frame - want).max() < 0.02  # of edges of a texture of random texels
        assert np.sqrt(np.mean((frame - want) ** 2)) < 0.003
        # and no frame of an instant is as near
        assert np.sqrt(np.mean((scene.frames(np.array([begin + 0.025]), device)[0] - want) ** 2)) > 0.02


def test_blur_of_a_video_is_the_mean_of_its_straight_logarithms(rng):
    scene = small_scenes.flicker(rng, step=1.0)
    times = scene.sample_times()
    begin, exposure = times[3] + 1e-4, times[17] - times[3] + 5e-4
    dense = begin + (np.arange(20_000) + 0.5) / 20_000 * exposure
    frames = np.log(scene.frames(times).astype(np.float64) + LOG_EPS).reshape(len(times), -1)
    want = np.stack([np.exp(np.interp(dense, times, level)).mean() - LOG_EPS for level in frames.T])
    got = scene.exposed_frames(np.array([begin]), exposure)[0]
    np.testing.assert_allclose(got.ravel(), want, atol=1e-6)


def test_light_at_rest_is_exposed_as_it_is(rng):
    light = rng.random((4, 5), np.float32)
    scene = small_scenes.static(light, 1.0, 11)
    np.testing.assert_allclose(scene.exposed_frames(np.array([0.0, 0.93]), 0.07), [light, light], atol=1e-7)
    # the rule of every other scene, too
    scene.frames = lambda times, device: np.broadcast_to(light, (len(times), 4, 5))
    got = Scene.exposed_frames(scene, np.array([0.31]), 0.4)
    np.testing.assert_allclose(got, [light], atol=1e-6)


@pytest.mark.parametrize(
    ("begin", "exposure", "message"),
    [
        (0.0, 0.0, "exposure must be a number > 0 s, got 0"),
        (0.0, float("nan"), "exposure must be a number > 0 s, got nan"),
        (0.95, 0.1, r"exposures must lie within the scene, 0\.\.1 s, got 0\.95\.\.1\.05"),
        (-0.1, 0.05, "exposures must lie within the scene"),
    ],
)
def test_impossible_exposures_are_refused(begin, exposure, message):
    with pytest.raises(dase.InputError, match=message):
        small_scenes.static(np.ones((2, 2)), 1.0, 3).exposed_frames(np.array([begin]), exposure)


COUPLED = dase.Sensor(
    (
        Threshold(on=0.2, off=0.199, phase=0.0),
        Exposure(amplitude=0.3, spread=0.0, period=0.07, exposure=0.003),  # of another camera's frames
    )
)


@pytest.mark.parametrize("suffix", ["h5", "npz"])
@pytest.mark.parametrize("start", [0.0, 0.0123])
def test_bursts_are_in_step_with_the_frames_of_a_file(tmp_path, suffix, start, device):
    path = tmp_path / f"a.{suffix}"
    scene = small_scenes.still(np.full(50, 0.3), 0.5, 51, start=start)
    generate.record_scene(scene, COUPLED, path, frame_rate=20.0, exposure=0.02, device=device)
    got = io.read(path)
    np.testing.assert_allclose(got.frame_exposure, 0.02, atol=2e-6)
    np.testing.assert_allclose(got.frame_times - 0.01, start + np.arange(10) / 20, atol=2e-6)
    assert np.all(got.frames == round(0.3 * 255))
    for polarity, edges in ((True, got.frame_times - 0.01), (False, got.frame_times + 0.01)):
        t = got.events.t[got.events.p == polarity]
        late = t[:, None] - edges
        # one event of each pixel at each edge, within a sample of it, and none elsewhere
        np.testing.assert_array_equal(((late > -2e-6) & (late < 1.1e-3)).sum(0), 50)
        assert len(t) == 50 * len(edges)


def test_a_data_set_has_frames_with_blur_and_says_so(tmp_path):
    options = ("--sequences", "1", "--jobs", "1", "--regime", "fast", "--size", "32x24", "--duration", "0.2")
    sensor = tmp_path / "sensor.toml"
    sensor.write_text(dump_sensor(COUPLED))
    done = command_line.dase_here(
        "synth", tmp_path / "out", *options, "--sensor", sensor, "--frame-rate", "20", "--exposure", "0.03"
    )
    assert done.returncode == 0, done.stderr
    record = tomllib.loads((tmp_path / "out" / generate.RECORD_FILE).read_text())
    assert record["exposure"] == 0.03
    assert record["sensor"]["exposure"]["period"] == 1 / 20
    assert record["sensor"]["exposure"]["exposure"] == 0.03
    got = io.read(tmp_path / "out" / "sequence_00000.h5")
    np.testing.assert_allclose(got.frame_times, np.arange(4) / 20 + 0.015)
    np.testing.assert_allclose(got.frame_exposure, 0.03)
    job = generate.DatasetJob(
        images="builtin", sensor="[threshold]", sequences=1, width=32, height=24, duration=0.2, regime="fast"
    )
    assert "exposure" not in job.text()  # off, the record is what it was
    scene = generate.make_scene(job, 0)
    dense = (np.arange(1000) + 0.5) / 1000 * 0.03
    want = 255 * np.mean([scene.frames(part).mean(0) for part in np.split(dense, 10)], axis=0)
    # photographs this small have texels finer than a pixel, which sub-frames half a pixel apart sample
    instant = 255 * scene.frames(np.array([0.015]))[0]
    assert np.sqrt(np.mean((got.frames[0] - want) ** 2)) < 0.2 * np.sqrt(np.mean((instant - want) ** 2))


def test_exposures_longer_than_a_period_are_refused(tmp_path):
    out = ("synth", tmp_path / "out", *command_line.SMALL)
    assert "at most the frames' period, 0.0166667 s, got 0.02" in command_line.refusal(
        *out, "--exposure", "0.02"
    )
    assert "at most the duration, 0.1 s, got 0.2" in command_line.refusal(*out, "--exposure", "0.2")
    assert ">= 0 s, got -1" in command_line.refusal(*out, "--exposure", "-1")
