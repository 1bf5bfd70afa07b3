"""What the statistics of a recording say, as a table, a histogram or JSON."""

from __future__ import annotations

import math
from typing import Any

from dase.events import LABELS
from dase.formatting import format_count, format_metric, format_percent, format_seconds
from dase.io.source import Note
from dase.recordings.statistics import Statistics


def statistics_table(statistics: Statistics) -> list[tuple[str, str]]:
    """Return what the statistics say as (name, value with unit)."""
    s = statistics
    pixels = s.width * s.height
    x, y = s.busiest_pixel
    shares = zip(LABELS, s.label_shares or (), strict=False)
    said = ", ".join(f"{name} {100 * share:.1f} %" for name, share in shares)
    return [
        ("sensor", f"{s.width} x {s.height}"),
        (
            "duration",
            format_seconds(s.duration) + (f", from {s.begin:.3f} s on" if abs(s.begin) >= 1e-3 else ""),
        ),
        ("events", format_count(s.events)),
        ("ON rate", f"{s.on_rate:.3g} events/pixel/s"),
        ("OFF rate", f"{s.off_rate:.3g} events/pixel/s"),
        ("ON share", f"{100 * s.on_share:.1f} %" if s.events else "unknown"),
        ("polarity flips", f"{format_percent(s.flip_share)} of successive events of a pixel"),
        ("isolated events", f"{s.alone_rate:.3g} events/pixel/s" if s.alone_rate >= 0 else "unknown"),
        ("interval, 0.1 %", format_seconds(s.interval_shortest)),
        ("interval, 1 %", format_seconds(s.interval_low)),
        ("interval, median", format_seconds(s.interval_median)),
        ("interval, 99 %", format_seconds(s.interval_high)),
        ("interval, modal", format_seconds(s.interval_mode)),
        ("time stamps", _describe_stamps(s)),
        ("readout period", _describe_period(s)),
        ("silent pixels", f"{format_count(s.silent_pixels)} ({100 * s.silent_pixels / pixels:.1f} %)"),
        ("busiest pixel", f"{format_metric(s.busiest_rate, 'Hz')} at ({x}, {y})" if s.events else "none"),
        ("hot pixels", _describe_hot_pixels(s)),
        *([("labels", said)] if said else []),
        ("frames", _describe_frames(s)),
    ]


def _describe_stamps(s: Statistics) -> str:
    if not s.events or not s.quantum > 0:
        return "unknown"
    step = f"multiples of {format_seconds(s.quantum)}" if s.quantum >= 1e-6 else "finer than 1 µs"
    return f"{step}, {s.events / s.stamps:.3g} events at each"


def _describe_period(s: Statistics) -> str:
    if not s.period > 0:
        return "none seen"
    return f"{format_seconds(s.period)} ({format_percent(s.period_share)} of short intervals are multiples)"


def _describe_hot_pixels(s: Statistics) -> str:
    if not s.hot_pixels:
        return "none"
    share = format_percent(s.hot_pixels / (s.width * s.height))
    return f"{format_count(s.hot_pixels)} ({share}), {format_percent(s.hot_share)} of the events"


def _describe_frames(s: Statistics) -> str:
    if not s.frames:
        return "none"
    short, long = s.exposure
    pace = f", every {format_seconds(s.frame_interval)}" if s.frame_interval > 0 else ", times unknown"
    if not long > 0:
        return f"{format_count(s.frames)}{pace}, exposure unknown"
    exposed = (
        format_seconds(long)
        if long - short < 0.01 * long
        else f"{format_seconds(short)} to {format_seconds(long)}"
    )
    return f"{format_count(s.frames)}{pace}, exposed {exposed}"


def interval_histogram(statistics: Statistics, *, width: int = 40) -> list[str]:
    """Return lines that draw how long the times between events of one pixel are, two bins per decade."""
    bins = statistics.intervals
    total = sum(count for *_, count in bins)
    most = max((count for *_, count in bins), default=1)
    out = []
    for begin, end, count in bins:
        eighths = max(round(8 * width * count / most), int(count > 0))
        bar = "█" * (eighths // 8) + " ▏▎▍▌▋▊▉"[eighths % 8].strip()
        span = f"{format_seconds(_round_edge(begin)):>7} .. {format_seconds(_round_edge(end)):<7}"
        out.append(f"{span} {format_percent(count / total):>7}  {bar}")
    return out


def as_json(format: str, statistics: Statistics, notes: list[Note]) -> dict[str, Any]:
    """Return statistics and notes for machines: numbers in SI units, None where nothing can be said."""

    def plain(value: Any) -> Any:
        if isinstance(value, tuple):
            return [plain(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    said = {name: plain(value) for name, value in vars(statistics).items()}
    return {"format": format, **said, "notes": [note.fields() for note in notes]}


def _round_edge(value: float) -> float:
    """Round an edge of a bin, 1 or 3.16 times a power of ten, to one digit."""
    return float(f"{value:.0e}")
