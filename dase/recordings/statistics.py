"""What is in a recording: rates, intervals, hot pixels, the structure of its time stamps, what looks odd.

Events are looked at piece by piece, in memory that does not grow with the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from typing import Any, Unpack

import cv2
import numpy as np
from numpy.typing import NDArray

from dase import io
from dase.events import LABELS, Events
from dase.io.rules import TooLateError
from dase.io.sequence import Sequence
from dase.io.source import Picture, ReadOptions
from dase.recordings.interval_statistics import IntervalStatistics


@dataclass(frozen=True)
class SurveySettings:
    """How events are looked at."""

    part: int = 1 << 20
    """Events looked at together; their keys of pixel and place in the part must fit into 64 bits."""
    asked: int = 1 << 14
    """Events of the first part that are asked whether they are alone; of later parts an eighth as many."""
    alone: float = 0.01
    """Time around an event in which its 3x3 pixels see no other where it is alone [s]."""
    hot_events: int = 10
    """Events that a hot pixel has at least."""
    hot_ratio: float = 10.0
    """Times the events of those around it that a hot pixel has at least."""

    least_gap: float = 0.01
    """Time without any event [s] that is remembered; shorter ones are no gaps."""
    most_gaps: int = 1000
    """Gaps that are remembered, the longest."""

    @property
    def place_bits(self) -> int:
        """Bits of the place of an event in a part."""
        return (self.part - 1).bit_length()


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """What people ask about a recording first. Not a number where nothing can be said."""

    width: int
    """Columns of the sensor."""
    height: int
    """Rows of the sensor."""
    frames: int
    """Grey frames."""
    frame_interval: float
    """Median time from one frame to the next [s]."""
    exposure: tuple[float, float]
    """Shortest and longest exposure of a frame [s]."""
    clipped: float
    """Share of the pixels of all frames that are black or white."""
    begin: float
    """First time of an event or frame [s]."""
    duration: float
    """From the first event or frame to the last [s]."""
    events: int
    """Events of both polarities."""
    on_rate: float
    """ON events per pixel [Hz]."""
    off_rate: float
    """OFF events per pixel [Hz]."""
    on_share: float
    """ON events / events."""
    flip_share: float
    """Share of successive events of one pixel that differ in polarity."""
    alone_rate: float
    """Events with no other in their 3x3 pixels within 10 ms, per pixel [Hz]; from a sample of the events."""
    interval_shortest: float
    """0.1st percentile of the time between successive events of one pixel [s]."""
    interval_low: float
    """1st percentile of it [s]."""
    interval_median: float
    """Median of it [s]."""
    interval_high: float
    """99th percentile of it [s]."""
    interval_mode: float
    """Most frequent of it [s]."""
    intervals: tuple[tuple[float, float, int], ...]
    """Histogram of it: begin [s], end [s], number."""
    simultaneous: int
    """Pairs of events of one pixel at the same time."""
    period: float
    """Time of which short intervals are multiples, that of a readout [s]."""
    period_share: float
    """Share of the intervals that are."""
    quantum: float
    """Largest time of which all time stamps are multiples, but for a common offset [s]."""
    stamps: int
    """Different time stamps in a row."""
    longest_gap: tuple[float, float]
    """Begin [s] and length [s] of the longest time without an event."""
    gaps: tuple[tuple[float, float], ...]
    """Begin [s] and length [s] of times of 10 ms and more without any event: the 1000 longest, in order."""
    active: tuple[int, int, int, int]
    """First column, first row, columns and rows of the part that has events."""
    silent_pixels: int
    """Pixels without an event."""
    busiest_rate: float
    """Events of the pixel that has most [Hz]."""
    busiest_pixel: tuple[int, int]
    """Its column and row."""
    hot_pixels: int
    """Pixels with ten times the events of those around them."""
    hot_share: float
    """Share of the events that come from them."""
    label_shares: tuple[float, ...] | None
    """Share of the events with each of `dase.events.LABELS`; None where events have no labels."""


class RecordingSurvey:
    """Takes the events and frames of a recording, each in order of time.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        settings: How events are looked at.
    """

    def __init__(self, width: int, height: int, settings: SurveySettings = SurveySettings()) -> None:
        self.settings = settings
        self.width, self.height = width, height
        pixels = width * height
        self._on = np.zeros(pixels, np.int64)  # zeros take no memory before they are written to
        self._off = np.zeros(pixels, np.int64)
        self._last = np.zeros(pixels)
        self._polarity = np.zeros(pixels, np.bool_)
        self._pairs = self._flips = 0
        self._asked = self._alone = 0
        self._labels: NDArray[np.int64] | None = np.zeros(len(LABELS), np.int64)
        self._span = (math.inf, -math.inf)
        self._newest = math.nan
        self._gap = (math.nan, 0.0)
        self._gaps: list[tuple[float, float]] = []
        self._quantum, self._stamps = 0, 0
        self._times: list[float] = []
        self._exposures: list[float] = []
        self._clipped: list[float] = []
        self.intervals = IntervalStatistics()

    def add_events(self, part: Events) -> None:
        """Take events."""
        size = self.settings.part
        for i in range(0, len(part), size):
            self._add_part(part.select(slice(i, i + size)))

    def add_frame(self, picture: Picture) -> None:
        """Take a frame."""
        if math.isfinite(picture.t):
            self._extend_span(float(picture.t), float(picture.t))
        self._times.append(float(picture.t))
        self._exposures.append(float(picture.exposure))
        white = np.iinfo(picture.grey.dtype).max if picture.grey.dtype.kind in "iu" else 1.0
        self._clipped.append(float(np.mean((picture.grey == 0) | (picture.grey == white))))

    def hot_pixels(self) -> NDArray[np.bool_]:
        """Return which pixels have ten times the events of those around them, shape (H, W)."""
        counts = (self._on + self._off).reshape(self.height, self.width)
        # the median of 3x3 pixels, so that a hot pixel does not count among those around its neighbour
        around = cv2.medianBlur(counts.astype(np.float32), 3)
        found: NDArray[np.bool_] = counts > self.settings.hot_ratio * (around + 1)
        found &= counts >= self.settings.hot_events
        return found

    def _extend_span(self, begin: float, end: float) -> None:
        self._span = min(self._span[0], begin), max(self._span[1], end)

    def _add_part(self, part: Events) -> None:
        t = part.t
        pixel = part.y.astype(np.int64) * self.width + part.x
        order = _stable_order(pixel)
        key = (pixel[order] << self.settings.place_bits) | order
        self._look_at_stamps(t)
        self._ask_whether_alone(part, key)
        self._count_by_pixel(part, key)
        if part.label is None:
            self._labels = None
        elif self._labels is not None:
            self._labels += np.bincount(part.label, minlength=len(LABELS))
        self._extend_span(float(t[0]), float(t[-1]))
        self._newest = float(t[-1])

    def _count_by_pixel(self, part: Events, key: NDArray[np.int64]) -> None:
        """Count the events, intervals and changes of polarity of every pixel."""
        bits = self.settings.place_bits
        pixel, index = key >> bits, key & ((1 << bits) - 1)
        t, p = part.t[index], part.p[index]
        # runs of one pixel in the sorted keys; what it sent last in earlier parts joins the parts
        first = np.ones(len(t), np.bool_)
        first[1:] = pixel[1:] != pixel[:-1]
        begin = np.flatnonzero(first)
        place = pixel[begin]
        known = self._on[place] + self._off[place] > 0
        between = np.diff(t)[~first[1:]]
        self.intervals.add(np.concatenate((between, t[begin[known]] - self._last[place[known]])))
        self._pairs += len(between) + int(np.count_nonzero(known))
        self._flips += int(np.count_nonzero((p[1:] != p[:-1]) & ~first[1:]))
        self._flips += int(np.count_nonzero(p[begin[known]] != self._polarity[place[known]]))
        end = np.append(begin[1:], len(t)) - 1
        self._last[place], self._polarity[place] = t[end], p[end]
        total = np.diff(np.append(begin, len(t)))
        on = np.add.reduceat(p.astype(np.int64), begin)
        self._on[place] += on
        self._off[place] += total - on

    def _look_at_stamps(self, t: NDArray[np.float64]) -> None:
        """Look at steps from one time to the next."""
        before = np.append(t[0] if math.isnan(self._newest) else self._newest, t[:-1])
        steps = t - before
        self._stamps += int(np.count_nonzero(steps)) + int(math.isnan(self._newest))
        longest = int(np.argmax(steps))
        if steps[longest] > self._gap[1]:
            self._gap = float(before[longest]), float(steps[longest])
        for place in np.flatnonzero(steps > self.settings.least_gap).tolist():
            self._gaps.append((float(before[place]), float(steps[place])))
        if len(self._gaps) > 2 * self.settings.most_gaps:  # only the longest can be worth a word
            self._gaps = sorted(self._gaps, key=lambda gap: -gap[1])[: self.settings.most_gaps]
        if self._quantum == 0 or self._quantum > 1000:  # finer than a microsecond is of no interest
            # the greatest common divisor needs whole numbers; offsets of the clock cancel in steps
            steps_ns = np.rint(steps * 1e9).astype(np.int64)
            if self._quantum == 0 or np.any(steps_ns % self._quantum):
                self._quantum = int(np.gcd.reduce(np.append(np.unique(steps_ns), self._quantum)))

    def _ask_whether_alone(self, part: Events, key: NDArray[np.int64]) -> None:
        """Ask some events whether they are alone; those near the ends of the part would not know."""
        t, alone, most = part.t, self.settings.alone, self.settings.asked
        first, last = np.searchsorted(t, (t[0] + alone, t[-1] - alone))
        if last <= first:
            return
        # fewer of later parts, so that long recordings do not pay for what short ones need
        count = min(most if not self._asked else most // 8, last - first)
        asked = np.unique(np.linspace(first, last - 1, count).astype(np.int64))
        after = np.searchsorted(t, t[asked] + alone, side="right")
        before = np.searchsorted(t, t[asked] - alone)
        found = np.zeros(len(asked), np.int64)
        x, y = part.x[asked].astype(np.int64), part.y[asked].astype(np.int64)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                # all events of a pixel stand together and in order of time: two searches count those near
                near = ((y + dy) * self.width + x + dx) << self.settings.place_bits
                good = (x + dx >= 0) & (x + dx < self.width) & (y + dy >= 0) & (y + dy < self.height)
                count = np.searchsorted(key, near | after) - np.searchsorted(key, near | before)
                found += np.where(good, count, 0)
        self._asked += len(asked)
        self._alone += int(np.count_nonzero(found == 1))

    def statistics(self) -> Statistics:
        """Return what was found."""
        counts = self._on + self._off
        events, on, pixels = int(counts.sum()), int(self._on.sum()), len(counts)
        begin, end = self._span if self._span[0] <= self._span[1] else (0.0, 0.0)
        duration = end - begin
        hot = self.hot_pixels()
        busiest = int(counts.argmax())
        period, period_share = self.intervals.period()
        return Statistics(
            width=self.width,
            height=self.height,
            **self._frame_statistics(),
            begin=begin,
            duration=duration,
            events=events,
            on_rate=_ratio_or_nan(on, pixels * duration),
            off_rate=_ratio_or_nan(events - on, pixels * duration),
            on_share=_ratio_or_nan(on, events),
            flip_share=_ratio_or_nan(self._flips, self._pairs),
            alone_rate=_ratio_or_nan(self._alone, self._asked) * _ratio_or_nan(events, pixels * duration),
            interval_shortest=self.intervals.quantile(0.001),
            interval_low=self.intervals.quantile(0.01),
            interval_median=self.intervals.quantile(0.5),
            interval_high=self.intervals.quantile(0.99),
            interval_mode=self.intervals.mode(),
            intervals=tuple(self.intervals.histogram()),
            simultaneous=self.intervals.zeros,
            period=period,
            period_share=period_share,
            quantum=self._quantum * 1e-9 if self._quantum else math.nan,
            stamps=self._stamps,
            longest_gap=self._gap,
            gaps=tuple(sorted(sorted(self._gaps, key=lambda gap: -gap[1])[: self.settings.most_gaps])),
            active=_active_area(counts.reshape(self.height, self.width)),
            silent_pixels=int(np.count_nonzero(counts == 0)),
            busiest_rate=_ratio_or_nan(int(counts[busiest]), duration),
            busiest_pixel=(busiest % self.width, busiest // self.width),
            hot_pixels=int(np.count_nonzero(hot)),
            hot_share=_ratio_or_nan(int(counts[hot.reshape(-1)].sum()), events),
            label_shares=self._label_shares(events),
        )

    def _frame_statistics(self) -> dict[str, Any]:
        times, exposures = np.array(self._times), np.array(self._exposures)
        return {
            "frames": len(times),
            "frame_interval": float(np.median(np.diff(times))) if len(times) > 1 else math.nan,
            "exposure": (float(exposures.min()), float(exposures.max()))
            if exposures.any()
            else (math.nan, math.nan),
            "clipped": float(np.mean(self._clipped)) if self._clipped else math.nan,
        }

    def _label_shares(self, events: int) -> tuple[float, ...] | None:
        if self._labels is None or not events:
            return None
        return tuple(float(count) / events for count in self._labels)


def _stable_order(pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the order of pixels below 2^32, (N,), in which those of one stay in order."""
    # NumPy sorts numbers of 8 and 16 bits by their digits, in half of the time that one sort of 64 bits takes
    order = np.argsort(pixel.astype(np.uint16), kind="stable")
    high = (pixel >> 16).astype(np.uint16)
    high = high.astype(np.uint8) if high.max(initial=0) < 256 else high
    return order[np.argsort(high[order], kind="stable")]


def _ratio_or_nan(a: float, b: float) -> float:
    return a / b if b > 0 else math.nan


def _active_area(counts: NDArray[np.int64]) -> tuple[int, int, int, int]:
    columns, rows = np.flatnonzero(counts.any(0)), np.flatnonzero(counts.any(1))
    if not len(columns):
        return 0, 0, 0, 0
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1


def survey_file(
    path: str | PathLike[str],
    *,
    notes: list[str] | None = None,
    progress: Callable[[int], object] = lambda count: None,
    **options: Unpack[ReadOptions],
) -> RecordingSurvey:
    """Look at a file piece by piece; only one whose times go back far is held in memory.

    Args:
        path: Any file that `dase.io.read` takes.
        options: What is known about the file, and the part to read, see `dase.io.ReadOptions`.
        notes: Gets sentences about what was skipped, repaired or guessed.
        progress: Is told how many events were looked at since it was told last.

    Raises:
        InputError: As for `dase.io.read`.
    """
    out: RecordingSurvey | None = None
    try:
        for part in io.stream(path, notes=notes, **options):
            out = out or RecordingSurvey(part.width, part.height)
            out.add_events(part)
            progress(len(part))
    except TooLateError:
        return survey_sequence(io.read(path, notes=notes, **options))
    assert out is not None  # a stream has at least one part
    for picture in io.pictures(path, notes=notes, **options):
        out.add_frame(picture)
    return out


def survey_sequence(sequence: Sequence, settings: SurveySettings = SurveySettings()) -> RecordingSurvey:
    """Look at a whole sequence."""
    out = RecordingSurvey(sequence.events.width, sequence.events.height, settings)
    out.add_events(sequence.events)
    if sequence.frames is not None:
        unknown = np.full(len(sequence.frames), math.nan)
        times = unknown if sequence.frame_times is None else sequence.frame_times
        exposures = np.zeros(len(unknown)) if sequence.frame_exposure is None else sequence.frame_exposure
        for grey, time, exposure in zip(sequence.frames, times, exposures, strict=True):
            out.add_frame(Picture(grey, time, float(exposure)))
    return out


def sequence_statistics(sequence: Sequence) -> Statistics:
    """Return the statistics of a whole sequence."""
    return survey_sequence(sequence).statistics()
