"""As much of FlatBuffers as AEDAT 4 needs: fields of one table, every access checked against the buffer.

    u32 place of the root table
    table     i32 distance back to its list of fields, then the values
    fields    u16 size of the list, u16 size of the table, then u16 places in the table, 0 where absent
    vectors   u32 distance from the field to u32 count, then the elements

Source: flatbuffers.dev, "FlatBuffer Internals".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError


@dataclass(frozen=True)
class Table:
    """A table at a place of a buffer; raises InputError or struct.error where it leads out of the buffer."""

    data: bytes
    place: int

    @classmethod
    def root(cls, data: bytes) -> Table:
        """Return the root table of a buffer without its size prefix."""
        return cls(data, _read_u32(data, 0))

    def _field(self, index: int) -> int | None:
        """Return the place of a field, None where it is absent."""
        fields = self.place - int(_unpack_number("<i", self.data, self.place))
        size = int(_unpack_number("<H", self.data, fields))
        entry = 4 + 2 * index
        offset = int(_unpack_number("<H", self.data, fields + entry)) if entry + 2 <= size else 0
        return self.place + offset if offset else None

    def number(self, index: int, kind: str, default: int) -> int:
        """Return a whole number field."""
        return int(self.real(index, kind, default))

    def real(self, index: int, kind: str, default: float) -> float:
        """Return a number field."""
        place = self._field(index)
        return default if place is None else _unpack_number(kind, self.data, place)

    def structs(self, index: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """Return a vector of structs, (N,); empty where it is absent."""
        place = self._field(index)
        if place is None:
            return np.empty(0, kind)
        place += _read_u32(self.data, place)
        count = _read_u32(self.data, place)
        if place + 4 + count * kind.itemsize > len(self.data):
            raise InputError(f"a vector claims {count} elements, more than the packet holds")
        return np.frombuffer(self.data, kind, count, place + 4)

    def tables(self, index: int) -> list[Table]:
        """Return a vector of tables; empty where it is absent."""
        offsets = self.structs(index, np.dtype("<u4"))
        if not len(offsets):
            return []
        place = self._field(index) or 0
        first = place + _read_u32(self.data, place) + 4
        return [Table(self.data, first + 4 * k + int(offset)) for k, offset in enumerate(offsets)]

    def text(self, index: int) -> bytes:
        """Return a text field."""
        return self.structs(index, np.dtype("u1")).tobytes()


def _read_u32(data: bytes, place: int) -> int:
    return int(_unpack_number("<I", data, place))


def _unpack_number(kind: str, data: bytes, place: int) -> Any:
    if place < 0:
        raise InputError("a place lies before the buffer")
    return struct.unpack_from(kind, data, place)[0]
