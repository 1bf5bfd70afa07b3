"""What looks odd in a recording: one sentence for each, judged from its statistics. Nothing is changed."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dase.formatting import format_count, format_percent, format_seconds
from dase.io.source import Note
from dase.recordings.statistics import Statistics

ONE_SIDED = 0.95  # share of one polarity
BARE = 0.05  # of the columns or rows without an event, where the others have many
HOT = 0.01  # share of the events
HOT_PIXELS = 0.001  # share of the pixels
FASTEST = 2e-6  # [s] no pixel sends two events so soon
GAP = 0.01  # [s] without an event, where it is also
GAPS = 50.0  # times as long as most
COARSE = 1e-5  # [s] of time stamps
FLIPS = 0.9  # share of successive events that differ in polarity
CLIPPED = 0.3  # share of black and white pixels in frames


def find_anomalies(s: Statistics) -> list[Note]:
    """Return what looks odd, as notes of the kind "odd"."""
    if not s.events:
        return [Note("there are no events", "odd", "empty")]
    return [*_polarity_anomalies(s), *_place_anomalies(s), *_time_anomalies(s), *_frame_anomalies(s)]


def _polarity_anomalies(s: Statistics) -> Iterator[Note]:
    if s.events >= 100 and not 1 - ONE_SIDED <= s.on_share <= ONE_SIDED:
        name, share = ("ON", s.on_share) if s.on_share > 0.5 else ("OFF", 1 - s.on_share)
        text = f"{format_percent(share)} of the events are {name}: their polarity may be lost"
        yield Note(text, "odd", "polarity")
    if s.events >= 1000 and s.flip_share > FLIPS:
        flips = format_percent(s.flip_share)
        text = f"{flips} of the successive events of a pixel differ in polarity: flicker, or noise"
        yield Note(text, "odd", "flips")


def _place_anomalies(s: Statistics) -> Iterator[Note]:
    x, y, width, height = s.active
    inside = s.silent_pixels - (s.width * s.height - width * height)
    if inside < 0.5 * width * height:
        for name, first, count, all_ in (("columns", x, width, s.width), ("rows", y, height, s.height)):
            spans = [(0, first - 1), (first + count, all_ - 1)]
            bare = [f"{a}..{b}" for a, b in spans if b - a + 1 > max(BARE * all_, 3)]
            if bare:
                yield Note(f"no event in {name} {' and '.join(bare)}", "odd", "bare", all_ - count)
    if s.hot_pixels and (s.hot_share > HOT or s.hot_pixels > HOT_PIXELS * s.width * s.height):
        share = format_percent(s.hot_share)
        text = f"{format_count(s.hot_pixels)} hot pixels send {share} of the events"
        yield Note(text, "odd", "hot", s.hot_pixels)


def _time_anomalies(s: Statistics) -> Iterator[Note]:
    if s.interval_low <= FASTEST:
        text = f"more than 1 % of the times between events of one pixel are {format_seconds(FASTEST)} or less"
        yield Note(text, "odd", "fast")
    if s.simultaneous > max(0.001 * s.events, 9):
        text = f"{format_count(s.simultaneous)} events are of the same pixel and time as another"
        yield Note(text, "odd", "duplicate", s.simultaneous)
    begin, length = s.longest_gap
    if length > max(GAP, GAPS * s.duration / max(s.stamps, 1)):
        text = f"no event at all for {format_seconds(length)}, from {begin:.3f} s on: data may be missing"
        yield Note(text, "odd", "gap")
    if s.quantum > COARSE:
        text = f"all time stamps are whole multiples of {format_seconds(s.quantum)}"
        yield Note(text, "odd", "coarse")


def _frame_anomalies(s: Statistics) -> Iterator[Note]:
    if not s.frames:
        return
    if math.isnan(s.frame_interval) and s.frames > 1:
        yield Note("the times of the frames are not known", "odd", "frames")
    elif math.isnan(s.exposure[1]):
        yield Note("the exposure of the frames is not known, or an instant", "odd", "exposure")
    elif s.exposure[1] > 1.01 * s.frame_interval:
        text = f"frames are exposed for {format_seconds(s.exposure[1])} but come every {format_seconds(s.frame_interval)}"
        yield Note(text, "odd", "exposure")
    if s.clipped > CLIPPED:
        yield Note(
            f"{format_percent(s.clipped)} of the pixels of the frames are black or white", "odd", "clipped"
        )
