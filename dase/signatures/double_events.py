"""Double events: a pixel sends the same twice within some microseconds, sooner than its dead time allows.

A handshake that is answered twice. Where the light jumps, events also follow each other fast, but then as
many per microsecond a little later. Where a delay falls as the light rises, events catch up with those before
them: ON events, and OFF events that follow such ON events. So doubles are there if OFF events have them whose
pixel was silent before, as in all cameras that were seen to have any. Events of one pixel at one time have
waited for each other, or share a slow clock's tick, and are no doubles.

A simulator that works frame by frame sends the events of a pixel in a frame some hundred microseconds
apart, which hides doubles among them. But all its pixels send at the same few times, and a double has one of
its own. Where that is as many microseconds later for all, doubles share it, too, and are seen if both
polarities have them and hardly anything else comes within hundreds of microseconds.

A slow handshake is answered twice only after some ten microseconds. What is as late could be two steps of a
fast rise as well. So it counts where hardly any is later, and hardly ever two in a row.

Some simulations have doubles some hundred microseconds late, which is what edges do, too, but at all times
from event to event. So these are doubles where the pixel was silent for more than a millisecond before, if
hardly any pair of either polarity is sooner or later than they are, and hardly any has a third event.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_percent, format_seconds
from dase.kernels import launch
from dase.kernels.event_groups import mark_times_of_many
from dase.kernels.event_neighbours import count_short_intervals
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.chance import poisson_interval
from dase.signatures.kinds import DOUBLE_EVENTS
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class DoubleSettings:
    """What is a double event."""

    least: float = 1e-3  # share of the events
    tie: float = 1e-8  # [s] at one time; a handshake takes longer
    near: float = 20e-6  # [s]
    slow: tuple[float, ...] = (40e-6, 80e-6)  # [s] tried where there are none below `near`
    far: float = 400e-6  # [s] dead times begin to show beyond it
    ratio: float = (
        6.0  # times as many per second below `near` as from there to `far`; recordings have 40 and more
    )
    bulk: float = 0.98  # share of the pixels that must have them without the busiest
    shared: float = 0.01
    """Share of the events up to `far` before and after from which on one time is of many pixels: eight times
    what whole microseconds have by chance."""

    none_later: float = 0.02
    """Intervals from `near` to `far` per interval below `near`, at most, for doubles at times that many
    pixels share: times within a frame are not always so close. So it is for those that are slow."""

    alone: float = 0.9
    """Share of slow doubles, at least, before whose first event the pixel was silent for `far`."""

    late: tuple[float, ...] = (160e-6, 320e-6, 640e-6)
    """[s] Ends of what is looked at for late ones, from a quarter of each; one is twice the one before."""

    late_far: float = 1.6e-3
    """[s] Up to which others are counted, and for which pixels were silent before late doubles."""

    late_sooner: float = 0.2
    """Intervals that are shorter than late doubles, relative to these, at most."""

    late_later: float = 0.2
    """The same of longer ones, up to `late_far`, and of third events as soon after. Two steps of a jump
    behind a fast low-pass are as alike, but come after each frame, sooner than pixels have to be silent."""

    late_usual: float = 0.5
    """Share of late doubles, at least, of other pixels than the busiest, those beyond `bulk`."""

    off_clock: float = 2.0
    """Events at times that few pixels share per double, at most, where the clock is slower than doubles: on
    such a clock the second of a double alone has another time."""


class IntervalCounts:
    """Counts short intervals between events of each pixel.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        settings: What is a double event.
    """

    def __init__(self, width: int, height: int, settings: DoubleSettings | None = None):
        self.settings = s = settings or DoubleSettings()
        self.edges = np.array([s.tie, s.near, *s.slow, s.far])
        """Between what intervals are counted in [s], shape (K,)."""
        self.counts = np.zeros((3, len(self.edges), 2, width * height), np.int32)
        """All intervals, those after a silence of `far`, and those of these that end at no time which many
        pixels share.

        Below the first edge and between edges, of OFF and of ON events, shape (3, K, 2, H * W).
        """
        self.sums = np.zeros(len(self.edges))
        """Of all intervals below the first edge and between edges [s], shape (K,)."""
        self.late_edges = np.array(
            [s.tie, 0.25 * s.late[0], *(0.5 * end for end in s.late), s.late[-1], s.late_far]
        )
        """The same of late doubles, shape (L,)."""
        self.late = np.zeros((4, len(self.late_edges), 2), np.int32)
        """As `counts`, of all pixels together, and after a silence of `late_far`, and how many others follow
        within that time, shape (4, L, 2)."""
        self.late_sums = np.zeros(len(self.late_edges))
        """As `sums`, shape (L,)."""
        self.late_of_pixels = np.zeros(width * height, np.int32)
        """Intervals that are late doubles if there are any."""
        self.events = np.zeros((2, width * height), np.int64)
        """OFF and ON events."""
        self.at_own_times = 0
        """Events at times that not many pixels share."""
        self._around = Events.empty(width, height)
        self._counted = 0
        self._last = np.full(width * height, -np.inf)
        self._interval = np.full(width * height, np.inf)
        self._polarity = np.zeros(width * height, np.uint8)
        self._cpu = launch.find_device("cpu")

    def push(self, events: Events) -> None:
        """Take events; the last are held back, for what comes after them tells whether they share a time."""
        if len(events):
            self._count(Events.concatenate([self._around, events]), float(events.t[-1]) - self._reach)

    def finish(self) -> None:
        """Take the events that were held back."""
        self._count(self._around, np.inf)

    @property
    def _reach(self) -> float:
        return self.settings.far + self.settings.tie

    def _count(self, events: Events, until: float) -> None:
        """Count events of which those before `_counted` are, up to a time [s], and keep what is around it."""
        end = int(np.searchsorted(events.t, until))
        if end > self._counted:
            shared = times_of_many(events.t, slice(self._counted, end), self.settings)
            self._count_intervals(events.select(slice(self._counted, end)), shared)
        begin = int(np.searchsorted(events.t, until - self._reach))
        self._around, self._counted = events.select(slice(begin, None)), end - begin

    def _count_intervals(self, events: Events, shared: NDArray[np.bool_]) -> None:
        pixel = row_major_pixels(events)
        self.at_own_times += int(np.count_nonzero(~shared))
        row = np.int32(self.events.shape[1])
        sent = np.bincount(pixel + row * events.p, minlength=self.events.size)
        self.events += sent.reshape(self.events.shape)
        columns = (
            (events.t, wp.float64), (pixel, int),
            (events.p.view(np.uint8), wp.uint8), (shared.view(np.uint8), wp.uint8),
            # whole microseconds as floating point numbers: 20 of them are not less than 20
            (self.edges - 1e-9, wp.float64), (self.late_edges - 1e-9, wp.float64),
            (self._last, wp.float64), (self._interval, wp.float64), (self._polarity, wp.uint8),
            (self.counts, int), (self.sums, wp.float64),
            (self.late, int), (self.late_sums, wp.float64), (self.late_of_pixels, int),
        )  # fmt: skip
        arrays = [wp.array(a, dtype=d, device=self._cpu, copy=False) for a, d in columns]
        wp.launch(count_short_intervals, dim=1, inputs=arrays, device=self._cpu)


def times_of_many(
    t: NDArray[np.float64], asked: slice | NDArray[np.int64], settings: DoubleSettings | None = None
) -> NDArray[np.bool_]:
    """Return at which times so many events come as if all pixels shared a few of them, shape (K,).

    Args:
        t: Times of events [s], sorted, shape (N,).
        asked: Places of K of them.
        settings: What is a double event.
    """
    s, out = settings or DoubleSettings(), np.empty(len(t), np.bool_)
    launch.run_on_arrays(mark_times_of_many, t, s.tie, s.far, s.shared, out)
    return out[asked]


def find_double_events(
    intervals: IntervalCounts, hot: NDArray[np.bool_], level: float, tick: float = 0.0
) -> Signature:
    """Look for pixels that send twice.

    The null has as many intervals per second below 20 µs as from there to 400 µs: binomial. It must fail for
    pairs of OFF events before which the pixel was silent for 400 µs and whose second does not share its time
    with many pixels, and without the busiest pixels, too: where thresholds differ, a few send dozens at a
    jump. Where it does not fail, 40 and 80 µs take the place of 20, and after these late doubles are looked
    for.

    Args:
        intervals: Counted intervals.
        hot: Pixels to leave out, shape (H * W,).
        level: p below which they are there.
        tick: Time between the ticks of the stamps [s]: at a slow clock, events that are not double share one,
            and doubles are seen only where their second leaves the ticks.
    """
    s = intervals.settings
    if tick >= s.near and not _leave_the_clock(intervals, hot):
        late = _look_for_late(intervals, hot, level, tick)
        return late or without_answer(
            DOUBLE_EVENTS, f"stamps are {format_seconds(tick)} apart, which hides what is sooner"
        )
    count = intervals.events.sum(0)
    events = int(count[~hot].sum())
    if events * s.least < 20:
        return without_answer(
            DOUBLE_EVENTS, f"{format_count(events)} events, too few for a share of {format_percent(s.least)}"
        )
    busy = float(np.quantile(count[~hot], s.bulk))
    totals = [_Totals.of(intervals, some) for some in (~hot, ~hot & (count <= busy))]
    soon = _look_within(intervals, 1, totals, level)
    if soon.found:
        return soon
    for reach in range(2, len(intervals.edges) - 1):
        slow = _look_within(intervals, reach, totals, level)
        if slow.found:
            return slow
    return _look_for_late(intervals, hot, level, tick) or soon


@dataclass(frozen=True)
class _Totals:
    """Of some pixels together: intervals as `IntervalCounts` has them, (3, K, 2), and events, (2,)."""

    counts: NDArray[np.int64]
    events: NDArray[np.int64]

    @classmethod
    def of(cls, intervals: IntervalCounts, some: NDArray[np.bool_]) -> Self:
        """Return those of pixels, shape (H * W,)."""
        return cls(intervals.counts[..., some].sum(-1), intervals.events[:, some].sum(1))


def _look_within(intervals: IntervalCounts, reach: int, totals: Sequence[_Totals], level: float) -> Signature:
    """Look for doubles that are sooner than an edge, by its number; beyond 1 they are slow.

    Args:
        intervals: Their edges and settings.
        reach: Number of the edge.
        totals: Of all pixels that are not hot, and without the busiest.
        level: p below which they are there.
    """
    s, edge = intervals.settings, float(intervals.edges[reach])
    every, events = totals[0].counts[0].sum(1), int(totals[0].events.sum())
    ties, near, rest = int(every[0]), int(every[1 : reach + 1].sum()), int(every[reach + 1 :].sum())
    chance = edge / s.far
    looks = 1 + len(s.slow)
    p = min(looks * max(_chance_of(some, reach, chance, s) for some in totals), 1.0)
    low, high = (limit / events for limit in poisson_interval(near))
    share, within = near / events, format_seconds(edge)
    hidden = ", most of these where many pixels send at one time"
    at_once = hidden if p < 1 and near * (1 / chance - 1) < s.ratio * rest else ""
    sums, numbers = intervals.sums[1 : reach + 1].sum(), intervals.counts[0, 1 : reach + 1].sum()
    entry = Signature(
        name=DOUBLE_EVENTS, answer=Answer.NOT_SEEN, p=p, size=share, low=low, high=high,
        unit="share of the events", least=s.least,
        sentence=f"{format_count(near)} events ({format_percent(share)}) within {within} of the same "
        f"pixel's last of the same polarity, {format_count(rest)} from there to 400 µs{at_once}",
        details={"near": near, "later": rest, "at_once": ties, "gap": float(sums / max(numbers, 1))},
    )  # fmt: skip
    unseen = f"{format_percent(share)} of the events within {within} of the same pixel's last"
    if share >= s.least and p == 1.0:
        unseen += ", which have caught up or follow each other fast"
    if rest > 2 * near * (1 / chance - 1) / s.ratio:
        unseen += f"; many more, {format_count(rest)}, within 400 µs"
    found = judge_signature(entry, level, unseen)
    if found.answer is Answer.NOT_SEEN and ties > max(near, s.least * events):
        reason = f"{format_percent(ties / events)} of the events come at the time of the same pixel's last"
        return replace(found, answer=Answer.CANNOT_SAY, sentence=f"{reason}: a delay or a slow clock")
    return found


def _look_for_late(
    intervals: IntervalCounts, hot: NDArray[np.bool_], level: float, tick: float
) -> Signature | None:
    """Return late doubles; None where there are none.

    The null has as many intervals per second from a quarter of an end to it as from there to `late_far`:
    binomial, for either polarity, after silences, at times that few pixels share.

    Args:
        intervals: Counted intervals.
        hot: Pixels that are not usual, shape (H * W,); what they send comes at all times.
        level: p below which they are there.
        tick: Time between the ticks of the stamps, or from scan to scan [s]: it hides what is not far longer.
    """
    if np.all(hot):
        return None
    s, events = intervals.settings, intervals.events[:, ~hot].sum(1)
    of_pixels, count = intervals.late_of_pixels, intervals.events.sum(0)
    usual = ~hot & (count <= np.quantile(count[~hot], s.bulk))
    if int(of_pixels[usual].sum()) < s.late_usual * int(of_pixels.sum()):
        return None
    for number, end in enumerate(s.late, 3):
        if tick >= 0.25 * end:
            continue
        near, later, sooner = (
            intervals.late[:, part].sum(1)
            for part in (slice(number - 1, number + 1), slice(number + 1, None), slice(1, number - 1))
        )
        every, silent, calm, followed = near  # OFF and ON
        if (
            np.any(calm < np.maximum(s.least * events, 20))
            or np.any(later[2] > s.late_later * calm)
            or np.any(followed > s.late_later * every)
            or np.any(sooner[2] > s.late_sooner * calm)
            or np.any(silent < s.alone * every)
        ):
            continue
        chance = 0.75 * end / (s.late_far - 0.25 * end)
        p = float(stats.binom.sf(calm - 1, calm + later[2], chance).max()) * len(s.late)
        number_of, total = int(every.sum()), int(events.sum())
        part = format_percent(number_of / total)
        low, high = (limit / total for limit in poisson_interval(number_of))
        gap = float(intervals.late_sums[number - 1 : number + 1].sum() / number_of)
        begins, ends, far = (format_seconds(time) for time in (0.25 * end, end, s.late_far))
        others = f"{format_count(int(later[1].sum()))} from there to {far} after as long a silence"
        found = Signature(
            name=DOUBLE_EVENTS, answer=Answer.NOT_SEEN, p=p, size=number_of / total, low=low, high=high,
            unit="share of the events", least=s.least,
            sentence=f"{format_count(number_of)} events ({part}) {begins} to {ends} "
            f"after the same pixel's last of the same polarity, {others}",
            details={"near": number_of, "later": int(later[0].sum()), "at_once": 0, "gap": gap},
        )  # fmt: skip
        judged = judge_signature(found, level, "")
        if judged.found:
            return judged
    return None


def _leave_the_clock(intervals: IntervalCounts, hot: NDArray[np.bool_]) -> bool:
    """Whether hardly anything but the second of doubles has a time that many pixels do not share.

    Stamps that are spread around slow ticks bring events of one pixel close together, too, but then most
    events have times of their own.
    """
    s = intervals.settings
    doubles = int(intervals.counts[0, 1][:, ~hot].sum())
    enough = doubles >= s.least * int(intervals.events[:, ~hot].sum())
    return enough and intervals.at_own_times <= s.off_clock * doubles


def _chance_of(some: _Totals, reach: int, chance: float, s: DoubleSettings) -> float:
    """Return p of the null, by which so great a share is soon, for some pixels; 1 if too few are double."""
    least = s.least * some.events
    every, silent, calm = some.counts[:, 1 : reach + 1].sum(1)  # OFF and ON
    later, _, calm_later = some.counts[:, reach + 1 :].sum(1)
    if reach > 1 and (later[0] > s.none_later * every[0] or silent[0] < s.alone * every[0]):
        return 1.0
    soon, rest = int(calm[0]), int(calm_later[0])
    if soon * (1 / chance - 1) < s.ratio * rest or not soon or soon < least[0]:
        # fast, but no faster than fast, or others have caught up with each other, or times are shared
        if np.any(every < np.maximum(least, 1)) or np.any(later > s.none_later * every):
            return 1.0
        if reach > 1 and np.any(silent < s.alone * every):
            return 1.0
        soon, rest = int(every[0]), int(later[0])
    return float(stats.binom.sf(soon - 1, soon + rest, chance))
