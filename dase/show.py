"""Look at a sequence: statistics, a contact sheet, a video."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import LABELS, Events
from dase.io.sequence import Sequence, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ON, OFF = "#c0392b", "#2f6fb5"
FRAME_RATE = 30.0  # video frames per second where the sequence does not say better


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """What people ask about a recording first. Not a number where nothing can be said."""

    width: int
    """Columns of the sensor."""
    height: int
    """Rows of the sensor."""
    frames: int
    """Grey frames."""
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
    interval_low: float
    """1st percentile of the time between successive events of one pixel [s]."""
    interval_median: float
    """Median of it [s]."""
    interval_high: float
    """99th percentile of it [s]."""
    silent_pixels: int
    """Pixels without an event."""
    busiest_rate: float
    """Events of the pixel that has most [Hz]."""
    busiest_pixel: tuple[int, int]
    """Its column and row."""
    label_shares: tuple[float, ...] | None
    """Share of the events with each of `dase.events.LABELS`; None where events have no labels."""


def statistics(sequence: Sequence) -> Statistics:
    """Compute the statistics of a sequence."""
    return _statistics(sequence, intervals(sequence.events))


def _statistics(sequence: Sequence, between: NDArray[np.float64]) -> Statistics:
    events = sequence.events
    pixels = events.width * events.height
    per_pixel = np.bincount(_flat(events), minlength=pixels)
    busiest = int(per_pixel.argmax())
    begin, end = sequence.span
    duration = end - begin
    on = int(np.count_nonzero(events.p))

    def ratio(a: float, b: float) -> float:
        return a / b if b > 0 else math.nan

    low, median, high = np.percentile(between, (1, 50, 99)) if len(between) else (math.nan,) * 3
    return Statistics(
        width=events.width,
        height=events.height,
        frames=0 if sequence.frames is None else len(sequence.frames),
        duration=duration,
        events=len(events),
        on_rate=ratio(on, pixels * duration),
        off_rate=ratio(len(events) - on, pixels * duration),
        on_share=ratio(on, len(events)),
        interval_low=float(low),
        interval_median=float(median),
        interval_high=float(high),
        silent_pixels=int(np.count_nonzero(per_pixel == 0)),
        busiest_rate=ratio(int(per_pixel[busiest]), duration),
        busiest_pixel=(busiest % events.width, busiest // events.width),
        label_shares=_label_shares(events),
    )


def _label_shares(events: Events) -> tuple[float, ...] | None:
    if events.label is None or not len(events):
        return None
    counts = np.bincount(events.label, minlength=len(LABELS))
    return tuple(float(count) / len(events) for count in counts)


def intervals(events: Events) -> NDArray[np.float64]:
    """Return the times between successive events of one pixel [s], over all pixels, in no useful order."""
    # one sort of (pixel, index) in 64 bits is several times faster than a stable argsort of the pixels
    key = (_flat(events) << 32) | np.arange(len(events))
    key.sort()
    pixel, time = key >> 32, events.t[key & 0xFFFFFFFF]
    between: NDArray[np.float64] = np.diff(time)[pixel[1:] == pixel[:-1]]
    return between


def _flat(events: Events) -> NDArray[np.int64]:
    return events.y.astype(np.int64) * events.width + events.x


def table(statistics: Statistics) -> list[tuple[str, str]]:
    """Return what the statistics say as (name, value with unit)."""
    s = statistics
    pixels = s.width * s.height
    x, y = s.busiest_pixel
    shares = zip(LABELS, s.label_shares or (), strict=False)
    said = ", ".join(f"{name} {100 * share:.1f} %" for name, share in shares)
    return [
        ("sensor", f"{s.width} x {s.height}"),
        ("duration", seconds(s.duration)),
        ("frames", f"{s.frames}"),
        ("events", grouped(s.events)),
        ("ON rate", f"{s.on_rate:.3g} events/pixel/s"),
        ("OFF rate", f"{s.off_rate:.3g} events/pixel/s"),
        ("ON share", f"{100 * s.on_share:.1f} %" if s.events else "unknown"),
        ("interval, 1 %", seconds(s.interval_low)),
        ("interval, median", seconds(s.interval_median)),
        ("interval, 99 %", seconds(s.interval_high)),
        ("silent pixels", f"{grouped(s.silent_pixels)} ({100 * s.silent_pixels / pixels:.1f} %)"),
        ("busiest pixel", f"{_metric(s.busiest_rate, 'Hz')} at ({x}, {y})" if s.events else "none"),
        *([("labels", said)] if said else []),
    ]


def grouped(count: int) -> str:
    """Return a count with its thousands set apart."""
    return f"{count:,}".replace(",", "\N{NO-BREAK SPACE}")


def seconds(value: float) -> str:
    """Return a time with three digits in a unit that fits: 12.1 s, 3.25 ms, 75 µs."""
    return _metric(value, "s")


def _metric(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "unknown"
    scales = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))
    scale, prefix = next((pair for pair in scales if abs(value) >= 0.9995 * pair[0]), scales[-1])
    digits = max(0, 2 - math.floor(math.log10(abs(value) / scale * 1.0005))) if value else 0
    text = f"{value / scale:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} {prefix}{unit}"


def default_window(sequence: Sequence) -> float:
    """Return a window [s] of 1, 2 or 5 times a power of ten that shows about one event in ten pixels."""
    begin, end = sequence.span
    events = sequence.events
    wanted = 1 / FRAME_RATE
    if len(events) and end > begin:
        rate = len(events) / (end - begin) / (events.width * events.height)
        wanted = min(0.1 / rate, wanted, end - begin)
    power = 10.0 ** math.floor(math.log10(wanted) + 1e-9)
    return power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))


def overlay(grey: NDArray[np.uint8] | None, counts: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Lay events over a frame: red ON, blue OFF, the more of them the less of the frame shows through.

    Args:
        grey: Frame, shape (H, W); None is white.
        counts: OFF and ON events, shape (2, H, W).

    Returns:
        Red, green and blue, shape (H, W, 3).
    """
    base = np.full(counts.shape[1:], 1.0) if grey is None else 0.22 + 0.7 * (grey / 255.0) ** 0.8
    total = counts.sum(0)
    colours = np.array([[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in (OFF, ON)])
    mixed = np.tensordot(counts / np.maximum(total, 1), colours, axes=(0, 0))  # (H, W, 3)
    alpha = np.where(total > 0, 1 - 0.35 * 0.5 ** (total - 1.0), 0.0)[..., None]
    blend: NDArray[np.float64] = (1 - alpha) * base[..., None] + alpha * mixed
    return np.rint(255 * blend).astype(np.uint8)


def draw(
    sequence: Sequence,
    *,
    title: str = "",
    at: float | None = None,
    window: float | None = None,
    moments: int = 6,
) -> Figure:
    """Draw moments of a sequence, its event rate and the intervals between events of one pixel.

    Args:
        sequence: What to show.
        title: Name over the sheet.
        at: Show this time only [s].
        window: Events of this span around each moment are shown [s]; default: `default_window`.
        moments: How many moments to show.

    Raises:
        InputError: `at` lies outside the sequence, or `window` is not positive.
    """
    from dase import sheet

    begin, end = sequence.span
    if at is not None and not begin <= at <= end:
        raise InputError(f"at: must lie in {begin:g}..{end:g} s, got {at:g} s")
    window = _checked_window(sequence, window)
    between = intervals(sequence.events)
    times = [at] if at is not None else moment_times(sequence, moments)
    dots = 360 if len(times) > 1 else 1300  # dots across a picture that stay visible on the sheet
    shrink = math.ceil(sequence.events.width / dots)
    panels = [panel(sequence, time, window, shrink=shrink) for time in times]
    return sheet.draw(sequence, _statistics(sequence, between), between, panels, times, window, title)


def panel(sequence: Sequence, time: float, window: float, *, shrink: int = 1) -> NDArray[np.uint8]:
    """Return the frame nearest to `time` [s] with the events of a window [s] around it over it.

    With `shrink`, that many rows and columns become one, and no event is lost. Shape (H, W, 3).
    """
    counts = sequence.events.counts([time - window / 2, time + window / 2])[0]
    frame = None
    if sequence.frames is not None and len(sequence.frames):
        frame = sequence.frames[int(np.abs(frame_times(sequence) - time).argmin())]
    if shrink > 1:
        for axis in (1, 2):
            counts = np.add.reduceat(counts, np.arange(0, counts.shape[axis], shrink), axis)
        frame = None if frame is None else frame[::shrink, ::shrink]
    return overlay(frame, counts)


def frame_times(sequence: Sequence) -> NDArray[np.float64]:
    """Return the times of the frames [s], shape (F,); spread evenly over the events where unknown."""
    if sequence.frame_times is not None:
        return sequence.frame_times
    count = 0 if sequence.frames is None else len(sequence.frames)
    return np.linspace(*sequence.span, count)


def moment_times(sequence: Sequence, count: int) -> list[float]:
    """Return times [s] that show the whole sequence: those of frames where there are any."""
    begin, end = sequence.span
    times = begin + (end - begin) * (np.arange(count) + 0.5) / count
    known = frame_times(sequence)
    if len(known):
        times = np.unique(known[np.abs(known[:, None] - times).argmin(0)])
    return [float(time) for time in times]


def video(sequence: Sequence, path: Path, *, window: float | None = None) -> None:
    """Write a video: every frame with the events since the frame before over it.

    Frames are shown at their own pace up to 60 per second, faster ones at 30. Without frames each picture
    is one window; sequences shorter than two seconds are then slowed down.

    Args:
        sequence: What to show.
        path: An .mp4 file; appears when it is complete.
        window: Span of events in each picture [s]; default: the time between frames, or 1/30 s.

    Raises:
        InputError: `window` is not positive, or no video can be written here.
    """
    import cv2

    if window is not None:
        _checked_window(sequence, window)
    begins, ends, rate = _video_times(sequence, window)
    scale = max(1, math.ceil(480 / sequence.events.width))
    size = tuple(n * scale // 2 * 2 for n in (sequence.events.width, sequence.events.height))
    with replacing(path) as temporary:
        out = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
        if not out.isOpened():
            raise InputError(f"{path}: OpenCV cannot write this video")
        try:
            for picture in _pictures(sequence, begins, ends, scale):
                out.write(np.ascontiguousarray(picture[: size[1], : size[0], ::-1]))
        finally:
            out.release()


def _video_times(
    sequence: Sequence, window: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return begin and end [s] of each picture, begin < t <= end, both (K,), and pictures per second."""
    begin, end = sequence.span
    if sequence.frames is not None and len(sequence.frames):
        ends = frame_times(sequence)
        pace = float(np.median(np.diff(ends))) if len(ends) > 1 else 0.0
        rate = 1 / pace if pace >= 1 / 60.5 else FRAME_RATE
        begins = np.append(ends[0] - pace, ends[:-1]) if window is None else ends - window
        return begins, ends, rate
    if window is None:
        window = min(1 / FRAME_RATE, (end - begin) / 60) or 1 / FRAME_RATE
    count = max(1, math.ceil((end - begin) / window - 1e-9))
    edges = begin + np.cumsum(np.append(0.0, np.full(count, window)))
    edges[0], edges[-1] = np.nextafter(begin, -math.inf), max(edges[-1], end)
    return edges[:-1], edges[1:], FRAME_RATE


def _pictures(
    sequence: Sequence, begins: NDArray[np.float64], ends: NDArray[np.float64], scale: int
) -> Iterator[NDArray[np.uint8]]:
    import cv2

    for index, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        frame = None if sequence.frames is None else sequence.frames[index]
        edges = np.nextafter((begin, end), math.inf)  # an event at the time of the frame belongs to it
        picture = overlay(frame, sequence.events.counts(edges)[0])
        picture = picture.repeat(scale, 0).repeat(scale, 1)
        place: dict[str, Any] = {"org": (10, 24), "fontFace": cv2.FONT_HERSHEY_SIMPLEX, "fontScale": 0.6}
        for colour, thickness in ((40, 4), (255, 1)):
            cv2.putText(
                picture, f"{end:.3f} s", color=(colour,) * 3, thickness=thickness, lineType=16, **place
            )
        yield picture


def _checked_window(sequence: Sequence, window: float | None) -> float:
    if window is None:
        return default_window(sequence)
    if not 0 < window < math.inf:
        raise InputError(f"window: must be above 0 s, got {window:g} s")
    return window
