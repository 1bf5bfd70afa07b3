"""A fixed pattern: pixels that send more than their neighbours in every part of the time.

Thresholds differ from pixel to pixel. What the scene leaves in the counts is smooth over pixels, because the
lens is; a pixel's own threshold is not. So counts of two halves of the time, each against its neighbours,
agree more at the same pixel than the agreement at shifts of one and two pixels extrapolates to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.formatting import format_percent, format_seconds
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.chance import NINETY, sign_flip_tail
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "fixed pattern"


@dataclass(frozen=True)
class PatternSettings:
    """How the pattern is looked for."""

    least: float = 0.05  # spread of counts over pixels, relative; what a lamp leaves of a scene reaches 0.02
    parts: int = 6  # of the time, in turns for one half and the other
    fewest_events: float = 3.0  # usual count of a pixel in each half
    fewest_pixels: int = 500
    block: int = 8  # [px] neighbours share the scene: blocks are independent, pixels are not
    hot: float = 2e-4  # share of hot pixels above which those not found as hot are a pattern, too
    shortest: float = 0.3  # [s] below, the halves are parts of one look at the scene
    # correlation of both halves' smooth counts above which they saw the same scene: sharp edges that went to
    # and fro looked like a pattern in 8 of 10 scenes, all above 0.57
    same_scene: float = 0.5


class HalfCounts:
    """Counts the events of each pixel and polarity in two interleaved halves of the time.

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
        self._begin, self._part = begin, max(end - begin, 1e-9) / self.settings.parts

    def push(self, events: Events) -> None:
        """Take events."""
        pixels = self.counts[0, 0].size
        part = np.clip((events.t - self._begin) / self._part, 0, self.settings.parts - 1).astype(np.int64)
        place = (events.p * 2 + part % 2) * pixels + row_major_pixels(events)
        self.counts += np.bincount(place, minlength=4 * pixels).reshape(self.counts.shape)


@dataclass(frozen=True)
class _Spikes:
    """What one polarity says: excess agreement at no shift, by pixel."""

    product: NDArray[np.float64]  # (H, W) of both halves, in standard errors squared, 0 where unknown
    signal: NDArray[np.float64]  # (H, W) the same beyond the extrapolation
    spread: NDArray[np.float64]  # (H, W) relative counts squared
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


def _find_spikes(halves: NDArray[np.int64], good: NDArray[np.bool_], s: PatternSettings) -> _Spikes:
    """Return what the two halves, shape (2, H, W), say."""
    counts = halves.astype(np.float64)
    weight = good.astype(np.float64)
    mean = np.stack([_mean_around(half, weight) for half in counts])
    used = (mean > s.fewest_events).all(0) & good
    used[:4] = used[-4:] = used[:, :4] = used[:, -4:] = False
    # one pixel that is far off must not decide
    errors = np.clip((counts - mean) / np.sqrt(mean + 1), -6, 6) * weight
    relative = np.clip(counts / np.maximum(mean, 1) - 1, -2, 2) * weight
    signal, spread = (np.where(used, _excess_agreement(*pair), 0.0) for pair in (errors, relative))
    return _Spikes(np.where(used, errors[0] * errors[1], 0.0), signal, spread, used)


def _sum_blocks(field: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    height, width = (size // block * block for size in field.shape)
    square = field[:height, :width].reshape(height // block, block, width // block, block)
    out: NDArray[np.float64] = square.sum((1, 3)).reshape(-1)
    return out


def _same_scene(counts: NDArray[np.int64], used: NDArray[np.bool_], good: NDArray[np.bool_]) -> float:
    """Return the correlation of the smooth counts of both halves over the pixels used."""
    weight = good.astype(np.float64)
    a, b = (_mean_around(half.astype(np.float64), weight)[used] for half in counts.sum(0))
    if a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def find_fixed_pattern(
    halves: HalfCounts, hot: NDArray[np.bool_], level: float, *, lamp: bool = False
) -> Signature:
    """Look for a pattern that stays.

    The null gives each block of pixels either sign: without a pattern, products of the two halves beyond the
    extrapolation are as often above zero as below. So are the products themselves, which must be beyond
    chance, too: where shifts agree less than nothing, the extrapolation alone says little.

    Args:
        halves: Events by pixel in two halves of the time.
        hot: Pixels to leave out, shape (H * W,).
        level: p below which it is there.
        lamp: Whether the light flickers: how often a still pixel follows depends on where its memory happens
            to stand, and that stays.
    """
    s = halves.settings
    if halves.duration < s.shortest:
        reason = f"{format_seconds(halves.duration)} of events are one look at the scene, not two"
        return without_answer(NAME, reason)
    good = ~hot.reshape(halves.counts.shape[2:])
    spikes = [_find_spikes(pair, good, s) for pair in halves.counts]
    known = [one for one in spikes if one.used.sum() >= s.fewest_pixels]
    if not known:
        pixels = max(int(one.used.sum()) for one in spikes)
        reason = f"{pixels} pixels have {s.fewest_events:g} events in each half, fewer than {s.fewest_pixels}"
        return without_answer(NAME, reason)
    fields = ([one.signal for one in known], [one.product for one in known])
    p = max(sign_flip_tail(_sum_blocks(np.sum(field, axis=0), s.block)) for field in fields)
    pixels = sum(int(one.used.sum()) for one in known)
    spread = _sum_blocks(np.sum([one.spread for one in known], axis=0), s.block)
    mean, error = float(spread.sum()) / pixels, math.sqrt(float((spread**2).sum())) / pixels
    size, low, high = (math.sqrt(max(mean + k * NINETY * error, 0.0)) for k in (0, -1, 1))
    used = np.any([one.used for one in known], axis=0)
    alike = _same_scene(halves.counts, used, good)
    entry = Signature(
        name=NAME, answer=Answer.NOT_SEEN, p=p, size=size, low=low, high=high,
        unit="relative spread of counts over pixels", least=s.least,
        sentence=f"pixels differ from their neighbours for good: counts spread by {format_percent(size)}",
        details={"pixels": pixels, "same_scene": alike},
    )  # fmt: skip
    unseen = (
        f"pixels differ by less than {format_percent(high)} for good"
        if high
        else "no agreement of both halves"
    )
    entry = judge_signature(entry, level, unseen)
    if not entry.found:
        return entry
    numbers = {"p": entry.p, "size": size, "low": low, "high": high, "unit": entry.unit, "least": s.least}
    if hot.mean() > s.hot:
        many = int(hot.sum())
        reason = f"spread {format_percent(size)}, but beside {many} hot pixels those nearly hot look so, too"
        return without_answer(NAME, reason, details=entry.details, **numbers)
    if lamp:
        reason = (
            f"spread {format_percent(size)}, but light that flickers leaves each pixel's memory where it is"
        )
        return without_answer(NAME, reason, details=entry.details, **numbers)
    if alike > s.same_scene:
        reason = (
            f"spread {format_percent(size)}, but both halves saw the same scene (correlation {alike:.2f})"
        )
        return without_answer(NAME, reason, details=entry.details, **numbers)
    return entry
