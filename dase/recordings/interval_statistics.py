"""The times between successive events of one pixel, gathered piece by piece in memory that does not grow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class IntervalSettings:
    """How finely intervals are counted, and what makes a period."""

    exact: int = 1 << 20
    """Intervals kept as they are; quantiles of more come from bins of 1 %."""
    least: float = 1e-7
    """Where the bins begin [s], below the microsecond of most time stamps."""
    decades: int = 13
    """How far the bins reach: up to 10^6 s."""
    fine: int = 240
    """Bins per decade, 1 % each; a multiple of all coarser bins per decade that are asked for."""
    short: int = 1 << 16
    """Up to where whole microseconds are counted, for the period [us]."""
    nudge: float = 0.02
    """Share of a bin that all move by: whole microseconds stay in one bin whatever their last bit says."""
    mode_bins: int = 24
    """Bins per decade the most frequent interval is looked for in."""
    mode_share: float = 0.002
    """Share of the intervals that a bin needs: a short bin with a single one would be densest."""
    fewest: int = 500
    """Short intervals that a period or a mode takes."""
    longest_period: float = 0.012
    """Longest period that is looked for [s]; `short` must hold several of it."""
    shortest_period: float = 2.5e-6
    """Shortest one [s]; whole microseconds resolve no shorter one."""
    peak: float = 0.5
    """Share of intervals in phase that makes a period; half of it must be left in its harmonics."""
    harmonics: int = 4
    """Multiples of the frequency that must be in phase, too: a hump has none."""


class IntervalStatistics:
    """Counts intervals in fine logarithmic bins, and short ones by the microsecond.

    Args:
        settings: Widths of bins, and what makes a period.
    """

    def __init__(self, settings: IntervalSettings = IntervalSettings()) -> None:
        self.settings = settings
        self.count = 0
        self.zeros = 0
        """Pairs of events of one pixel at the same time."""
        self._bins = np.zeros(settings.decades * settings.fine, np.int64)
        self._short = np.zeros(settings.short, np.int64)
        self._exact: list[NDArray[np.float64]] = []

    def add(self, seconds: NDArray[np.float64]) -> None:
        """Add intervals [s], (N,)."""
        settings = self.settings
        self.count += len(seconds)
        if self.count <= settings.exact:
            self._exact.append(seconds.copy())
        # pairs at one time have no logarithm; they count as the shortest intervals in quantiles
        positive = seconds[seconds > 0]
        self.zeros += len(seconds) - len(positive)
        # in place: parts of a million intervals would need five copies otherwise
        place = np.log10(positive, out=np.empty_like(positive))
        place -= math.log10(settings.least)
        place *= settings.fine
        place += settings.nudge
        np.clip(place, 0, len(self._bins) - 1, out=place)
        self._bins += np.bincount(place.astype(np.int64), minlength=len(self._bins))
        short = np.rint(positive[positive < (settings.short - 1) * 1e-6] * 1e6).astype(np.int64)
        self._short += np.bincount(short, minlength=settings.short)

    def quantile(self, share: float, *, positive: bool = False) -> float:
        """Return the interval [s] below which a share of them lies; not a number without any.

        Args:
            share: Of all intervals, or of those that are not 0.
            positive: Whether pairs of events at one time are left out.
        """
        if not self.count or (positive and self.count == self.zeros):
            return math.nan
        if positive and self.zeros:
            share = (self.zeros + share * (self.count - self.zeros - 1)) / (self.count - 1)
        if self.count <= self.settings.exact:
            return float(np.quantile(np.concatenate(self._exact), share))
        total = np.cumsum(self._bins) + self.zeros
        wanted = share * self.count
        if wanted <= self.zeros:
            return 0.0
        at = int(np.searchsorted(total, wanted))
        inner = 1 - (total[at] - wanted) / self._bins[at]
        return float(self.settings.least * 10 ** ((at + inner) / self.settings.fine))

    def histogram(self, per_decade: int = 2) -> list[tuple[float, float, int]]:
        """Return begin [s], end [s] and number of intervals of each bin, from the first to the last with any.

        Pairs of events at the same time are not in it.
        """
        counts = self._bins.reshape(self.settings.decades * per_decade, -1).sum(1)
        filled = np.flatnonzero(counts)
        if not len(filled):
            return []
        edges = self.settings.least * 10 ** (np.arange(len(counts) + 1) / per_decade)
        span = range(int(filled[0]), int(filled[-1]) + 1)
        return [(float(edges[k]), float(edges[k + 1]), int(counts[k])) for k in span]

    def mode(self) -> float:
        """Return the interval [s] that is met most often per microsecond; not a number where none is."""
        settings = self.settings
        counts = self._bins.reshape(settings.decades * settings.mode_bins, -1).sum(1)
        if counts.sum() < settings.fewest:
            return math.nan
        edges = settings.least * 10 ** (np.arange(len(counts) + 1) / settings.mode_bins)
        filled = counts > settings.mode_share * counts.sum()
        at = int(np.argmax(np.where(filled, counts / np.diff(edges), 0.0)))
        low, high = (round(edge * 1e6) for edge in (edges[at], edges[at + 1]))
        if low < 1 or high >= settings.short:
            return float(math.sqrt(edges[at] * edges[at + 1]))
        return float(low + int(np.argmax(self._short[low : high + 1]))) * 1e-6

    def period(self) -> tuple[float, float]:
        """Return the time [s] of which short intervals are multiples, and the share that is in phase.

        A sensor that scans its rows sees an event only when their turn comes. Not numbers where nothing is
        periodic.
        """
        settings = self.settings
        total = int(self._short.sum())
        if total < settings.fewest:
            return math.nan, math.nan
        power = np.abs(np.fft.rfft(self._short)) / total  # at k: share in phase with a period of short / k
        first = math.ceil(settings.short * 1e-6 / settings.longest_period)
        last = min(math.floor(settings.short * 1e-6 / settings.shortest_period), len(power) - 1)
        for k in range(first, last // 2):
            if power[k] < settings.peak or power[k] < power[k - 1 : k + 2].max():
                continue
            # a line stands out of its surroundings, its own leakage left out
            around = np.concatenate((power[k - k // 4 - 4 : k - 2], power[k + 3 : k + k // 4 + 5]))
            if power[k] < 3 * float(np.median(around)):
                continue  # a hump, no line
            tone = _refine_frequency(self._short, k)
            tones = [m * tone for m in range(1, settings.harmonics + 1) if m * k <= last]
            shares = [abs(_phase_coherence(self._short, one)) for one in tones]
            if min(shares) > settings.peak / 2:
                return 1e-6 / tone, shares[0]
        return math.nan, math.nan


def _phase_coherence(counts: NDArray[np.int64], tone: float) -> complex:
    """Return the share of intervals in phase at a frequency [1/us]."""
    at = np.flatnonzero(counts)
    return complex(np.sum(counts[at] * np.exp(-2j * np.pi * tone * at)) / counts.sum())


def _refine_frequency(counts: NDArray[np.int64], k: int) -> float:
    """Return the frequency [1/us] near k / len(counts) at which a high harmonic is strongest."""
    tone, reach = k / len(counts), 0.7 / len(counts)
    # thrice a grid of 15 narrowed to a sixth: finer than the intervals resolve
    for _ in range(3):
        tones = tone + np.linspace(-reach, reach, 15)
        tone = float(tones[np.argmax([abs(_phase_coherence(counts, one)) for one in tones])])
        reach /= 6
    return tone
