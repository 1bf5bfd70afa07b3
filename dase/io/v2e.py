"""HDF5 files of v2e (`--dvs_h5`).

    events       [N, 4] uint32: time [us], column, row, 0 or 1
    frame        [F, H, W] uint8, frame_ts [F] uint32 [us], frame_idx [F]: the frames it was simulated from

The frames are instants, without exposure; without them the size is found from the events. Source: v2e (MIT),
Hu et al., v2e: from video frames to realistic DVS events, 2021.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dase.errors import InputError
from dase.io.columns import PART, checked_dataset, has_datasets, open_hdf5, pieces_reader
from dase.io.format import camera_format
from dase.io.sequence import checked_coordinates
from dase.io.source import Picture, Piece, Size, Source


def _read_parts(file: Any, source: Source) -> Iterator[Piece]:
    events = checked_dataset(file, "events", 2)
    if events.shape[1] != 4 or events.dtype.kind not in "iu":
        raise InputError(f"'events' must be whole numbers of shape (N, 4), got {events.dtype} {events.shape}")
    for i in range(0, len(events), PART):
        t, x, y, p = events[i : i + PART].T
        yield Piece(
            t.astype(np.int64),
            checked_coordinates(x, "events[:, 1]"),
            checked_coordinates(y, "events[:, 2]"),
            p,
        )


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames [us]."""
    with open_hdf5(source.path) as file:
        if "frame" not in file or "frame_ts" not in file:
            return
        images, times = checked_dataset(file, "frame", 3), checked_dataset(file, "frame_ts", 1)
        if images.dtype != np.uint8 or len(images) != len(times):
            raise InputError(f"'frame' must be uint8, one for each of the {len(times)} times of 'frame_ts'")
        for k, time in enumerate(times[:].astype(np.int64)):
            yield Picture(images[k], time)


def read_size(source: Source) -> Size | None:
    """Return the size of the frames, or None."""
    with open_hdf5(source.path) as file:
        images = file.get("frame")
        return (images.shape[2], images.shape[1]) if images is not None and images.ndim == 3 else None


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file holds a table of events at its root."""
    return has_datasets(path, head, "events")


FORMAT = camera_format(
    name="v2e HDF5",
    suffixes=(".h5",),
    matches=matches_format,
    pieces=pieces_reader(_read_parts),
    size=read_size,
    pictures=read_pictures,
)
