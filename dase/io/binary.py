"""What readers and writers of binary event files share: blocks of whole records, counters that start over."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Writer
from dase.io.source import Source

BLOCK = 1 << 22  # [bytes] read at once


def read_records(source: Source, begin: int, kind: Any) -> Iterator[NDArray[Any]]:
    """Yield the records of a file from byte `begin` on, in blocks (N,); note a broken one at the end."""
    size = np.dtype(kind).itemsize
    with source.path.open("rb") as file:
        file.seek(begin)
        rest = b""
        while block := file.read(BLOCK // size * size):
            block = rest + block if rest else block
            count = len(block) // size
            rest = block[count * size :]
            yield np.frombuffer(block, kind, count)
    if rest:
        sentence = f"{len(rest)} bytes at the end are no whole record of {size} bytes: skipped"
        source.note(sentence, "refused", "damage", 1)


class Rollover:
    """Continues a counter of some bits beyond its range.

    Args:
        bits: Bits of the counter.
        back: Take a jump of more than half the range as one from before the last start over. That heals a
            damaged value, but not a gap of half the range, which only a frequent counter never has.
    """

    def __init__(self, bits: int, *, back: bool = False) -> None:
        self._range, self._back = 1 << bits, back
        self._last: int | None = None
        self._turns = 0

    def __call__(self, values: NDArray[Any]) -> NDArray[np.int64]:
        """Return the continued values of the next values, each (N,)."""
        values = values.astype(np.int64)
        if not len(values):
            return values
        before = np.empty_like(values)
        before[0] = values[0] if self._last is None else self._last
        before[1:] = values[:-1]
        step = values - before
        turns = np.cumsum(step < -(self._range // 2))
        if self._back:
            turns -= np.cumsum(step > self._range // 2)
        turns += self._turns
        self._last, self._turns = int(values[-1]), int(turns[-1])
        values += turns * self._range
        return values


def set_bits(octets: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return the places of the bits that are set in bytes, the lowest first."""
    filled = np.flatnonzero(octets != 0)
    if 2 * len(filled) > len(octets):
        return np.flatnonzero(np.unpackbits(octets, bitorder="little").view(np.bool_))
    # where one bit in ten or fewer is set NumPy looks for each on its own, which is slower
    bits = np.flatnonzero(np.unpackbits(octets[filled], bitorder="little").view(np.bool_))
    return filled.take(bits >> 3) << 3 | bits & 7


def bridge_gaps(
    counts: NDArray[np.int64], last: int, step: int, name: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return what has to be counted in between so that no jump of a counter is taken for a start over.

    Args:
        counts: Values of the counter, not decreasing, (N,).
        last: Value before the first.
        step: Largest jump that is understood.
        name: Format, for the message.

    Returns:
        Index of the value they lead to, and values in between, each (K,).
    """
    before = np.concatenate(([last], counts[:-1]))
    extra = np.maximum((counts - before - 1) // step, 0)
    total = int(extra.sum())
    # EVT3 needs a word per 4 s of a gap, EVT2 one per 72 min: a million are no recording's any more
    if total > 1 << 20:
        raise InputError(
            f"{name}: times are too large or have too long a gap for this format, write .h5 instead"
        )
    index = np.repeat(np.arange(len(counts)), extra)
    nth = np.arange(total) - np.repeat(np.cumsum(extra) - extra, extra) + 1
    return index, before[index] + nth * step


def weave_words(
    columns: list[tuple[NDArray[np.bool_], NDArray[Any]]],
    before: tuple[NDArray[np.int64], NDArray[Any]],
) -> NDArray[Any]:
    """Return the words of all events in a row, of the type in which they are given.

    Args:
        columns: Which events want a word (N,), and the words (N,), in the order they take within an event.
        before: Index of an event and word to put before all of its words, each (K,).
    """
    wanted = np.stack([column[0] for column in columns], axis=1)
    words = np.stack([column[1] for column in columns], axis=1)[wanted]
    if len(before[0]):
        counts = wanted.sum(axis=1)
        words = np.insert(words, (np.cumsum(counts) - counts)[before[0]], before[1])
    return words


class EventWriter(Writer):
    """Writes a camera's file: a header once the size of the sensor is known, then events.

    Such files hold no frames; thresholds and configuration have no place in them and are left out.
    """

    name = "this format"

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file: BinaryIO = path.open("wb")
        self._started = False

    def finish(self) -> None:
        """Write the header if no event came, and close."""
        self._start()
        self._file.close()

    def abandon(self) -> None:
        """Close the file."""
        with suppress(OSError):
            self._file.close()

    def _start(self) -> None:
        if not self._started:
            assert self.size is not None
            self._started = True
            self._file.write(self._header(self.size[1], self.size[0]))

    def _put_events(self, part: Events) -> None:
        self._start()
        self._file.write(self._encoded(part, self._microseconds(part.t)))

    def _microseconds(self, t: NDArray[np.float64]) -> NDArray[np.int64]:
        if t[0] < 0:
            raise InputError(f"{self.name}: times must not be negative, got {t[0]:g} s")
        if t[-1] >= 2**52 / 1e6:
            raise InputError(f"{self.name}: times must stay below {2**52 / 1e6:g} s, got {t[-1]:g} s")
        return np.rint(t * 1e6).astype(np.int64)

    def _limit(self, width: int, height: int, largest: int) -> None:
        if max(width, height) > largest:
            raise InputError(
                f"{self.name}: the sensor must be at most {largest} wide and high, got {width}x{height}"
            )

    @abstractmethod
    def _header(self, width: int, height: int) -> bytes: ...

    @abstractmethod
    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes: ...

    def _put_frame(self, *args: Any) -> None:
        raise InputError(f"{self.name} holds events only, no frames: write .h5 or .npz to keep them")

    def _put_thresholds(self, values: NDArray[np.float32]) -> None:
        """Such files have no place for thresholds."""

    def _put_configuration(self, text: str) -> None:
        """Such files have no place for a configuration."""
