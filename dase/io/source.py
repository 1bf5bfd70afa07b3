"""What a file format is, and what every reader of a camera's file shares: source, pieces, order, size.

A reader yields pieces in the order of the file, in the file's own ticks. From them `camera_format` makes the
two ways to read: `read` takes all of it and sorts, `stream` hands on chunks of exactly the length asked for,
sorted within `LATENESS`, in memory that does not grow with the file.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence, Writer, reading

Size = tuple[int, int]
"""Columns and rows."""

CHUNK = 1 << 20  # events that `stream` hands on at once
LATENESS = 0.1  # [s] an event may come this much after later ones and still be put in its place
DATE = 1e8  # [s] first times beyond three years are dates: such a file counts from its first event instead
LARGEST = 8192  # columns or rows of a sensor that a file may claim
SIZES: tuple[Size, ...] = (
    (128, 128),
    (240, 180),
    (304, 240),
    (320, 320),
    (346, 260),
    (640, 480),
    (1280, 720),
)
"""Sensors that were built, from small to large: the first that holds all events is the guess."""

BOMB_BYTES = 200 << 20
BOMB_RATIO = 100


@dataclass(frozen=True)
class Source:
    """A file to read, what the user knows about it, and what the reader saw.

    Args:
        path: File or folder.
        size: Columns and rows where the user says so; it wins over what the file says.
        notes: Sentences about what was skipped, repaired or guessed; readers append to it.
    """

    path: Path
    size: Size | None = None
    notes: list[str] = field(default_factory=list)

    def note(self, sentence: str) -> None:
        """Append a sentence, once."""
        if sentence not in self.notes:
            self.notes.append(sentence)


class Piece(NamedTuple):
    """Some events in the order of the file: ticks (int64 or float64), columns, rows, ON; each (N,)."""

    t: NDArray[Any]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]

    def take(self, index: Any) -> Piece:
        """Return the events of an index, mask or slice."""
        return Piece(*(column[index] for column in self))


class Frames(NamedTuple):
    """Frames of a camera: grey (F, H, W), middle of exposure [ticks] (F,), duration of exposure [s] (F,)."""

    grey: NDArray[np.uint8]
    t: NDArray[Any]
    exposure: NDArray[np.float64] | None = None
    flow: NDArray[np.float32] | None = None


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file format: how to know it, read it and write it."""

    name: str
    suffixes: tuple[str, ...]
    matches: Callable[[Path, bytes], bool]
    """Whether a path with these first bytes holds this format; never raises."""
    read: Callable[[Source], Sequence]
    """Read all of it."""
    stream: Callable[[Source, int], Iterator[Events]]
    """Yield its events in chunks; at least one, if empty, for the size of the sensor."""
    create: Callable[[Path], AbstractContextManager[Writer]] | None = None
    """Open for writing; None where the format is read only."""
    keeps: frozenset[str] = frozenset({"events"})
    """What of a sequence a file can hold."""
    extra: str | None = None
    """Optional dependency of the package that reading needs."""


def camera_format(
    *,
    pieces: Callable[[Source], Iterator[Piece]],
    size: Callable[[Source], Size | None],
    frames: Callable[[Source], Frames | None] = lambda source: None,
    extent: Callable[[Source], Size] | None = None,
    ticks: float = 1e6,
    **fields: Any,
) -> Format:
    """Make a format of its reader.

    Args:
        pieces: Yields the events in the order of the file; called again where the size has to be found.
        size: Tells columns and rows, or None where the file does not say.
        frames: Reads the frames.
        extent: Tells one more than the largest column and row, where that is cheaper than decoding all.
        ticks: Ticks per second of pieces and frames.
        fields: The other fields of Format.
    """
    name = fields["name"]

    def sensor(source: Source) -> Size:
        known = source.size or size(source)
        if known is None:
            found = extent(source) if extent else _extent(pieces(source))
            known = guess_size(source, found)
        return checked_size(known)

    def read(source: Source) -> Sequence:
        with reading(source.path, name):
            return _read(source, pieces(source), frames(source), sensor(source), ticks)

    def stream(source: Source, chunk: int) -> Iterator[Events]:
        with reading(source.path, name):
            yield from _stream(source, pieces(source), sensor(source), ticks, chunk)

    return Format(read=read, stream=stream, **fields)


def _read(
    source: Source, pieces: Iterable[Piece], frames: Frames | None, size: Size, ticks: float
) -> Sequence:
    piece = join(list(inside(source, pieces, size)))
    if not in_order(piece.t):
        back = float(np.max(np.maximum.accumulate(piece.t) - piece.t)) / ticks
        count = int(np.count_nonzero(np.diff(piece.t) < 0))
        source.note(f"times go back {count} times, by up to {back:g} s: events were sorted")
        piece = piece.take(np.argsort(piece.t, kind="stable"))
    first = piece.t if len(piece.t) or frames is None else frames.t
    origin = _origin(source, first, ticks)
    events = Events((piece.t - origin) / ticks, piece.x, piece.y, piece.p, *size)
    if frames is None or not len(frames.grey):
        return Sequence(events)
    if frames.grey.shape[1:] != (size[1], size[0]):
        shape = frames.grey.shape
        source.note(f"frames of {shape[2]}x{shape[1]} do not fit the {size[0]}x{size[1]} sensor: left out")
        return Sequence(events)
    times = (frames.t - origin) / ticks
    return Sequence(events, frames.grey, times, frames.flow, frame_exposure=frames.exposure)


def _stream(
    source: Source, pieces: Iterable[Piece], size: Size, ticks: float, chunk: int
) -> Iterator[Events]:
    if chunk < 1:
        raise InputError(f"chunk must be at least 1 event, got {chunk}")
    origin = None
    for piece in _cut(_ordered(inside(source, pieces, size), ticks), chunk):
        origin = _origin(source, piece.t, ticks) if origin is None else origin
        yield Events((piece.t - origin) / ticks, piece.x, piece.y, piece.p, *size)
    if origin is None:
        yield Events.empty(*size)


def _origin(source: Source, t: NDArray[Any], ticks: float) -> Any:
    """Return the tick of time zero: that of the file, or its first event where the file counts as a date."""
    if not len(t) or abs(float(t[0])) / ticks < DATE:
        return t.dtype.type(0)
    source.note(f"times count from the first event, which the file dates {float(t[0]) / ticks:.6f} s")
    return t[0]


def join(pieces: list[Piece]) -> Piece:
    """Join pieces; none make an empty one."""
    if len(pieces) == 1:
        return pieces[0]
    if not pieces:
        none = np.empty(0, np.uint16)
        return Piece(np.empty(0, np.int64), none, none, np.empty(0, np.bool_))
    columns: list[NDArray[Any]] = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    return Piece(*columns)


def in_order(t: NDArray[Any]) -> bool:
    """Whether times never go back."""
    return bool(np.all(t[1:] >= t[:-1]))


def inside(source: Source, pieces: Iterable[Piece], size: Size) -> Iterator[Piece]:
    """Pass on the events that lie on the sensor; note how many did not."""
    outside = 0
    for piece in pieces:
        if not len(piece.t):
            continue
        if piece.t.dtype.kind == "f" and not np.all(np.isfinite(piece.t)):
            raise InputError("a time is not a finite number")
        if int(piece.x.max()) >= size[0] or int(piece.y.max()) >= size[1]:
            good = (piece.x < size[0]) & (piece.y < size[1])
            outside += len(good) - int(np.count_nonzero(good))
            piece = piece.take(good)
        if len(piece.t):
            yield piece
    if outside:
        source.note(f"{outside} events lie outside the {size[0]}x{size[1]} sensor: skipped")


def _ordered(pieces: Iterable[Piece], ticks: float) -> Iterator[Piece]:
    """Pass on pieces sorted by time; each waits until nothing is expected to come before its end."""
    held: deque[Piece] = deque()
    newest = done = -np.inf
    for piece in pieces:
        if float(piece.t.min()) < done:
            back = (done - float(piece.t.min())) / ticks
            raise InputError(
                f"times go back by {back:g} s, too far to sort while streaming: read the whole file, "
                "or convert it to .h5 first"
            )
        held.append(piece)
        if piece.t[0] < newest or not in_order(piece.t):
            merged = join(list(held))
            merged = merged.take(np.argsort(merged.t, kind="stable"))
            cut = int(np.searchsorted(merged.t, merged.t[-1] - LATENESS * ticks))
            held = deque(
                part for part in (merged.take(slice(cut)), merged.take(slice(cut, None))) if len(part.t)
            )
        newest = float(held[-1].t[-1])
        while held[0].t[-1] < newest - LATENESS * ticks:
            done = float(held[0].t[-1])
            yield held.popleft()
    yield from held


def _cut(pieces: Iterable[Piece], chunk: int) -> Iterator[Piece]:
    """Cut and join pieces to exactly `chunk` events; the last may be shorter."""
    waiting: list[Piece] = []
    missing = chunk
    for piece in pieces:
        while len(piece.t) >= missing:
            waiting.append(piece.take(slice(missing)))
            piece = piece.take(slice(missing, None))
            yield join(waiting)
            waiting, missing = [], chunk
        if len(piece.t):
            waiting.append(piece)
            missing -= len(piece.t)
    if waiting:
        yield join(waiting)


def _extent(pieces: Iterable[Piece]) -> Size:
    width = height = 1
    for piece in pieces:
        if len(piece.t):
            width, height = max(width, int(piece.x.max()) + 1), max(height, int(piece.y.max()) + 1)
    return width, height


def guess_size(source: Source, extent: Size) -> Size:
    """Return the smallest sensor that holds all events, of those that were built."""
    for size in SIZES:
        if extent[0] <= size[0] and extent[1] <= size[1]:
            break
    else:
        size = extent
    source.note(f"the file does not say how large the sensor is: {size[0]}x{size[1]} holds all its events")
    return size


def checked_size(size: Size) -> Size:
    """Return the size; raises InputError where no sensor is so small or so large."""
    if not (1 <= size[0] <= LARGEST and 1 <= size[1] <= LARGEST):
        raise InputError(f"a sensor must be 1x1 to {LARGEST}x{LARGEST}, got {size[0]}x{size[1]}")
    return size


def refuse_bomb(packed: int, unpacked: int) -> None:
    """Raise InputError where a small file claims to unpack to something absurd [bytes]."""
    if unpacked > BOMB_BYTES and unpacked > BOMB_RATIO * packed:
        raise InputError(
            f"unpacks from {packed / 1e6:.3g} to {unpacked / 1e6:.0f} MB: "
            f"more than {BOMB_RATIO} times is refused"
        )


def missing_extra(what: str, extra: str) -> InputError:
    """Return the error for a library that is not installed."""
    return InputError(f'{what} needs an optional library: pip install "dase[{extra}]"')
