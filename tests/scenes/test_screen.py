"""What a screen shows: its frames, their light, the file that tells them, and what a camera sees."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

import dase
from dase import InputError
from dase.scenes.screen_scene import AROUND, ScreenScene, ScreenView, apply_homography
from dase.scenes.screen_stimulus import (
    DITHER,
    PARTS,
    PROGRAMME,
    ScreenStimulus,
    code_changes,
    mark_codes,
    read_stimulus,
    truth_text,
)

SMALL = (160, 90)


@pytest.fixture(scope="module")
def stimulus():
    return ScreenStimulus(size=SMALL)


def frame_at(stimulus, time):
    return math.floor(time * stimulus.refresh + 1e-6)


def test_segments_follow_each_other(stimulus):
    segments = stimulus.segments
    assert [s.begin for s in segments[1:]] == [s.end for s in segments[:-1]]
    assert segments[0].begin == 0
    kinds = [s.kind for s in segments]
    assert kinds == ["rest", "flash", "marks", "gamma", *PARTS, "marks", "flash", "rest"]


def test_light_of_levels_is_the_inverse_of_levels(stimulus):
    light = np.geomspace(0.02, 1, 500)
    levels = stimulus.level_of(light)
    shown = (levels / 255.0) ** 2.2 * 0.999 + 0.001
    # half a level, at the darkest the coarsest
    assert np.abs(np.log(shown / light)).max() < 0.5 * 2.2 / levels.min() * 1.2
    np.testing.assert_allclose(stimulus.light_of_levels()[levels], shown)


def test_a_chequerboard_is_half_of_white_whatever_gamma_is(stimulus):
    frame = stimulus.segment_of("gamma").begin
    assert (stimulus.levels(frame) == DITHER).all()
    picture = stimulus.picture(frame)
    assert set(np.unique(picture)) == {0, 255}
    for gamma in (1.8, 2.2, 2.6):
        # black and white in turn, in light
        want = np.mean((picture / 255.0) ** gamma * 0.999 + 0.001)
        assert stimulus.light_of_levels(gamma)[DITHER] == pytest.approx(want, rel=1e-9)


def test_contrast_of_steps_is_what_the_truth_says(stimulus):
    truth = json.loads(truth_text(stimulus))
    segment = next(s for s in truth["segments"] if s["kind"] == "steps")
    first = frame_at(stimulus, segment["begin"])
    second = frame_at(stimulus, segment["begin"] + segment["slot"])
    # an inverse of its own, tile by tile
    light = [(stimulus.picture(k).astype(float) / 255) ** 2.2 * 0.999 + 0.001 for k in (first, second)]
    change = np.log(light[1] / light[0])
    rows, columns = PROGRAMME.rows, PROGRAMME.columns
    middles = change[
        np.ix_(
            (np.arange(rows) * 90 // rows + 90 // rows // 2),
            (np.arange(columns) * 160 // columns + 160 // columns // 2),
        )
    ]
    np.testing.assert_allclose(middles.reshape(-1), segment["contrast"], rtol=1e-6)
    # and what was wanted, but for levels of 8 bits
    wanted = np.resize(PROGRAMME.step_sizes, rows * columns)
    assert np.abs(np.array(segment["contrast"]) - wanted).max() < 0.08


def test_the_chirp_ends_at_half_of_the_refresh_rate(stimulus):
    segment = stimulus.segment_of("chirp")
    light = stimulus.light_of_levels()
    middle = [float(np.log(light[stimulus.levels(k)[10, 70]])) for k in range(segment.begin, segment.end)]
    way = np.sign(np.diff(middle))
    moving = np.flatnonzero(way)
    turns = moving[np.flatnonzero(np.diff(way[moving]))]
    assert np.diff(turns)[0] > 10  # 1 to 2 Hz
    assert np.median(np.diff(turns)[-8:]) <= 2


def test_edges_go_at_their_speeds(stimulus):
    segment = stimulus.segment_of("edges")
    frames = [stimulus.levels(segment.begin + k).astype(float) for k in (0, 30)]
    bands = len(segment.values["speeds"])
    for band, speed in enumerate(segment.values["speeds"]):
        row = (2 * band + 1) * SMALL[1] // (2 * bands)
        way = round(speed * 30 / stimulus.refresh)
        if abs(way) < SMALL[0]:
            a, b = frames[0][row], np.roll(frames[1][row], -way)
            inside = slice(abs(way), SMALL[0] - abs(way))
            np.testing.assert_array_equal(a[inside], b[inside])


def test_codes_are_unlike():
    codes = mark_codes(24, 10)
    assert len(set(codes)) == 24
    changes = np.array([code_changes(c) / np.linalg.norm(code_changes(c)) for c in codes])
    assert (changes @ changes.T - np.eye(24)).max() < 0.8


def test_the_file_tells_the_same(tmp_path):
    made = ScreenStimulus(144.0, (320, 180), 2.4, 0.002, ("steps", "edges"), True)
    path = tmp_path / "s.json"
    path.write_text(truth_text(made))
    again = read_stimulus(path)
    assert (again.refresh, again.size, again.gamma, again.parts) == (
        144.0,
        (320, 180),
        2.4,
        ("steps", "edges"),
    )
    for frame in range(0, made.frame_count, 97):
        np.testing.assert_array_equal(again.levels(frame), made.levels(frame))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "video"}, "is not the JSON that dase stimulus writes"),
        ({"version": 99}, "is of version 99"),
        ({"refresh": "x"}, "a value is missing or of the wrong type"),
        ({"refresh": 10**400}, "a value is missing or of the wrong type"),
        ({"size": [float("inf"), 1]}, "a value is missing or of the wrong type"),
        ({"gamma": 40.0}, "gamma must lie in"),
        ({"parts": ["song"]}, "parts must be of"),
        ({"segments": []}, "its segments are not those"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path, stimulus, change, message):
    path = tmp_path / "s.json"
    path.write_text(json.dumps({**stimulus.as_truth(), **change}))
    with pytest.raises(InputError, match=message):
        read_stimulus(path)


@pytest.mark.parametrize("bad", [{"refresh": 5.0}, {"size": (97, 64)}, {"black": 0.5}, {"gamma": 0.0}])
def test_numbers_out_of_range(bad):
    with pytest.raises(InputError):
        ScreenStimulus(**bad)


def test_light_is_held_for_a_refresh_and_rows_follow(stimulus):
    flash = stimulus.segment_of("flash")
    slot = (flash.end - flash.begin) // len(flash.values["code"])
    view = ScreenView.filling((32, 18), SMALL)
    view = ScreenView(32, 18, view.homography, 2.0, 1.001, 0.012)
    scene = ScreenScene(stimulus, view)
    turn = (flash.begin + slot) / stimulus.refresh  # the first bit that is bright
    light = stimulus.light_of_levels()
    low, high = light[stimulus.level_of([PROGRAMME.flash_dark, PROGRAMME.flash_bright])]
    for row in (0, 9, 17):
        at = 2.0 + 1.001 * turn + 0.012 * (row + 0.5) / 18
        pixel = np.array([row * 32 + 16], np.int32)
        got = scene._values(np.array([at - 1e-4, at + 1e-4, at + 0.09]), pixel)[:, 0]
        np.testing.assert_allclose(got, [low, high, high], rtol=1e-5)


def test_the_picture_is_that_of_a_warp(stimulus):
    """OpenCV warps a frame in linear light, many times finer than a pixel: the same, but for edges."""
    corners = np.float32([[6, 4], [58, 7], [55, 40], [9, 38]])
    screen = np.float32([[0, 0], [160, 0], [160, 90], [0, 90]])
    matrix = cv2.getPerspectiveTransform(screen, corners)
    scene = ScreenScene(stimulus, ScreenView(64, 48, matrix))
    number = stimulus.segment_of("edges").begin + 7
    fine = 8
    # pixels of OpenCV have their middles at whole numbers
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    to = half @ np.diag([fine, fine, 1.0]) @ matrix @ np.linalg.inv(half)
    light = stimulus.light_of_levels()[stimulus.levels(number)].astype(np.float32)
    warped = cv2.warpPerspective(
        light, to, (64 * fine, 48 * fine), flags=cv2.INTER_NEAREST, borderValue=AROUND
    )
    want = warped.reshape(48, fine, 64, fine).mean((1, 3))
    got = scene.frames(np.array([(number + 0.5) / stimulus.refresh]))[0]
    pixels = np.arange(64 * 48, dtype=np.int32)
    trusted = scene.is_trusted(np.array([1e9]), pixels)[0].reshape(48, 64)
    assert 1000 < trusted.sum() < 64 * 48
    error = np.abs(got - want)[trusted].mean()
    assert np.median(np.abs(got - want)[trusted]) < 1e-3
    # half a pixel away it is clearly another picture
    away = np.array([[1, 0, 0.5], [0, 1, 0], [0, 0, 1]]) @ matrix
    other = ScreenScene(stimulus, ScreenView(64, 48, away))
    shifted = other.frames(np.array([(number + 0.5) / stimulus.refresh]))[0]
    assert error < 0.3 * np.abs(shifted - want)[trusted].mean()
    assert got[0, 0] == pytest.approx(AROUND)


def test_homography_is_that_of_opencv(rng):
    matrix = np.array([[1.1, 0.2, 3.0], [-0.1, 0.9, 5.0], [1e-3, 2e-3, 1.0]])
    points = rng.uniform(0, 100, (20, 2))
    want = cv2.perspectiveTransform(points[None], matrix)[0]
    np.testing.assert_allclose(apply_homography(-matrix, *points.T).T, want)


def test_a_stimulus_is_a_scene(tmp_path, stimulus):
    path = tmp_path / "s.json"
    path.write_text(truth_text(stimulus))
    scene = dase.open_stimulus(path, size=(40, 30))
    assert (scene.width, scene.height) == (40, 30)
    assert np.ptp(np.diff(scene.sample_times())) < 1e-9
    assert scene.duration == pytest.approx(stimulus.duration)
