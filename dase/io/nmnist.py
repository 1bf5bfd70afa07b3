"""N-MNIST and N-Caltech101 (.bin): five bytes per event, without any header.

    u8 column, u8 row, bit 7 of the third byte: ON; the other 23 bits, big-endian: time [us]
    row 240     no event: the time goes on by 8192 us

As nothing marks such a file, one is known by its suffix and by events that could be: whole records, times
that hardly go back. Source: Orchard et al., Converting static image datasets to spiking neuromorphic datasets
using saccades, 2015.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.io.binary import read_records
from dase.io.format import camera_format, find_extent
from dase.io.source import Piece, Size, Source

RECORD = np.dtype([("x", "u1"), ("y", "u1"), ("t", "u1", 3)])
SMALL = (34, 34)  # of N-MNIST


def _decode(block: NDArray[np.void], begin: int) -> tuple[Piece, int]:
    """Return the events of records, and how far overflows moved the time so far [us]."""
    high, middle, low = block["t"].astype(np.int64).T
    over = block["y"] == 240  # no row: the time goes on by 2^13 us
    moved = begin + np.cumsum(over) * (1 << 13)
    t = ((high & 127) << 16 | middle << 8 | low) + moved
    good = np.flatnonzero(~over)
    x, y = (block[name][good].astype(np.uint16) for name in "xy")
    return Piece(t[good], x, y, high[good] > 127), int(moved[-1]) if len(moved) else begin


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [us]."""
    moved = 0
    for block in read_records(source, 0, RECORD):
        piece, moved = _decode(block, moved)
        yield piece


def read_size(source: Source) -> Size | None:
    """Return the size of N-MNIST where all events fit it, else None."""
    width, height = find_extent(read_pieces(source))
    return SMALL if width <= SMALL[0] and height <= SMALL[1] else None


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file could be of N-MNIST: nothing marks one, so its suffix must say so as well."""
    if path.suffix.lower() != ".bin" or len(head) < RECORD.itemsize:
        return False
    piece, _ = _decode(np.frombuffer(head, RECORD, len(head) // RECORD.itemsize), 0)
    back = np.count_nonzero(np.diff(piece.t) < 0)
    return bool(len(piece.t) and back <= 0.01 * len(piece.t))


FORMAT = camera_format(
    name="N-MNIST",
    suffixes=(),  # which so many files have that content must say so as well
    matches=matches_format,
    pieces=read_pieces,
    size=read_size,
)
