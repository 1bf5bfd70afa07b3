"""Bursts of the whole array that no single one shows, told by all of them together.

Where a frame disturbs one pixel in a hundred, a burst is lost among the events of what moves. Added up over
the frames of a second it is far above chance. Their time is not known, nor whether a shutter goes from row to
row, so all intervals and delays are tried: the rate is folded on each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from dase.kernels import launch
from dase.kernels.folded_rates import find_fold_heights
from dase.signatures.clock import ClockCounts


@dataclass(frozen=True)
class FaintBurstSettings:
    """What is folded, and what of it are bursts of frames."""

    longest: float = 4.0  # [s] of the recording in which intervals are looked for; a second has enough frames
    usual: float = 0.02  # [s] its mean is the usual rate: longer than a burst, shorter than a scene
    most: float = 4.0  # standard errors that a step counts at most: what moves may be far above
    delays: float = 0.012  # [s] the last row comes as much before or after the first, at most
    apart: float = 1e-3  # [s] between delays that are tried: less is lost in a step of the clock
    beat: float = 8.0  # standard errors of what comes again within `shortest`, which is taken out first,
    once: float = 4.0  # and of what does after a single turn: bursts do after two of half their interval
    beats: int = 4  # of its turns on both sides are what is taken out of one
    clear: float = 6.0  # standard errors above nine of ten phases before that: what it left may beat
    periods: int = 6  # of those at which a rate comes again are folded, for each delay
    best: int = 12  # of all these are looked at closely
    fewest_frames: int = 7  # with less not even the same moment in each frame is significant
    shortest: float = 0.014  # [s] what repeats sooner is a lamp: it has 100 or 120 cycles per second
    fewest_events: int = 50  # of a tile that is asked
    tiles: float = (
        0.8  # share of these that must be above the usual by a standard error; by chance a sixth are
    )
    fewest_tiles: int = 16  # that are asked
    lasts: float = (
        3e-3  # [s] for which the folded rate is above half of its height: bursts 1 to 2 ms, scenes 4
    )
    screen: float = 1 / 60  # [s] what comes so often may be a screen that is seen
    lamps: tuple[float, float] = (100.0, 120.0)
    """[Hz] Lamps flicker so: where bursts come as often as each second, third, fourth cycle of one, it may be
    that, to which thresholds of a simulator answer now and then."""

    near_lamp: float = 0.003
    """Cycles by which their interval may be no whole number of these."""

    near_screen: float = 5e-3  # of that, is as often


FAINT = FaintBurstSettings()


@dataclass(frozen=True)
class FaintBursts:
    """Bursts at even times, of one polarity.

    Args:
        interval: From one to the next [s].
        first: When the first comes in the first row [s].
        delay: From the first row to the last [s]; negative where the last comes first.
        polarity: 1 for ON, 0 for OFF.
        p: Chance of as much without frames, times what was tried.
        rates: Of each burst, relative to the usual, shape (n,).
        excess: Events of a burst above the usual.
        mean: How far the folded rate is above the usual, in standard errors of a step, shape (M,).
        at: Which of these steps has the bursts.
        lasts: How long the folded rate is above half of its height [s].
        tiles: Share of the tiles that take part.
    """

    interval: float
    first: float
    delay: float
    polarity: int
    p: float
    rates: NDArray[np.float64]
    excess: float
    mean: NDArray[np.float64]
    at: int
    lasts: float
    tiles: float


class _Excess:
    """How far the events of a polarity are above the usual rate, by step and tile.

    A frame reaches as many pixels of each tile, so each counts by its excess relative to its rate: what moves
    in one part hides nothing in the others.
    """

    def __init__(self, counts: NDArray[np.uint32], step: float, settings: FaintBurstSettings):
        """Compare counts by step and tile, shape (K, T), with their mean over `settings.usual` seconds."""
        self.settings, self.step, self.beat = settings, step, 0.0
        self.counts = counts.astype(np.float64)
        width = 2 * round(settings.usual / step / 2) + 1
        self.width = width
        usual = uniform_filter1d(self.counts, width, axis=0, mode="nearest")
        self.usual = np.maximum(usual, 0.05 * self.counts.mean(0) + 0.02)
        weight = 1 / (self.usual + 0.3)  # a rate of nothing tells no more than a few events do
        self.excess = (self.counts - self.usual) * weight
        self.variance = self.usual * weight**2
        self.side = round(math.sqrt(counts.shape[1]))
        # of each row of tiles, shape (side, K)
        self._of_bands, self._variance_of_bands = (
            np.ascontiguousarray(table.reshape(-1, self.side, self.side).sum(2).T)
            for table in (self.excess, self.variance)
        )
        self.beat = _find_beat(self.aligned(0.0)[0], step, settings)

    def delays_of_bands(self, delay: float) -> NDArray[np.int64]:
        """Return by how many steps each row of tiles comes later, shape (side,)."""
        out: NDArray[np.int64] = np.round(
            delay * (np.arange(self.side) + 0.5) / self.side / self.step
        ).astype(np.int64)
        return out

    def aligned(self, delay: float, with_beat: bool = False) -> tuple[NDArray[np.float64], int]:
        """Return the excess of two steps together, in standard errors, shape (K',), and its first step.

        Args:
            delay: From the first row to the last [s].
            with_beat: Whether what repeats sooner than frames do is left in.
        """
        steps = self.delays_of_bands(delay)
        before, behind = max(-int(steps.min()), 0), max(int(steps.max()), 0)
        count = len(self.counts) - before - behind
        above, variance = np.zeros(count), np.zeros(count)
        for band, late in enumerate(steps):
            rows = slice(before + late, before + late + count)
            above += self._of_bands[band, rows]
            variance += self._variance_of_bands[band, rows]
        out = above / np.sqrt(variance + 1e-9)
        out -= uniform_filter1d(out, self.width, mode="nearest")
        out = np.clip(out, -self.settings.most, self.settings.most)
        out = _without_beat(out, self.beat, self.settings.beats) if self.beat and not with_beat else out
        out /= max(float(out.std()), 1e-9)
        # a burst may be cut in two by the clock
        return np.convolve(out, [math.sqrt(0.5)] * 2)[: len(out)], before


def find_faint_bursts(clock: ClockCounts, settings: FaintBurstSettings = FAINT) -> FaintBursts | None:
    """Return the bursts at even times that stand out most; None where none of the whole array do.

    Args:
        clock: The events by time.
        settings: What is folded, and what of it are bursts.
    """
    s, step = settings, clock.settings.step
    counts = clock.counts[: round(s.longest / step)]
    if len(counts) * step < (s.fewest_frames + 1) * s.shortest + 2 * s.delays:
        return None
    found: list[tuple[float, int, float, float]] = []
    delays = np.arange(-s.delays, s.delays + 0.5 * s.apart, s.apart)
    excess = [_Excess(counts[:, polarity], step, s) for polarity in range(2)]
    for polarity, delay in product(range(2), delays):
        rate, _ = excess[polarity].aligned(float(delay))
        periods = _likely_periods(rate, step, s)
        found += [
            (float(height), polarity, float(delay), float(period))
            for height, period in zip(_fold_heights(rate, periods), periods, strict=True)
        ]
    found.sort(reverse=True)
    best: tuple[float, int, float, float] | None = None
    for _, polarity, delay, period in found[: s.best]:
        rate, _ = excess[polarity].aligned(delay)
        for part in (1, 2, 3):  # of two and three intervals each burst is the same again
            if period / part * step < s.shortest:
                continue
            height, near = _refine(rate, period / part)
            if best is None or height > best[0]:
                best = height, polarity, delay, near
    if best is None:
        return None
    _, polarity, delay, period = best
    return _describe(clock, excess[polarity], polarity, delay, period, s)


def _without_beat(rate: NDArray[np.float64], beat: float, turns: int) -> NDArray[np.float64]:
    """Return a rate less its mean so many `turns` of a beat [steps] before and behind."""
    steps = np.arange(len(rate))
    near, known = np.zeros(len(rate)), np.zeros(len(rate))
    for turn in (*range(-turns, 0), *range(1, turns + 1)):
        place = np.round(steps + turn * beat).astype(np.int64)
        inside = (place >= 0) & (place < len(rate))
        near[inside] += rate[place[inside]]
        known[inside] += 1
    return rate - near / np.maximum(known, 1)


def find_row_delay(clock: ClockCounts, interval: float, settings: FaintBurstSettings = FAINT) -> float:
    """Return by how much bursts of a known interval [s] come later in the last row than in the first [s]."""
    s, step = settings, clock.settings.step
    counts = clock.counts[: round(s.longest / step)]
    if len(counts) * step < 2 * interval + 2 * s.delays:
        return 0.0
    delays = np.arange(-s.delays, s.delays + 0.5 * s.apart, s.apart)
    heights = []
    for polarity in range(2):
        excess = _Excess(counts[:, polarity], step, s)
        heights.append(
            [_fold(excess.aligned(float(d), with_beat=True)[0], interval / step)[0].max() for d in delays]
        )
    best = np.array(heights).max(0)
    # of delays that do as well the shortest: a burst that lasts shows for several
    good = delays[best >= 0.97 * best.max()]
    return float(good[np.abs(good).argmin()])


def _find_beat(rate: NDArray[np.float64], step: float, s: FaintBurstSettings) -> float:
    """Return the period in steps of what repeats sooner than frames do; 0 where nothing does.

    Frames of a clip and lamps do, which may be far above the bursts.
    """
    again = _again(rate)
    tried = np.arange(4.0, s.shortest / step, 0.25)
    heights = np.array([_height_of_turns(again, tried, (turn,)) for turn in (1, 3, 5, 7, 9, 11)])
    height = heights.sum(0) / math.sqrt(len(heights))
    height[heights[0] < s.once] = 0.0
    return float(tried[height.argmax()]) if height.max() > s.beat else 0.0


def _again(rate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much a rate of mean 0 comes again after so many steps, per pair of steps that far apart."""
    steps = len(rate)
    size = 1 << (2 * steps - 1).bit_length()
    spectrum = np.fft.rfft(rate, size)
    out: NDArray[np.float64] = np.fft.irfft(spectrum * spectrum.conj())[:steps]
    out /= max(float(out[0]) / steps, 1e-12)
    out[:3] = 0.0
    return out


def _height_of_turns(
    again: NDArray[np.float64], periods: NDArray[np.float64], turns: Sequence[int]
) -> NDArray[np.float64]:
    """Return how much a rate comes again after turns of each period, in standard errors, shape (P,)."""
    lag = np.round(np.outer(turns, periods)).astype(np.int64)
    inside = lag < 0.85 * len(again)  # of more, few pairs are left
    height = np.where(inside, again[np.minimum(lag, len(again) - 1)], 0.0).sum(0)
    pairs = 1 + np.where(inside, len(again) - lag, 0).sum(0)
    out: NDArray[np.float64] = height / np.sqrt(pairs)
    return out


def _likely_periods(rate: NDArray[np.float64], step: float, s: FaintBurstSettings) -> NDArray[np.float64]:
    """Return periods [steps] after which, and their multiples, a rate comes again most, shape (P,)."""
    again = maximum_filter1d(_again(rate), 3)
    longest = len(rate) / s.fewest_frames
    tried = np.exp(np.arange(math.log(s.shortest / step), math.log(longest), 2e-3))
    height = _height_of_turns(again, tried, range(1, 13))
    out: list[float] = []
    for n in np.argsort(height)[::-1]:
        if all(abs(tried[n] / other - 1) > 0.01 for other in out):
            out.append(float(tried[n]))
        if len(out) == s.periods:
            break
    return np.array(out)


def _places(count: int, period: float) -> NDArray[np.int64]:
    """Return the steps of each whole period, shape (n, M)."""
    whole = int((count - 1) / period)
    places = np.round(np.arange(whole)[:, None] * period + np.arange(int(period))).astype(np.int64)
    out: NDArray[np.int64] = places[places[:, -1] < count]
    return out


def _fold(rate: NDArray[np.float64], period: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean over periods in standard errors, shape (M,), and the rate of each, shape (n, M)."""
    each = rate[_places(len(rate), period)]
    return each.sum(0) / math.sqrt(max(len(each), 1)), each


def _fold_heights(rate: NDArray[np.float64], periods: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest mean of a rate folded on each period [steps], in standard errors, shape (P,)."""
    cpu, heights = launch.find_device("cpu"), np.empty(len(periods))
    inputs = [wp.array(a, dtype=wp.float64, device=cpu, copy=False) for a in (rate, periods, heights)]
    launch.run_kernel(find_fold_heights, len(periods), inputs, cpu)
    return heights


def _refine(rate: NDArray[np.float64], about: float, reach: float = 0.012) -> tuple[float, float]:
    """Return the greatest folded rate near a period [steps], and its period."""
    # fine enough that the first and the last frame keep step
    tried = about * (1 + np.arange(-reach, reach, 0.3 / len(rate)))
    heights = _fold_heights(rate, tried)
    best = int(np.argmax(heights))
    return float(heights[best]), float(tried[best])


def _describe(
    clock: ClockCounts, excess: _Excess, polarity: int, delay: float, period: float, s: FaintBurstSettings
) -> FaintBursts | None:
    """Return what is known of bursts in the first seconds; None where they show without their beat alone."""
    step, count = clock.settings.step, len(excess.counts)
    rate, begin = excess.aligned(delay)
    mean, each = _fold(rate, period)
    at = int(mean.argmax())
    # If frames had nothing to do with it their clocks could be turned: ranks of one phase are uniform
    ranks = (each >= each[:, at][:, None]).mean(1)
    tried = 2 * (2 * s.delays / s.apart + 1) * count * len(mean)
    p = min(1.0, tried * float(stats.gamma.sf(-np.log(ranks).sum(), len(each))))
    shared, rates, more = _at_bursts(excess, begin, period, at, delay, s)
    if len(clock.counts) > count:  # a longer time tells the interval better
        period = _refine_over(clock, polarity, delay, period, s)
    if excess.beat:
        plain, _ = _fold(excess.aligned(delay, with_beat=True)[0], period)
        others = np.sort(plain)[-max(len(plain) // 10, 2)]
        if plain[at] < others + s.clear or (plain > plain[at]).sum() > 1:
            return None
    lasts = step * float((mean > 0.5 * mean[at]).sum())
    first = clock.begin + (begin + at) * step  # two steps, of which this one is the second
    return FaintBursts(period * step, first, delay, polarity, p, rates, more, mean, at, lasts, shared)


def _at_bursts(
    excess: _Excess, begin: int, period: float, at: int, delay: float, s: FaintBurstSettings
) -> tuple[float, NDArray[np.float64], float]:
    """Return which share of the tiles takes part, the rate of each burst, and how many events it has more."""
    count, late = excess.counts.shape[0], excess.delays_of_bands(delay)
    frames = np.round(np.arange(int(count / period)) * period).astype(np.int64) + at + begin
    steps = frames[:, None, None] + late[None, :, None] - np.arange(2)  # (n, side, 2)
    frames_inside = ((steps >= 0) & (steps < count)).all((1, 2))
    steps = steps[frames_inside]
    tiles = np.arange(excess.side**2).reshape(excess.side, excess.side)

    def over(table: NDArray[np.float64]) -> NDArray[np.float64]:
        found = table[steps[:, :, :, None], tiles[None, :, None, :]].sum(2)  # both steps: (n, side, side)
        out: NDArray[np.float64] = found.reshape(len(steps), -1)
        return out

    above = over(excess.excess).sum(0) / np.sqrt(over(excess.variance).sum(0) + 1e-9)
    asked = excess.counts.sum(0) >= s.fewest_events
    shared = float((above[asked] > 1).mean()) if asked.sum() >= s.fewest_tiles else 0.0
    events, usual = over(excess.counts).sum(1), over(excess.usual).sum(1)
    return shared, (events + 1) / (usual + 1), float((events - usual).mean())


def _refine_over(
    clock: ClockCounts, polarity: int, delay: float, period: float, s: FaintBurstSettings
) -> float:
    """Return the period [steps] that keeps step over all of a recording, each time over twice as much."""
    step, count = clock.settings.step, round(s.longest / clock.settings.step)
    while count < len(clock.counts):
        count = min(2 * count, len(clock.counts))
        rate, _ = _Excess(clock.counts[:count, polarity], step, s).aligned(delay)
        _, period = _refine(rate, period, reach=2.0 / count)
    return period
