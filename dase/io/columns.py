"""What the layouts in HDF5 share: columns read slice by slice, and checks before anything is read."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.sequence import coordinates
from dase.io.source import Piece, Size, Source, missing_extra, refuse_bomb

HDF5 = b"\x89HDF\r\n\x1a\n"
HEAP = b"GCOL\x01\0\0\0"
PART = 1 << 20  # events read at once
BLOSC, BLOSC2, ZSTD, LZ4 = 32001, 32026, 32015, 32004  # numbers of filters that hdf5plugin brings

_plugin_tried = False


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading, with the filters of hdf5plugin where that is installed."""
    global _plugin_tried
    if not _plugin_tried:
        _plugin_tried = True
        with suppress(ImportError):
            import hdf5plugin  # noqa: F401  # registers its filters
    check_heaps(path)
    with h5py.File(path, "r") as file:
        yield file


def check_heaps(path: Path) -> None:
    """Raise InputError where a heap of texts is damaged: HDF5 2.0 reads one with an empty hole for ever.

    A heap is "GCOL", version 1, three zeros, u64 size with this head; then objects: u16 number, 6 bytes, u64
    length, data padded to 8 bytes; number 0 is the hole at the end, whose length counts its head.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        begin = 0
        while (begin := content.find(HEAP, begin)) >= 0:
            end = begin + int.from_bytes(content[begin + 8 : begin + 16], "little")
            place = begin + 16
            while place + 16 <= min(end, len(content)):
                length = int.from_bytes(content[place + 8 : place + 16], "little")
                hole = content[place : place + 2] == b"\0\0"
                step = length if hole else 16 + -(-length // 8) * 8
                if step < 16 or place + step > end:
                    raise InputError("a heap of texts is damaged")
                place += step
            begin += len(HEAP)


def has(path: Path, head: bytes, *names: str) -> bool:
    """Whether a file is HDF5 and holds datasets of all these names."""
    if not head.startswith(HDF5):
        return False
    try:
        with h5py.File(path, "r") as file:
            return all(isinstance(file.get(name), h5py.Dataset) for name in names)
    except Exception:  # damaged: left to the reader that is tried at last
        return False


def dataset(file: Any, name: str, ndim: int | None = None) -> Any:
    """Return a dataset; raises InputError where it is missing, absurdly large or needs a filter."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"has no '{name}'")
    if ndim is not None and found.ndim != ndim:
        raise InputError(f"'{name}' must have {ndim} axes, got shape {found.shape}")
    if found.dtype.kind not in "biuf" and found.dtype.names is None:
        raise InputError(f"'{name}' must hold numbers, got {found.dtype}")
    refuse_bomb(found.id.get_storage_size(), found.size * found.dtype.itemsize)
    for number in _filters(found):
        if not h5py.h5z.filter_avail(number):
            if number in (BLOSC, BLOSC2, ZSTD, LZ4):
                raise missing_extra(f"'{name}' is packed in a way that", "hdf5")
            raise InputError(f"'{name}' is packed with HDF5 filter {number}, which is not known here")
    return found


def _filters(found: Any) -> list[int]:
    properties = found.id.get_create_plist()
    return [properties.get_filter(k)[0] for k in range(properties.get_nfilters())]


def columns(
    file: Any, names: tuple[str, str, str, str], part: int = 0
) -> Iterator[tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]]:
    """Yield slices of four columns t, x, y and p; times as the file holds them, ON where p is above zero."""
    found = [dataset(file, name, 1) for name in names]
    length = len(found[0])
    for name, column in zip(names, found, strict=True):
        if len(column) != length:
            raise InputError(f"'{name}' has {len(column)} entries, '{names[0]}' {length}")
    for i in range(0, length, part or PART):
        t, x, y, p = (column[i : i + (part or PART)] for column in found)
        yield t, coordinates(x, names[1]), coordinates(y, names[2]), p > 0


def largest(file: Any, x: str, y: str) -> Size:
    """Return one more than the largest column and row."""
    out = []
    for name in (x, y):
        column = dataset(file, name, 1)
        parts = (column[i : i + PART] for i in range(0, len(column), PART))
        out.append(max((int(part.max()) for part in parts), default=0) + 1)
    return out[0], out[1]


def size_attribute(file: Any, name: str) -> Size | None:
    """Return columns and rows from an attribute of the file that holds rows and columns, or None."""
    value = np.asarray(file.attrs.get(name, []))
    if value.shape != (2,) or value.dtype.kind not in "iu":
        return None
    return int(value[1]), int(value[0])


def scalar(file: Any, name: str) -> int:
    """Return a whole number that a dataset holds, 0 where it is absent."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        return 0
    if found.size != 1 or found.dtype.kind not in "iuf":
        raise InputError(f"'{name}' must be one number, got {found.dtype} of shape {found.shape}")
    return int(np.asarray(found[()]).reshape(-1)[0])


def reader(
    parts: Callable[[Any, Source], Iterator[Piece]],
) -> Callable[[Source], Iterator[Piece]]:
    """Return a reader of pieces that opens the file of a source and keeps it open while it yields."""

    def pieces(source: Source) -> Iterator[Piece]:
        with opened(source.path) as file:
            yield from parts(file, source)

    return pieces
