"""Prophesee DAT: fixed records behind a header of `%` lines.

    header    % Version 2, % Height 480, % Width 640, ...; then a byte type (0 or 12: events), a byte size 8
    record    u32 time [us], starts over after 71 min; u32 with column 13..0, row 27..14, polarity 31..28

Version 1 numbers columns with 9 bits (8..0), rows with 8 (16..9), and has polarity in bit 17. All
little-endian. Source: docs.prophesee.ai, "DAT file format".
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io import raw
from dase.io.binary import EventWriter, Rollover, read_records
from dase.io.format import camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Piece, Source

EVENTS = bytes((12, 8))
"""What stands between header and records: their type, 12 (or 0) for changes of contrast, and their bytes."""


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    with source.path.open("rb") as file:
        if not matches_format(source.path, file.read(raw.LONGEST)):
            raise InputError("has no DAT header")
    header = raw.read_header(source)
    version = header.keys.get("Version", "2")
    if version not in ("1", "2"):
        raise InputError(f"DAT version {version} is not known, only 1 and 2")
    bits_x, bits_y = (9, 8) if version == "1" else (14, 14)
    turns = Rollover(32)
    for block in read_records(source, header.length + 2, np.dtype([("t", "<u4"), ("a", "<u4")])):
        address = block["a"]
        x = (address & ((1 << bits_x) - 1)).astype(np.uint16)
        y = ((address >> bits_x) & ((1 << bits_y) - 1)).astype(np.uint16)
        polarity = (address >> (bits_x + bits_y)) & (1 if version == "1" else 15)
        yield Piece(turns(block["t"]), x, y, polarity > 0)


def matches_format(path: Path, head: bytes) -> bool:
    """Whether the header is followed by type and size of events."""
    header = raw.parse_header(head)
    return (
        bool(header.length)
        and header.encoding is None
        and head[header.length : header.length + 2] in (EVENTS, bytes((0, 8)))
    )


class _Writer(EventWriter):
    name = "DAT"

    def _header(self, width: int, height: int) -> bytes:
        self._limit(width, height, 1 << 14)
        text = f"% Data file containing CD events.\n% Version 2\n% Height {height}\n% Width {width}\n"
        return text.encode() + EVENTS

    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes:
        if t_us[-1] >= 2**32:
            raise InputError(f"DAT: times must stay below 2^32 us = 4294 s, got {part.t[-1]:g} s")
        out = np.empty((len(part), 2), "<u4")
        out[:, 0] = t_us
        out[:, 1] = part.x | (part.y.astype(np.uint32) << 14) | (part.p.astype(np.uint32) << 28)
        return out.tobytes()


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open a DAT file for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


FORMAT = camera_format(
    name="DAT",
    suffixes=(".dat",),
    create=create,
    matches=matches_format,
    pieces=read_pieces,
    size=raw.read_size,
)
