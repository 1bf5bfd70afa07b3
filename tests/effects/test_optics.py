"""Optics blur against an explicit convolution, its physics, and what must hold however time is cut."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from helpers.event_comparison import by_pixel, same
from helpers.small_scenes import flicker, layers
from scipy.stats import norm

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.optics_blur import OpticsBlur, Unsharp, blur_weights
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.kernels import launch, pixel_stages, scene_blur

SCENES = {"video": flicker, "layers": layers}


def blurred(pictures: np.ndarray, sigma: float) -> np.ndarray:
    """Return pictures behind samples of a Gaussian, shape (K, H, W), as one matrix per axis."""
    steps = np.arange(-40, 41)
    wider = np.geomspace(0.9 * sigma, 1.6 * sigma + 0.3, 200001)[:, None]
    density = np.exp(-0.5 * (np.arange(1, 41) / wider) ** 2)
    variance = 2 * (density * np.arange(1, 41) ** 2).sum(1) / (1 + 2 * density.sum(1))
    width = wider[np.argmin(np.abs(variance - sigma**2)), 0]
    share = norm.pdf(steps, scale=width) / norm.pdf(steps, scale=width).sum()

    def matrix(size: int) -> np.ndarray:
        reach = int(8 * sigma) + 6
        out = np.zeros((size, size))
        fold = np.pad(np.arange(size), reach, mode="reflect")
        for n in range(-reach, reach + 1):
            for i in range(size):
                out[i, fold[reach + i + n]] += share[40 + n]
        return out

    rows, columns = (matrix(n) for n in pictures.shape[1:])
    return np.einsum("ij,kjm,nm->kin", rows, pictures.astype(np.float64), columns)


@pytest.mark.parametrize("sigma", [0.01, 0.3, 1.0, 4.0])
def test_the_point_spread_has_the_width_asked_for(sigma):
    line = blur_weights(sigma).astype(np.float64)
    n = np.arange(len(line))
    assert line[0] + 2 * line[1:].sum() == pytest.approx(1, abs=1e-6)
    assert 2 * np.sum(line * n**2) == pytest.approx(sigma**2, rel=4e-3)
    assert np.all(line >= 0)


@pytest.mark.parametrize(
    "way", [scene_blur.blur_frames, scene_blur.blur_by_kernels], ids=["chosen", "kernels"]
)
@pytest.mark.parametrize(("size", "sigma"), [((7, 9), 0.5), ((24, 13), 1.7), ((3, 2), 1.0), ((1, 5), 0.8)])
def test_the_blur_is_a_convolution(device, rng, way, size, sigma):
    pictures = rng.random((3, *size), np.float32)
    every, some = np.arange(size[0] * size[1], dtype=np.int32), np.array([4, 0, 3], np.int32)
    want = blurred(pictures, sigma).reshape(3, -1)
    where = launch.find_device(device)
    flat = wp.array(pictures.reshape(3, -1), dtype=float, device=where)
    for pixels in (every, some):
        got = way(flat, blur_weights(sigma), size[1], pixels, where).numpy()
        np.testing.assert_allclose(got, want[:, pixels], atol=5e-5)


@pytest.mark.parametrize("kind", SCENES)
def test_switched_off_it_changes_nothing(device, rng, kind):
    scene, plain = SCENES[kind](rng), dase.Sensor((Threshold(), Vignetting()))
    off = plain.with_effect(OpticsBlur.identity())
    assert off.effects[0].name == "optics_blur"
    assert off.through_optics(scene) is scene
    want = dase.simulate(scene, plain, device=device)
    same(dase.simulate(scene, off, device=device), want)
    edges = [0.0, scene.duration / 3, scene.duration]
    np.testing.assert_array_equal(
        dase.count(scene, off, edges, device=device), dase.count(scene, plain, edges, device=device)
    )
    on = dase.simulate(scene, plain.with_effect(OpticsBlur(sigma=0.5)), device=device)
    assert len(on) < 0.9 * len(want)  # neighbours of independent pixels average out


@pytest.mark.parametrize("kind", SCENES)
def test_pixels_see_the_blurred_pictures(device, rng, kind):
    scene, sensor = SCENES[kind](rng), dase.Sensor((Threshold(phase=0.0),))
    times, sigma = scene.sample_times(), 0.9
    stored = dase.VideoScene(blurred(scene.frames(times), sigma).clip(0), times)
    want = dase.count(stored, sensor, times, device=device)
    unsharp = sensor.with_effect(OpticsBlur(sigma=sigma))
    got = dase.count(scene, unsharp, times, device=device)
    assert want.sum() > 500
    assert np.mean(got != want) < 2e-3  # a crossing within rounding of a sample
    frames = Unsharp(scene, sigma).frames(times[:3], device)
    np.testing.assert_allclose(frames, stored.frames(times[:3]), atol=5e-5)


@pytest.mark.parametrize("sigma", [0.4, 1.3])
def test_noisy_slow_pixels_see_the_blurred_pictures(device, rng, sigma):
    scene = flicker(rng)
    times = scene.sample_times()
    pixels = dase.Sensor((Bandwidth(cutoff=60.0), Threshold(on=0.15, off=0.15), Shot(rate=20.0)))
    stored = dase.VideoScene(blurred(scene.frames(times), sigma).clip(0), times)
    edges = times[::3]
    want = dase.count(stored, pixels, edges, seed=3, device=device)
    got = dase.count(scene, pixels.with_effect(OpticsBlur(sigma=sigma)), edges, seed=3, device=device)
    assert want.sum() > 500
    # light that differs by float32's rounding may cross beside the edge of a window
    assert np.abs(got - want).sum() <= 0.004 * want.sum()
    assert np.abs(dase.count(scene, pixels, edges, seed=3, device=device) - want).sum() > 0.1 * want.sum()


@pytest.mark.parametrize("kind", SCENES)
def test_chunks_and_pixels_do_not_matter(device, rng, kind):
    scene, sensor = SCENES[kind](rng), dase.Sensor((OpticsBlur(sigma=0.6), Threshold()))
    whole = dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=10**6))
    same(dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=5)), whole)
    some = np.array([40, 3, 41], np.int32)
    part = by_pixel(dase.simulate(scene, sensor, device=device, pixels=some))
    every = by_pixel(whole)
    assert sum(len(every[i]) for i in some) > 5
    for i in some:
        np.testing.assert_array_equal(part[i], every[i])


def test_some_of_the_pixels_see_what_they_see_among_all(device, rng):
    """Enough of them for blocks of pixels, which read along rows of memory."""
    scene, sensor = layers(rng), dase.Sensor((OpticsBlur(sigma=0.6), Threshold()))
    pixels = np.arange(100, 180)
    every, some = (
        dase.count(scene, sensor, [0, scene.duration], device=device, pixels=chosen)[0, 0]
        for chosen in (None, pixels)
    )
    np.testing.assert_array_equal(some, every[:, pixels])
    assert some.sum() > 20


@pytest.mark.parametrize("sigma", [2.0, 3.0])
def test_an_edge_becomes_a_ramp_of_the_width_of_the_lens(device, sigma):
    dark, bright, speed, theta = 0.1, 0.8, 40.0, 0.25
    edge = np.where(np.arange(400) < 200, bright, dark).astype(np.float32)[None].repeat(9, 0)
    zoom = (400 / 64, 400 / 64)
    motion = dase.Motion(x=(-0.5, 0.5), scale_x=zoom, scale_y=zoom)
    ground = dase.Picture(np.full((9, 64), dark, np.float32))
    pair = [dase.Layer(ground, dase.Motion()), dase.Layer(dase.Picture(edge), motion)]
    scene = dase.LayerScene(pair, width=64, height=9, duration=64 / speed, travel=0.05)
    sensor = dase.Sensor((OpticsBlur(sigma=sigma), Threshold(on=theta, off=theta, phase=0.0)), log_eps=1e-6)
    events = dase.simulate(scene, sensor, device=device)
    levels = dark * np.exp(theta * np.arange(1, 9))
    share = (levels[levels < bright] - dark) / (bright - dark)
    want = sigma / speed * norm.ppf(share)
    at = events.t[(events.y == 4) & (events.x == 30)]
    # an edge of texels is one texel wide, and time is sampled every twentieth of a pixel
    np.testing.assert_allclose(np.diff(at), np.diff(want), atol=0.1 / speed)
    assert len(at) == len(want)


def test_fine_texture_fades(device):
    x, sigma, period = np.arange(96), 1.2, 6
    wave = 0.2 * np.cos(2 * np.pi / period * x)
    moving = np.stack([0.5 + np.roll(wave, k) for k in range(6)])[:, None].repeat(8, 1)
    scene = Unsharp(dase.VideoScene(moving.astype(np.float32), 0.01 * np.arange(6)), sigma)
    left = np.ptp(scene.frames(np.array([0.02]), device)[0, 4, 24:72]) / np.ptp(wave)
    assert left == pytest.approx(np.exp(-2 * (np.pi * sigma / period) ** 2), rel=1e-3)


def test_stored_logarithms_are_refused(rng):
    scene = flicker(rng)
    scene.source = lambda times, pixels, device: ("log", pixel_stages.Frames())
    with pytest.raises(dase.InputError, match="optics_blur and bayer need intensities"):
        dase.simulate(scene, dase.Sensor((OpticsBlur(), Threshold())))
