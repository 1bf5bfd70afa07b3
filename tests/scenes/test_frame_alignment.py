"""Alignment of frames and events: known ones are found, and those of real cameras are right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from reference.scene_frames import film, moving_picture

import dase
from dase.scenes.frame_alignment import FLIPS
from dase.scenes.frame_motion import estimate_stretches


@pytest.fixture(scope="module")
def recorded():
    """Events and exposed frames of one camera before one scene."""
    rng = np.random.default_rng(2)
    scene = moving_picture(rng, width=160, height=120, duration=0.6, speed=0.7)
    begin, end, frames = film(scene, rng, noise=0.005)
    sensor = dase.Sensor((dase.EFFECTS["threshold"](on=0.2, off=0.2, phase=1.0),))
    return dase.simulate(scene, sensor, seed=4), frames, begin, end


def late(events, delay):
    return replace(events, t=events.t + delay)


def test_what_is_aligned_stays(recorded):
    found = dase.align(*recorded)
    assert (found.flip_x, found.flip_y) == (False, False)
    assert np.hypot(*found.shift) < 0.15
    assert abs(found.offset) < 2e-3  # the memory of a pixel lags behind by up to a threshold
    assert found.score == pytest.approx(found.score_as_is, abs=0.01)
    assert found.score > 0.8
    assert found.clear == frozenset()
    frames, begin, end = found.apply(*recorded[1:])
    for got, given in zip((frames, begin, end), recorded[1:][:1] + recorded[2:], strict=True):
        np.testing.assert_array_equal(got, given)


@pytest.mark.parametrize("flip", FLIPS)
@pytest.mark.parametrize("shift", [(3.0, -2.0), (-0.7, 1.3)])
def test_mirror_and_shift_are_found_and_undone(recorded, flip, shift):
    events, frames, begin, end = recorded
    matrix = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    moved = [cv2.warpAffine(f, matrix, f.shape[::-1], borderMode=cv2.BORDER_REPLICATE) for f in frames]
    wrong = np.stack(moved)[:, :: -1 if flip[1] else 1, :: -1 if flip[0] else 1]
    found = dase.align(events, wrong, begin, end)
    assert (found.flip_x, found.flip_y) == flip
    np.testing.assert_allclose(found.shift, shift, atol=0.2)
    assert found.score_as_is < 0.75 * found.score
    assert found.clear == ({"flip", "shift"} if any(flip) else {"shift"})
    said = repr(found).splitlines()
    assert len(said) < 10
    assert max(map(len, said)) <= 100
    assert f"  clear: {', '.join(sorted(found.clear))}" in said
    again = dase.align(events, *found.apply(wrong, begin, end))
    assert again.clear == frozenset()
    assert again.score_as_is > 0.97 * found.score


@pytest.mark.parametrize(("delay", "clear"), [(0.008, False), (-0.01, True), (0.045, True), (-0.052, True)])
def test_clocks_apart_are_found(recorded, delay, clear):
    """Eight milliseconds may be the pixels' own, of which the sensor model is to give account."""
    events, frames, begin, end = recorded
    found = dase.align(late(events, delay), frames, begin, end)
    assert found.offset == pytest.approx(delay, abs=2e-3)
    assert found.spread[0] < 2e-3
    assert ("offset" in found.clear) == clear
    _, moved, _ = found.apply(frames, begin, end)
    np.testing.assert_allclose(moved - begin, found.offset if clear else 0)
    _, asked, until = found.apply(frames, begin, end, parts=["offset"])
    np.testing.assert_allclose(asked - begin, delay, atol=2e-3)
    np.testing.assert_allclose(until - asked, end - begin)


def test_exposure_counts(recorded):
    """Events of an exposure count in part: without it the correlation is lower."""
    events, frames, begin, end = recorded
    rng = np.random.default_rng(9)
    scene = moving_picture(rng, width=160, height=120, duration=0.6, speed=0.7)
    begin, end, frames = film(scene, rng, exposure=0.03)
    events = dase.simulate(scene, dase.Sensor(), seed=4)
    middle = 0.5 * (begin + end)
    assert dase.align(events, frames, begin, end).score > dase.align(events, frames, middle).score + 0.01


def test_noise_decides_nothing(recorded, rng):
    _, frames, begin, end = recorded
    count = 20_000
    events = dase.Events(
        np.sort(rng.uniform(0, 0.6, count)),
        rng.integers(0, 160, count, np.uint16),
        rng.integers(0, 120, count, np.uint16),
        rng.random(count) < 0.5,
        160,
        120,
    )
    found = dase.align(events, frames, begin, end)
    assert found.score < 0.1
    assert found.clear == frozenset()
    still = dase.align(events, np.full_like(frames, 90), begin, end)
    assert still.score == 0
    assert still.clear == frozenset()


def test_bad_input_gets_a_sentence(recorded):
    events, frames, begin, end = recorded
    with pytest.raises(
        dase.InputError, match="frames must have the size of the events, 160x120, got 159x120"
    ):
        dase.align(events, frames[:, :, 1:], begin, end)
    with pytest.raises(dase.InputError, match="no events between the frames"):
        dase.align(late(events, 100.0), frames, begin, end)
    with pytest.raises(dase.InputError, match="reach must lie between"):
        dase.align(events, frames, begin, end, reach=30)
    with pytest.raises(dase.InputError, match="latest must be >= 0"):
        dase.align(events, frames, begin, end, latest=-1.0)
    with pytest.raises(dase.InputError, match="parts must be of flip, shift, offset, got turn"):
        dase.align(*recorded).apply(frames, begin, end, parts=["turn"])


def test_report_shows_the_table(recorded):
    text = dase.align(*recorded).report()
    assert "mirror: left to right" in text
    rows = [line for line in text.splitlines() if line.startswith("     +0")]
    assert len(rows) == 4
    assert all(len(row.split()) == 8 for row in rows)


def recording(shared, name):
    """Events, frames and begins of windows or exposures, ends [s] of a recording."""
    held = np.load(shared / "recordings" / f"{name}.npz")
    width, height = (int(n) for n in held["wh"])
    events = dase.Events(1e-6 * held["t_us"], held["x"], held["y"], held["p"] > 0, width, height)
    return events, held["frames"], 1e-6 * held["frame_begin_us"], 1e-6 * held["frame_end_us"]


def check_zero_is_best(found):
    """The correlation at no flip and no shift is above that at every other one tried, by a clear margin."""
    reach = found.shifts.shape[1] // 2
    best = found.shifts[0, reach, reach]
    rest = found.shifts.copy()
    rest[0, reach, reach] = -1
    assert best > rest.max() + 0.02
    for distance in (1, 2, 4):
        places = [reach - distance, reach, reach + distance]
        ring = [found.shifts[0, y, x] for y in places for x in places if (y, x) != (reach, reach)]
        assert max(ring) < best
    assert rest[1:].max() < 0.5 * best
    assert (found.flip_x, found.flip_y) == (False, False)
    assert np.hypot(*found.shift) < 0.5
    assert found.clear == frozenset()


def test_cradle_frames_lie_on_its_events(shared):
    """A DAVIS346 with exact exposures; its events come some milliseconds late, as pixels in the dark do."""
    found = dase.align(*recording(shared, "davis346_cuke_cradle"))
    check_zero_is_best(found)
    assert found.score > 0.9
    assert 2e-3 < found.offset < 8e-3


def test_camera_shake_frames_lie_on_its_events(shared):
    """Times, exposures and intensities of this recording are partly unknown; see docs/scenes.md."""
    events, *arrays = recording(shared, "davis240c_camerashake")
    frames, begin, end = (part[:20] for part in arrays)
    exposed = begin + 0.75 * (end - begin)
    light = frames / np.float32(255)
    found = dase.align(events, frames, begin, exposed, gains=estimate_stretches(list(light)))
    check_zero_is_best(found)
    assert found.score > 0.85


@pytest.mark.slow
def test_between_frames_the_cradle_moves_as_its_events_say(shared):
    """Windows of 10 ms: the scene's changes agree better with the events than straight interpolation's."""
    events, frames, begin, end = recording(shared, "davis346_cuke_cradle")
    scene = dase.CameraScene(frames, begin, end)
    lag, soft = 5e-3, 0.03
    edges = np.concatenate(
        [np.linspace(a, b, 5)[:-1] for a, b in zip(scene.times, scene.times[1:], strict=False)]
    )
    edges = np.append(edges, scene.times[-1])
    counts = events.counts(edges + lag)
    net = (counts[:, 1] - counts[:, 0]).clip(-20, 20).astype(float)
    changes = np.diff(np.log(scene.frames(edges) + soft), axis=0)
    logs = np.log(frames / 255 + soft)
    straight = np.diff(logs, axis=0).repeat(4, 0) / 4
    doubt = scene.doubt(0.5 * (edges[1:] + edges[:-1]))
    moving = (doubt > 0.15) & (doubt < 1)  # what does not move tells nothing, what is blurred away less
    got, linear = (np.corrcoef(net[moving], c[moving])[0, 1] for c in (changes, straight))
    assert got > 0.5
    assert got > 1.3 * linear
    everywhere = [np.corrcoef(net.ravel(), c.ravel())[0, 1] for c in (changes, straight)]
    assert everywhere[0] > 1.1 * everywhere[1]
