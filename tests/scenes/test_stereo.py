"""Two cameras: a plane's disparity is f b / Z, and labels are those of what is seen."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import small_scenes

import dase
from dase.datasets.generate import record_scene
from dase.effects.threshold import Threshold
from dase.scenes.stereo import stereo_pair


def plane(rng: np.random.Generator) -> dase.LayerScene:
    """Return a texture that moves down and turns, before a camera that turns."""
    picture = dase.Picture(rng.random((40, 60), np.float32), None)
    motion = dase.Motion(y=(0.0, 0.1), scale_x=(1.3, 1.3), scale_y=(1.3, 1.3))
    return dase.LayerScene(
        [dase.Layer(picture, motion)], width=48, height=32, duration=0.1, camera=dase.Motion(angle=(0.0, 0.3))
    )


def test_the_right_camera_sees_a_plane_further_left(device, rng):
    pair = stereo_pair(plane(rng), [4.0], baseline=0.1, focal=240.0)
    shift = 6  # 240 px · 0.1 m / 4 m
    assert pair.disparities == pytest.approx((shift,))
    times = np.array([0.0, 0.04, 0.1])
    left, right = (scene.frames(times, device) for scene in pair)
    np.testing.assert_allclose(right[..., :-shift], left[..., shift:], atol=2e-4)
    assert np.abs(right - left).mean() > 0.05


def test_events_of_the_right_are_those_of_the_left_shifted(device, rng):
    pair = stereo_pair(plane(rng), [4.0], baseline=0.1, focal=240.0)
    sensor = dase.Sensor((Threshold(on=0.3, off=0.3, phase=0.0),))
    # at the same samples: how far the corners of the picture move differs
    pair.right.sample_times = pair.left.sample_times
    edges = np.array([0.0, 0.1])
    left, right = (dase.count(one, sensor, edges, device=device)[0, 0].reshape(2, 32, 48) for one in pair)
    assert left.sum() > 500
    # a light that ends at a threshold may fall on either side of it by float32's rounding
    assert np.mean(right[..., :-6] != left[..., 6:]) < 0.01


def test_labels_are_those_of_the_foremost_layer(device, rng):
    pair = stereo_pair(small_scenes.layers(rng), [8.0, 2.0, 1.0], baseline=0.02, focal=100.0)
    times = np.array([0.0, 0.1])
    for right in (False, True):
        disparity, depth = pair.labels(times, device, right=right)
        assert disparity.shape == depth.shape == (2, 20, 24)
        np.testing.assert_allclose(disparity, 100.0 * 0.02 / depth, rtol=1e-6)
        assert set(np.unique(depth)) == {8.0, 2.0, 1.0}
    # the flow shows which layer is foremost, independently of the labels
    scene = pair.left
    flow, maps = scene.flow(times, device), scene.velocity(times)
    _, depth = pair.labels(times, device)
    rows, columns = np.mgrid[:20, :24]
    for layer, far in enumerate(pair.depths):
        want = np.einsum("kij,jhw->kihw", maps[:, layer], np.stack([columns, rows, np.ones((20, 24))]))
        here = np.broadcast_to((depth == far)[:, None], flow.shape)
        np.testing.assert_allclose(flow[here], want[here], rtol=1e-3, atol=1e-2)


def test_files_of_a_pair_show_the_disparity_of_the_labels(tmp_path, rng):
    """Blocks of the left file's frames are searched in the right one's."""
    pair = stereo_pair(plane(rng), [4.0], baseline=0.1, focal=240.0)
    files = []
    for seed, view in enumerate(pair):
        path = tmp_path / f"{seed}.h5"
        record_scene(view, dase.Sensor(), path, frame_rate=50.0, exposure=0.004, seed=seed)
        files.append(dase.io.read(path))
    left, right = files
    np.testing.assert_array_equal(left.frame_times, right.frame_times)
    disparity, _ = pair.labels(left.frame_times)
    assert len(left.frames) == 5
    frames = zip(left.frames.astype(float), right.frames.astype(float), disparity, strict=True)
    for ours, theirs, truth in frames:
        for row, column in ((4, 16), (12, 24), (20, 36)):
            block = np.s_[row : row + 8, column : column + 8]
            errors = [np.mean((ours[block] - np.roll(theirs, d, axis=1)[block]) ** 2) for d in range(16)]
            assert np.argmin(errors) == np.rint(truth[row + 4, column + 4])


def test_without_a_baseline_both_see_the_same(rng):
    pair = stereo_pair(small_scenes.layers(rng), [3.0, 2.0, 2.0], baseline=0.0, focal=100.0)
    left, right = (scene.frames(np.array([0.0, 0.13])) for scene in pair)
    np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize(
    ("depths", "baseline", "focal", "message"),
    [
        ([2.0, 1.0], 0.1, 100.0, "3 layers need as many depths, got 2"),
        ([1.0, 2.0, 1.0], 0.1, 100.0, "not grow towards the foreground"),
        ([1.0, 0.5, 0.0], 0.1, 100.0, "depths must be > 0 m"),
        ([3.0, 2.0, 1.0], -0.1, 100.0, "baseline must be >= 0 m and focal > 0 px, got -0.1 and 100"),
        ([3.0, 2.0, 1.0], 0.1, 0.0, "focal > 0 px"),
    ],
)
def test_impossible_pairs_are_refused(rng, depths, baseline, focal, message):
    with pytest.raises(dase.InputError, match=message):
        stereo_pair(small_scenes.layers(rng), depths, baseline=baseline, focal=focal)
