"""Colour filters against an independent mosaic in NumPy, and what must not change."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.event_comparison import by_pixel, same
from helpers.small_scenes import layers

import dase
from dase.datasets.generate import DatasetJob, generate_dataset, make_scene, record_scene
from dase.effects.bandwidth import Bandwidth
from dase.effects.bayer import Bayer
from dase.effects.optics_blur import OpticsBlur
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.scenes.between_frames import CameraScene
from dase.scenes.image_sources import Picture, open_images

PLAIN = dase.Sensor((Threshold(on=0.15, off=0.15),))
BUSY = dase.Sensor((Bandwidth(cutoff=60.0), Threshold(on=0.15, off=0.15), Shot(rate=20.0)))


def coloured_video(rng: np.random.Generator, kind: type = np.float32) -> dase.VideoScene:
    """Return pixels that swing in each colour by themselves, of 8 bits or real."""
    times = np.arange(40) * 1e-3
    phase, speed = rng.uniform(0, 2 * np.pi, (7, 9, 3)), rng.uniform(50, 300, (7, 9, 3))
    values = 0.5 + 0.4 * np.sin(speed * times[:, None, None, None] + phase)
    frames = np.rint(255 * values).astype(np.uint8) if kind is np.uint8 else values.astype(np.float32)
    return dase.VideoScene(frames, times)


def coloured_layers(rng: np.random.Generator) -> dase.LayerScene:
    """Return the small scene with colours of their own; one of its layers stays grey."""
    scene = layers(rng)
    coloured = []
    for number, layer in enumerate(scene.layers):
        colour = rng.random((3, *layer.picture.grey.shape), np.float32)
        grey = np.tensordot(np.float32([0.21, 0.72, 0.07]), colour, 1)
        picture = Picture(grey, layer.picture.alpha, colour) if number != 1 else layer.picture
        coloured.append(dase.Layer(picture, layer.motion))
    return scene.like(layers=coloured)


def mosaic(colours: np.ndarray, pattern: str, purity: float) -> np.ndarray:
    """Return what pixels see of light (K, H, W, 3) behind their filters, (K, H, W), pixel by pixel."""
    out = np.empty(colours.shape[:3])
    for y in range(out.shape[1]):
        for x in range(out.shape[2]):
            weights = (1 - purity) * np.array([0.21, 0.72, 0.07])
            weights["rgb".index(pattern[2 * (y % 2) + x % 2])] += purity
            out[:, y, x] = colours[:, y, x] @ weights
    return out


@pytest.mark.parametrize("sensor", [PLAIN, BUSY], ids=["alone", "with bandwidth and noise"])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "grbg", "gbrg"])
@pytest.mark.parametrize("purity", [0.3, 0.8, 1.0])
def test_events_are_those_of_the_mosaic(device, rng, pattern, purity, sensor):
    scene = coloured_video(rng)
    light = mosaic(scene._colours._frames.astype(np.float64), pattern, purity)
    want = dase.VideoScene(light.astype(np.float32), scene.sample_times())
    edges = scene.sample_times()[::3]
    filtered = sensor.with_effect(Bayer(pattern=pattern, purity=purity))
    got = dase.count(scene, filtered, edges, seed=3, device=device)
    expected = dase.count(want, sensor, edges, seed=3, device=device)
    assert expected.sum() > 500
    # light that differs by float32's rounding may cross beside the edge of a window
    assert np.abs(got - expected).sum() <= 0.002 * expected.sum()
    assert np.abs(dase.count(scene, sensor, edges, seed=3, device=device) - expected).sum() > 50
    for n, letter in enumerate("rgb"):
        rows, columns = np.nonzero(filtered["bayer"].colours(9, 7) == n)
        assert {pattern[2 * (y % 2) + x % 2] for y, x in zip(rows, columns, strict=True)} == {letter}


@pytest.mark.parametrize("purity", [0.5, 1.0])
def test_layers_lie_behind_the_filters(device, rng, purity):
    """Light is linear in textures, so the mosaic of rendered colours is what pixels see."""
    scene, effect = coloured_layers(rng), Bayer(purity=purity, pattern="gbrg")
    times = scene.sample_times()
    apart = [
        scene.like(
            layers=[
                dase.Layer(Picture(p.grey if p.colour is None else p.colour[n], p.alpha), layer.motion)
                for layer in scene.layers
                for p in [layer.picture]
            ]
        ).frames(times, device)
        for n in range(3)
    ]
    seen = effect.seen(scene)
    want = mosaic(np.stack(apart, -1).astype(np.float64), "gbrg", purity)
    np.testing.assert_allclose(seen.frames(times, device), want, atol=2e-6)
    edges = np.linspace(0, scene.duration, 4)
    got = dase.count(scene, PLAIN.with_effect(effect), edges, device=device)
    expected = dase.count(dase.VideoScene(want.astype(np.float32), times), PLAIN, edges, device=device)
    assert expected.sum() > 300
    assert np.abs(got - expected).sum() <= 0.01 * expected.sum()
    blurred = seen.exposed_frames(np.array([0.01]), 0.02, device)
    dense = np.mean([seen.frames(np.array([t]), device) for t in np.linspace(0.01, 0.03, 200)], axis=0)
    np.testing.assert_allclose(blurred, dense, atol=0.02)


@pytest.mark.parametrize("sensor", [PLAIN, BUSY], ids=["alone", "with bandwidth and noise"])
def test_off_and_grey_change_nothing(device, rng, sensor):
    scene = coloured_layers(rng)
    off = sensor.with_effect(Bayer.identity())
    assert off.through_optics(scene) is scene
    same(dase.simulate(scene, off, device=device), dase.simulate(scene, sensor, device=device))
    on = sensor.with_effect(Bayer())
    grey = layers(rng)
    assert on.through_optics(grey) is grey
    value = np.repeat(rng.random((40, 7, 9, 1), np.float32), 3, axis=3)
    for frames in (value, np.rint(255 * value).astype(np.uint8)):
        video = dase.VideoScene(frames, np.arange(40) * 1e-3, gamma=2.2)
        seen = on.through_optics(video)
        assert seen is not video
        want = dase.simulate(video, sensor, seed=4, device=device)
        assert len(want) > 500
        same(dase.simulate(video, on, seed=4, device=device), want)


def test_chunks_and_pixels_do_not_matter(device, rng):
    scene, sensor = coloured_layers(rng), BUSY.with_effect(Bayer())
    whole = dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=10**6))
    same(dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=5)), whole)
    some = np.array([40, 3, 41], np.int32)
    part, every = by_pixel(dase.simulate(scene, sensor, device=device, pixels=some)), by_pixel(whole)
    for i in some:
        np.testing.assert_array_equal(part[i], every[i])


def test_the_lens_lies_before_the_filters(device, rng):
    scene = coloured_video(rng)
    sensor = dase.Sensor((OpticsBlur(sigma=0.8), Bayer(purity=1.0), Threshold()))
    times = scene.sample_times()[:5]
    blur = dase.Sensor((OpticsBlur(sigma=0.8), Threshold()))
    alone = scene._colours._frames
    sharp = [
        blur.through_optics(dase.VideoScene(alone[..., n], scene.sample_times())).frames(times, device)
        for n in range(3)
    ]
    got = sensor.through_optics(scene).frames(times, device)
    np.testing.assert_allclose(got, mosaic(np.stack(sharp, -1).astype(np.float64), "rggb", 1.0), atol=1e-5)


def test_colours_are_followed_between_frames(device, rng):
    """The motion is that of the grey, whichever filter is before it."""
    grey = rng.random((4, 12, 16), np.float32)
    grey = np.stack([cv2.GaussianBlur(one, (5, 5), 0) for one in grey])
    tint = np.float32([0.6, 1.0, 0.3])[None, :, None, None]
    scene = CameraScene(grey, np.arange(4) * 0.02, colours=(tint * grey[:, None]).astype(np.float32))
    seen = Bayer(purity=1.0).seen(scene)
    times = scene.times[[0, 2]]
    want = mosaic((tint * grey[:, None]).transpose(0, 2, 3, 1)[[0, 2]].astype(np.float64), "rggb", 1.0)
    np.testing.assert_allclose(seen.frames(times, device), want, atol=1e-6)
    assert seen._filtered[0].matched(0) is scene.matched(0)


def test_pictures_keep_their_colours(tmp_path, rng):
    """Cut-outs and backgrounds carry the colours of their pixels; their grey is the same with and without."""
    pixels = rng.integers(0, 256, (60, 80, 3), np.uint8)
    pixels = cv2.GaussianBlur(pixels, (9, 9), 0)
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    for draw in ("background", "foreground"):
        plain, coloured = (
            getattr(open_images(str(tmp_path), colour=c), draw)(np.random.default_rng(5))
            for c in (False, True)
        )
        np.testing.assert_array_equal(plain.grey, coloured.grey)
        assert plain.colour is None
        luma = np.tensordot([0.21, 0.72, 0.07], coloured.colour, 1)
        np.testing.assert_allclose(luma, coloured.grey, atol=0.02)  # a median is not linear
        assert coloured.colour.std(axis=0).mean() > 0.01
    whole = open_images(str(tmp_path), colour=True).background(rng)
    want = np.stack([cv2.medianBlur(np.float32(pixels[..., n] / 255), 3) for n in (2, 1, 0)])
    np.testing.assert_allclose(whole.colour, want, atol=1e-6)
    cv2.imwrite(str(tmp_path / "a.png"), np.repeat(pixels[..., :1], 3, axis=2))
    from dase.scenes.image_sources import _read_picture

    _read_picture.cache_clear()
    assert open_images(str(tmp_path), colour=True).background(rng).colour is None


def test_files_of_synth_hold_the_mosaic(tmp_path):
    sensor = dase.load_sensor("ideal").with_effect(Bayer(pattern="bggr"))
    options = dict(
        images="builtin",
        sequences=2,
        width=40,
        height=30,
        duration=0.1,
        regime="medium",
        seed=2,
        frame_rate=20.0,
    )
    job = DatasetJob(sensor=dase.dump_sensor(sensor), **options)
    plain = DatasetJob(sensor=dase.dump_sensor(dase.load_sensor("ideal")), **options)
    generate_dataset(job, tmp_path / "a")
    generate_dataset(plain, tmp_path / "plain")
    found, grey = dase.io.read(job.path(tmp_path / "a", 0)), dase.io.read(plain.path(tmp_path / "plain", 0))
    assert 'pattern = "bggr"' in found.configuration
    want = np.rint(255 * Bayer(pattern="bggr").seen(make_scene(job, 0)).frames(found.frame_times))
    np.testing.assert_array_equal(found.frames, want)
    assert np.abs(found.frames.astype(int) - grey.frames).max() > 5
    np.testing.assert_array_equal(found.flow, grey.flow)
    path = tmp_path / "v.h5"
    record_scene(coloured_video(np.random.default_rng(0), np.uint8), sensor, path, frame_rate=100.0)
    assert len(dase.io.read(path).frames) == 4


@pytest.mark.parametrize("between", ["lines", "motion"])
def test_videos_keep_their_colours(tmp_path, rng, between):
    """A folder of frames, read as one, is the array of its colours."""
    frames = rng.integers(0, 256, (4, 12, 16, 3), np.uint8)
    frames = np.stack([cv2.GaussianBlur(one, (5, 5), 0) for one in frames])
    for n, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / f"{n}.png"), frame[..., ::-1])
    for colour in (False, True):
        scene = dase.open_video(tmp_path, fps=50.0, between=between, gamma=2.0, colour=colour)
        seen = Bayer(purity=0.7, pattern="grbg").seen(scene)
        assert (seen is scene) != colour
    times = scene.sample_times()[[0, -1]] if between == "motion" else scene.sample_times()
    # purity acts on light, of which grey is that of the luma
    light = (frames / 255.0) ** 2
    luma = (frames @ np.array([0.21, 0.72, 0.07]) / 255) ** 2
    own = mosaic(light, "grbg", 1.0)
    want = 0.3 * luma + 0.7 * own
    got = seen.frames(times)
    np.testing.assert_allclose(got, want[[0, -1]] if between == "motion" else want, atol=1e-4)
