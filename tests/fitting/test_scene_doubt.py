"""What half of the frames make of a scene is added to what statistics may be off by."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import dase
from dase.diagnosis.directional_test import deviation_towards
from dase.diagnosis.settings import DEFAULTS
from dase.effects import EFFECTS
from dase.fitting.data_split import SplitMeasurement, split_measurement
from dase.fitting.measurement import Measurement, camera_scene
from dase.fitting.model import FittedModel, fit_present_model, with_effect_added
from dase.fitting.scene_doubt import is_guessed, with_scene_doubt
from dase.scenes.between_frames import CameraScene
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

WIDTH, HEIGHT, GAP, EXPOSURE = 96, 72, 0.04, 0.01
TRUE = Sensor(effects=(EFFECTS["threshold"](on=0.2, off=0.22),))


def shaking(seconds: float = 0.9) -> VideoScene:
    """Return a soft texture that shakes by some pixels."""
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.random((HEIGHT + 40, WIDTH + 40), np.float32), (0, 0), 1.5)
    texture = 0.03 + 0.9 * (texture - texture.min()) / np.ptp(texture)
    times = np.arange(0, seconds, 1e-3)
    frames = np.empty((len(times), HEIGHT, WIDTH), np.float32)
    for k, t in enumerate(times):
        x, y = 11 * np.sin(2 * np.pi * 3.7 * t), 9 * np.sin(2 * np.pi * 5.1 * t + 1)
        move = np.array([[1, 0, x - 20], [0, 1, y - 20]], np.float32)
        frames[k] = cv2.warpAffine(texture, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return VideoScene(frames, times)


def filmed(scene: VideoScene) -> CameraScene:
    """Return the scene between the frames of a camera of 8 bits."""
    times = scene.sample_times()
    dense = scene.frames(times)
    begins = np.arange(0, times[-1] - EXPOSURE, GAP)
    shown = [dense[(times >= b - 1e-9) & (times < b + EXPOSURE - 1e-9)].mean(0) for b in begins]
    grey = np.rint(255 * np.array(shown)).astype(np.uint8)
    return camera_scene(grey, begins, begins + EXPOSURE, [])


@pytest.fixture(scope="module")
def measured() -> tuple[SplitMeasurement, CameraScene, FittedModel]:
    scene = shaking()
    camera = filmed(scene)
    evidence = split_measurement(Measurement(dase.simulate(scene, TRUE, seed=1), camera), pixels=500)
    return evidence, camera, fit_present_model(evidence, Sensor(), None, seed=0)


def test_a_right_model_counts_as_right_where_frames_are_all_that_is_known(measured):
    evidence, camera, model = measured
    bare = model.judge(evidence.report, repeats=24, seed=7)
    doubted = with_scene_doubt(evidence, camera, model, seed=0)
    judged = model.judge(doubted.report, repeats=24, seed=7)
    assert bare.error > bare.gate  # a perfect sensor would be unexplained
    assert judged.error < judged.gate
    assert evidence.report.doubt is None


def test_what_a_scene_does_not_explain_is_still_seen(measured):
    """Pixels that rest for 10 ms after each event: the mean error may hide that, but not along its way."""
    evidence, camera, model = measured
    doubted = with_scene_doubt(evidence, camera, model, seed=0)
    slow = TRUE.with_effect(EFFECTS["refractory"](period=0.01))
    other = split_measurement(Measurement(dase.simulate(shaking(), slow, seed=1), camera), pixels=500)
    same = replace(other.report, doubt=doubted.report.doubt, drift=doubted.report.drift)
    looks = SimpleNamespace(seed=0, settings=DEFAULTS)
    there = with_effect_added(model, EFFECTS["refractory"](period=0.01))
    assert deviation_towards(looks, same, model, there) > DEFAULTS.hidden.away
    plain = doubted.report
    assert deviation_towards(looks, plain, model, there) < DEFAULTS.hidden.away_held_out


def test_only_scenes_between_frames_are_guessed():
    scene = shaking(0.3)
    assert not is_guessed(scene)
    assert is_guessed(filmed(scene))
    times = scene.sample_times()[:20]
    grey = np.rint(255 * scene.frames(times)).astype(np.uint8)
    assert not is_guessed(CameraScene(grey, times, times))


def test_every_second_frame_is_the_same_camera():
    camera = filmed(shaking(0.5))
    half = camera.every(2)
    np.testing.assert_array_equal(half.times, camera.times[::2])
    np.testing.assert_array_equal(half.intensity(1), camera.intensity(2))
    assert half.trust == camera.trust


def test_a_part_of_the_time_is_the_same_scene():
    camera = filmed(shaking(0.5))
    first, last = camera.times[3] + 0.01, camera.times[6] - 0.01
    part = camera.within(first, last)
    np.testing.assert_array_equal(part.times, camera.times[3:7])
    times = np.linspace(first, last, 5)
    np.testing.assert_allclose(part.frames(times), camera.frames(times), atol=1e-6)
    np.testing.assert_array_equal(camera.within(-1.0, 9.0).times, camera.times)
    between = float(camera.times[4:6].mean())
    np.testing.assert_array_equal(camera.within(between, between).times, camera.times[4:6])


def test_fewer_pixels_are_compared_where_the_scene_is_guessed(monkeypatch):
    """Over the same time, and with a third of them in the scout."""
    asked: list[dict[str, Any]] = []

    def split(*args: Any, **options: Any) -> Any:
        asked.append(options)
        raise dase.InputError("enough")

    monkeypatch.setattr("dase.diagnosis.compared_measurement.split_measurement", split)
    scene = shaking(0.5)
    events = dase.simulate(scene, TRUE, seed=1)
    for known, fewer in ((scene, 1.0), (filmed(scene), 1 / 3)):
        with pytest.raises(dase.InputError, match="enough"):
            dase.diagnose(events, TRUE, scene=known, pixels=1500)
        assert asked[-1]["pixels"] == round(1500 * fewer)
        assert asked[-1]["settings"].plenty == pytest.approx(DEFAULTS.plenty * fewer)
        assert asked[-1]["settings"].scouts == round(500 * fewer)
