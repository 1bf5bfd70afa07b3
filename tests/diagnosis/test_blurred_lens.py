"""Clips that are sharper than the camera saw them: its lens is found, and what pixels do beside it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import shaken_texture

import dase
from dase.diagnosis.blurred_lens import behind_lens as through_lens
from dase.diagnosis.blurred_lens import lens_between_events, rules_out_lens
from dase.diagnosis.late_light import more_alike_if_late
from dase.effects import EFFECTS
from dase.effects.bandwidth import Bandwidth
from dase.effects.optics_blur import OpticsBlur, blur_weights
from dase.events import Events
from dase.fitting.measurement import Measurement, as_measurement
from dase.results import Diagnosis, Grade
from dase.scenes.video import VideoScene

SIGMA = 1.3
TRIED = {name: EFFECTS[name] for name in ("optics_blur", "bandwidth", "jitter", "leak", "shot", "mismatch")}
PIXELS = 200


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    """Texture from step to step of a pixel, so that there is something to blur."""
    smooth = shaken_texture()
    times = smooth.sample_times()
    light = smooth.frames(times)
    edges = np.clip(0.5 + 3 * (light - cv2.GaussianBlur(light.mean(0), (0, 0), 9)), 0.1, 1)
    return VideoScene((255 * edges).astype(np.uint8), times)


def behind_lens(scene: VideoScene, sigma: float, *more: dase.Effect) -> Events:
    """Return events of a clip that OpenCV has blurred, so that dase's lens takes no part."""
    times = scene.sample_times()
    light = [cv2.GaussianBlur(frame, (0, 0), sigma) for frame in scene.frames(times)]
    sensor = dase.Sensor((*more, dase.EFFECTS["threshold"](on=0.2, off=0.22)))
    return dase.simulate(VideoScene(np.stack(light), times), sensor, seed=1)


def diagnose_briefly(events: Events, scene: VideoScene, effects: dict[str, type[dase.Effect]]) -> Diagnosis:
    """Return a diagnosis of few pixels, of two effects at most."""
    return dase.diagnose(
        events, "ideal", scene=scene, effects=effects, most=2, pixels=PIXELS, settings=NO_LIMITS
    )


@pytest.mark.slow
def test_a_lens_is_found_beside_a_leak(scene):
    events = behind_lens(scene, SIGMA, dase.EFFECTS["leak"](rate=4.0))
    found = diagnose_briefly(events, scene, TRIED)
    assert found.selected == ("optics_blur", "leak")
    width = found.parameters["optics_blur.sigma"]
    assert width.value == pytest.approx(SIGMA, rel=0.06)
    assert width.low < SIGMA < width.high
    assert found.sensor["optics_blur"].sigma == width.value
    assert found.sensor["leak"].rate == pytest.approx(4.0, rel=0.15)
    # each step has an error, the first one without the lens, and as given it is larger still
    sharp, *others = found.errors
    assert len(others) == 2
    assert sharp > 3 * others[0] > 3 * others[1]
    assert found.unexplained is None
    # what it wrote is what the clip is compared with
    assert dase.compare(events, found.sensor, scene=scene, pixels=PIXELS).error < 1


@pytest.mark.parametrize("beside", ["", "dark", "jitter", "shot"])
def test_a_lens_is_seen_by_how_far_light_goes_from_event_to_event(scene, beside):
    more = {"dark": EFFECTS["dark"](current=0.03), "jitter": EFFECTS["jitter"](spread=0.1),
            "shot": EFFECTS["shot"](rate=5.0)}  # fmt: skip
    events = behind_lens(scene, SIGMA, *([more[beside]] if beside else []))
    seen = lens_between_events(as_measurement(events, scene), log_eps=1e-3)
    assert seen.measurement.lens.sigma == pytest.approx(SIGMA, rel=0.05)
    assert seen.behind < 0.5 * seen.sharp
    # seen through it already
    assert lens_between_events(seen.measurement, log_eps=1e-3) is None


@pytest.mark.parametrize(
    "effect",
    [
        EFFECTS["jitter"](spread=0.3), EFFECTS["mismatch"](spread=0.3), EFFECTS["bandwidth"](cutoff=30.0),
        EFFECTS["second_order"](cutoff=60.0), EFFECTS["latency"](delay=5e-3), EFFECTS["linlog"](knee=0.2),
        EFFECTS["refractory"](period=0.01), EFFECTS["vignetting"](loss=0.8), EFFECTS["shot"](rate=20.0),
    ],
    ids=lambda effect: effect.name,
)  # fmt: skip
def test_what_makes_steps_differ_is_no_lens(scene, effect):
    sensor = dase.Sensor((effect, EFFECTS["threshold"](on=0.2, off=0.22)))
    events = dase.simulate(scene, sensor, seed=1)
    assert lens_between_events(as_measurement(events, scene), log_eps=1e-3) is None


def test_a_low_pass_explains_steps_better_than_a_lens_and_a_lens_better_than_that(scene):
    sensor = dase.Sensor((EFFECTS["bandwidth"](cutoff=30.0), EFFECTS["threshold"](on=0.2, off=0.22)))
    slow = as_measurement(dase.simulate(scene, sensor, seed=1), scene)
    blurred = as_measurement(behind_lens(scene, SIGMA), scene)
    assert more_alike_if_late(slow, through_lens(slow, SIGMA), log_eps=1e-3)
    assert not more_alike_if_late(blurred, through_lens(blurred, SIGMA), log_eps=1e-3)


BESIDE = {
    "latency": {"delay": 3e-3},
    "bandwidth": {"cutoff": 100.0},
    "second_order": {"cutoff": 30.0},
    "high_pass": {"cutoff": 3.0},
    "refractory": {"period": 2e-2},
    "jitter": {"spread": 0.3},
    "dark": {"current": 0.1},
    "voltage_noise": {"sigma": 0.05, "cutoff": 100.0},
}


@pytest.mark.parametrize("beside", BESIDE)
@pytest.mark.parametrize("sigma", [0.5, SIGMA])
def test_a_lens_is_not_ruled_out_whatever_is_beside_it(scene, sigma, beside):
    events = behind_lens(scene, sigma, EFFECTS[beside](**BESIDE[beside]))
    assert not rules_out_lens(as_measurement(events, scene), log_eps=1e-3)


@pytest.mark.parametrize("beside", ["", "voltage_noise"])
def test_a_lens_is_ruled_out_where_steps_differ_more_behind_any(scene, beside):
    more = [EFFECTS[beside](**BESIDE[beside])] if beside else []
    sensor = dase.Sensor((*more, EFFECTS["threshold"](on=0.2, off=0.22)))
    events = dase.simulate(scene, sensor, seed=1)
    assert rules_out_lens(as_measurement(events, scene), log_eps=1e-3)


@pytest.mark.slow
def test_a_lens_and_a_dark_current_are_told_apart(scene):
    """Neither leaves little by itself, and light that is too sharp looks like a jitter."""
    events = behind_lens(scene, SIGMA, EFFECTS["dark"](current=0.05))
    tried = TRIED | {"dark": EFFECTS["dark"]}
    found = diagnose_briefly(events, scene, tried)
    assert {one.effect: one.grade for one in found.findings} == {
        "optics_blur": Grade.CERTAIN, "dark": Grade.CERTAIN,
    }  # fmt: skip
    assert found.parameters["optics_blur.sigma"].value == pytest.approx(SIGMA, rel=0.06)
    assert found.parameters["dark.current"].value == pytest.approx(0.05, rel=0.1)


@pytest.mark.slow
def test_a_lens_and_a_latency_are_told_apart(scene):
    """Light is looked up too late, so that steps do not show the lens, and a latency alone leaves much."""
    events = behind_lens(scene, SIGMA, EFFECTS["latency"](delay=5e-3))
    assert lens_between_events(as_measurement(events, scene), log_eps=1e-3) is None
    tried = TRIED | {"latency": EFFECTS["latency"], "linlog": EFFECTS["linlog"]}
    found = diagnose_briefly(events, scene, tried)
    assert {one.effect: one.grade for one in found.findings} == {
        "optics_blur": Grade.SUPPORTED, "latency": Grade.SUPPORTED,
    }  # fmt: skip
    assert found.parameters["optics_blur.sigma"].value == pytest.approx(SIGMA, rel=0.06)
    assert found.parameters["latency.delay"].value == pytest.approx(5e-3, rel=0.1)


@pytest.mark.slow
def test_what_nobody_knows_beside_a_latency_is_no_lens(scene):
    hidden = (EFFECTS["latency"](delay=5e-3), EFFECTS["second_order"](cutoff=30.0))
    events = dase.simulate(scene, dase.Sensor((*hidden, EFFECTS["threshold"](on=0.2, off=0.22))), seed=1)
    tried = {name: EFFECTS[name] for name in ("optics_blur", "latency", "jitter", "leak", "shot", "mismatch")}
    found = diagnose_briefly(events, scene, tried)
    assert found.unexplained is not None
    assert "optics_blur" not in {one.effect for one in (*found.findings, *found.stand_ins)}


@pytest.mark.slow
def test_a_slow_photoreceptor_that_nobody_knows_is_no_lens(scene):
    sensor = dase.Sensor((Bandwidth(cutoff=25.0), dase.EFFECTS["threshold"](on=0.2, off=0.22)))
    events = dase.simulate(scene, sensor, seed=1)
    known = {name: effect for name, effect in TRIED.items() if name != "bandwidth"}
    found = diagnose_briefly(events, scene, known)
    assert "optics_blur" not in {one.effect for one in found.findings}


def test_a_model_is_compared_and_fitted_behind_its_lens(scene):
    events = behind_lens(scene, SIGMA)
    sharp = dase.Sensor((dase.EFFECTS["threshold"](on=0.2, off=0.22),))
    lens = sharp.with_effect(OpticsBlur(sigma=SIGMA))
    without, behind = (dase.compare(events, one, scene=scene, pixels=PIXELS).error for one in (sharp, lens))
    assert behind < 0.5
    assert without > 3
    fitted = dase.fit(events, lens, scene=scene, pixels=PIXELS)
    assert fitted.sensor["optics_blur"].sigma == SIGMA
    assert fitted.sensor["threshold"].on == pytest.approx(0.2, rel=0.02)
    assert set(fitted.parameters) == {"threshold.on", "threshold.off"}


def test_frames_that_are_held_are_each_blurred_once(scene):
    behind = OpticsBlur(sigma=SIGMA)
    held = scene.held(1e-3)
    events = behind_lens(scene, SIGMA)
    seen = Measurement(events, held).through_lens_of(dase.Sensor((behind, dase.EFFECTS["threshold"]())))
    assert isinstance(seen.scene, VideoScene)
    assert seen.held == held.held_for > 0
    assert seen.scene.sharp is held
    times = held.sample_times()[[0, 7, 8]]
    want = behind.seen(held).frames(times)
    np.testing.assert_allclose(seen.scene.frames(times), want, atol=1e-5)
    # seen through it once more it stays as it is
    assert seen.through_lens_of(dase.Sensor((behind, dase.EFFECTS["threshold"]()))).scene is seen.scene


def test_a_clip_behind_a_lens_stays_there_however_its_frames_are_taken(scene):
    """A diagnosis behind a lens may still find that frames were held, or filtered one by one."""
    weights = blur_weights(SIGMA)
    blurred = scene.blurred(weights)
    held, want = blurred.held(1e-3), scene.held(1e-3).blurred(weights)
    times = want.sample_times()[[0, 7, 8]]
    np.testing.assert_array_equal(held.frames(times), want.frames(times))
    assert held.held_for == scene.longest_gap()
    assert held.sharp.held_for == scene.longest_gap()
    by_frames = blurred.known_at_frames()
    assert by_frames.by_frames
    assert by_frames.sharp.by_frames
    assert not scene.by_frames


@pytest.mark.slow
def test_a_lens_that_was_given_and_is_off_does_not_hide_the_one_that_is_found(scene):
    off = dase.Sensor((OpticsBlur.identity(), dase.EFFECTS["threshold"](on=0.2, off=0.22)))
    lens = {"optics_blur": EFFECTS["optics_blur"]}
    found = dase.diagnose(
        behind_lens(scene, SIGMA), off, scene=scene, effects=lens, most=1, pixels=PIXELS, settings=NO_LIMITS
    )
    assert found.selected == ("optics_blur",)
    assert found.sensor["optics_blur"].sigma == pytest.approx(SIGMA, rel=0.06)
