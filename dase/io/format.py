"""What a file format is, and how its reader becomes one.

A reader yields pieces in the order of the file, in the file's own ticks. From them `camera_format` makes the
two ways to read: `read` takes all of it and sorts, `stream` hands on chunks of exactly the length asked for,
sorted within `LATENESS`, in memory that does not grow with the file. Frames come one by one beside that.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io import rules
from dase.io.sequence import Sequence, Writer, reading_file
from dase.io.source import Beside, Motion, Picture, Piece, Size, Source, checked_size, guess_size, join_pieces

LIMIT = 4 << 30  # [bytes] of frames, or of flow, taken into memory

Read = TypeVar("Read")


@contextmanager
def closed_after(items: Iterator[Read]) -> Iterator[Iterator[Read]]:
    """Let go of the file that is being read, at the end of a block.

    Where a later step refuses what was read, the error holds all steps, and the first one the file: until
    the error is forgotten, and from Python 3.12 on until cycles are collected.
    """
    try:
        yield items
    finally:
        if isinstance(items, Generator):
            items.close()


def no_pictures(source: Source) -> Iterator[Picture]:
    """Yield nothing: a format without frames."""
    return iter(())


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
    pictures: Callable[[Source], Iterator[Picture]] = no_pictures
    """Yield its frames with their times [s], as `read` gives them; not a number where nothing tells them."""
    motion: Callable[[Source], Motion | None] = lambda source: None
    """Read the samples of its motion sensor, times [s]; None where there are none."""
    beside: Callable[[Source], Beside] = lambda source: (None, None)
    """Read thresholds and configuration."""
    create: Callable[[Path], AbstractContextManager[Writer]] | None = None
    """Open for writing; None where the format is read only."""
    keeps: frozenset[str] = frozenset({"events"})
    """What of a sequence a file can hold."""
    asks: frozenset[str] = frozenset()
    """Options of `ReadOptions` beside the size that say what a file may leave open."""
    extra: str | None = None
    """Optional dependency of the package that reading needs."""


def camera_format(
    *,
    pieces: Callable[[Source], Iterator[Piece]],
    size: Callable[[Source], Size | None],
    pictures: Callable[[Source], Iterator[Picture]] = no_pictures,
    motion: Callable[[Source], Motion | None] = lambda source: None,
    extent: Callable[[Source], Size] | None = None,
    ticks: float = 1e6,
    **fields: Any,
) -> Format:
    """Make a format of its reader.

    Args:
        pieces: Yields the events in the order of the file; called again where the size has to be found.
        size: Tells columns and rows, or None where the file does not say.
        pictures: Yields the frames.
        motion: Reads the samples of the motion sensor.
        extent: Tells one more than the largest column and row, where that is cheaper than decoding all.
        ticks: Ticks per second of pieces, frames and motion.
        fields: The other fields of Format.
    """
    r = _Reader(fields["name"], pieces, size, pictures, motion, extent, ticks)
    return Format(read=r.read, stream=r.stream, pictures=r.shown, motion=r.moved, **fields)


@dataclass(frozen=True)
class _Reader:
    """The ways to read a file, see `camera_format`."""

    name: str
    pieces: Callable[[Source], Iterator[Piece]]
    size: Callable[[Source], Size | None]
    pictures: Callable[[Source], Iterator[Picture]]
    motion: Callable[[Source], Motion | None]
    extent: Callable[[Source], Size] | None
    ticks: float

    def read(self, source: Source) -> Sequence:
        with reading_file(source.path, self.name):
            size = self._sensor(source)
            with closed_after(self.pictures(source)) as pictures:
                frames = collect_pictures(_keep_fitting(source, pictures, size))
            with closed_after(self.pieces(source)) as pieces:
                return _read_whole(source, pieces, frames, size, self.ticks)

    def stream(self, source: Source, chunk: int) -> Iterator[Events]:
        with reading_file(source.path, self.name), closed_after(self.pieces(source)) as pieces:
            yield from _stream_events(source, pieces, self._sensor(source), self.ticks, chunk)

    def shown(self, source: Source) -> Iterator[Picture]:
        with reading_file(source.path, self.name), closed_after(self.pictures(source)) as pictures:
            size, zero = self._sensor(source), None
            for picture in _keep_fitting(source, pictures, size):
                zero = self._begin(source, size, np.array([picture.t])) if zero is None else zero
                yield picture._replace(t=(picture.t - zero) / self.ticks)

    def moved(self, source: Source) -> Motion | None:
        with reading_file(source.path, self.name):
            found = self.motion(source)
            if found is None:
                return None
            with closed_after(self.pictures(source)) as pictures:
                first = next(pictures, None)
            times = found.t if first is None else np.array([first.t])
            zero = self._begin(source, self._sensor(source), times)
            return found._replace(t=(found.t - zero) / self.ticks)

    def _sensor(self, source: Source) -> Size:
        known = source.size or self.size(source)
        if known is None:
            known = guess_size(source, (self.extent or self._extent)(source))
        return checked_size(known)

    def _extent(self, source: Source) -> Size:
        with closed_after(self.pieces(source)) as pieces:
            return find_extent(pieces)

    def _begin(self, source: Source, size: Size, without_events: NDArray[Any]) -> Any:
        """Return the tick of time zero: of the first event, else of these times."""
        with closed_after(self.pieces(source)) as pieces:
            settled = rules.settle_pieces(source, pieces, size, self.ticks)
            ordered = rules.order_pieces(source, settled, self.ticks)
            first = next((piece.t for piece in ordered), without_events)
        return rules.find_origin(source, first, self.ticks)


def _keep_fitting(source: Source, pictures: Iterable[Picture], size: Size) -> Iterator[Picture]:
    """Pass on the pictures that are as large as the sensor; note the others."""
    for picture in pictures:
        if picture.grey.shape != size[::-1]:
            height, width = picture.grey.shape
            source.note(
                f"frames of {width}x{height} do not fit the {size[0]}x{size[1]} sensor: left out",
                "refused",
                "frames",
            )
            return
        yield picture


def _read_whole(
    source: Source, pieces: Iterable[Piece], pictures: list[Picture], size: Size, ticks: float
) -> Sequence:
    piece = rules.by_time(source, join_pieces(list(rules.settle_pieces(source, pieces, size, ticks))), ticks)
    times = np.array([picture.t for picture in pictures])
    zero = rules.find_origin(source, piece.t if len(piece.t) else times, ticks)
    events = Events((piece.t - zero) / ticks, piece.x, piece.y, piece.p, *size, piece.label)
    return sequence_of(events, pictures, zero, ticks)


def collect_pictures(pictures: Iterable[Picture]) -> list[Picture]:
    """Return pictures of one size; raises InputError where they differ or fill the memory."""
    out: list[Picture] = []
    total = 0
    for picture in pictures:
        total += picture.grey.nbytes + (0 if picture.flow is None else picture.flow.nbytes)
        if total > LIMIT:
            raise InputError(f"its frames need more than {LIMIT >> 30} GiB of memory: cut it into parts")
        if out and picture.grey.shape != out[0].grey.shape:
            a, b = out[0].grey.shape, picture.grey.shape
            raise InputError(f"frame {len(out)} is {b[1]}x{b[0]}, those before are {a[1]}x{a[0]}")
        if out and picture.grey.dtype != out[0].grey.dtype:
            kinds = picture.grey.dtype, out[0].grey.dtype
            raise InputError(f"frame {len(out)} is {kinds[0]}, those before are {kinds[1]}")
        out.append(picture)
    return out


def sequence_of(events: Events, pictures: list[Picture], begin: Any = 0, ticks: float = 1.0) -> Sequence:
    """Return a sequence of events and frames.

    Args:
        events: The events.
        pictures: The frames; times are not a number where nothing tells them. Their pixels are let go.
        begin: Tick of time zero.
        ticks: Ticks per second.
    """
    if not pictures:
        return Sequence(events)
    times = (np.array([picture.t for picture in pictures]) - begin) / ticks
    exposure = np.array([picture.exposure for picture in pictures], np.float64)
    with_flow = all(picture.flow is not None for picture in pictures)
    frames = np.empty((len(pictures), *pictures[0].grey.shape), pictures[0].grey.dtype)
    flow = np.empty((len(pictures), 2, *pictures[0].grey.shape), np.float32) if with_flow else None
    for k in range(len(pictures)):  # each is let go when it has its place: all are never there twice
        frames[k] = pictures[k].grey
        if flow is not None:
            flow[k] = pictures[k].flow
        pictures[k] = pictures[k]._replace(grey=frames[k], flow=None)
    return Sequence(
        events,
        frames,
        None if np.isnan(times).any() else times,
        flow,
        frame_exposure=exposure if exposure.any() else None,
    )


def _stream_events(
    source: Source, pieces: Iterable[Piece], size: Size, ticks: float, chunk: int
) -> Iterator[Events]:
    zero = None
    settled = rules.settle_pieces(source, pieces, size, ticks)
    for piece in cut_chunks(rules.order_pieces(source, settled, ticks), chunk):
        zero = rules.find_origin(source, piece.t, ticks) if zero is None else zero
        yield Events((piece.t - zero) / ticks, piece.x, piece.y, piece.p, *size, piece.label)
    if zero is None:
        yield Events.empty(*size)


def cut_chunks(pieces: Iterable[Piece], chunk: int) -> Iterator[Piece]:
    """Cut and join pieces to exactly `chunk` events; the last may be shorter."""
    waiting: list[Piece] = []
    missing = chunk
    for piece in pieces:
        while len(piece.t) >= missing:
            waiting.append(piece.take(slice(missing)))
            piece = piece.take(slice(missing, None))
            yield join_pieces(waiting)
            waiting, missing = [], chunk
        if len(piece.t):
            waiting.append(piece)
            missing -= len(piece.t)
    if waiting:
        yield join_pieces(waiting)


def find_extent(pieces: Iterable[Piece]) -> Size:
    """Return one more than the largest column and row."""
    width = height = 1
    for piece in pieces:
        if len(piece.t):
            width, height = max(width, int(piece.x.max()) + 1), max(height, int(piece.y.max()) + 1)
    return width, height
