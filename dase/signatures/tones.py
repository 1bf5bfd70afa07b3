"""Tones of events: how far the events of a pixel, or of some, come in step with light that swings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ToneSettings:
    """Which tones are looked for: those of lamps."""

    slowest: float = 45.0  # [Hz]
    fastest: float = 450.0
    step: float = 5e-4  # [s]
    span: float = 16.0  # [s] the mains keep their phase no longer

    def independent(self, span: float) -> float:
        """Return how many tones are looked for in so long a time [s], by which a chance is multiplied."""
        return 2 * (self.fastest - self.slowest) * max(span, self.step)


LAMPS = ToneSettings()
"""Those that signatures look for."""


def swings(
    trains: Sequence[tuple[Array, Array]], begin: float, span: float, s: ToneSettings
) -> tuple[Array, Array]:
    """Return tones [Hz], shape (F,), and how far the events' signs add up at them, shape (K, F).

    Args:
        trains: Times [s] and signs of the events of each of K pixels.
        begin: Of the time that is looked at [s].
        span: Its length [s].
        s: Which tones.
    """
    pad = next_fast_len(4 * (int(span / s.step) + 1), real=True)
    cells = np.arange(math.ceil(s.slowest * pad * s.step), int(s.fastest * pad * s.step) + 1)
    sums = np.empty((len(trains), len(cells)))
    for row, (t, sign) in zip(sums, trains, strict=True):
        train = np.bincount(((t - begin) / s.step).astype(np.int64), sign)
        row[:] = np.abs(np.fft.rfft(train, pad)[cells])
    return cells / (pad * s.step), sums
