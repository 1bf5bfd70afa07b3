"""Scenes of the blind benchmark, used nowhere else."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

WIDTH, HEIGHT, RATE = 144, 108, 1000


@lru_cache(maxsize=4)
def scene_of(number: int) -> Any:
    """Return a scene of the development set by its number."""
    return draw_scene(np.random.default_rng([number, 2024]))


def draw_scene(rng: np.random.Generator) -> Any:
    """Return a scene with fast, slow and resting content over a wide range of light, 1 s at 1 kHz."""
    import cv2

    import dase

    images = dase.open_images("builtin")
    still = cv2.resize(images.background(rng).grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    turn = rng.uniform(0, 2 * np.pi)
    light = np.exp(1.6 * (np.cos(turn) * x + np.sin(turn) * y) - 1.6)
    still = np.clip(still, 0.02, 1) * light
    things = []
    for speed in np.geomspace(15, 900, 9) * rng.uniform(0.8, 1.25, 9):
        size = int(rng.uniform(18, 44))
        patch = cv2.resize(images.background(rng).grey, (size, size), interpolation=cv2.INTER_AREA)
        patch = np.clip(patch * np.exp(rng.uniform(-2.0, 0.3)), 0.004, 1)
        rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
        alpha = (np.hypot(rows, columns) < size / 2 - 1).astype(np.float32)
        things.append(
            (patch, alpha, speed, rng.uniform(0, 1, 2), rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9))
        )
    frames = np.empty((RATE + 1, HEIGHT, WIDTH), np.float32)
    for k in range(RATE + 1):
        frames[k] = _frame(still, things, k / RATE)
    return dase.VideoScene(frames, np.arange(RATE + 1) / RATE)


def _frame(still: np.ndarray, things: list[Any], t: float) -> np.ndarray:
    import cv2

    out = still.astype(np.float32)
    for patch, alpha, speed, where, angle, span in things:
        # back and forth along a line, so that pixels see both edges and pauses
        reach = 0.5 * span * WIDTH
        along = reach * np.sin(speed * t / max(reach, 1))
        corner = (
            where * (WIDTH, HEIGHT) + along * np.array([np.cos(angle), np.sin(angle)]) - patch.shape[0] / 2
        )
        first = np.floor(corner).astype(int)
        move = np.array([[1, 0, corner[0] - first[0]], [0, 1, corner[1] - first[1]]], np.float32)
        size = (patch.shape[0] + 1,) * 2
        cover = cv2.warpAffine(alpha, move, size)
        value = cv2.warpAffine(patch.astype(np.float32), move, size, borderMode=cv2.BORDER_REPLICATE)
        low = np.maximum(first, 0)
        high = np.minimum(first + size[0], (WIDTH, HEIGHT))
        if np.all(high > low):
            window = np.s_[low[1] : high[1], low[0] : high[0]]
            part = np.s_[low[1] - first[1] : high[1] - first[1], low[0] - first[0] : high[0] - first[0]]
            out[window] = out[window] * (1 - cover[part]) + value[part] * cover[part]
    return out
