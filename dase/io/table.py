"""Plain tables in NumPy files: numbers of shape (N, 4), or (4, N), whose columns have no names.

The order of the columns is told by the user or by the values, see `dase.io.column_order`, and said. Times are
microseconds where all are whole numbers, else seconds.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.arrays import NPY, read_any_header
from dase.io.column_order import is_micro, order_of
from dase.io.format import camera_format
from dase.io.sequence import checked_coordinates
from dase.io.source import Piece, Source


def _blocks(source: Source, rows: int = 1 << 18) -> Iterator[NDArray[Any]]:
    """Yield the table a block of rows after the other, each (N, 4)."""
    length = source.path.stat().st_size
    with source.path.open("rb") as file:
        shape, kind, by_column = read_any_header(file, length, length)
        begin = file.tell()
        if by_column:
            shape = shape[::-1]
        lines = len(shape) == 2 and shape[1] == 4
        if kind.kind not in "iuf" or len(shape) != 2 or 4 not in shape:
            raise InputError(f"must be a table of numbers (N, 4), got {kind} {shape}")
        count = shape[0] if lines else shape[1]
        for i in range(0, count, rows):
            size = min(rows, count - i)
            if lines:
                file.seek(begin + 4 * i * kind.itemsize)
                block = _read(file, 4 * size, kind).reshape(size, 4)
            else:  # four columns one after the other
                columns = []
                for k in range(4):
                    file.seek(begin + (k * count + i) * kind.itemsize)
                    columns.append(_read(file, size, kind))
                block = np.stack(columns, axis=1)
            yield block


def _read(file: Any, count: int, kind: np.dtype[Any]) -> NDArray[Any]:
    data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise InputError("ends before its events do")
    return np.frombuffer(data, kind)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [s]."""
    order, micro = "", False
    for block in _blocks(source):
        if not order:
            order = order_of(source, block)
            micro = is_micro(block[:, order.index("t")])
        t, x, y, p = (block[:, order.index(letter)] for letter in "txyp")
        seconds = t / 1e6 if micro else t.astype(np.float64)
        yield Piece(seconds, checked_coordinates(x, "columns"), checked_coordinates(y, "rows"), p)


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file is an array of four columns."""
    if not head.startswith(NPY):
        return False
    try:
        shape, kind, _ = read_any_header(io.BytesIO(head), 1 << 62, 1 << 62)
    except Exception:  # damaged: left to the reader that is tried at last
        return False
    return len(shape) == 2 and 4 in shape and kind.kind in "iuf"


FORMAT = camera_format(
    name="NumPy table",
    suffixes=(),
    matches=matches_format,
    pieces=read_pieces,
    size=lambda source: None,
    ticks=1.0,
    asks=frozenset({"columns"}),
)
