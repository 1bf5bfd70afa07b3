"""Prophesee EVT 3.0: 16-bit little-endian words that change a state; behind a header of `%` lines.

    bits 15..12     11          10..0
    0  ADDR_Y       camera      row of the events that follow
    2  ADDR_X       polarity    column: one event
    3  VECT_BASE_X  polarity    column of the vectors that follow
    4  VECT_12      bit i of 11..0: an event at base + i; then the base moves on by 12
    5  VECT_8       bit i of  7..0: an event at base + i; then the base moves on by 8
    6  TIME_LOW     bits 11..0 of the time [us]
    8  TIME_HIGH    bits 23..12 of the time; starts over after 16.8 s. A new value sets bits 11..0 to zero.
    7  CONTINUED_4, 10 EXT_TRIGGER, 14 OTHERS, 15 CONTINUED_12: skipped
    1  row of events that are not changes of contrast: skipped with their events

Events before the first TIME_HIGH have no time, events before the first ADDR_Y no row: both are skipped.
Sources: docs.prophesee.ai, "EVT 3.0 format"; OpenEB (Apache-2.0) for what TIME_HIGH does to the low bits.
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
from dase.io.binary import EventWriter, Rollover, bridge_gaps, read_records, set_bits, weave_words
from dase.io.format import camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Piece, Source

PART = 1 << 18  # words decoded at once; three million events if all are full vectors
NOWHERE = 65535  # row of events that have none
UNDATED = -(1 << 40)  # high part of the time before there is any


class Word(IntEnum):
    """Types of words."""

    ADDR_Y = 0
    OTHER_Y = 1
    ADDR_X = 2
    VECT_BASE_X = 3
    VECT_12 = 4
    VECT_8 = 5
    TIME_LOW = 6
    CONTINUED_4 = 7
    TIME_HIGH = 8
    EXT_TRIGGER = 10
    OTHERS = 14
    CONTINUED_12 = 15


# one running sum counts row words and words that set the low bits of the time at the same time
COUNTED = np.zeros(16, np.int64)
COUNTED[[Word.ADDR_Y, Word.OTHER_Y]] = 1
COUNTED[Word.TIME_LOW] = 1 << 32
STEP = np.zeros(16, np.int64)
STEP[Word.VECT_12], STEP[Word.VECT_8] = 12, 8
BITS = np.array([bin(mask).count("1") for mask in range(4096)], np.int64)


class Decoder:
    """Decodes words; carries time, row and vector base over from one call to the next.

    Args:
        clears: Whether a new TIME_HIGH sets the low bits of the time to zero, as it does in EVT 3.0.
    """

    def __init__(self, *, clears: bool = True) -> None:
        self._clears = clears
        self._turns = Rollover(12, back=True)
        self._high = UNDATED  # continued high part of the time
        self._low = 0
        self._y = NOWHERE
        self._base = (NOWHERE, False)  # column and polarity
        self.undated = 0
        self.unknown = 0

    def __call__(self, words: NDArray[np.uint16]) -> Iterator[Piece]:
        """Yield the events of the next words, (N,)."""
        for i in range(0, len(words), PART):
            yield self._part(words[i : i + PART])

    def _part(self, words: NDArray[np.uint16]) -> Piece:
        kind = (words >> 12).astype(np.uint8)
        self.unknown += sum(int(np.count_nonzero(kind == free)) for free in set(range(16)) - set(Word))
        counted = COUNTED.take(kind)
        undated = self._high == UNDATED
        rows, times = self._rows(words, kind), self._times(words, kind, counted)
        at = np.flatnonzero((kind == Word.ADDR_X) | (kind == Word.VECT_12) | (kind == Word.VECT_8))
        if undated:
            dated = int(np.argmax(kind == Word.TIME_HIGH)) if self._high != UNDATED else len(kind)
            early = int(np.searchsorted(at, dated))
            self.undated += early
            at = at[early:]
        known = counted.cumsum().take(at)
        place = known >> 32
        base, on, mask = self._columns(words, kind, at)
        piece = Piece(times.take(place), base, rows.take(known & 0xFFFFFFFF), on)
        if mask is None:
            return piece
        bits = set_bits(mask.astype("<u2", copy=False).view(np.uint8))
        count = BITS.take(mask)
        t, x, y, p = (np.repeat(column, count) for column in (piece.t, piece.x, piece.y, piece.p))
        return Piece(t, x + (bits & 15).astype(np.uint16), y, p)

    def _rows(self, words: NDArray[np.uint16], kind: NDArray[np.uint8]) -> NDArray[np.uint16]:
        """Return the row before the first word and after each row word."""
        at = np.flatnonzero(kind <= Word.OTHER_Y)
        out = np.empty(len(at) + 1, np.uint16)
        out[0] = self._y
        out[1:] = np.where(kind[at] == Word.ADDR_Y, words[at] & 2047, NOWHERE)
        self._y = int(out[-1])
        return out

    def _times(
        self, words: NDArray[np.uint16], kind: NDArray[np.uint8], counted: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the time [us] before the first word and after each that sets its low bits.

        TIME_HIGH words that change the high bits do so too; they are added to `counted`.
        """
        at_high = np.flatnonzero(kind == Word.TIME_HIGH)
        highs = self._turns(words.take(at_high) & 4095)
        changes = np.flatnonzero(np.diff(highs, prepend=self._high))
        at_high, highs = at_high[changes], highs[changes]
        counted[at_high] = 1 << 32
        sets = kind == Word.TIME_LOW
        sets[at_high] = True
        at = np.flatnonzero(sets)
        places = np.searchsorted(at, at_high)
        out = np.empty(len(at) + 1, np.int64)
        out[0] = self._low
        out[1:] = words.take(at) & 4095
        if self._clears:
            out[places + 1] = 0
        else:  # the low bits stay those of the last word that told them
            told = np.arange(len(out))
            told[places + 1] = 0
            out = out.take(np.maximum.accumulate(told))
        self._low = int(out[-1])
        counts = np.diff(places + 1, prepend=0, append=len(out))
        high = np.repeat(np.concatenate(([self._high], highs)), counts)
        self._high = int(high[-1])
        out |= high << 12
        return out

    def _columns(
        self, words: NDArray[np.uint16], kind: NDArray[np.uint8], at: NDArray[np.intp]
    ) -> tuple[NDArray[np.uint16], NDArray[np.bool_], NDArray[np.uint16] | None]:
        """Return column, polarity and, where there are vectors, the mask of each event word."""
        kinds, value = kind[at], words[at]
        x, on = value & np.uint16(2047), (value & 2048).astype(np.bool_)
        vectors = np.flatnonzero((kind >= Word.VECT_BASE_X) & (kind <= Word.VECT_8))
        if not len(vectors):
            return x, on, None
        step = STEP[kind[vectors]]
        moved = np.cumsum(step) - step  # by the vectors before
        is_base = kind[vectors] == Word.VECT_BASE_X
        nth = np.cumsum(is_base)
        bases = np.concatenate(([self._base[0]], words[vectors][is_base] & 2047)).astype(np.int64)
        start = bases - np.concatenate(([0], moved[is_base]))
        ons = np.concatenate(([self._base[1]], (words[vectors][is_base] & 2048) > 0))
        column = np.minimum(start[nth] + moved, NOWHERE - 12)
        end = int(start[nth[-1]] + moved[-1] + step[-1])
        self._base = (min(end, NOWHERE), bool(ons[nth[-1]]))
        late = vectors[~is_base]
        kept = late >= at[0] if len(at) else np.zeros(len(late), np.bool_)
        is_vector = kinds >= Word.VECT_12
        x[is_vector] = column[~is_base][kept]
        on[is_vector] = ons[nth[~is_base]][kept]
        mask = np.where(is_vector, value & np.where(kinds == Word.VECT_8, 255, 4095), 1).astype(np.uint16)
        return x, on, mask

    def report(self, source: Source) -> None:
        """Note what was skipped."""
        if self.undated:
            sentence = f"{self.undated} event words before the first time word: skipped"
            source.note(sentence, "refused", "undated", self.undated)
        if self.unknown:
            source.note(f"{self.unknown} words of unknown type: skipped", "refused", "damage", self.unknown)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    decoder = Decoder()
    for words in read_records(source, raw.read_header(source, "EVT3").length, "<u2"):
        yield from decoder(words)
    decoder.report(source)


class _Writer(EventWriter):
    """Writes single events; row and time words only where they change."""

    name = "EVT3"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._t = -1
        self._y = -1

    def _header(self, width: int, height: int) -> bytes:
        self._limit(width, height, 1 << 11)  # 11 bits number columns and rows
        text = f"% evt 3.0\n% format EVT3;height={height};width={width}\n% geometry {width}x{height}\n% end\n"
        return text.encode()

    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes:
        before = np.concatenate(([self._t], t_us[:-1]))
        high, y = t_us >> 12, part.y.astype(np.int64)
        at, between = bridge_gaps(high, max(self._t, 0) >> 12, 1 << 10, self.name)
        new_high = (high != before >> 12) | (before < 0)
        columns = [
            (new_high, _make_words(Word.TIME_HIGH, high & 4095)),
            # also after a new TIME_HIGH, as not every reader clears the low bits there
            ((t_us != before) | new_high, _make_words(Word.TIME_LOW, t_us & 4095)),
            (np.diff(y, prepend=self._y) != 0, _make_words(Word.ADDR_Y, y)),
            (np.ones(len(y), np.bool_), _make_words(Word.ADDR_X, part.x | (part.p.astype(np.int64) << 11))),
        ]
        self._t, self._y = int(t_us[-1]), int(y[-1])
        return weave_words(columns, (at, _make_words(Word.TIME_HIGH, between & 4095))).astype("<u2").tobytes()


def _make_words(kind: Word, value: NDArray[np.int64]) -> NDArray[np.uint16]:
    # of the size in the file: all words of all events are woven together, where memory is what costs
    return ((kind << 12) | value).astype(np.uint16)


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open an EVT3 file for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


FORMAT = camera_format(
    name="EVT3",
    suffixes=(".raw", ".evt3"),
    create=create,
    matches=lambda path, head: raw.parse_header(head).encoding == "EVT3",
    pieces=read_pieces,
    size=raw.read_size,
)
