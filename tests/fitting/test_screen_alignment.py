"""A recording of a stimulus: where the screen is in the picture, when it begins, its gamma, and the fit."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from helpers.own_effects import effect_that_makes

import dase
from dase import EFFECTS, Events, InputError, Sensor
from dase.fitting.data_split import split_measurement
from dase.fitting.fit import widen_by_gamma
from dase.fitting.measurement import Measurement, as_measurement
from dase.fitting.screen_alignment import align_screen
from dase.fitting.screen_limits import notes_on_screen, screen_limits_of
from dase.fitting.time_window import repeated_gaps
from dase.results import Estimate
from dase.scenes.screen_scene import ScreenScene, ScreenView, apply_homography
from dase.scenes.screen_stimulus import ScreenStimulus, truth_text

SCREEN = (320, 180)
CAMERA = (64, 48)
PLACES = {
    "straight": [[4, 8], [61, 6], [59, 41], [6, 39]],
    "upside down": [[61, 41], [4, 39], [6, 7], [59, 6]],
    "mirrored": [[61, 6], [4, 8], [6, 39], [59, 41]],
    "a quarter": [[52, 3], [51, 45], [14, 46], [12, 4]],
    "part": [[-16, 4], [60, 2], [58, 46], [-14, 44]],
}


def with_(**effects) -> Sensor:
    sensor = Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    return sensor


def view_of(name, **times) -> ScreenView:
    width, height = SCREEN
    screen = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    return ScreenView(*CAMERA, cv2.getPerspectiveTransform(screen, np.float32(PLACES[name])), **times)


def recorded(stimulus, view, *, gamma=2.2, seed=1, **effects) -> Events:
    noisy = {"mismatch": {"spread": 0.08}, "bandwidth": {"cutoff": 150.0}, "shot": {"rate": 1.0}}
    sensor = with_(threshold={"on": 0.22, "off": 0.18}, **{**noisy, **effects})
    return dase.simulate(ScreenScene(stimulus, view, gamma=gamma), sensor, seed=seed)


@pytest.fixture(scope="module")
def short():
    return ScreenStimulus(size=SCREEN, parts=())


def distance(found, true) -> float:
    """Largest distance of nine places of the screen from where they are [px]."""
    x, y = np.meshgrid([0, SCREEN[0] / 2, SCREEN[0]], [0, SCREEN[1] / 2, SCREEN[1]])
    off = apply_homography(found.homography, x, y) - apply_homography(true.homography, x, y)
    return float(np.hypot(*off).max())


@pytest.mark.parametrize("place", PLACES)
def test_place_and_time_are_found(short, place):
    true = view_of(place, offset=0.4321, pace=1.0008, scan=0.0 if place == "a quarter" else 0.012)
    found = align_screen(recorded(short, true, gamma=2.4), short)
    assert distance(found.view, true) < (0.7 if place == "part" else 0.45)
    assert 1e3 * found.view.offset == pytest.approx(1e3 * true.offset, abs=1.0)
    assert found.view.pace == pytest.approx(true.pace, abs=5e-5)
    assert found.view.scan == pytest.approx(true.scan, abs=1.5e-3)
    assert abs(found.gamma - 2.4) < max(4 * found.gamma_error, 0.05)
    said = " ".join(found.notes)
    assert ("mirrored" in said) == (place == "mirrored")
    assert ("turned by 180°" in said or "turned by 179°" in said or "turned by 178°" in said) == (
        place == "upside down"
    )
    assert ("turned by 9" in said or "turned by 8" in said) == (place == "a quarter")
    assert ("% of the screen is out of the picture" in said) == (place == "part")
    assert found.visible == pytest.approx(0.79 if place == "part" else 1.0, abs=0.03)


def test_a_gamma_that_is_not_the_given_one_is_said():
    given = ScreenStimulus(size=SCREEN, parts=(), gamma=1.9, gamma_given=True)
    found = align_screen(recorded(given, view_of("straight"), gamma=2.4), given)
    assert found.gamma == 1.9
    assert any("1.9 was given" in note for note in found.notes)


def test_a_recording_that_ends_early(short):
    events = recorded(short, view_of("straight", offset=0.2, pace=1.0005))
    found = align_screen(events.select(events.t < 0.2 + short.duration - 1.2), short)
    assert found.view.pace == 1.0
    assert 1e3 * found.view.offset == pytest.approx(200.0, abs=2.0)
    assert any("its last flash is not in the recording" in note for note in found.notes)


def test_what_is_no_recording_of_it(short, rng):
    count = 200_000
    t = np.sort(rng.uniform(0, 6, count))
    x, y = rng.integers(0, 64, count), rng.integers(0, 48, count)
    noise = Events(t, x, y, rng.random(count) < 0.5, 64, 48)
    with pytest.raises(InputError, match="the flash with which the stimulus begins is not in the recording"):
        align_screen(noise, short)
    with pytest.raises(InputError, match="no events"):
        align_screen(Events.empty(64, 48), short)


def test_a_screen_that_is_too_small(short):
    true = view_of("straight")
    shrink = np.array([[0.12, 0, 28], [0, 0.12, 20], [0, 0, 1]])
    events = recorded(short, ScreenView(*CAMERA, shrink @ true.homography))
    with pytest.raises(InputError, match=r"of 24 marks of the screen are found in the picture, at least 6"):
        align_screen(events, short)


def test_a_camera_that_moves_is_told(short):
    first, last = view_of("straight"), view_of("straight")
    last = ScreenView(*CAMERA, np.array([[1, 0, 2.0], [0, 1, 1.0], [0, 0, 1]]) @ last.homography)
    half = 0.5 * short.duration
    parts = [
        one.select((one.t < half) == (n == 0))
        for n, one in enumerate((recorded(short, first), recorded(short, last)))
    ]
    found = align_screen(Events.concatenate(parts), short)
    assert any("the camera or the screen moved" in note for note in found.notes)


def test_a_recording_and_the_file_are_a_measurement(short, tmp_path):
    """Where the screen is trusted: not at its border, not outside, not while chequerboards are shown."""
    true = view_of("straight", offset=0.4)
    path = tmp_path / "stimulus.json"
    path.write_text(truth_text(short))
    measured = as_measurement(recorded(short, true), path)
    assert measured.trust is not None
    assert any("marks of the screen are found" in note for note in measured.notes)
    dither = short.segment_of("gamma")
    times = 0.4 + np.array([dither.begin - 10, dither.begin + 10]) / short.refresh
    inside = measured.trust(times, np.arange(64 * 48, dtype=np.int32)).reshape(2, 48, 64)
    assert not inside[1].any()
    assert not inside[0][:5].any()
    share = cv2.contourArea(np.float32(PLACES["straight"])) / (64 * 48)
    assert share - 0.2 < inside[0].mean() < share


def test_pauses_of_a_stimulus_are_not_missing_data(short):
    true = view_of("straight", offset=0.4)
    events = recorded(short, true, shot={"rate": 0.01})
    assert len(repeated_gaps(events.t))
    split = split_measurement(Measurement(events, ScreenScene(short, true)), pixels=100)
    assert not any("data are missing" in note for note in split.notes)


def test_thresholds_are_as_uncertain_as_gamma(short):
    scene = ScreenScene(short, view_of("straight"), gamma=2.0, gamma_error=0.1)
    wide = widen_by_gamma({"threshold.on": Estimate(0.2, 0.19, 0.22), "leak.rate": Estimate(1, 0, 2)}, scene)
    assert wide["leak.rate"] == Estimate(1, 0, 2)
    reach = 1.6448536 * 0.05 * 0.2
    assert wide["threshold.on"].low == pytest.approx(0.2 - math.hypot(0.01, reach))
    assert wide["threshold.on"].high == pytest.approx(0.2 + math.hypot(0.02, reach))


def test_every_limit_is_of_something_that_is_there(short):
    for effect in EFFECTS.values():
        assert effect.screen_limits.keys() <= {"", *(p.name for p in effect.parameters())}
    limits = screen_limits_of(EFFECTS.values(), short)
    assert all(len(limit) > 20 and "{" not in limit for limit in limits.values())
    assert f"above about {short.refresh / 4:g} Hz" in limits["bandwidth.cutoff"]
    (said,) = notes_on_screen(with_(dark={"current": 0.1}), short)
    assert said.startswith("not told by a screen, dark: ")
    assert "lens cap" in said


def test_an_effect_of_the_user_says_what_a_screen_cannot_tell(short):
    """A sensor that has it gets a note, whatever the effect is called."""
    own = effect_that_makes("glow")
    own.screen_limits = {"": "glow wants more than {refresh:g} Hz"}
    assert notes_on_screen(Sensor().with_effect(own()), short) == [
        f"not told by a screen, glow: glow wants more than {short.refresh:g} Hz"
    ]


@pytest.mark.slow
def test_thresholds_are_fitted_within_their_intervals(tmp_path):
    shown = ScreenStimulus(size=SCREEN, parts=("steps", "ramps"))
    events = recorded(shown, view_of("straight", offset=0.4321, pace=1.0008, scan=0.012), gamma=2.35)
    path = tmp_path / "stimulus.json"
    path.write_text(truth_text(shown))
    start = with_(
        threshold={"on": 0.3, "off": 0.3},
        mismatch={"spread": 0.08},
        bandwidth={"cutoff": 150.0},
        shot={"rate": 1.0},
    )
    found = dase.fit(events, start, scene=path, free=["threshold", "bandwidth.cutoff"], pixels=150)
    assert any("marks of the screen are found" in note for note in found.notes)
    for name, true in (("threshold.on", 0.22), ("threshold.off", 0.18)):
        estimate = found.parameters[name]
        assert estimate.low <= true <= estimate.high
        assert estimate.high - estimate.low < 0.2 * true
    assert found.error < 0.25 * found.before
