"""NumPy archives as a stream, and structured arrays as other tools store them.

    NAME.npz      our own layout, see `dase.io.npz`, member by member in slices
    NAME.npz      one structured array with fields t, x, y, p
    NAME.npy      such an array alone

Times of structured arrays are in microseconds where they are whole numbers, else in seconds. Fields may also
be called ts or timestamp, xs, ys, ps or polarity or on. Nothing is ever unpickled.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io import npz, rules
from dase.io.format import Format, camera_format, find_extent
from dase.io.sequence import GREYS, Sequence, checked_coordinates, reading_file
from dase.io.source import Beside, Picture, Piece, Source, refuse_bomb

NPY = b"\x93NUMPY"
ZIP = b"PK\x03\x04"
PART = 1 << 18  # events read at once
NAMES = (
    ("t", "ts", "timestamp", "timestamps", "time"),
    ("x", "xs"),
    ("y", "ys"),
    ("p", "ps", "pol", "polarity", "on"),
)
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def _read_header(stream: IO[bytes], packed: int, unpacked: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the header of an array; raises InputError where it holds objects or claims more than there is."""
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise InputError(f"array of unknown version {version}")
    shape, by_column, kind = HEADERS[version](stream)
    if kind.hasobject:
        raise InputError("holds Python objects, which are never unpickled (allow_pickle is off)")
    size = kind.itemsize * int(np.prod([float(n) for n in shape]))
    if size > unpacked or min(shape, default=0) < 0 or (by_column and len(shape) > 1):
        raise InputError(f"array of {kind} {shape} does not fit its {unpacked} bytes")
    refuse_bomb(packed, size)
    return shape, kind


def _read_slices(stream: IO[bytes], count: int, kind: np.dtype[Any], part: int = 0) -> Iterator[NDArray[Any]]:
    part = part or PART
    for i in range(0, count, part):
        size = min(part, count - i) * kind.itemsize
        data = stream.read(size)
        if len(data) != size:
            raise InputError("ends before its events do")
        yield np.frombuffer(data, kind)


def _check_members(archive: zipfile.ZipFile) -> None:
    """Raise InputError where members would unpack to something absurd."""
    for name in npz.KEYS:
        if f"{name}.npy" in archive.NameToInfo:
            info = archive.getinfo(f"{name}.npy")
            with archive.open(info) as stream:
                _read_header(stream, info.compress_size, info.file_size)


def _own_pieces(source: Source) -> Iterator[Piece]:
    with zipfile.ZipFile(source.path) as archive, ExitStack() as stack:
        streams: list[Iterator[NDArray[Any]]] = []
        lengths: list[int] = []
        if any(f"{name}.npy" not in archive.NameToInfo for name in npz.EVENT_KEYS):
            return  # frames alone, or refused by `_own_size`
        labelled = "label.npy" in archive.NameToInfo
        for name in (*npz.EVENT_KEYS, "label") if labelled else npz.EVENT_KEYS:
            info = archive.getinfo(f"{name}.npy")
            stream = stack.enter_context(archive.open(info))
            shape, kind = _read_header(stream, info.compress_size, info.file_size)
            if len(shape) != 1 or (lengths and shape[0] != lengths[0]):
                raise InputError(f"'{name}' must be one number per event, got shape {shape}")
            lengths.append(shape[0])
            streams.append(_read_slices(stream, shape[0], kind))
        for t, x, y, p, *label in zip(*streams, strict=True):
            whole = t.astype(np.int64 if t.dtype.kind in "iu" else np.float64)
            yield Piece(whole, checked_coordinates(x, "x"), checked_coordinates(y, "y"), p, *label)


def _read_maps(archive: zipfile.ZipFile, name: str, stack: ExitStack) -> Iterator[NDArray[Any]]:
    """Yield the frames, (H, W), or the flow, (2, H, W), of an archive one by one."""
    info = archive.getinfo(f"{name}.npy")
    stream = stack.enter_context(archive.open(info))
    shape, kind = _read_header(stream, info.compress_size, info.file_size)
    if name == "frames" and (len(shape) != 3 or kind not in GREYS):
        raise InputError(f"'frames' must be uint8 or uint16 (F, H, W), got {kind} {shape}")
    if name == "flow" and len(shape) != 4:
        raise InputError(f"'flow' must have shape (F, 2, H, W), got {shape}")
    count = int(np.prod(shape[1:]))
    for row in _read_slices(stream, shape[0] * count, kind, count):
        yield row.reshape(shape[1:])


def _own_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames [us], one by one, with the flow at them."""
    with zipfile.ZipFile(source.path) as archive, ExitStack() as stack:
        members = {name for name in npz.KEYS if f"{name}.npy" in archive.NameToInfo}
        if "frames" not in members:
            return
        small = {name: npz.load_member(archive, name) for name in npz.FRAME_KEYS[1:] if name in members}
        times, exposure = npz.frame_times(small)
        rows = [_read_maps(archive, name, stack) for name in ("frames", "flow") if name in members]
        for k, (grey, *flow) in enumerate(zip(*rows, strict=True)):
            yield Picture(
                grey,
                np.nan if times is None else times[k] * 1e6,
                0.0 if exposure is None else float(exposure[k]),
                *flow,
            )


def _read_own(source: Source) -> Sequence:
    with reading_file(source.path, "NumPy archive"), zipfile.ZipFile(source.path) as archive:
        _check_members(archive)
    return npz.read(source)


def _read_beside(source: Source) -> Beside:
    with reading_file(source.path, "NumPy archive"), zipfile.ZipFile(source.path) as archive:
        _check_members(archive)
        names = (n for n in ("thresholds", "configuration") if f"{n}.npy" in archive.NameToInfo)
        return npz.parse_beside({name: npz.load_member(archive, name) for name in names})


def _own_size(source: Source) -> tuple[int, int] | None:
    """Return columns and rows: of the maps where there are any, else as `wh` says, either way round."""
    with zipfile.ZipFile(source.path) as archive:
        _check_members(archive)
        known = [name for name in npz.EVENT_KEYS if f"{name}.npy" in archive.NameToInfo]
        for name in ("frames", "flow", "thresholds"):
            if f"{name}.npy" in archive.NameToInfo:
                info = archive.getinfo(f"{name}.npy")
                with archive.open(info) as stream:
                    shape, _ = _read_header(stream, info.compress_size, info.file_size)
                if len(shape) >= 2:
                    return shape[-1], shape[-2]
        if not known:
            raise InputError(npz.NOTHING)
        if len(known) < len(npz.EVENT_KEYS):
            raise InputError(f"has no '{next(n for n in npz.EVENT_KEYS if n not in known)}'")
        if "wh.npy" not in archive.NameToInfo:
            raise InputError("does not say how large the sensor is")
        with archive.open("wh.npy") as stream:
            wh = np.lib.format.read_array(stream, allow_pickle=False)
    if wh.shape != (2,) or wh.dtype.kind not in "iu":
        raise InputError(f"'wh' must be two integers, got {wh.dtype} of shape {wh.shape}")
    size = int(wh[0]), int(wh[1])
    return size if size[0] == size[1] else rules.turned_size(source, size, find_extent(_own_pieces(source)))


def _event_fields(kind: np.dtype[Any]) -> list[str] | None:
    """Return the names of t, x, y and p in a structured type, None where one is missing."""
    names = {name.lower(): name for name in kind.names or ()}
    found = [next((names[name] for name in known if name in names), None) for known in NAMES]
    return None if None in found else [name for name in found if name is not None]


def _find_table(archive: zipfile.ZipFile) -> tuple[str, int, np.dtype[Any]] | None:
    """Return name, length and type of the first structured array of events."""
    for info in archive.infolist():
        if info.filename.endswith(".npy"):
            with archive.open(info) as stream:
                shape, kind = _read_header(stream, info.compress_size, info.file_size)
            if len(shape) == 1 and _event_fields(kind):
                return info.filename, shape[0], kind
    return None


def _table_pieces(source: Source) -> Iterator[Piece]:
    with ExitStack() as stack:
        if source.path.suffix.lower() == ".npy" or not zipfile.is_zipfile(source.path):
            stream: IO[bytes] = stack.enter_context(source.path.open("rb"))
            length = source.path.stat().st_size
            shape, kind = _read_header(stream, length, length)
            if len(shape) != 1 or not _event_fields(kind):
                raise InputError(f"must be a structured array with fields t, x, y, p, got {kind} {shape}")
            count = shape[0]
        else:
            archive = stack.enter_context(zipfile.ZipFile(source.path))
            found = _find_table(archive)
            if found is None:
                raise InputError("has no structured array with fields t, x, y, p")
            stream = stack.enter_context(archive.open(found[0]))
            count, kind = found[1:]
            _read_header(stream, count * kind.itemsize, archive.getinfo(found[0]).file_size)
        names = _event_fields(kind) or []
        for rows in _read_slices(stream, count, kind):
            t, x, y, p = (rows[name] for name in names)
            time = t.astype(np.float64) if t.dtype.kind == "f" else t.astype(np.int64) / 1e6
            yield Piece(time, checked_coordinates(x, names[1]), checked_coordinates(y, names[2]), p)


def _matches_table(path: Path, head: bytes) -> bool:
    if head.startswith(NPY):
        return True
    if not head.startswith(ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            own = {f"{name}.npy" for name in npz.KEYS} & set(archive.NameToInfo)
            return not own and _find_table(archive) is not None
    except Exception:  # damaged: left to the reader that is tried at last
        return False


_own = camera_format(
    name="NumPy archive",
    suffixes=(),
    matches=_matches_table,
    pieces=_own_pieces,
    size=_own_size,
    pictures=_own_pictures,
)

OWN = Format(
    name="NumPy archive",
    suffixes=(".npz",),
    matches=lambda path, head: head.startswith(ZIP),
    read=_read_own,
    stream=_own.stream,
    pictures=_own.pictures,
    beside=_read_beside,
    create=npz.create,
    keeps=frozenset({"events", "frames", "flow", "thresholds", "configuration"}),
)
TABLE = camera_format(
    name="structured NumPy array",
    suffixes=(".npy",),
    matches=_matches_table,
    pieces=_table_pieces,
    size=lambda source: None,
    ticks=1.0,
)
