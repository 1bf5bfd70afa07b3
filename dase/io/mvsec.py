"""HDF5 files of MVSEC: `NAME_data.hdf5`, and its ground truth `NAME_gt.hdf5` beside it.

    davis/left/events              [N, 4]: column, row, time [Unix s], polarity -1 or 1
    davis/left/image_raw           [F, 260, 346] uint8
    davis/left/image_raw_ts        [F] [Unix s]
    davis/left/flow_dist, flow_dist_ts     in the ground truth: [K, 2, 260, 346] displacement [px] from each
                                   time to the next, x then y, not rectified

The left camera is read, the right one where there is no left. Times count from the first event. Flow becomes
px/s and is given at the frames, by the map whose interval holds the frame, not a number outside; ground truth
too large for memory is left out, and said. Source: Zhu et al., The multivehicle stereo event camera dataset,
2018.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.columns import PART, checked_dataset, has_datasets, open_hdf5, pieces_reader
from dase.io.format import camera_format
from dase.io.sequence import checked_coordinates
from dase.io.source import Picture, Piece, Size, Source

CAMERAS = ("davis/left", "davis/right")
FLOW_LIMIT = 1 << 30  # [bytes] of flow taken into memory


def _find_camera(file: Any) -> str:
    for camera in CAMERAS:
        if f"{camera}/events" in file:
            return camera
    raise InputError("has no 'davis/left/events'")


def _read_parts(file: Any, source: Source) -> Iterator[Piece]:
    events = checked_dataset(file, f"{_find_camera(file)}/events", 2)
    if events.shape[1] != 4:
        raise InputError(f"'{events.name}' must have shape (N, 4), got {events.shape}")
    for i in range(0, len(events), PART):
        part = events[i : i + PART]
        x, y = (checked_coordinates(part[:, k], f"{events.name}[:, {k}]") for k in (0, 1))
        yield Piece(part[:, 2].astype(np.float64), x, y, part[:, 3])


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames [s] and, from the ground truth beside the file, the flow at them."""
    with open_hdf5(source.path) as file, ExitStack() as stack:
        camera = _find_camera(file)
        if f"{camera}/image_raw" not in file:
            return
        images, times = (
            checked_dataset(file, f"{camera}/image_raw", 3),
            checked_dataset(file, f"{camera}/image_raw_ts", 1),
        )
        if images.dtype != np.uint8 or len(images) != len(times):
            raise InputError(f"'{images.name}' must be uint8, one for each of the {len(times)} times")
        t = times[:].astype(np.float64)
        flow = _read_flow(source, camera, t, images.shape[1:], stack)
        for k, time in enumerate(t):
            yield Picture(images[k], time, flow=next(flow, None))


def _read_flow(
    source: Source, camera: str, t: NDArray[np.float64], shape: tuple[int, int], stack: ExitStack
) -> Iterator[NDArray[np.float32]]:
    """Yield the flow [px/s] at the times of frames, (2, H, W), from the ground truth beside the file."""
    path = source.path.with_name(source.path.name.replace("_data.", "_gt."))
    if path == source.path or not path.is_file():
        return
    if 8 * len(t) * shape[0] * shape[1] > FLOW_LIMIT:
        sentence = f"the flow of {path.name} needs more than {FLOW_LIMIT >> 30} GiB of memory: left out"
        return source.note(sentence, "refused", "flow")
    file = stack.enter_context(open_hdf5(path))
    if f"{camera}/flow_dist" not in file:
        return
    flow = checked_dataset(file, f"{camera}/flow_dist", 4)
    begin = checked_dataset(file, f"{camera}/flow_dist_ts", 1)[:].astype(np.float64)
    if flow.shape != (len(begin), 2, *shape):
        raise InputError(f"{path.name}: '{flow.name}' must have shape (K, 2, H, W), got {flow.shape}")
    interval = np.diff(begin)
    for k in np.searchsorted(begin, t, side="right") - 1:
        known = 0 <= k < len(interval) and interval[k] > 0
        yield (
            (flow[k] / interval[k]).astype(np.float32) if known else np.full((2, *shape), np.nan, np.float32)
        )


def read_size(source: Source) -> Size | None:
    """Return the size of the frames, or that of a DAVIS346."""
    with open_hdf5(source.path) as file:
        images = file.get(f"{_find_camera(file)}/image_raw")
        found = images is not None and images.ndim == 3
        return (images.shape[2], images.shape[1]) if found else (346, 260)


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file holds the events of a DAVIS of MVSEC."""
    return any(has_datasets(path, head, f"{camera}/events") for camera in CAMERAS)


FORMAT = camera_format(
    name="MVSEC HDF5",
    suffixes=(".hdf5",),
    matches=matches_format,
    pieces=pieces_reader(_read_parts),
    size=read_size,
    pictures=read_pictures,
    ticks=1.0,
)
