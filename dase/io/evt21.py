"""Prophesee EVT 2.1: 64-bit little-endian words, up to 32 events of one row and polarity in each.

    bits 63..60  59..54   53..43   42..32   31..0
    0 NEG (OFF)  time     column   row      bit i: an event at column + i
    1 POS (ON)   time     column   row
    8 TIME_HIGH  ---- 28 bits of time ----  bits 33..6; starts over after 4 h 46 min
    10 EXT_TRIGGER, 14 OTHERS, 15 CONTINUED skipped

In files with `endianness=legacy` (IMX636 and older) the two 32-bit halves of a word are swapped; where the
header is silent, the place of the TIME_HIGH words, whose other half is zero, tells. Read only.
Source: docs.prophesee.ai, "EVT 2.1 format".
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dase.io import raw
from dase.io.binary import read_records, set_bits
from dase.io.evt2 import KNOWN, Decoder, Word
from dase.io.format import camera_format
from dase.io.source import Piece, Source

PART = 1 << 16  # words decoded at once
DENSE = 1 << 14  # of them, where each may hold many events: their bits stay in the cache


def expand_masks(base: Piece, mask: NDArray[np.uint32]) -> Iterator[Piece]:
    """Yield an event at column x + i for every bit i of `mask` (N,) that is set, in this order."""
    if mask.all() and not np.any(mask & (mask - np.uint32(1))):  # one event in every word
        exponent = (mask.astype(np.float32).view(np.uint32) >> 23) - 127
        yield base._replace(x=base.x + exponent.astype(np.uint16))
        return
    for i in range(0, len(mask), DENSE):
        place = set_bits(mask[i : i + DENSE].astype("<u4").view(np.uint8))
        out = base.take(i + (place >> 5))
        yield out._replace(x=out.x + (place & 31).astype(np.uint16))


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    header = raw.read_header(source, "EVT21")
    decoder = Decoder()
    swapped: bool | None = None
    for block in read_records(source, header.length, "<u8"):
        halves = block.view("<u4").reshape(-1, 2)
        swapped = _halves_swapped(header, halves) if swapped is None else swapped
        word, mask = halves[:, 0 if swapped else 1], halves[:, 1 if swapped else 0]
        for i in range(0, len(word), PART):
            at, base = decoder.part(word[i : i + PART])
            yield from expand_masks(base, mask[i : i + PART][at])
    decoder.report(source)


def _halves_swapped(header: raw.Header, halves: NDArray[np.uint32]) -> bool:
    """Whether the half with type, time and place comes first."""
    said = header.options.get("endianness", header.keys.get("endianness", ""))
    if said:
        return said == "legacy"
    times = [
        np.count_nonzero((halves[:, i] >> 28 == Word.TIME_HIGH) & (halves[:, 1 - i] == 0)) for i in (0, 1)
    ]
    known = [np.count_nonzero(KNOWN[halves[:, i] >> 28]) for i in (0, 1)]
    return (times[0], known[0]) > (times[1], known[1])


FORMAT = camera_format(
    name="EVT2.1",
    suffixes=(),
    matches=lambda path, head: raw.parse_header(head).encoding == "EVT21",
    pieces=read_pieces,
    size=raw.read_size,
)
