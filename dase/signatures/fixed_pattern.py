"""A fixed pattern: pixels that send more ON for each OFF event than their neighbours, in both halves.

Thresholds differ from pixel to pixel. How many events a pixel sends is the scene's, and sharp edges that come
back leave the same numbers again. But light that rises falls again, so ON events times the ON threshold are
OFF events times the OFF threshold, whatever passes, up to what the light has changed between begin and end.
So the balance of two halves of the time, each against its neighbours, agrees at the same pixel where
thresholds differ. What the scene leaves of it does not, for the light where the first half ends is where
the second begins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.formatting import format_percent, format_seconds
from dase.signatures.calm_events import intervals_of_pixels, row_major_pixels
from dase.signatures.chance import NINETY, sign_flip_tail
from dase.signatures.kinds import FIXED_PATTERN
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class PatternSettings:
    """How the pattern is looked for."""

    least: float = 0.05  # spread of the ratio of ON to OFF events over pixels, relative
    fewest_events: float = 3.0  # usual count of a pixel in each half, of each polarity
    fewest_pixels: int = 500
    block: int = 8  # [px] neighbours share the scene: blocks are independent, pixels are not
    hot: float = 2e-4  # share of hot pixels above which those not found as hot are a pattern, too
    shortest: float = 0.3  # [s] below, the halves are parts of one look at the scene
    dead: tuple[float, float] = (3e-4, 0.04)  # [s] dead times that are looked for
    dead_rare: float = 0.005  # share of the intervals that are shorter than one at most
    dead_wide: float = 1.5  # intervals up to this many times as long
    # share of the intervals that end with one: at most 0.16 in 100 made recordings without or of 1 ms, 0.23
    # and more in 33 of 35 of 2 to 15 ms
    dead_ends: float = 0.2


class HalfCounts:
    """Counts the events of each pixel and polarity in both halves of the time.

    The halves are not cut into parts that take turns: each cut leaves what the light has changed between two
    of them, which hid one of three spreads of 15 %.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        begin: Of the recording [s].
        end: Of the recording [s].
        settings: How the pattern is looked for.
    """

    def __init__(
        self, width: int, height: int, begin: float, end: float, settings: PatternSettings | None = None
    ):
        self.settings = settings or PatternSettings()
        self.counts = np.zeros((2, 2, height, width), np.int64)
        """Events, shape (polarity, half, H, W)."""
        self.duration = end - begin
        self._middle = (begin + end) / 2

    def push(self, events: Events) -> None:
        """Take events."""
        pixels = self.counts[0, 0].size
        place = (events.p * 2 + (events.t >= self._middle)) * pixels + row_major_pixels(events)
        self.counts += np.bincount(place, minlength=4 * pixels).reshape(self.counts.shape)


@dataclass(frozen=True)
class _Spikes:
    """Excess agreement of both halves at no shift, by pixel, each (H, W), 0 where unknown."""

    product: NDArray[np.float64]  # of both halves, in standard errors squared
    signal: NDArray[np.float64]  # the same beyond the extrapolation
    spread: NDArray[np.float64]  # relative ratios squared
    used: NDArray[np.bool_]


def _mean_around(field: NDArray[np.float64], good: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the good pixels of 5x5 around each."""
    border = cv2.BORDER_REFLECT
    weight = cv2.blur(good, (5, 5), borderType=border)
    out: NDArray[np.float64] = cv2.blur(field * good, (5, 5), borderType=border) / np.maximum(weight, 1e-9)
    return out


def _excess_agreement(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of two fields beyond what shifts of one and two pixels extrapolate to."""

    def shifted(far: int) -> NDArray[np.float64]:
        out: NDArray[np.float64] = (
            sum(np.roll(b, shift, axis) for axis in (0, 1) for shift in (far, -far)) / 4  # type: ignore[assignment]
        )
        return a * out

    return a * b - (4 * shifted(1) - shifted(2)) / 3


def _find_spikes(counts: NDArray[np.int64], good: NDArray[np.bool_], s: PatternSettings) -> _Spikes:
    """Return what the balance of the two halves says; counts have the shape (polarity, half, H, W)."""
    off, on = counts.astype(np.float64)
    weight = good.astype(np.float64)
    used = np.logical_and.reduce(
        [_mean_around(half, weight) > s.fewest_events for half in (*off, *on)], initial=True
    )
    used &= good
    used[:4] = used[-4:] = used[:, :4] = used[:, -4:] = False
    # as many thresholds up as down
    off *= on[:, good].sum() / max(float(off[:, good].sum()), 1.0)
    both, more = on + off, on - off

    def beyond_neighbours(field: NDArray[np.float64], most: float) -> list[NDArray[np.float64]]:
        # one pixel that is far off must not decide
        return [np.clip(half - _mean_around(half, weight), -most, most) * weight for half in field]

    errors = beyond_neighbours(more / np.sqrt(both + 1), 6.0)
    relative = beyond_neighbours(more / np.maximum(both / 2, 1), 2.0)
    signal, spread = (np.where(used, _excess_agreement(*pair), 0.0) for pair in (errors, relative))
    return _Spikes(np.where(used, errors[0] * errors[1], 0.0), signal, spread, used)


def _sum_blocks(field: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    height, width = (size // block * block for size in field.shape)
    square = field[:height, :width].reshape(height // block, block, width // block, block)
    out: NDArray[np.float64] = square.sum((1, 3)).reshape(-1)
    return out


def _dead_time(events: Events, s: PatternSettings) -> float:
    """Return the time that pixels are deaf after an event [s], if many wait for its end; else 0."""
    intervals = intervals_of_pixels(events)
    intervals = np.sort(intervals[intervals < np.inf])
    if not len(intervals):
        return 0.0
    tried = np.geomspace(*s.dead, 36)
    shorter, within = (
        np.searchsorted(intervals, times) / len(intervals) for times in (0.999 * tried, s.dead_wide * tried)
    )
    ends = np.where(shorter <= s.dead_rare, within - shorter, 0.0)
    return float(tried[ends.argmax()]) if ends.max() > s.dead_ends else 0.0


def find_fixed_pattern(halves: HalfCounts, hot: NDArray[np.bool_], level: float, first: Events) -> Signature:
    """Look for a pattern that stays.

    The null gives each block of pixels either sign: without a pattern, products of the two halves beyond the
    extrapolation are as often above zero as below. So are the products themselves, which must be beyond
    chance, too: where shifts agree less than nothing, the extrapolation alone says little.

    Args:
        halves: Events by pixel in two halves of the time.
        hot: Pixels to leave out, shape (H * W,).
        level: p below which it is there.
        first: Events of the begin, which tell a dead time: what a pixel misses in it depends on how fast
            light rises and falls there, and comes back with the scene.
    """
    s = halves.settings
    if halves.duration < s.shortest:
        reason = f"{format_seconds(halves.duration)} of events are one look at the scene, not two"
        return without_answer(FIXED_PATTERN, reason)
    spikes = _find_spikes(halves.counts, ~hot.reshape(halves.counts.shape[2:]), s)
    pixels = int(spikes.used.sum())
    if pixels < s.fewest_pixels:
        reason = (
            f"{pixels} pixels have {s.fewest_events:g} ON and OFF events in each half, "
            f"fewer than {s.fewest_pixels}"
        )
        return without_answer(FIXED_PATTERN, reason)
    p = max(sign_flip_tail(_sum_blocks(field, s.block)) for field in (spikes.signal, spikes.product))
    spread = _sum_blocks(spikes.spread, s.block)
    mean, error = float(spread.sum()) / pixels, math.sqrt(float((spread**2).sum())) / pixels
    size, low, high = (math.sqrt(max(mean + k * NINETY * error, 0.0)) for k in (0, -1, 1))
    entry = Signature(
        name=FIXED_PATTERN, answer=Answer.NOT_SEEN, p=p, size=size, low=low, high=high,
        unit="relative spread of ON per OFF event over pixels", least=s.least,
        sentence="pixels differ from their neighbours for good: ON events for each OFF event spread by "
        f"{format_percent(size)}",
        details={"pixels": pixels},
    )  # fmt: skip
    unseen = (
        f"pixels differ by less than {format_percent(high)} for good"
        if high
        else "no agreement of both halves"
    )
    entry = judge_signature(entry, level, unseen)
    if not entry.found:
        return entry
    doubt = ""
    if hot.mean() > s.hot:
        doubt = f"beside {int(hot.sum())} hot pixels those nearly hot look so, too"
    elif dead := _dead_time(first, s):
        doubt = f"pixels are deaf for {format_seconds(dead)} after an event: what they miss is the scene's"
    if not doubt:
        return entry
    return replace(entry, answer=Answer.CANNOT_SAY, sentence=f"spread {format_percent(size)}, but {doubt}")
