"""Scenes from frames: a user's own high-speed video, or an array."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.kernels import pixel
from dase.scene import Scene


class VideoScene(Scene):
    """Frames at given times; between two frames the log intensity of a pixel runs straight.

    Args:
        frames: Linear intensity in [0, 1], shape (F, height, width).
        times: Times of the frames [s], increasing, shape (F,); the scene begins with the first.
    """

    def __init__(self, frames: ArrayLike, times: ArrayLike):
        self._frames = np.asarray(frames)
        self._times = np.asarray(times, np.float64)
        if self._frames.ndim != 3 or min(self._frames.shape) < 1:
            raise InputError(f"video: frames must have shape (F, height, width), got {self._frames.shape}")
        if self._times.shape != (len(self._frames),):
            raise InputError(f"video: {len(self._frames)} frames need as many times, got {self._times.shape}")
        if np.any(np.diff(self._times) <= 0):
            raise InputError("video: frame times must increase")
        if not np.all(np.isfinite(self._frames)) or self._frames.min() < 0:
            raise InputError("video: intensities must be finite and >= 0")
        self.height, self.width = self._frames.shape[1:]
        self.duration = float(self._times[-1] - self._times[0])

    def sample_times(self) -> NDArray[np.float64]:
        """Return the times of the frames [s]."""
        return self._times

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the stored intensities of these pixels."""
        source = pixel.Frames()
        flat = self._at(times).reshape(len(times), -1)
        values = flat if len(pixels) == flat.shape[1] else flat[:, pixels]
        source.values = wp.array(np.ascontiguousarray(values, np.float32), dtype=float, device=device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the frames at `times`, which must be times of frames, shape (K, height, width)."""
        return np.asarray(self._at(times), np.float32)

    def _at(self, times: NDArray[np.float64]) -> NDArray[Any]:
        index = np.searchsorted(self._times, times)
        if np.any(index >= len(self._times)) or not np.array_equal(self._times[index], times):
            raise InputError("video: asked for a time between its frames")
        return self._frames[index]
