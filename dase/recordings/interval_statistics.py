"""The times between successive events of one pixel, gathered piece by piece in memory that does not grow."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

EXACT = 1 << 20  # intervals kept as they are; quantiles of more come from bins of 1 %
LEAST, DECADES, FINE = 1e-7, 13, 240  # [s] where the bins begin, how far they reach, bins per decade
SHORT = 1 << 16  # [us] up to which whole microseconds are counted, for the period
NUDGE = 0.02  # of a bin: whole microseconds stay in one bin whatever their last bit says
MODE = 24  # bins per decade the most frequent interval is looked for in
FEWEST = 500  # short intervals that a period or a mode takes
LONGEST = 0.012  # [s] periods looked for
SHARPEST = 2.5e-6  # [s]
PEAK = 0.5  # share of intervals in phase that makes a period
HARMONICS = 4


class IntervalStatistics:
    """Counts intervals in fine logarithmic bins, and short ones by the microsecond."""

    def __init__(self) -> None:
        self.count = 0
        self.zeros = 0
        """Pairs of events of one pixel at the same time."""
        self._bins = np.zeros(DECADES * FINE, np.int64)
        self._short = np.zeros(SHORT, np.int64)
        self._exact: list[NDArray[np.float64]] = []

    def add(self, seconds: NDArray[np.float64]) -> None:
        """Add intervals [s], (N,)."""
        self.count += len(seconds)
        if self.count <= EXACT:
            self._exact.append(seconds.copy())
        positive = seconds[seconds > 0]
        self.zeros += len(seconds) - len(positive)
        place = np.log10(positive, out=np.empty_like(positive))
        place -= math.log10(LEAST)
        place *= FINE
        place += NUDGE
        np.clip(place, 0, len(self._bins) - 1, out=place)
        self._bins += np.bincount(place.astype(np.int64), minlength=len(self._bins))
        short = np.rint(positive[positive < (SHORT - 1) * 1e-6] * 1e6).astype(np.int64)
        self._short += np.bincount(short, minlength=SHORT)

    def quantile(self, share: float) -> float:
        """Return the interval [s] below which a share of them lies; not a number without any."""
        if not self.count:
            return math.nan
        if self.count <= EXACT:
            return float(np.quantile(np.concatenate(self._exact), share))
        total = np.cumsum(self._bins) + self.zeros
        wanted = share * self.count
        if wanted <= self.zeros:
            return 0.0
        at = int(np.searchsorted(total, wanted))
        inner = 1 - (total[at] - wanted) / self._bins[at]
        return float(LEAST * 10 ** ((at + inner) / FINE))

    def histogram(self, per_decade: int = 2) -> list[tuple[float, float, int]]:
        """Return begin [s], end [s] and number of intervals of each bin, from the first to the last with any.

        Pairs of events at the same time are not in it.
        """
        counts = self._bins.reshape(DECADES * per_decade, -1).sum(1)
        filled = np.flatnonzero(counts)
        if not len(filled):
            return []
        edges = LEAST * 10 ** (np.arange(len(counts) + 1) / per_decade)
        span = range(int(filled[0]), int(filled[-1]) + 1)
        return [(float(edges[k]), float(edges[k + 1]), int(counts[k])) for k in span]

    def mode(self) -> float:
        """Return the interval [s] that is met most often per microsecond; not a number where none is."""
        counts = self._bins.reshape(DECADES * MODE, -1).sum(1)
        if counts.sum() < FEWEST:
            return math.nan
        edges = LEAST * 10 ** (np.arange(len(counts) + 1) / MODE)
        at = int(np.argmax(np.where(counts > 0.002 * counts.sum(), counts / np.diff(edges), 0.0)))
        low, high = (round(edge * 1e6) for edge in (edges[at], edges[at + 1]))
        if low < 1 or high >= SHORT:
            return float(math.sqrt(edges[at] * edges[at + 1]))
        return float(low + int(np.argmax(self._short[low : high + 1]))) * 1e-6

    def period(self) -> tuple[float, float]:
        """Return the time [s] of which short intervals are multiples, and the share that is in phase.

        A sensor that scans its rows sees an event only when their turn comes. Not numbers where nothing is
        periodic.
        """
        total = int(self._short.sum())
        if total < FEWEST:
            return math.nan, math.nan
        power = np.abs(np.fft.rfft(self._short)) / total  # at k: share in phase with a period of SHORT / k
        first = math.ceil(SHORT * 1e-6 / LONGEST)
        last = min(math.floor(SHORT * 1e-6 / SHARPEST), len(power) - 1)
        for k in range(first, last // 2):
            if power[k] < PEAK or power[k] < power[k - 1 : k + 2].max():
                continue
            around = np.concatenate((power[k - k // 4 - 4 : k - 2], power[k + 3 : k + k // 4 + 5]))
            if power[k] < 3 * float(np.median(around)):
                continue  # a hump, no line
            tone = _refine_frequency(self._short, k)
            shares = [
                abs(_phase_coherence(self._short, m * tone)) for m in range(1, HARMONICS + 1) if m * k <= last
            ]
            if min(shares) > PEAK / 2:
                return 1e-6 / tone, shares[0]
        return math.nan, math.nan


def _phase_coherence(counts: NDArray[np.int64], tone: float) -> complex:
    """Return the share of intervals in phase at a frequency [1/us]."""
    at = np.flatnonzero(counts)
    return complex(np.sum(counts[at] * np.exp(-2j * np.pi * tone * at)) / counts.sum())


def _refine_frequency(counts: NDArray[np.int64], k: int) -> float:
    """Return the frequency [1/us] near k / SHORT at which a high harmonic is strongest."""
    tone, reach = k / SHORT, 0.7 / SHORT
    for _ in range(3):
        tones = tone + np.linspace(-reach, reach, 15)
        tone = float(tones[np.argmax([abs(_phase_coherence(counts, one)) for one in tones])])
        reach /= 6
    return tone
