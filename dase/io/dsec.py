"""HDF5 files of DSEC and of data sets that took its layout over (M3ED, TUM-VIE, eTraM and others).

    events/t, x, y, p       times [us] from the begin, columns, rows, 1 = ON; M3ED: prophesee/left/...
    t_offset                [us] to add for the clock of the frames
    ms_to_idx               index of the first event of each millisecond; not needed to read all

The columns are packed with Blosc, which the extra "hdf5" (hdf5plugin) unpacks. Times are those of `events/t`;
`t_offset` is noted. The size of the sensor is M3ED's `calib/resolution` or found from the events. Frames are
files of their own, of another size, and are not read. Source: Gehrig et al., DSEC: a stereo event camera
dataset for driving scenarios, 2021; dsec.ifi.uzh.ch/data-format.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dase.errors import InputError
from dase.io.columns import find_largest, has_datasets, open_hdf5, pieces_reader, read_columns, read_scalar
from dase.io.format import camera_format
from dase.io.source import Piece, Size, Source

GROUPS = ("events", "prophesee/left")


def _events_group(file: Any) -> str:
    for group in GROUPS:
        if f"{group}/t" in file:
            return group
    raise InputError("has no 'events/t'")


def _column_names(group: str) -> tuple[str, str, str, str]:
    t, x, y, p = (f"{group}/{name}" for name in "txyp")
    return t, x, y, p


def _read_parts(file: Any, source: Source) -> Iterator[Piece]:
    offset = read_scalar(file, "t_offset")
    if offset:
        source.note(f"t_offset: add {offset / 1e6:.6f} s for the clock of the frames", "said", "offset")
    for t, x, y, p in read_columns(file, _column_names(_events_group(file))):
        yield Piece(t.astype(np.float64 if t.dtype.kind == "f" else np.int64), x, y, p)


def read_size(source: Source) -> Size | None:
    """Return columns and rows where the file tells them."""
    with open_hdf5(source.path) as file:
        found = file.get(f"{_events_group(file)}/calib/resolution")
        if isinstance(found, h5py.Dataset) and found.shape == (2,) and found.dtype.kind in "iu":
            return int(found[0]), int(found[1])
    return None


def find_extent(source: Source) -> Size:
    """Return one more than the largest column and row."""
    with open_hdf5(source.path) as file:
        return find_largest(file, *_column_names(_events_group(file))[1:3])


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file holds the four columns."""
    return any(has_datasets(path, head, *_column_names(group)) for group in GROUPS)


FORMAT = camera_format(
    name="DSEC HDF5",
    suffixes=(".h5", ".hdf5"),
    extra="hdf5",
    matches=matches_format,
    pieces=pieces_reader(_read_parts),
    size=read_size,
    extent=find_extent,
)
