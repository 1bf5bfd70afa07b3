"""Time stamps that many events share: a clock that ticks slowly, a readout that goes from row to row, or
packets that leave at times of their own.

A packet has what the array has sent since the one before it, so the longer that is ago, the more events have
its time. What works frame by frame also gives many events one time, but some gaps between such times come
again and again, or longer ones have no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_percent, format_seconds
from dase.probes import timestamp_patterns
from dase.recordings.interval_statistics import IntervalStatistics
from dase.signatures.calm_events import intervals_of_pixels, row_major_pixels
from dase.signatures.kinds import TIME_STAMPS
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class StampSettings:
    """How regularities are looked for."""

    least: float = 0.5  # share of the events that follow it
    most: int = 1 << 20  # events that are looked at, the first ones
    fewest: int = 2000
    tried: int = 1 << 16  # periods of intervals that are looked at
    packet: float = 20e-6
    """[s] Between packets, at least, for half of them: events that come at one time by chance are closer."""
    together: float = 2.0
    """Events in a packet, at least, in the mean."""
    packets: int = 100
    """Packets, at least."""
    alike: float = 0.02
    """Share of the gaps between packets that are the same, at most: 0.01 where they are drawn; 0.06 and more
    in 47 of 48 clips of simulators that work frame by frame."""
    follows: float = 0.5
    """Rank correlation of the events in a packet with the gap before it, at least: 0.7 to 0.99 of packets, up
    to 0.56 of frames whose gaps are alike, 0.1 of the one clip of frames whose are not."""


def _tolerance(pattern: timestamp_patterns.TimestampStructure, events: Events) -> float:
    """Return the share of stamps that follow a pattern by chance."""
    p = timestamp_patterns
    if pattern.line:
        scan = pattern.line * p.readout_lines(events, pattern.direction)[0]
        file_step = min(1.1 * p.PATTERNS.file_step, 0.2 * scan)
        return min(1.0, 2 * max(file_step, p.PATTERNS.pause * scan) / scan)
    return min(1.0, 2 * min(1.1 * p.PATTERNS.file_step, 0.2 * pattern.step) / pattern.step)


def _find_pattern(events: Events) -> Signature | None:
    """Return the pattern of the first half of the stamps, as the second half follows it."""
    half = len(events) // 2
    first, second = events.select(slice(0, half)), events.select(slice(half, None))
    pattern = timestamp_patterns.find_structure(first)
    if not pattern.step and not pattern.line:
        return None
    share = float(pattern.shares(second).max())
    count = round(share * len(second))
    p = float(stats.binom.sf(count - 1, len(second), _tolerance(pattern, second)))
    low, high = stats.beta.interval(0.9, count + 0.5, len(second) - count + 0.5)
    if pattern.line:
        lines = timestamp_patterns.readout_lines(second, pattern.direction)[0]
        what = "rows" if lines == events.height and pattern.direction in ("down", "up") else "columns"
        period = pattern.line * lines
        said = f"a readout scans the {what} in {format_seconds(period)} ({pattern.direction})"
        details = {"line": pattern.line, "period": period, "direction": pattern.direction}
    else:
        said = f"stamps are multiples of {format_seconds(pattern.step)}"
        details = {"step": pattern.step}
    return Signature(
        name=TIME_STAMPS, answer=Answer.NOT_SEEN, p=p, size=share, low=float(low), high=float(high),
        unit="share of the events",
        sentence=f"{said}: {format_percent(share)} of the events", details=details,
    )  # fmt: skip


def _find_period(events: Events, s: StampSettings) -> Signature | None:
    """Return the period of which intervals of pixels are multiples.

    Phases of n intervals have a Rayleigh statistic above R with a chance of exp(-R), for each period. Pixels
    that see the same send at the same intervals: as many count as there are different multiples.
    """
    intervals = IntervalStatistics()
    between = intervals_of_pixels(events)
    # of a pixel that sends twice, the second says nothing of the scan
    between = between[(between > timestamp_patterns.PATTERNS.shortest) & (between < 0.065)]
    intervals.add(between)
    period, share = intervals.period()
    if not period > 0:
        return None
    multiples = np.bincount(np.rint(between / period).astype(np.int64))
    different = float(multiples.sum()) ** 2 / float((multiples.astype(np.float64) ** 2).sum())
    p = min(1.0, s.tried * math.exp(-min(different * share**2, 700.0)))
    error = 1.645 / math.sqrt(2 * different)
    return Signature(
        name=TIME_STAMPS, answer=Answer.NOT_SEEN,
        p=p, size=share, low=share - error, high=min(share + error, 1.0),
        unit="share of short intervals", details={"period": period},
        sentence=f"short intervals of a pixel are multiples of {format_seconds(period)}: "
        f"{format_percent(share)}",
    )  # fmt: skip


def _find_packets(events: Events, s: StampSettings) -> Signature | None:
    """Return packets, each with what was sent since the one before; None where there are none.

    Numbers of events that do not depend on the gaps before have a rank correlation with them that is normal,
    of variance 1 / (n - 1).
    """
    stamps, many = np.unique(np.rint(1e6 * events.t).astype(np.int64), return_counts=True)
    gaps = np.diff(stamps)
    if len(gaps) < s.packets or many.mean() < s.together or np.median(gaps) < 1e6 * s.packet:
        return None
    if np.unique(gaps, return_counts=True)[1].max() > s.alike * len(gaps):
        return None
    if np.ptp(many[1:]) == 0:
        return None
    follows = float(stats.spearmanr(gaps, many[1:]).statistic)
    if follows < s.follows:
        return None
    shared, gap = int(many[many > 1].sum()), 1e-6 * float(np.median(gaps))
    low, high = stats.beta.interval(0.9, shared + 0.5, len(events) - shared + 0.5)
    return Signature(
        name=TIME_STAMPS, answer=Answer.NOT_SEEN, p=float(stats.norm.sf(follows * math.sqrt(len(gaps) - 1))),
        size=shared / len(events), low=float(low), high=float(high), unit="share of the events",
        sentence=f"events get their times in packets, {format_seconds(gap)} after each other in the median "
        f"and hardly ever alike: {format_percent(shared / len(events))} of the events share theirs",
        details={"step": gap, "packets": float(len(stamps))},
    )  # fmt: skip


def find_time_stamps(
    events: Events,
    hot: NDArray[np.bool_],
    level: float,
    *,
    repeats: bool = False,
    settings: StampSettings | None = None,
) -> Signature:
    """Look for regularities of the time stamps.

    A pattern is read off the first half of the events; the others follow it by chance as often as its
    tolerance is wide. Where there is none, packets are looked for.

    Args:
        events: The first of the recording, as many as `StampSettings.most`.
        hot: Pixels to leave out, shape (H * W,).
        level: p below which there are any.
        repeats: Whether the light flickers, so that pixels that see the same repeat the same intervals, or a
            bus sends events at equal ones.
        settings: How regularities are looked for.
    """
    s = settings or StampSettings()
    kept = events.select(~hot[row_major_pixels(events)])
    if len(kept) < s.fewest:
        return without_answer(
            TIME_STAMPS, f"{format_count(len(kept))} events, fewer than {format_count(s.fewest)}"
        )
    entry = _find_pattern(kept) or _find_packets(kept, s) or (None if repeats else _find_period(kept, s))
    if entry is None:
        return Signature(
            name=TIME_STAMPS,
            answer=Answer.NOT_SEEN,
            p=1.0,
            least=s.least,
            sentence="no regularity above 3 µs",
        )
    return judge_signature(replace(entry, least=s.least), level, "no regularity above 3 µs")
