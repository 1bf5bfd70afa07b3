"""Pictures that lie on the device, as a scene for effects that act before the pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels.scene_layers import Frames
from dase.scenes.scene import Scene


class RenderedScene(Scene):
    """Pictures of one scene at the samples of one chunk.

    Args:
        size: Columns and rows [px].
        values: Intensities on the device, shape (K, rows · columns).
    """

    def __init__(self, size: tuple[int, int], values: wp.array):
        self.width, self.height = size
        self.values, self.duration = values, 0.0

    def sample_times(self) -> NDArray[np.float64]:
        """Return numbers that stand for the samples, shape (K,)."""
        return np.arange(self.values.shape[0], dtype=np.float64)

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the intensities of pixels (N,) at all samples, whatever `times` (K,) says."""
        seen = Frames()
        every = len(pixels) == self.width * self.height
        seen.values = self.values
        if not every:
            seen.values = wp.array(
                np.ascontiguousarray(self.values.numpy()[:, pixels]), dtype=float, device=device
            )
        return "frames", seen

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the pictures at the samples of these numbers, shape (K, height, width)."""
        return np.asarray(self.values.numpy()[times.astype(int)].reshape(-1, self.height, self.width))
