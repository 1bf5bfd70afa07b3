"""Look at a sequence: statistics, a contact sheet, a video."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.figures import contact_sheet
from dase.figures.style import Colour
from dase.io.sequence import Sequence, replacing
from dase.io.video_writer import VideoCodec, open_video_writer
from dase.recordings.statistics import RecordingSurvey, survey_sequence

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT_FRAME_RATE = 30.0
"""Pictures per second of a video where the sequence does not say better [Hz]."""


def default_window(sequence: Sequence) -> float:
    """Return a window [s] of 1, 2 or 5 times a power of ten that shows about one event in ten pixels."""
    begin, end = sequence.span
    events = sequence.events
    wanted = 1 / DEFAULT_FRAME_RATE
    if len(events) and end > begin:
        rate = len(events) / (end - begin) / (events.width * events.height)
        wanted = min(0.1 / rate, wanted, end - begin)
    power = 10.0 ** math.floor(math.log10(wanted) + 1e-9)
    return power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))


def overlay_events(grey: NDArray[Any] | None, counts: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Lay events over a frame: red ON, blue OFF, the more of them the less of the frame shows through.

    Args:
        grey: Frame of 8 to 16 bits, shape (H, W); None is white.
        counts: OFF and ON events, shape (2, H, W).

    Returns:
        Red, green and blue, shape (H, W, 3).
    """
    base = np.full(counts.shape[1:], 1.0) if grey is None else 0.22 + 0.7 * (grey / _white_level(grey)) ** 0.8
    total = counts.sum(0)
    colours = np.array(
        [[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in (Colour.OFF, Colour.ON)]
    )
    mixed = np.tensordot(counts / np.maximum(total, 1), colours, axes=(0, 0))  # (H, W, 3)
    alpha = np.where(total > 0, 1 - 0.35 * 0.5 ** (total - 1.0), 0.0)[..., None]
    blend: NDArray[np.float64] = (1 - alpha) * base[..., None] + alpha * mixed
    return np.rint(255 * blend).astype(np.uint8)


def _white_level(grey: NDArray[Any]) -> float:
    """Return the largest number of the 8, 10, 12, 14 or 16 bits that a frame makes use of."""
    return float(
        (1 << next(bits for bits in (8, 10, 12, 14, 16) if int(grey.max(initial=0)) < 1 << bits)) - 1
    )


def draw_sequence(
    sequence: Sequence,
    *,
    title: str = "",
    at: float | None = None,
    window: float | None = None,
    moments: int = 6,
    survey: RecordingSurvey | None = None,
) -> Figure:
    """Draw moments of a sequence, its event rate and the intervals between events of one pixel.

    Args:
        sequence: What to show.
        title: Name over the sheet.
        at: Show this time only [s].
        window: Events of this span around each moment are shown [s]; default: `default_window`.
        moments: How many moments to show.
        survey: Of the sequence, where it was looked at before; else it is now.

    Raises:
        InputError: `at` lies outside the sequence, or `window` is not positive.
    """
    begin, end = sequence.span
    if at is not None and not begin <= at <= end:
        raise InputError(f"at: must lie in {begin:g}..{end:g} s, got {at:g} s")
    window = _checked_window(sequence, window)
    times = [at] if at is not None else moment_times(sequence, moments)
    dots = 360 if len(times) > 1 else 1300  # dots across a picture that stay visible on the sheet
    shrink = math.ceil(sequence.events.width / dots)
    panels = [moment_picture(sequence, time, window, shrink=shrink) for time in times]
    survey = survey_sequence(sequence) if survey is None else survey
    return contact_sheet.draw_contact_sheet(sequence, survey, panels, times, window, title)


def moment_picture(sequence: Sequence, time: float, window: float, *, shrink: int = 1) -> NDArray[np.uint8]:
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
    return overlay_events(frame, counts)


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


CODECS = (VideoCodec("avc1", True), VideoCodec("vp09", True), VideoCodec("mp4v", False))
"""H.264, VP9 and MPEG-4, of which builds of OpenCV for free software often lack the first."""


def write_video(sequence: Sequence, path: Path, *, window: float | None = None) -> VideoCodec:
    """Write a video: every frame with the events since the frame before over it.

    Frames are shown at their own pace up to 60 per second, faster ones at 30. Without frames each picture
    is one window; sequences shorter than two seconds are then slowed down.

    Args:
        sequence: What to show.
        path: An .mp4 file; appears when it is complete.
        window: Span of events in each picture [s]; default: the time between frames, or 1/30 s.

    Returns:
        What it is packed in: the first of `CODECS` that OpenCV has here.

    Raises:
        InputError: `window` is not positive, or no video can be written here.
    """
    if window is not None:
        _checked_window(sequence, window)
    begins, ends, rate = _video_times(sequence, window)
    scale = max(1, math.ceil(480 / sequence.events.width))
    size = tuple(n * scale // 2 * 2 for n in (sequence.events.width, sequence.events.height))
    with replacing(path) as temporary:
        out, codec = open_video_writer(temporary, rate, size, CODECS)
        if out is None:
            raise InputError(f"{path}: OpenCV cannot write this video")
        try:
            for picture in _video_pictures(sequence, begins, ends, scale):
                out.write(np.ascontiguousarray(picture[: size[1], : size[0], ::-1]))
        finally:
            out.release()
    return codec


def _video_times(
    sequence: Sequence, window: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return begin and end [s] of each picture, begin < t <= end, both (K,), and pictures per second."""
    begin, end = sequence.span
    if sequence.frames is not None and len(sequence.frames):
        ends = frame_times(sequence)
        pace = float(np.median(np.diff(ends))) if len(ends) > 1 else 0.0
        rate = 1 / pace if pace >= 1 / 60.5 else DEFAULT_FRAME_RATE
        begins = np.append(ends[0] - pace, ends[:-1]) if window is None else ends - window
        return begins, ends, rate
    if window is None:
        window = min(1 / DEFAULT_FRAME_RATE, (end - begin) / 60) or 1 / DEFAULT_FRAME_RATE
    count = max(1, math.ceil((end - begin) / window - 1e-9))
    edges = begin + np.cumsum(np.append(0.0, np.full(count, window)))
    edges[0], edges[-1] = np.nextafter(begin, -math.inf), max(edges[-1], end)
    return edges[:-1], edges[1:], DEFAULT_FRAME_RATE


def _video_pictures(
    sequence: Sequence, begins: NDArray[np.float64], ends: NDArray[np.float64], scale: int
) -> Iterator[NDArray[np.uint8]]:
    import cv2  # only videos of sequences need it

    for index, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        frame = None if sequence.frames is None else sequence.frames[index]
        edges = np.nextafter((begin, end), math.inf)  # an event at the time of the frame belongs to it
        picture = overlay_events(frame, sequence.events.counts(edges)[0])
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
