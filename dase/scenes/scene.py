"""What a sensor looks at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError

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


SUBFRAMES = 32
"""Of one exposure, rendered at once: memory does not grow with its duration."""


def to_grey(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return intensities as greys of 8 bits, of the same shape: 255 is intensity 1 and above."""
    levels = light * np.float32(255)
    np.rint(levels, out=levels)  # in place, as memory costs more than arithmetic here
    return np.clip(levels, 0, 255, out=levels).astype(np.uint8)


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

    def filtered(self, purity: float) -> tuple[Scene, Scene, Scene] | None:
        """Return the scene behind a red, a green and a blue filter; None where it has no colour.

        Behind a filter linear intensity is (1 - purity) · grey + purity · colour.

        Args:
            purity: Share of the light of a filter's own colour, in [0, 1].
        """
        return None

    def grey_frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.uint8]:
        """Return frames of 8 bits at `times` [s], shape (K, height, width): 255 is intensity 1 and above."""
        return to_grey(self.frames(times, device))

    def exposed_frames(
        self, begins: NDArray[np.float64], exposure: float, device: str = "cpu"
    ) -> NDArray[np.float32]:
        """Return frames with their blur: the mean of the intensity over each exposure.

        Args:
            begins: Of the exposures [s], shape (K,).
            exposure: Duration of each [s], > 0.
            device: `cpu`, `cuda` or a Warp name.

        Returns:
            Intensities in [0, 1], shape (K, height, width).

        Raises:
            InputError: An exposure that is no duration, or that begins before the scene or ends after it.
        """
        check_exposures(self, begins, exposure)
        out = np.zeros((len(begins), self.height, self.width), np.float32)
        for frame, edges in zip(out, self._exposure_edges(begins, exposure), strict=True):
            middles, shares = (edges[:-1] + edges[1:]) / 2, np.diff(edges) / (edges[-1] - edges[0])
            for some in range(0, len(middles), SUBFRAMES):
                part = slice(some, some + SUBFRAMES)
                frame += np.tensordot(shares[part].astype(np.float32), self.frames(middles[part], device), 1)
        return out

    def _exposure_edges(self, begins: NDArray[np.float64], exposure: float) -> Iterator[NDArray[np.float64]]:
        """Yield the edges of the sub-frames of each exposure [s]: samples, between which little changes."""
        samples = self.sample_times()
        for begin in begins:
            first, last = max(begin, samples[0]), min(begin + exposure, samples[-1])
            yield np.concatenate([[first], samples[(samples > first) & (samples < last)], [last]])

    def _first_time(self) -> float:
        return float(self.sample_times()[0])

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32] | None:
        """Return the flow at `times` [px/s], shape (K, 2, height, width), x then y; None where unknown."""
        return None


def check_exposures(scene: Scene, begins: NDArray[np.float64], exposure: float) -> None:
    """Raise InputError where exposures [s] are no durations, or do not lie within a scene."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure must be a number > 0 s, got {exposure:g}")
    first = scene._first_time()
    last, slack = first + scene.duration, 1e-9 * max(scene.duration, exposure)
    if len(begins) and (np.min(begins) < first - slack or np.max(begins) + exposure > last + slack):
        raise InputError(
            f"exposures must lie within the scene, {first:g}..{last:g} s, "
            f"got {np.min(begins):g}..{np.max(begins) + exposure:g}"
        )
