"""Our own HDF5 files, of the layout of S2R (`dase.io.h5`), as a stream, and checked before they are read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from dase.errors import InputError
from dase.io import h5
from dase.io.columns import HDF5, columns, dataset, largest, opened, reader, size_attribute
from dase.io.sequence import Sequence, reading
from dase.io.source import Format, Piece, Size, Source, camera_format

COLUMNS = ("events/ts", "events/xs", "events/ys", "events/ps")
LAYOUTS = "S2R, DSEC, MVSEC, v2e, Prophesee"


def _parts(file: Any, source: Source) -> Iterator[Piece]:
    for t, x, y, p in columns(file, COLUMNS):
        yield Piece(t.astype(np.float64), x, y, p)


def _size(source: Source) -> Size | None:
    """Return columns and rows: of the first map where there is any, else of the attribute, either way."""
    with opened(source.path) as file:
        _check(file)
        for group in ("images", "flow"):
            for name in file.get(group, ()):
                shape = dataset(file, f"{group}/{name}").shape
                if len(shape) >= 2:
                    return shape[-1], shape[-2]
        size = size_attribute(file, "sensor_resolution")
        if size is None:
            raise InputError("does not say how large the sensor is")
        width, height = largest(file, COLUMNS[1], COLUMNS[2])
        return size if width <= size[0] and height <= size[1] else size[::-1]


def _check(file: Any) -> None:
    """Raise InputError where nothing of the layout is there, or something is absurdly large."""
    if not any(name in file for name in (*COLUMNS, "images")):
        held: list[str] = []
        file.visit(lambda name: held.append(name) if len(held) < 6 else None)
        raise InputError(f"is HDF5 of no known layout ({LAYOUTS}): holds {', '.join(held) or 'nothing'}")

    def check(name: str, found: Any) -> None:
        if isinstance(found, h5py.Dataset) and name.split("/")[0] in ("events", "images", "flow", "dase"):
            dataset(file, name)

    file.visititems(check)


def read(source: Source) -> Sequence:
    """Read a file; raises InputError where it is damaged, incomplete or of no known layout."""
    with reading(source.path, "HDF5"), opened(source.path) as file:
        _check(file)
    return h5.read(source.path)


_streamed = camera_format(
    name="HDF5",
    suffixes=(),
    matches=lambda path, head: False,
    pieces=reader(_parts),
    size=_size,
    ticks=1.0,
)

FORMAT = Format(
    name="HDF5",
    suffixes=(".h5", ".hdf5"),
    matches=lambda path, head: head.startswith(HDF5),
    read=read,
    stream=_streamed.stream,
    create=h5.create,
    keeps=frozenset({"events", "frames", "flow", "thresholds", "configuration"}),
)
