"""MATLAB files (.mat) with fields x, y, t or ts, p or pol: version 5 to 7, and 7.3, which is HDF5.

    128 bytes: text, u16 version 0x0100, "IM" of a little-endian machine; then elements
    element    u32 type, u32 bytes, data padded to 8; small: u16 type, u16 bytes <= 4, data in 4 bytes
    type 15    zlib stream of one element
    type 14    matrix: elements with u32 flags and class, i32 dimensions, name, then its numbers (which may be
               stored in a smaller type), or of a structure its fields: i32 bytes of a name, names, matrices

The fields are variables of the file or those of a structure in it, as `TD`. Times are microseconds where all
are whole numbers, else seconds. Where the least column and the least row are both 1, MATLAB counted them from
1, and one is taken off; polarities 1 and 2 are OFF and ON. Both is noted. Source: MathWorks, "MAT-File
Format", R2024.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.column_order import LETTERS, is_micro
from dase.io.columns import Hdf5Group, checked_dataset, open_hdf5
from dase.io.format import camera_format
from dase.io.sequence import checked_coordinates
from dase.io.source import BOMB_BYTES, BOMB_RATIO, Piece, Source, refuse_bomb

MAGIC_73 = b"MATLAB 7.3 MAT-file"
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Number of a type in the file to that of NumPy, without the order of its bytes."""


class ElementType(IntEnum):
    """Types of elements that are no numbers."""

    MATRIX = 14
    PACKED = 15


class ArrayClass(IntEnum):
    """Classes of arrays; numbers may have a smaller type in the file than in MATLAB, and keep it here."""

    STRUCTURE = 2
    FIRST_OF_NUMBERS = 6
    LAST_OF_NUMBERS = 15


Columns = dict[str, NDArray[Any]]
"""Values (N,) by the letters t, x, y and p."""


class _Elements:
    """The elements in some bytes, one after the other; InputError where one reaches beyond them."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data, self._order, self._place = data, order, 0

    def __iter__(self) -> Iterator[tuple[int, memoryview]]:
        while self._place + 8 <= len(self._data):
            yield self.take()

    def take(self) -> tuple[int, memoryview]:
        """Return type and data of the next element."""
        if self._place + 8 > len(self._data):
            raise InputError("a variable ends before its parts do")
        kind, size = struct.unpack_from(f"{self._order}II", self._data, self._place)
        if kind >> 16:  # small: both in the first word
            kind, size, begin = kind & 0xFFFF, min(kind >> 16, 4), self._place + 4
            self._place += 8
        else:
            begin = self._place + 8
            # packed elements are not padded
            self._place = begin + (size if kind == ElementType.PACKED else -(-size // 8) * 8)
        if begin + size > len(self._data):
            raise InputError("a variable claims more bytes than the file has")
        return kind, self._data[begin : begin + size]

    def draw_numbers(self) -> NDArray[Any]:
        """Return the numbers of the next element, (N,)."""
        kind, data = self.take()
        if kind not in NUMBERS:
            raise InputError(f"a variable holds values of the unknown type {kind}")
        name = np.dtype(f"{self._order}{NUMBERS[kind]}")
        return np.frombuffer(data, name, len(data) // name.itemsize)


def _unpack(data: memoryview) -> memoryview:
    """Return what a zlib stream holds, if that is no absurd amount."""
    most = max(BOMB_BYTES, BOMB_RATIO * len(data))
    stream = zlib.decompressobj()
    out = stream.decompress(data, most)
    if stream.unconsumed_tail:
        refuse_bomb(len(data), len(out) + BOMB_RATIO * len(data) + 1)
        raise InputError("a packed variable is too large")
    return memoryview(out)


def _read_matrix(data: memoryview, order: str, depth: int = 0) -> tuple[str, Any]:
    """Return name and content of a matrix: numbers (N,), a dictionary of a structure's fields, else None."""
    if not len(data):
        return "", None
    parts = _Elements(data, order)
    flags, sizes = parts.draw_numbers(), parts.draw_numbers()
    _, name = parts.take()
    text = bytes(name).decode("latin-1")
    kind = int(flags[0]) & 255 if len(flags) else 0
    if ArrayClass.FIRST_OF_NUMBERS <= kind <= ArrayClass.LAST_OF_NUMBERS:
        values = parts.draw_numbers()
        if math.prod(sizes.tolist()) != len(values):
            raise InputError(f"'{text}' must have {math.prod(sizes.tolist())} numbers, has {len(values)}")
        return text, values
    if kind == ArrayClass.STRUCTURE and depth == 0 and math.prod(sizes.tolist()) == 1:
        (width,) = parts.draw_numbers().tolist()
        _, names = parts.take()
        if not 0 < width <= 64:
            raise InputError(f"'{text}' claims names of {width} bytes")
        fields = {}
        for i in range(0, len(names) // width * width, width):
            field = bytes(names[i : i + width]).split(b"\0")[0].decode("latin-1")
            inner, matrix = parts.take()
            if inner == ElementType.MATRIX:
                fields[field] = _read_matrix(matrix, order, depth + 1)[1]
        return text, fields
    return text, None


def _variables(source: Source) -> dict[str, Any]:
    """Return the variables of a file of version 5 to 7: numbers (N,), or fields of a structure."""
    data = memoryview(source.path.read_bytes())
    if len(data) < 128 or bytes(data[126:128]) not in (b"IM", b"MI"):
        raise InputError("has no header of a MATLAB file")
    order = "<" if bytes(data[126:128]) == b"IM" else ">"
    out: dict[str, Any] = {}
    unpacked = 0
    for kind, element in _Elements(data[128:], order):
        if kind == ElementType.PACKED:
            content = _unpack(element)
            unpacked += len(content)
            refuse_bomb(len(data), unpacked)
            kind, element = _Elements(content, order).take()
        if kind == ElementType.MATRIX:
            name, values = _read_matrix(element, order)
            out[name] = values
    return out


def _event_columns(variables: dict[str, Any]) -> Columns | None:
    """Return the columns of events among these variables, or in one of the structures among them."""
    found: Columns = {}
    for name, values in variables.items():
        letter = LETTERS.get(name.lower())
        if letter is not None and isinstance(values, np.ndarray | h5py.Dataset):
            found.setdefault(letter, values)
    if len(found) == 4:
        return found
    inner = (_event_columns(values) for values in variables.values() if isinstance(values, dict))
    return next((columns for columns in inner if columns is not None), None)


def _columns_of_73(root: Hdf5Group) -> Columns | None:
    """Return the columns of a file of version 7.3: at its root, or in one of its groups."""
    for group in (root, *(root.get(name) for name in root if not name.startswith("#"))):
        if not isinstance(group, Hdf5Group):
            continue
        names = {LETTERS[name.lower()]: name for name in group if name.lower() in LETTERS}
        if len(names) == 4:
            return {letter: checked_dataset(group, name) for letter, name in names.items()}
    return None


def _pieces_of(source: Source, columns: Columns | None, rows: int = 1 << 20) -> Iterator[Piece]:
    if columns is None:
        raise InputError("has no variables, or fields of a structure, named x, y, t or ts, p or pol")
    length = columns["t"].size
    for letter, column in columns.items():
        if column.size != length:
            raise InputError(f"'{letter}' has {column.size} values, 't' {length}")
    from_one = _least(columns["x"]) == 1 and _least(columns["y"]) == 1
    if from_one and length:
        source.note("columns and rows count from 1, as in MATLAB: one was taken off", "assumed", "origin")
    twos = (
        length > 0 and _least(columns["p"]) == 1 and any(np.any(p > 1) for p in _slices(columns["p"], rows))
    )
    if twos:
        source.note("polarities are 1 and 2: 2 was taken for ON", "assumed", "polarity")
    slices = [_slices(columns[letter], rows) for letter in "txyp"]
    micro: bool | None = None
    for t, x, y, p in zip(*slices, strict=True):
        micro = is_micro(t) if micro is None else micro
        x, y = checked_coordinates(x, "x"), checked_coordinates(y, "y")
        if from_one:
            x, y = x - np.uint16(1), y - np.uint16(1)
        yield Piece(t / 1e6 if micro else t.astype(np.float64), x, y, p > 1 if twos else p)


def _slices(column: Any, rows: int) -> Iterator[NDArray[Any]]:
    """Yield the values of an array or dataset of one long dimension, as (N,), a slice after the other."""
    long = int(np.argmax(column.shape)) if column.ndim else 0
    if column.size != column.shape[long]:
        raise InputError(f"a column must be a vector, got shape {column.shape}")
    for i in range(0, column.size, rows):
        place = tuple(slice(i, i + rows) if k == long else 0 for k in range(column.ndim))
        values = np.asarray(column[place])
        yield values if values.dtype.kind != "b" else values.astype(np.uint8)


def _least(column: Any) -> float:
    return min((float(part.min()) for part in _slices(column, 1 << 20)), default=0.0)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [s]."""
    with source.path.open("rb") as file:
        newer = file.read(len(MAGIC_73)) == MAGIC_73
    if not newer:
        yield from _pieces_of(source, _event_columns(_variables(source)))
        return
    with open_hdf5(source.path) as root:
        yield from _pieces_of(source, _columns_of_73(root))


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file begins as those of MATLAB do."""
    return head.startswith((b"MATLAB 5.0 MAT-file", MAGIC_73))


FORMAT = camera_format(
    name="MATLAB",
    suffixes=(".mat",),
    matches=matches_format,
    pieces=read_pieces,
    size=lambda source: None,
    ticks=1.0,
)
