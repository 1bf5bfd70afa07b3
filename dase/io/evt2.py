"""Prophesee EVT 2.0: 32-bit little-endian words behind a header of `%` lines.

    bits 31..28   27..22    21..11   10..0
    0  CD_OFF     time      column   row        low 6 bits of the time [us]
    1  CD_ON      time      column   row
    8  TIME_HIGH  ------- 28 bits of time ----  bits 33..6; starts over after 4 h 46 min
    10 EXT_TRIGGER, 14 OTHERS, 15 CONTINUED     skipped

Events before the first TIME_HIGH have no time and are skipped. Source: docs.prophesee.ai, "EVT 2.0 format".
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.io import raw
from dase.io.binary import EventWriter, Rollover, bridge_gaps, read_records, weave_words
from dase.io.format import camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Piece, Source

PART = 1 << 17  # words decoded at once: their arrays stay in the cache


class Word(IntEnum):
    """Types of words."""

    CD_OFF = 0
    CD_ON = 1
    TIME_HIGH = 8
    EXT_TRIGGER = 10
    OTHERS = 14
    CONTINUED = 15


KNOWN = np.isin(np.arange(16), list(Word))
"""Which of the 16 types there are."""


class Decoder:
    """Decodes words; carries the time over from one call to the next."""

    def __init__(self) -> None:
        self._high: int | None = None  # continued high part of the time
        self._turns = Rollover(28)
        self.undated = 0
        self.unknown = 0

    def __call__(self, words: NDArray[np.uint32]) -> Iterator[Piece]:
        """Yield the events of the next words, (N,)."""
        for i in range(0, len(words), PART):
            yield self.part(words[i : i + PART])[1]

    def part(self, words: NDArray[np.uint32]) -> tuple[NDArray[np.intp], Piece]:
        """Return which of the next words are dated events, and these events, each (K,)."""
        kind = (words >> 28).astype(np.uint8)
        if not KNOWN[kind].all():
            self.unknown += int(np.count_nonzero(~KNOWN[kind]))
        is_high = kind == Word.TIME_HIGH
        at = np.flatnonzero(kind <= Word.CD_ON)
        high = np.empty(np.count_nonzero(is_high) + 1, np.int64)
        high[0] = -1 if self._high is None else self._high
        high[1:] = self._turns(words[is_high] & 0xFFFFFFF)
        count = np.cumsum(is_high, dtype=np.int32)[at]
        if self._high is None and len(at) and count[0] == 0:
            early = int(np.searchsorted(count, 1))
            self.undated += early
            at, count = at[early:], count[early:]
        self._high = int(high[-1]) if len(high) > 1 else self._high
        events = words[at]
        t = (high << 6)[count] + ((events >> 22) & 63)
        x = ((events >> 11) & 2047).astype(np.uint16)
        y = (events & 2047).astype(np.uint16)
        return at, Piece(t, x, y, kind[at].astype(np.bool_))

    def report(self, source: Source) -> None:
        """Note what was skipped."""
        if self.undated:
            sentence = f"{self.undated} events before the first time word: skipped"
            source.note(sentence, "refused", "undated", self.undated)
        if self.unknown:
            source.note(f"{self.unknown} words of unknown type: skipped", "refused", "damage", self.unknown)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    decoder = Decoder()
    for words in read_records(source, raw.read_header(source, "EVT2").length, "<u4"):
        yield from decoder(words)
    decoder.report(source)


class _Writer(EventWriter):
    name = "EVT2"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._high = -1

    def _header(self, width: int, height: int) -> bytes:
        self._limit(width, height, 1 << 11)  # 11 bits number columns and rows
        text = f"% evt 2.0\n% format EVT2;height={height};width={width}\n% geometry {width}x{height}\n% end\n"
        return text.encode()

    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes:
        high = t_us >> 6
        new = np.diff(high, prepend=self._high) != 0
        steps = bridge_gaps(high, max(self._high, 0), 1 << 26, self.name)
        self._high = int(high[-1])
        event = (
            (part.p.astype(np.int64) << 28) | ((t_us & 63) << 22) | (part.x.astype(np.int64) << 11) | part.y
        )
        words = weave_words(
            [(new, time_word(high)), (np.ones_like(new), event)], (steps[0], time_word(steps[1]))
        )
        return words.astype("<u4").tobytes()


def time_word(high: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return TIME_HIGH words of high parts of times, (N,)."""
    return (Word.TIME_HIGH << 28) | (high & 0xFFFFFFF)


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open an EVT2 file for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


FORMAT = camera_format(
    name="EVT2",
    suffixes=(".evt2",),
    create=create,
    matches=lambda path, head: raw.parse_header(head).encoding == "EVT2",
    pieces=read_pieces,
    size=raw.read_size,
)
