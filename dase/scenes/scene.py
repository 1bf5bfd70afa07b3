"""What a sensor looks at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOG_EPS = 1e-3
"""Added to intensities before the logarithm between frames; that of sensors unless they say otherwise."""


@dataclass(frozen=True)
class SamplingSettings:
    """How densely a scene that is known at any time is sampled (Eq. 5 of Stoffregen et al., 2020)."""

    travel: float = 0.5
    """Share of a pixel that anything may move between two samples (λ): less would be no change to a pixel."""
    shortest: float = 1e-3
    """Lower bound of the time between samples [s] (δ), so that something fast does not cost without bound."""
    longest: float = 1 / 72
    """Upper bound of it [s], so that effects of time show at rest; S2R samples at 72 Hz at least."""


class Scene(ABC):
    """Linear intensity, and where known flow, at pixels and times.

    Attributes:
        width: Columns of the picture [px].
        height: Rows of the picture [px].
        duration: Length [s].
        anytime: Whether `source` takes any time between the first sample and the last.
    """

    width: int
    height: int
    duration: float
    anytime: bool = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.width}x{self.height} pixels, {self.duration:g} s)"

    @abstractmethod
    def sample_times(self) -> NDArray[np.float64]:
        """Return the times at which the scene is to be sampled [s], from 0 to `duration`, increasing."""

    @abstractmethod
    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return what a pixel kernel reads intensities from.

        Args:
            times: Samples [s], shape (K,), a run of `sample_times`.
            pixels: Row-major indices of the pixels asked for, shape (N,).
            device: Warp device of the result.

        Returns:
            Name of a source of `dase.kernels.pixel_stages`, and its arguments.
        """

    @abstractmethod
    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return intensities in [0, 1] at `times` [s], shape (K, height, width)."""

    def grey_frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.uint8]:
        """Return frames of 8 bits at `times` [s], shape (K, height, width): 255 is intensity 1 and above."""
        levels = self.frames(times, device) * np.float32(255)
        np.rint(levels, out=levels)  # in place, as memory costs more than arithmetic here
        return np.clip(levels, 0, 255, out=levels).astype(np.uint8)

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32] | None:
        """Return the flow at `times` [px/s], shape (K, 2, height, width), x then y; None where unknown."""
        return None
