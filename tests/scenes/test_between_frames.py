"""Scenes between a camera's frames, against what the camera really saw."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from reference.scene_frames import bilinear, blend, film, moving_picture, origin

import dase
from dase.kernels import launch, scene_frames
from dase.scenes.between_frames import TrustSettings
from dase.scenes.frame_motion import HOPELESS, estimate_stretches

EPS = 1e-3


def smooth(rng, shape, size):
    """Two smooth random fields of standard deviation `size`, shape (*shape, 2)."""
    field = cv2.GaussianBlur(rng.standard_normal((*shape, 2)), (0, 0), 4)
    return np.float32(size * field / field.std())


def rms(error):
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("size", [(23, 31), (9, 14)])
def test_rendering_matches_the_twin(device, rng, size):
    to = launch.find_device(device)
    frames = rng.random((3, *size), np.float32)
    ahead, back = (np.stack([smooth(rng, size, 3.0) for _ in "01"]) for _ in "ab")  # some lead far outside
    ahead[0, :4] = 0
    matches = scene_frames.upload_matches(frames, ahead, back, EPS, to)
    y, x = np.mgrid[: size[0], : size[1]].reshape(2, -1)
    pixels = rng.permutation(size[0] * size[1])[:100].astype(np.int32)
    places = np.stack([x, y], 1)[pixels].astype(float)
    interval, share = np.array([0, 0, 1, 1], np.int32), np.array([0.0, 0.3, 0.55, 0.9], np.float32)
    got = scene_frames.render_between(matches, pixels, interval, share, EPS, to).numpy()
    doubts = rng.random((2, 2, *size), np.float32)
    doubted = scene_frames.render_doubt(matches, doubts, pixels, interval, share, to)
    for k, (j, s) in enumerate(zip(interval, share, strict=True)):
        pair = frames[j].astype(float), frames[j + 1].astype(float), ahead[j], back[j]
        want = blend(*pair, s, places, scene_frames.STEPS, EPS)
        np.testing.assert_allclose(got[k], want, atol=2e-4, rtol=2e-4)
        at = [origin(w, t, places, scene_frames.STEPS) for w, t in ((ahead[j], s), (back[j], 1 - s))]
        near = [np.clip(np.floor(p + 0.5), 0, np.array(size[::-1]) - 1).astype(int) for p in at]
        a, b = (doubts[j, n][p[:, 1], p[:, 0]] for n, p in enumerate(near))
        same = np.isclose(doubted[k], np.sqrt((1 - s) * a**2 + s * b**2), atol=1e-5)
        assert same.mean() > 0.97  # float32 may round a place between two pixels to the other one
    assert np.abs(bilinear(ahead[0], places)).max() > 4


@pytest.fixture(scope="module")
def filmed():
    """A moving picture, what a camera made of it, and the scene between its frames."""
    rng = np.random.default_rng(5)
    truth = moving_picture(rng)
    begin, end, frames = film(truth, rng, noise=0.005)
    return truth, frames, dase.CameraScene(frames, begin, end)


def test_a_frame_is_met_exactly_and_without_a_jump(filmed, device):
    _, frames, scene = filmed
    np.testing.assert_array_equal(scene.frames(scene.times, device), frames / np.float32(255))
    for step in (-1e-7, 1e-7):
        at = scene.times[1:-1] + step
        np.testing.assert_allclose(scene.frames(at, device), frames[1:-1] / 255, atol=1e-3)


def test_time_is_smooth(filmed, device):
    """Halving the step of time halves the changes from sample to sample: no jumps anywhere."""
    _, _, scene = filmed
    most = []
    for step in (4e-4, 2e-4, 1e-4):
        times = np.arange(scene.times[1] - 2e-3, scene.times[1] + 2e-3, step)
        change = np.abs(np.diff(np.log(scene.frames(times, device) + EPS), axis=0))
        most.append(np.percentile(change, 99.99))
    assert most[1] < 0.6 * most[0]
    assert most[2] < 0.6 * most[1]


def test_any_pixels_and_chunks_give_the_same(filmed, device, rng):
    _, _, scene = filmed
    times = np.sort(rng.uniform(*scene.times[[0, -1]], 9))
    pixels = rng.permutation(scene.width * scene.height)[:500].astype(np.int32)
    whole = scene.frames(times, device).reshape(9, -1)[:, pixels]
    name, source = scene.source(times, pixels, launch.find_device(device))
    assert name == "frames"
    np.testing.assert_array_equal(source.values.numpy(), whole)
    apart = [
        scene.source(times[k : k + 1], pixels, launch.find_device(device))[1].values.numpy() for k in range(9)
    ]
    np.testing.assert_array_equal(np.concatenate(apart), whole)
    doubt = scene.doubt(times, device=device).reshape(9, -1)[:, pixels]
    np.testing.assert_array_equal(scene.doubt(times, pixels=pixels, device=device), doubt)
    sensor = dase.Sensor((dase.EFFECTS["threshold"](on=0.2, off=0.2),))
    a, b = (
        dase.Events.concatenate(list(dase.stream(scene, sensor, chunk=c, device=device))) for c in (7, 64)
    )
    assert len(a) > 1000
    np.testing.assert_array_equal(a.t, b.t)


def between_frames(truth, frames, scene, shares=(0.25, 0.5, 0.75)):
    """Errors of log intensity of the scene and of straight interpolation, and doubts, at times between."""
    gaps = np.diff(scene.times)
    times = np.sort(np.concatenate([scene.times[:-1] + s * gaps for s in shares]))
    k = scene.interval(times)
    share = ((times - scene.times[k]) / gaps[k])[:, None, None]
    want, logs = np.log(truth.frames(times) + EPS), np.log(frames / 255 + EPS)
    straight = (1 - share) * logs[k] + share * logs[k + 1]
    return np.log(scene.frames(times) + EPS) - want, straight - want, scene.doubt(times)


def test_between_frames_it_is_near_the_truth_and_says_where_not():
    """Photographs under fast objects, 25 frames a second of 10 ms, with noise."""
    errors, straights, doubts = [], [], []
    for seed in (0, 1, 2, 3):
        rng = np.random.default_rng(100 + seed)
        truth = moving_picture(rng, speed=1 + 0.5 * seed)
        begin, end, frames = film(truth, rng, noise=0.005)
        found = between_frames(truth, frames, dase.CameraScene(frames, begin, end))
        for out, part in zip((errors, straights, doubts), found, strict=True):
            out.append(part.ravel())
    error, straight, doubt = (np.concatenate(part) for part in (errors, straights, doubts))
    trusted, bad = doubt <= TrustSettings.tolerance, np.abs(error) > 0.25
    recall, share = (bad & ~trusted).sum() / bad.sum(), bad.mean()
    precision = (bad & ~trusted).sum() / (~trusted).sum()
    print(
        f"rms {rms(error):.3f}, straight {rms(straight):.3f}; trusted {trusted.mean():.3f}: "
        f"{rms(error[trusted]):.3f}, straight {rms(straight[trusted]):.3f}; "
        f"bad {share:.3f}, recall {recall:.3f}, precision {precision:.3f}"
    )
    assert rms(error) < 0.65 * rms(straight)
    assert rms(error[trusted]) < 0.45 * rms(straight[trusted])
    assert rms(error[trusted]) < 0.25 * rms(straight)
    assert trusted.mean() > 0.7
    assert recall > 0.75
    assert precision > 4 * share  # far more often wrong than anywhere
    # doubt is an expected error: it grows with the true one, and is not far from it
    classes = [
        (doubt > a) & (doubt <= b) for a, b in ((0, 0.05), (0.05, 0.1), (0.1, 0.2), (0.2, 0.5), (0.5, 2))
    ]
    sizes = [rms(error[c]) for c in classes]
    assert sizes == sorted(sizes)
    assert 0.2 < sizes[2] / 0.15 < 1.5


def test_events_of_the_scene_are_those_of_the_truth(device):
    rng = np.random.default_rng(11)
    truth = moving_picture(rng)
    begin, end, frames = film(truth, rng, exposure=2e-3)
    scene = dase.CameraScene(frames, begin, end)
    straight = dase.VideoScene(frames / np.float32(255), scene.times)
    sensor = dase.Sensor((dase.EFFECTS["threshold"](on=0.15, off=0.15),))
    inside = np.linspace(*scene.times[[0, -1]], 13)
    counts = [dase.count(s, sensor, inside, device=device)[0] for s in (truth, scene, straight)]
    net = [(c[:, 1] - c[:, 0]).astype(float) for c in counts]
    trusted = scene.trusted().reshape(len(scene) - 1, -1)[scene.interval(inside[:-1] + 1e-6)]
    assert trusted.mean() > 0.6
    got, linear = (np.corrcoef(net[0][trusted], n[trusted])[0, 1] for n in net[1:])
    assert got > 0.8
    assert got > linear + 0.15


def test_saturation_and_what_only_one_frame_shows_are_not_trusted(rng):
    texture = np.float32(0.2 + 0.6 * rng.random((60, 120)))
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
    frames = np.stack([np.rint(255 * texture[:, k : k + 80]) for k in (0, 4, 8)]).astype(np.uint8)
    frames[:, 20:26, 30:36], frames[:, 40:46, 50:56] = 255, 0
    scene = dase.CameraScene(frames, [0.0, 0.04, 0.08])
    trusted = scene.trusted()
    for rows, columns in ((slice(20, 26), slice(30, 36)), (slice(40, 46), slice(50, 56))):
        assert not trusted[:, rows, columns].any()
        assert scene.doubt([0.0])[0, rows, columns].min() == HOPELESS
    assert not trusted[:, :, 77:].any()  # comes into the picture only in the second frame
    assert trusted[:, 5:15, 10:70].mean() > 0.95
    confidence = scene.confidence([0.02])
    assert confidence.min() < 1e-6
    assert confidence.max() > 0.9
    np.testing.assert_array_equal(confidence[0] >= 0.5, scene.doubt([0.02])[0] <= scene.limit(0))
    strict = scene.trusted(relative=0)
    assert (strict <= trusted).all()
    doubt = scene.doubt(np.linspace(0, 0.04 - 1e-9, 9)).max(0)
    np.testing.assert_array_equal(strict[0], doubt <= TrustSettings.tolerance)
    pixels = np.array([5 * 80 + 30, 22 * 80 + 33], np.int32)
    at_once = scene.is_trusted(np.array([-0.01, 0.01, 0.05, 0.09]), pixels)
    np.testing.assert_array_equal(at_once, [[0, 0], [1, 0], [1, 0], [0, 0]])


def test_doubt_knows_motion_blur(rng):
    """The longer the exposure, the less what moves is trusted; what rests is."""
    truth = moving_picture(rng, speed=2.0)
    shares = []
    for exposure in (1e-3, 0.02):
        begin, end, frames = film(truth, rng, exposure=exposure)
        shares.append(dase.CameraScene(frames, begin, end).trusted(relative=0).mean())
    assert shares[1] < shares[0] - 0.05
    still = film(moving_picture(rng, speed=0.0), rng, exposure=0.02)
    assert dase.CameraScene(still[2], *still[:2]).trusted().mean() > 0.99


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float", "gamma", "black"])
def test_values_become_linear_intensity(rng, kind):
    light = np.float32(0.05 + 0.9 * rng.random((3, 20, 30)))
    stored, options = {
        "uint8": (np.rint(255 * light).astype(np.uint8), {}),
        "uint16": (np.rint(65535 * light).astype(np.uint16), {}),
        "float": (light, {}),
        "gamma": (np.rint(65535 * light ** (1 / 2.2)).astype(np.uint16), {"gamma": 2.2}),
        "black": (np.rint(64 + 4000 * light).astype(np.uint16), {"black": 64, "white": 4064}),
    }[kind]
    scene = dase.CameraScene(stored, [0.0, 0.1, 0.2], **options)
    np.testing.assert_allclose(scene.frames(scene.times), light, atol=2.1e-3 if kind == "uint8" else 2e-4)


def test_samples_follow_the_motion(rng):
    times = {}
    for speed in (0.0, 1.0, 20.0):
        begin, end, frames = film(moving_picture(rng, speed=speed, objects=0), rng)
        scene = dase.CameraScene(frames, begin, end)
        times[speed] = scene.sample_times()
        assert np.isin(scene.times, times[speed]).all()
        assert np.diff(times[speed]).min() > 0.99e-3
        assert np.diff(times[speed]).max() < 1.01 / 72
    assert len(times[0.0]) == 3 * 4 + 1  # a frame every 40 ms, at least 72 samples a second
    assert len(times[0.0]) < len(times[1.0]) < len(times[20.0])


def test_stretches_of_frames_are_found():
    rng = np.random.default_rng(3)
    truth = moving_picture(rng, duration=0.4, objects=1)
    begin, end, frames = film(truth, rng)
    gains, offsets = rng.uniform(0.85, 1.1, len(frames)), rng.uniform(-0.04, 0.04, len(frames))
    light = frames / np.float32(255)
    stretched = np.clip(gains[:, None, None] * light + offsets[:, None, None], 0, 1).astype(np.float32)
    found = estimate_stretches(list(stretched))
    undone = found[:, :1] * np.stack([gains, offsets], 1) + found[:, 1:] * (0, 1)
    # common gain and offset are free; between neighbours they are not
    levels = undone[:, :1] * (0.3, 0.7) + undone[:, 1:]
    before = gains[:, None] * (0.3, 0.7) + offsets[:, None]
    assert np.abs(np.diff(before, axis=0)).max() > 0.1
    assert np.abs(np.diff(levels, axis=0)).max() < 0.02
    doubts = [dase.CameraScene(stretched, begin, end, gains=g).matched(3).doubt for g in (found, None)]
    assert np.median(doubts[0]) < 0.5 * np.median(doubts[1])


GOOD = {"frames": np.full((3, 4, 5), 9, np.uint8), "begin": [0.0, 0.1, 0.2], "end": [0.05, 0.15, 0.25]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": np.zeros((3, 4), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((1, 4, 5), np.uint8)}, "at least 2 frames"),
        ({"frames": np.zeros((3, 4, 5), complex)}, "real numbers"),
        ({"frames": np.full((3, 4, 5), np.nan)}, "finite"),
        ({"begin": [0.0, 0.1]}, "3 frames need as many times, begin has"),
        ({"begin": [0.0, np.inf, 0.2]}, "begin must be finite"),
        ({"end": [0.05, 0.05, 0.25]}, "end before they begin"),
        ({"begin": [0.0, 0.0, 0.2], "end": None}, "must increase"),
        ({"gamma": 0.0}, "gamma > 0"),
        ({"black": 255.0}, "0 <= black < white"),
        ({"gains": np.ones((2, 2))}, "gains must be finite, shape"),
        ({"travel": 0.0}, "travel > 0"),
    ],
)
def test_bad_input_gets_a_sentence(change, message):
    with pytest.raises(dase.InputError, match=message):
        dase.CameraScene(**{**GOOD, **change})


def test_times_outside_are_refused():
    scene = dase.CameraScene(**GOOD)
    assert scene.duration == pytest.approx(0.2)
    with pytest.raises(dase.InputError, match=r"times must lie in 0.025..0.225 s"):
        scene.frames(np.array([0.0]))
    assert scene.interval([0.025, 0.124, 0.125, 0.225]).tolist() == [0, 0, 1, 1]
