"""Opposite pairs at rest: a pixel with nothing around it sends an event, and soon one of the other polarity.

Noise on the pixel's voltage crosses a threshold and returns. Independent ON and OFF trains, as of leak or of
single photons that leave no trace in the pixel, come in no pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import grouped, percent
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.chance import poisson_interval
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "opposite pairs"


@dataclass(frozen=True)
class PairSettings:
    """What makes a pair."""

    least: float = 2.0  # times as many as by chance
    near: float = 0.02  # [s] a pair
    later: tuple[float, float] = (0.1, 0.4)  # [s] no pair any more, but still the same scene
    busiest: float = 4.0  # [Hz] of a pixel at rest; of one that sends more, few intervals are long


class PairCounts:
    """Counts successive calm events of each pixel by their distance.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        settings: What makes a pair.
    """

    def __init__(self, width: int, height: int, settings: PairSettings | None = None):
        self.settings = settings or PairSettings()
        pixels = width * height
        self._time = np.full(pixels, -np.inf)
        self._polarity = np.zeros(pixels, np.bool_)
        self.events = np.zeros((2, pixels), np.int64)
        """Calm events, OFF and ON."""
        self.opposite = np.zeros((2, pixels), np.int64)
        """Opposite pairs, near and later."""
        self.same = np.zeros(pixels, np.int64)
        """Pairs of one polarity, near."""

    def push(self, calm: Events) -> None:
        """Take calm events."""
        if not len(calm):
            return
        pixel = row_major_pixels(calm)
        order = np.argsort(pixel, kind="stable")
        pixel, t, p = pixel[order], calm.t[order], calm.p[order]
        first = np.concatenate(([True], pixel[1:] != pixel[:-1]))
        before = np.where(first, self._time[pixel], np.roll(t, 1))
        flips = p != np.where(first, self._polarity[pixel], np.roll(p, 1))
        gap = t - before
        near = gap < self.settings.near
        begin, end = self.settings.later
        size = len(self._time)
        for row, chosen in ((0, near), (1, (gap >= begin) & (gap < end))):
            self.opposite[row] += np.bincount(pixel[chosen & flips], minlength=size)
        self.same += np.bincount(pixel[near & ~flips], minlength=size)
        for row in range(2):
            self.events[row] += np.bincount(pixel[p == bool(row)], minlength=size)
        last = np.append(first[1:], True)
        self._time[pixel[last]], self._polarity[pixel[last]] = t[last], p[last]


def find_opposite_pairs(
    pairs: PairCounts, hot: NDArray[np.bool_], duration: float, level: float, *, lamp: bool = False
) -> Signature:
    """Look for opposite pairs at rest.

    The null has ON and OFF trains of each pixel independent: their pairs are then Poisson distributed. A
    scene makes rates differ over time, so as many are expected, too, as the pairs farther apart tell.

    Args:
        pairs: Counted pairs.
        hot: Pixels to leave out, shape (H * W,).
        duration: Of the recording [s].
        level: p below which they are there.
        lamp: Whether the light flickers, which makes opposite pairs.
    """
    s = pairs.settings
    rest = ~hot & (pairs.events.sum(0) <= max(s.busiest * duration, 10.0))
    off, on = pairs.events[:, rest]
    near = int(pairs.opposite[0, rest].sum())
    events = int((off + on).sum())
    trains = float((off * on).sum() * 2 * s.near / max(duration, s.near))
    # a train of rate r has exp(r t) times as many intervals below t as above
    begin, end = s.later
    favour = np.exp((off + on) / max(duration, end) * (begin + end) / 2)
    local = float((pairs.opposite[1, rest] * favour).sum()) * s.near / (end - begin)
    expected = max(trains, local)
    flips = f"{percent(near / max(near + int(pairs.same[rest].sum()), 1))} of near pairs flip"
    p = float(stats.poisson.sf(near - 1, expected)) if near else 1.0
    low, high = (limit / max(expected, 1e-3) for limit in poisson_interval(near))
    known = {
        "p": p, "size": near / max(expected, 1e-3), "low": low, "high": high,
        "unit": "times as many as by chance", "least": s.least,
        "details": {
            "pairs": near, "expected": expected, "trains": trains, "local": local, "calm_events": events,
            "on_rate": float(on.sum() / max(duration, 1e-9) / max(len(on), 1)),
            "off_rate": float(off.sum() / max(duration, 1e-9) / max(len(off), 1)),
        },
    }  # fmt: skip
    if lamp:
        return without_answer(NAME, f"{near} pairs, but light that flickers makes them, too", **known)
    # what would be seen: twice the least size
    if stats.poisson.sf(math.ceil(2 * s.least * expected) - 1, expected) >= level and p >= level:
        reason = f"{grouped(events)} calm events: {near} pairs, {expected:.2g} by chance, too few to tell"
        return without_answer(NAME, reason, **known)
    said = f"noise of the pixels at rest: {near} opposite pairs within 20 ms, {expected:.3g} by chance; {flips}"
    unseen = f"{near} opposite pairs at rest, {expected:.3g} by chance"
    return judge_signature(Signature(name=NAME, answer=Answer.NOT_SEEN, sentence=said, **known), level, unseen)
