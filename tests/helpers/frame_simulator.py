"""A small simulator that knows frames alone, and a clip for it; shares nothing with dase's kernels."""

from __future__ import annotations

import numpy as np

from dase.events import Events
from dase.scenes.video import VideoScene

WIDTH, HEIGHT = 72, 48


def shaken_texture(seed: int = 0, gap: float = 2e-3, length: float = 0.8) -> VideoScene:
    """Return a texture that shakes to and fro, in 8 bits."""
    rng = np.random.default_rng(seed)
    wide = rng.standard_normal((HEIGHT + 40, WIDTH + 60))
    kernel = np.hanning(11) / np.hanning(11).sum()
    for axis in (0, 1):
        wide = np.apply_along_axis(np.convolve, axis, wide, kernel, "same")
    texture = np.exp(0.8 * wide / wide.std())
    times = np.arange(0.0, length, gap)
    x, y = 15 * np.sin(2 * np.pi * 1.3 * times), 10 * np.sin(2 * np.pi * 1.9 * times + 1)
    frames = []
    for dx, dy in zip(x, y, strict=True):
        rows = np.stack(
            [np.interp(np.arange(WIDTH) + 30 + dx, np.arange(WIDTH + 60), row) for row in texture]
        )
        at = np.arange(HEIGHT) + 20 + dy
        low = np.floor(at).astype(int)
        share = (at - low)[:, None]
        frames.append(rows[low] * (1 - share) + rows[low + 1] * share)
    light = np.array(frames)
    return VideoScene((255 * np.clip(light / np.quantile(light, 0.99), 0.02, 1)).astype(np.uint8), times)


def bright_texture(gap: float, length: float = 1.2) -> VideoScene:
    """Return that texture nowhere so dark that a simulator is linear there."""
    scene = shaken_texture(gap=gap, length=length)
    light = scene.frames(scene.sample_times())
    return VideoScene(np.round(255 * (0.1 + 0.9 * light)).astype(np.uint8), scene.sample_times())


def counted_between_frames(
    scene: VideoScene,
    spread: float,
    *,
    leak: float = 0.0,
    seed: int = 0,
    same: bool = False,
    shot: float = 0.0,
    forgets: str = "",
    hot: int = 0,
) -> Events:
    """Return events as a simulator of frames sends them: evenly between two, linear in the dark.

    Args:
        scene: Frames of light.
        spread: Of the thresholds of 0.2, relative.
        leak: Rate [Hz], a quarter apart from pixel to pixel.
        seed: Of the random numbers.
        same: Whether each pixel has one threshold for both polarities.
        shot: Rate of noise of either polarity that no memory knows of [Hz].
        forgets: Where pixels take the light of a frame for their memory, as in `HighPass.at`; for `"frames"`
            times begin with that of the frame before.
        hot: Pixels that send 400 ON events a second beside, which no memory knows of.
    """
    rng = np.random.default_rng(seed)
    times = scene.sample_times()
    light = 255 * scene.frames(times)
    level = np.where(light < 20, light / 20 * np.log(20), np.log(np.maximum(light, 1e-9)))
    high, low = (np.maximum(0.2 * (1 + spread * rng.standard_normal(light.shape[1:])), 0.02) for _ in "+-")
    low = high if same else low
    rate = leak * np.exp(0.25 * rng.standard_normal(light.shape[1:]))
    memory, out = level[0].copy(), []
    for begin, end, now in zip(times[:-1], times[1:], level[1:], strict=True):
        memory -= rate * high * (end - begin)
        for sign, threshold in ((1, high), (-1, low)):
            count = np.floor(np.maximum(sign * (now - memory), 0) / threshold).astype(int)
            for n in range(count.max(initial=0)):
                y, x = np.nonzero(count > n)
                t = begin + (end - begin) * (n + 1) / (count[y, x] + 1)
                if forgets == "frames":
                    t = begin + (end - begin) * n / count[y, x]
                out.append((t, x, y, np.full(len(x), sign > 0)))
            memory += sign * count * threshold
            memory = np.where((count > 0) & (forgets == "sending frames"), now, memory)
        memory = now.copy() if forgets == "frames" else memory
    for place in rng.choice(WIDTH * HEIGHT, hot, replace=False):
        t = np.sort(rng.uniform(0, times[-1], rng.poisson(400 * times[-1])))
        out.append((t, *(np.full(len(t), at) for at in (place % WIDTH, place // WIDTH, True))))
    many = rng.poisson(shot * times[-1] * WIDTH * HEIGHT)
    noise = [rng.integers(0, size, many) for size in (WIDTH, HEIGHT, 2)]
    out.append((rng.uniform(0, times[-1], many), noise[0], noise[1], noise[2] > 0))
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    order = np.argsort(t, kind="stable")
    return Events(t[order], x[order], y[order], p[order], WIDTH, HEIGHT)
