"""What looks odd in a recording: one sentence for each, judged from its statistics. Nothing is changed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from dase.formatting import format_count, format_percent, format_seconds
from dase.io.source import Note
from dase.recordings.statistics import Statistics


@dataclass(frozen=True)
class AnomalySettings:
    """From where on a statistic counts as odd."""

    least_events: int = 100
    """Fewer events say nothing about the share of polarities."""
    one_sided: float = 0.95
    """Share of one polarity; unequal thresholds alone seldom make so much."""
    least_events_for_flips: int = 1000
    """Fewer events say nothing about how polarities follow each other."""
    flips: float = 0.9
    """Share of successive events of a pixel that differ in polarity: moving edges come in runs."""
    bare: float = 0.05
    """Share of the columns or rows at one side without an event, where the others have many."""
    bare_lines: int = 3
    """So few columns or rows may be bare on a small sensor, too."""
    hot_share: float = 0.01
    """Share of the events that hot pixels may send."""
    hot_pixels: float = 0.001
    """Share of the pixels that may be hot."""
    shortest_interval: float = 2e-6
    """Time in which no pixel sends two events [s]."""
    simultaneous: float = 0.001
    """Share of the events that may be of the same pixel and time as another."""
    least_simultaneous: int = 9
    """So few of them are never odd."""
    gap: float = 0.01
    """Time without an event [s] that is odd where it is also `gaps` times the usual one."""
    gaps: float = 50.0
    """Times the mean time from one time stamp to the next."""
    coarse: float = 1e-5
    """Step of time stamps [s]; latencies and short intervals drown in a larger one."""
    exposure: float = 1.01
    """Exposure as a share of the time between frames; a camera cannot expose longer, but clocks round."""
    clipped: float = 0.3
    """Share of black and white pixels in frames."""
    alike: float = 0.2
    """By how much gaps that repeat differ in length, as a share of it."""
    repeated: int = 3
    """Gaps of one length that make one that repeats."""


def find_anomalies(s: Statistics, settings: AnomalySettings = AnomalySettings()) -> list[Note]:
    """Return what looks odd, as notes of the kind "odd".

    Args:
        s: Statistics of the recording.
        settings: From where on a statistic counts as odd.
    """
    if not s.events:
        return [Note("there are no events", "odd", "empty")]
    looks = (_polarity_anomalies, _place_anomalies, _time_anomalies, _frame_anomalies)
    return [note for look in looks for note in look(s, settings)]


def _polarity_anomalies(s: Statistics, limits: AnomalySettings) -> Iterator[Note]:
    if s.events >= limits.least_events and not 1 - limits.one_sided <= s.on_share <= limits.one_sided:
        name, share = ("ON", s.on_share) if s.on_share > 0.5 else ("OFF", 1 - s.on_share)
        text = f"{format_percent(share)} of the events are {name}: their polarity may be lost"
        yield Note(text, "odd", "polarity")
    if s.events >= limits.least_events_for_flips and s.flip_share > limits.flips:
        flips = format_percent(s.flip_share)
        text = f"{flips} of the successive events of a pixel differ in polarity: flicker, or noise"
        yield Note(text, "odd", "flips")


def _place_anomalies(s: Statistics, limits: AnomalySettings) -> Iterator[Note]:
    x, y, width, height = s.active
    inside = s.silent_pixels - (s.width * s.height - width * height)
    # where most of the active part is silent as well, bare columns say nothing
    if inside < 0.5 * width * height:
        for name, first, count, all_ in (("columns", x, width, s.width), ("rows", y, height, s.height)):
            spans = [(0, first - 1), (first + count, all_ - 1)]
            bare = [f"{a}..{b}" for a, b in spans if b - a + 1 > max(limits.bare * all_, limits.bare_lines)]
            if bare:
                yield Note(f"no event in {name} {' and '.join(bare)}", "odd", "bare", all_ - count)
    most = limits.hot_pixels * s.width * s.height
    if s.hot_pixels and (s.hot_share > limits.hot_share or s.hot_pixels > most):
        share = format_percent(s.hot_share)
        text = f"{format_count(s.hot_pixels)} hot pixels send {share} of the events"
        yield Note(text, "odd", "hot", s.hot_pixels)


def _time_anomalies(s: Statistics, limits: AnomalySettings) -> Iterator[Note]:
    if s.interval_low <= limits.shortest_interval:
        soon = format_seconds(limits.shortest_interval)
        text = f"more than 1 % of the times between events of one pixel are {soon} or less"
        yield Note(text, "odd", "fast")
    if s.simultaneous > max(limits.simultaneous * s.events, limits.least_simultaneous):
        text = f"{format_count(s.simultaneous)} events are of the same pixel and time as another"
        yield Note(text, "odd", "duplicate", s.simultaneous)
    yield from _gap_anomalies(s, limits)
    if s.quantum > limits.coarse:
        text = f"all time stamps are whole multiples of {format_seconds(s.quantum)}"
        yield Note(text, "odd", "coarse")


def _gap_anomalies(s: Statistics, limits: AnomalySettings) -> Iterator[Note]:
    """Name the gaps: one, several, or one that comes again and again with the same length."""
    least = max(limits.gap, limits.gaps * s.duration / max(s.stamps, 1))
    gaps = [gap for gap in s.gaps if gap[1] > least]
    if not gaps:
        return
    longest = max(gaps, key=lambda gap: gap[1])
    lengths = sorted(length for _, length in gaps)
    middle = lengths[len(lengths) // 2]
    alike = [gap for gap in gaps if abs(gap[1] - middle) <= limits.alike * middle]
    if len(alike) >= limits.repeated:
        begins = [begin for begin, _ in alike]
        steps = sorted(b - a for a, b in pairwise(begins))
        every, total = steps[len(steps) // 2], sum(length for _, length in alike)
        regular = steps[-1] - steps[0] <= limits.alike * every
        pace = f"every {format_seconds(every)}" if regular else f"some {format_seconds(every)} apart"
        text = (
            f"no event at all for {format_seconds(middle)}, {len(alike)} times, {pace}, "
            f"from {begins[0]:.3f} s on: {format_percent(total / s.duration)} of the time may be missing"
        )
        yield Note(text, "odd", "gap", len(alike))
        gaps = [gap for gap in gaps if gap not in alike]
        if not gaps:
            return
        longest = max(gaps, key=lambda gap: gap[1])
    text = (
        f"no event at all for {format_seconds(longest[1])}, from {longest[0]:.3f} s on: data may be missing"
    )
    if len(gaps) > 1:
        text += f"; {len(gaps)} such gaps"
    yield Note(text, "odd", "gap", len(gaps))


def _frame_anomalies(s: Statistics, limits: AnomalySettings) -> Iterator[Note]:
    if not s.frames:
        return
    if math.isnan(s.frame_interval) and s.frames > 1:
        yield Note("the times of the frames are not known", "odd", "frames")
    elif math.isnan(s.exposure[1]):
        # a simulator's frames are of an instant, cameras' files may not tell: both come without an exposure
        text = "no exposure is given for the frames: they count as light of one instant"
        yield Note(text, "odd", "exposure")
    elif s.exposure[1] > limits.exposure * s.frame_interval:
        exposure, interval = format_seconds(s.exposure[1]), format_seconds(s.frame_interval)
        text = f"frames are exposed for {exposure} but come every {interval}"
        yield Note(text, "odd", "exposure")
    if s.clipped > limits.clipped:
        yield Note(
            f"{format_percent(s.clipped)} of the pixels of the frames are black or white", "odd", "clipped"
        )
