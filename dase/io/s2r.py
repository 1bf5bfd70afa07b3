"""Our own HDF5 files, of the layout of S2R (`dase.io.h5`), as a stream, and checked before they are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any

import numpy as np

from dase.errors import InputError
from dase.io import h5
from dase.io.columns import (
    HDF5,
    Hdf5Group,
    checked_dataset,
    find_largest,
    open_hdf5,
    pieces_reader,
    read_columns,
    size_attribute,
)
from dase.io.format import Format, camera_format
from dase.io.rules import turned_size
from dase.io.sequence import GREYS, Sequence, reading_file
from dase.io.source import Beside, Picture, Piece, Size, Source

COLUMNS = ("events/ts", "events/xs", "events/ys", "events/ps")


def _read_parts(file: Any, source: Source) -> Iterator[Piece]:
    labelled = "events/labels" in file
    for t, x, y, p, *label in read_columns(file, COLUMNS, beside=("events/labels",) if labelled else ()):
        yield Piece(t.astype(np.float64), x, y, p, *label)


def _read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames [s] with the flow at them, not a number where there is none."""
    with open_hdf5(source.path) as file:
        flows, images = h5.numbered_members(file, "flow"), h5.numbered_members(file, "images")
        for name, image in images.items():
            grey = h5.checked_member(image, GREYS, 2)
            flow = h5.checked_member(flows[name], (np.float32,), 3) if name in flows else None
            if flow is None and flows:
                flow = np.full((2, *grey.shape), np.nan, np.float32)
            yield Picture(grey, h5.time_of(image), h5.exposure_of(image), flow)


def _read_size(source: Source) -> Size | None:
    """Return columns and rows: of the first map where there is any, else of the attribute, either way."""
    with open_hdf5(source.path) as file:
        _check_layout(file)
        for group in ("images", "flow"):
            for name in file.names(group):
                shape = checked_dataset(file, f"{group}/{name}").shape
                if len(shape) >= 2:
                    return shape[-1], shape[-2]
        size = size_attribute(file, "sensor_resolution")
        if size is None:
            raise InputError("does not say how large the sensor is")
        return turned_size(source, size, find_largest(file, COLUMNS[1], COLUMNS[2]))


def _check_layout(file: Any) -> None:
    """Raise InputError where nothing of the layout is there, or something is absurdly large."""
    if not any(name in file for name in (*COLUMNS, "images")):
        held = ", ".join(islice(_list_names(file), 6))
        raise InputError(
            f"is HDF5 of no known layout (S2R, DSEC, MVSEC, v2e, Prophesee): holds {held or 'nothing'}"
        )
    # of each group only what a reader takes from it; what lies deeper is never asked for
    for name in (*COLUMNS, "events/labels", "dase/thresholds"):
        if name in file:
            checked_dataset(file, name)
    for group in ("images", "flow"):
        h5.numbered_members(file, group)


def _list_names(file: Hdf5Group) -> Iterator[str]:
    """Yield the names at the root of a file and one level below; links that lead out are names, too."""
    for name in file:
        yield name
        with suppress(Exception):  # whatever a damaged file makes of it
            inner = file.get(name)
            yield from (f"{name}/{one}" for one in (inner if isinstance(inner, Hdf5Group) else ()))


def _read_beside(source: Source) -> Beside:
    with reading_file(source.path, "HDF5"), open_hdf5(source.path) as file:
        _check_layout(file)
        return h5.read_beside(file)


def read(source: Source) -> Sequence:
    """Read a file; raises InputError where it is damaged, incomplete or of no known layout."""
    with reading_file(source.path, "HDF5"), open_hdf5(source.path) as file:
        _check_layout(file)
    return h5.read(source)


_streamed = camera_format(
    name="HDF5",
    suffixes=(),
    matches=lambda path, head: False,
    pieces=pieces_reader(_read_parts),
    size=_read_size,
    pictures=_read_pictures,
    ticks=1.0,
)

FORMAT = Format(
    name="HDF5",
    suffixes=(".h5", ".hdf5"),
    matches=lambda path, head: head.startswith(HDF5),
    read=read,
    stream=_streamed.stream,
    pictures=_streamed.pictures,
    beside=_read_beside,
    create=h5.create,
    keeps=frozenset({"events", "frames", "flow", "thresholds", "configuration"}),
)
