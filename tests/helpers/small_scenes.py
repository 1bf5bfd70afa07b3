"""Scenes of a few pixels that stand still, step, ramp, flicker or move."""

from __future__ import annotations

import numpy as np

import dase


def flicker(rng: np.random.Generator, samples: int = 60, size: tuple[int, int] = (8, 10), step: float = 0.25):
    """Return a video whose log intensities wander, unevenly sampled; times are whole 2^-12 s."""
    level = np.cumsum(rng.normal(0, step, (samples, *size)), 0) + rng.uniform(-4, -0.5, size)
    level = -np.abs(level)  # stays below white
    times = np.cumsum(rng.integers(4, 24, samples)) / 4096
    return dase.VideoScene(np.exp(level).astype(np.float32), times)


def layers(rng: np.random.Generator, size: tuple[int, int] = (24, 20)) -> dase.LayerScene:
    """Return a background and two turning, half transparent objects."""
    made = []
    for n, scale in enumerate((1.3, 0.5, 0.3)):
        grey = rng.random((18, 22), np.float32)
        alpha = None if n == 0 else rng.random((18, 22), np.float32).round() * np.float32(0.7)
        x, y = rng.uniform(-0.4, 0.4, (2, 2)).tolist()
        zoom = (scale, 1.2 * scale)
        motion = dase.Motion(x=tuple(x), y=tuple(y), angle=(0.3 * n, n), scale_x=zoom, scale_y=zoom[::-1])
        made.append(dase.Layer(dase.Picture(grey, alpha), motion))
    return dase.LayerScene(made, width=size[0], height=size[1], duration=0.2)


def static(light: np.ndarray, seconds: float, samples: int) -> dase.VideoScene:
    """Return a scene in which nothing moves; light is the intensity of each pixel, shape (H, W)."""
    frames = np.broadcast_to(np.asarray(light, np.float32), (samples, *light.shape))
    return dase.VideoScene(frames, np.linspace(0, seconds, samples))


def ramp(change: float, seconds: float, pixels: int, samples: int = 41) -> dase.VideoScene:
    """Return pixels whose log(intensity + 0.001) all run straight over `change`."""
    level = np.linspace(0, change, samples) + np.log(0.0011) - min(change, 0)
    frames = (np.exp(level) - 1e-3)[:, None, None] * np.ones((1, pixels))
    return dase.VideoScene(frames, np.linspace(0, seconds, samples))


def still(light: np.ndarray, seconds: float, samples: int, start: float = 0.0) -> dase.VideoScene:
    """Return pixels of constant light, one row, sampled evenly."""
    frames = np.broadcast_to(np.asarray(light, np.float32), (samples, 1, np.size(light)))
    return dase.VideoScene(frames, start + np.linspace(0, seconds, samples))
