"""NumPy archives of one sequence: small enough for memory, readable without this package.

    t_us (int32 [us]), x, y (uint16), p (uint8, 1 = ON)      shape (N,), sorted by time
    label (int8, where known)                                shape (N,), places in `dase.events.LABELS`
    wh                                                       [width, height]
    frames (uint8 or uint16)                                 shape (F, H, W)
    frame_begin_us, frame_end_us (int32 [us])                shape (F,), begin and end of the exposure
    flow (float32 [px/s], x then y)                          shape (F, 2, H, W)
    thresholds (float32, OFF then ON)                        shape (2, H, W)
    configuration                                            TOML text

Read beside that: `frame_us` instead of begin and end, frames without times, frames without events, and flow
without frames, which is then taken as the displacement over the whole stream [px].
"""

from __future__ import annotations

import zipfile
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.rules import sensor_events
from dase.io.sequence import GREYS, Grey, Sequence, Writer, checked_coordinates, reading_file, writing_file
from dase.io.source import Beside, Piece, Source

EVENT_KEYS = ("t_us", "x", "y", "p")
FRAME_KEYS = ("frames", "frame_begin_us", "frame_end_us", "frame_us")
KEYS = (*EVENT_KEYS, "label", "wh", *FRAME_KEYS, "flow", "thresholds", "configuration")

NOTHING = "has neither events (t_us, x, y, p) nor frames"


class _Writer(Writer):
    """Keeps all parts in memory and writes them at the end, for an array needs its length first."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._parts: list[tuple[NDArray[Any], ...]] = []
        self._labels: list[NDArray[np.int8]] = []
        self._images: list[NDArray[Grey]] = []
        self._flow: list[NDArray[np.float32]] = []
        self._begin_us: list[NDArray[np.int32]] = []
        self._end_us: list[NDArray[np.int32]] = []
        self._extra: dict[str, NDArray[Any]] = {}
        path.touch()  # so that a folder without permission is noticed before the work

    def _put_events(self, part: Events) -> None:
        self._parts.append(_event_columns(part))
        if part.label is not None:
            self._labels.append(part.label.astype(np.int8))

    def _put_frame(
        self,
        index: int,
        time: float,
        grey: NDArray[Grey],
        flow: NDArray[np.float32] | None,
        exposure: float,
    ) -> None:
        self._images.append(grey.copy())
        self._begin_us.append(_to_microseconds(time - exposure / 2))
        self._end_us.append(_to_microseconds(time + exposure / 2))
        if flow is not None:
            self._flow.append(flow.astype(np.float32))

    def _put_thresholds(self, values: NDArray[np.float32]) -> None:
        self._extra["thresholds"] = values

    def _put_configuration(self, text: str) -> None:
        self._extra["configuration"] = np.array(text)

    def finish(self) -> None:
        """Write the archive."""
        assert self.size is not None
        parts = [_event_columns(Events.empty(1, 1)), *self._parts]
        # deflate level 1 takes 7.2 M events of a DAVIS240C from 9.0 to 2.8 bytes each, writing 10 M and
        # reading 41 M events/s on one core; level 6 takes 2.5 bytes but writes 2 M events/s
        with zipfile.ZipFile(self._path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, column in zip(EVENT_KEYS, zip(*parts, strict=True), strict=True):
                _store_member(archive, name, np.concatenate(column))
            if self._with_labels:
                _store_member(archive, "label", np.concatenate([np.empty(0, np.int8), *self._labels]))
            _store_member(archive, "wh", np.array(self.size[::-1], np.int64))
            if self._images:
                _store_member(archive, "frames", np.stack(self._images))
                _store_member(archive, "frame_begin_us", np.stack(self._begin_us))
                _store_member(archive, "frame_end_us", np.stack(self._end_us))
            if self._flow:
                _store_member(archive, "flow", np.stack(self._flow))
            for name, value in self._extra.items():
                _store_member(archive, name, value)

    def abandon(self) -> None:
        """Let go of the parts."""
        self._parts.clear()
        self._labels.clear()


def _event_columns(part: Events) -> tuple[NDArray[Any], ...]:
    """Copies of t, x, y and p, each (N,), as the archive holds them."""
    return _to_microseconds(part.t), part.x.copy(), part.y.copy(), part.p.astype(np.uint8)


def _to_microseconds(seconds: ArrayLike) -> NDArray[np.int32]:
    """Round times [s] to whole microseconds; raises InputError where int32 cannot hold them."""
    out = np.rint(np.asarray(seconds, np.float64) * 1e6)
    if out.size and max(-float(out.min()), float(out.max())) >= 2**31:
        worst = float(out.min() if -out.min() > out.max() else out.max()) / 1e6
        raise InputError(f"npz: times must stay below 2^31 us = 2147 s, got {worst:g} s; use .h5 instead")
    return out.astype(np.int32)


def _store_member(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    # a member opened by its name is dated 1980, always: the same content gives the same bytes
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, array, allow_pickle=False)


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open an archive for writing; it appears under its name when the block ends well.

    The whole sequence waits in memory until then: use HDF5 for long ones.
    """
    return writing_file(path, _Writer)


def read(source: Source) -> Sequence:
    """Read an archive; raises InputError where it is damaged or incomplete. Pickled members are refused."""
    with reading_file(source.path, "NumPy archive"), zipfile.ZipFile(source.path) as archive:
        there = set(archive.namelist())
        idle = {"flow"} if not source.flow and "frames.npy" in there else set()
        known = (name for name in KEYS if f"{name}.npy" in there and name not in idle)
        return _parse_members(source, {name: load_member(archive, name) for name in known})


def load_member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """Return a member of the archive, of whatever shape; never unpickles."""
    with archive.open(f"{name}.npy") as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _parse_members(source: Source, content: dict[str, NDArray[Any]]) -> Sequence:
    frames, flow, thresholds = (content.get(name) for name in ("frames", "flow", "thresholds"))
    if frames is not None and (frames.dtype not in GREYS or frames.ndim != 3):
        raise InputError(f"'frames' must be uint8 or uint16 (F, H, W), got {frames.dtype} {frames.shape}")
    if frames is None and not set(EVENT_KEYS) & set(content):
        raise InputError(NOTHING)
    events = _parse_events(source, content, (frames, flow, thresholds))
    if flow is not None and frames is None:
        flow = flow / max(float(events.t[-1] - events.t[0]), 1e-6) if len(events) else None
    times, exposure = (None, None) if frames is None else frame_times(content)
    thresholds, configuration = parse_beside(content)
    return Sequence(
        events,
        frames,
        times,
        None if flow is None else flow.astype(np.float32, copy=False),
        thresholds,
        configuration,
        exposure,
    )


def parse_beside(content: dict[str, NDArray[Any]]) -> Beside:
    """Return the thresholds [log intensity], shape (2, H, W), and the configuration, None where absent."""
    thresholds, configuration = content.get("thresholds"), content.get("configuration")
    return (
        None if thresholds is None else thresholds.astype(np.float32, copy=False),
        None if configuration is None else str(configuration),
    )


def _parse_events(
    source: Source, content: dict[str, NDArray[Any]], maps: tuple[NDArray[Any] | None, ...]
) -> Events:
    if not set(EVENT_KEYS) & set(content):
        frames = maps[0]
        assert frames is not None
        return Events.empty(frames.shape[2], frames.shape[1])
    missing = [name for name in EVENT_KEYS if name not in content]
    if missing:
        raise InputError(f"has no '{missing[0]}'")
    wh = content.get("wh")
    if wh is not None and (wh.shape != (2,) or wh.dtype.kind not in "iu"):
        raise InputError(f"'wh' must be two integers, got {wh.dtype} of shape {wh.shape}")
    x, y = (checked_coordinates(content[name], name) for name in "xy")
    piece = Piece(content["t_us"] / 1e6, x, y, content["p"], content.get("label"))
    return sensor_events(source, piece, size=None if wh is None else (int(wh[0]), int(wh[1])), maps=maps)


def frame_times(
    content: dict[str, NDArray[Any]],
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Return middle and duration of the exposures [s], each (F,) or None."""
    if "frame_us" in content:
        return content["frame_us"] / 1e6, None
    if "frame_begin_us" not in content or "frame_end_us" not in content:
        return None, None
    begin = content["frame_begin_us"].astype(np.float64)
    end = content["frame_end_us"].astype(np.float64)
    exposure = (end - begin) / 1e6
    return (begin + end) / 2e6, exposure if exposure.any() else None
