"""What is put right, left out or refused in the events of any file: the one place of each rule.

    polarity    0/1, -1/1 or any other coding: above zero is ON
    wrap        a clock of 32 bits of microseconds that starts over goes on
    bounds      events outside the sensor are left out; where most are, the size must be wrong: refused
    order       events are sorted by time
    origin      times that are dates count from the first event instead
    size        a size stored the wrong way round is turned

What merely looks wrong (hot pixels, events twice, gaps) is found in `dase.recordings.statistics` and left
alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import LABELS, Events
from dase.io.source import Piece, Size, Source, join_pieces


@dataclass(frozen=True)
class TimeRules:
    """When a time is late, a date, or from a clock that started over."""

    lateness: float = 0.1
    """An event may come this much [s] after later ones and still be put in its place."""

    date: float = 1e8
    """First times [s] beyond three years are dates: such a file counts from its first event instead."""

    clocks: tuple[tuple[int, int], ...] = ((0, 1 << 31), (0, 1 << 32), (-(1 << 31), 1 << 32))
    """Least value and range [us] of clocks that start over."""

    margin: float = 0.1
    """Share of its range that a clock is from its ends at most, before and after it started over."""


TIME_RULES = TimeRules()


class TooLateError(InputError):
    """Events come too late to be sorted in a stream; the whole file can be sorted."""


def settle_pieces(source: Source, pieces: Iterable[Piece], size: Size, ticks: float) -> Iterator[Piece]:
    """Pass on pieces with what can be put right at once: polarity, wraps, bounds; not yet the order."""
    return keep_inside(source, _unwrap_clock(source, _settle_polarity(source, pieces), ticks), size)


def _settle_polarity(source: Source, pieces: Iterable[Piece]) -> Iterator[Piece]:
    """Turn numbers into ON and OFF, and check labels."""
    for piece in pieces:
        if piece.label is not None:
            piece = piece._replace(label=_labels(piece.label))
        if piece.p.dtype != np.bool_:
            codes = piece.p
            least, most = (float(codes.min()), float(codes.max())) if len(codes) else (0.0, 1.0)
            if not (least >= -1 and most <= 1):
                source.note(
                    "polarities are neither 0 and 1 nor -1 and 1: above zero was taken for ON",
                    "assumed",
                    "polarity",
                )
            piece = piece._replace(p=codes > 0)
        yield piece


def _labels(label: NDArray[Any]) -> NDArray[np.int8]:
    if label.dtype.kind not in "iu" or np.any((label < 0) | (label >= len(LABELS))):
        raise InputError(f"labels must be whole numbers in 0..{len(LABELS) - 1}: {', '.join(LABELS)}")
    return label.astype(np.int8, copy=False)


def _unwrap_clock(source: Source, pieces: Iterable[Piece], ticks: float) -> Iterator[Piece]:
    """Continue times that fall from near the top of a 32-bit clock to near its bottom; float or whole.

    A single step up again undoes it: the clock of late events has not yet started over.
    """
    last: float | None = None
    clock: tuple[float, float] | None = None  # least value and range [ticks]
    turns = count = 0
    for piece in pieces:
        t = piece.t
        if not len(t):
            yield piece
            continue
        before = float(t[0]) if last is None else last
        last = float(t[-1])
        jump = 0.7 * (1 << 31) * ticks / 1e6
        if turns or max(before, float(t.max())) - float(t.min()) > jump:
            earlier = np.concatenate((np.array([before]), t[:-1].astype(np.float64)))
            clock = clock or _find_clock(earlier, t.astype(np.float64), ticks)
            if clock is not None:
                steps = _clock_turns(earlier, t.astype(np.float64), clock)
                count += int(np.count_nonzero(steps > 0))
                level = turns + np.cumsum(steps)
                level -= np.minimum(np.minimum.accumulate(level), 0)  # nothing comes before the first turn
                turns = int(level[-1])
                piece = piece._replace(t=t + (level * clock[1]).astype(t.dtype))
        yield piece
    if count and clock is not None:
        length = clock[1] / ticks
        source.note(
            f"the clock started over {count} times after {length:.1f} s: times go on",
            "repaired",
            "wrap",
            count,
        )


def _find_clock(
    before: NDArray[np.float64], after: NDArray[np.float64], ticks: float
) -> tuple[float, float] | None:
    """Return least value and range [ticks] of the clock that started over between these times, or None."""
    for least, span in TIME_RULES.clocks:
        clock = (least * ticks / 1e6, span * ticks / 1e6)
        if np.any(_clock_turns(before, after, clock) > 0):
            return clock
    return None


def _clock_turns(
    before: NDArray[np.float64], after: NDArray[np.float64], clock: tuple[float, float]
) -> NDArray[np.int64]:
    """Return 1 where a clock started over between two times, -1 where it went back over its start, else 0."""
    least, span = clock
    margin, top = TIME_RULES.margin, least + span
    low, high = least + margin * span, least + (1 - margin) * span
    down = (before >= high) & (before < top) & (after >= least) & (after < low)
    up = (after >= high) & (after < top) & (before >= least) & (before < low)
    return down.astype(np.int64) - up


def keep_inside(source: Source, pieces: Iterable[Piece], size: Size) -> Iterator[Piece]:
    """Pass on the events that lie on the sensor; note how many did not.

    Raises:
        InputError: A time is no number, or most events lie outside a size that the file claims.
    """
    outside = total = 0
    for piece in pieces:
        if not len(piece.t):
            continue
        if piece.t.dtype.kind == "f" and not np.all(np.isfinite(piece.t)):
            raise InputError("a time is not a finite number")
        total += len(piece.t)
        if int(piece.x.max()) >= size[0] or int(piece.y.max()) >= size[1]:
            good = (piece.x < size[0]) & (piece.y < size[1])
            outside += len(good) - int(np.count_nonzero(good))
            piece = piece.take(np.flatnonzero(good))
        if len(piece.t):
            yield piece
    if not outside:
        return
    if 2 * outside > total and source.size is None:
        raise InputError(
            f"{outside} of {total} events lie outside the {size[0]}x{size[1]} it claims: "
            "the size is wrong, or the file is damaged"
        )
    sentence = f"{outside} events lie outside the {size[0]}x{size[1]} sensor: skipped"
    source.note(sentence, "refused", "bounds", outside)


def by_time(source: Source, piece: Piece, ticks: float) -> Piece:
    """Return the events of a whole file sorted by time; those of one time keep their order."""
    if in_order(piece.t):
        return piece
    back = float(np.max(np.maximum.accumulate(piece.t) - piece.t)) / ticks
    count = int(np.count_nonzero(np.diff(piece.t) < 0))
    _note_order(source, count, back)
    return piece.take(np.argsort(piece.t, kind="stable"))


def _note_order(source: Source, count: int, back: float) -> None:
    sentence = f"times go back {count} times, by up to {back:g} s: events were sorted"
    source.note(sentence, "repaired", "order", count)


def in_order(t: NDArray[Any]) -> bool:
    """Whether times (N,) never go back."""
    return bool(np.all(t[1:] >= t[:-1]))


def order_pieces(source: Source, pieces: Iterable[Piece], ticks: float) -> Iterator[Piece]:
    """Pass on pieces sorted by time; each waits until nothing is expected to come before its end."""
    held: deque[Piece] = deque()
    newest = done = last = -np.inf
    count, farthest = 0, 0.0
    for piece in pieces:
        if float(piece.t.min()) < done:
            back = (done - float(piece.t.min())) / ticks
            raise TooLateError(
                f"times go back by {back:g} s, too far to sort while streaming: read the whole file, "
                "or convert it to .h5 first"
            )
        held.append(piece)
        if piece.t[0] < newest or not in_order(piece.t):
            before = np.concatenate(([last], piece.t[:-1]))
            count += int(np.count_nonzero(piece.t < before))
            ahead = np.maximum(np.maximum.accumulate(before), newest)
            farthest = max(farthest, float(np.max(ahead - piece.t)))
            merged = join_pieces(list(held))
            merged = merged.take(np.argsort(merged.t, kind="stable"))
            cut = int(np.searchsorted(merged.t, merged.t[-1] - TIME_RULES.lateness * ticks))
            held = deque(
                part for part in (merged.take(slice(cut)), merged.take(slice(cut, None))) if len(part.t)
            )
        last = float(piece.t[-1])
        newest = float(held[-1].t[-1])
        while held[0].t[-1] < newest - TIME_RULES.lateness * ticks:
            done = float(held[0].t[-1])
            yield held.popleft()
    yield from held
    if count:
        _note_order(source, count, farthest / ticks)


def find_origin(source: Source, t: NDArray[Any], ticks: float) -> Any:
    """Return the tick of time zero: that of the file, or its first event where the file counts as a date.

    Args:
        source: Gets a note of the date.
        t: Times of the first events [ticks], shape (N,).
        ticks: In a second.
    """
    if not len(t) or abs(float(t[0])) / ticks < TIME_RULES.date:
        return t.dtype.type(0)
    sentence = f"times count from the first event, which the file dates {float(t[0]) / ticks:.6f} s"
    source.note(sentence, "said", "origin")
    return t[0]


def turned_size(source: Source, size: Size, extent: Size) -> Size:
    """Return a size, the other way round where only so all events lie on the sensor.

    Args:
        source: The file.
        size: Columns and rows as the file says; writers of such files are known to swap the two.
        extent: One more than the largest column and row of an event.
    """
    if extent[0] <= size[0] and extent[1] <= size[1]:
        return size
    if extent[0] > size[1] or extent[1] > size[0]:
        return size
    source.note(f"the sensor is {size[1]}x{size[0]}, stored the wrong way round", "repaired", "size")
    return size[::-1]


def sensor_events(
    source: Source,
    piece: Piece,
    *,
    size: Size | None,
    maps: tuple[NDArray[Any] | None, ...] = (),
) -> Events:
    """Build the events of a file that is read whole, by the rules above.

    Args:
        source: The file.
        piece: Its events, times [s].
        size: Columns and rows as the file says.
        maps: Arrays (..., H, W); the first that is there decides the size over `size`.

    Raises:
        InputError: The size is unknown, most events lie outside the sensor, or labels are not of `LABELS`.
    """
    shape = next((array.shape for array in maps if array is not None and array.ndim >= 2), None)
    known = source.size or (None if shape is None else (shape[-1], shape[-2]))
    if len({len(piece.t), len(piece.x), len(piece.y), len(piece.p)}) != 1:
        raise InputError("t, x, y and p must have one common shape (N,)")
    if known is None and size is not None:
        extent = (int(piece.x.max()) + 1, int(piece.y.max()) + 1) if len(piece.x) else (0, 0)
        known = turned_size(source, size, extent)
    if known is None:
        raise InputError("does not say how large the sensor is")
    good = list(settle_pieces(source, [piece], known, 1.0)) or [piece.take(slice(0))]
    t, x, y, p, label = by_time(source, join_pieces(good), 1.0)
    label = None if label is None else label.astype(np.int8, copy=False)
    return Events(
        t.astype(np.float64, copy=False), x, y, p.astype(np.bool_, copy=False), known[0], known[1], label
    )
