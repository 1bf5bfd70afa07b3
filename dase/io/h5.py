"""HDF5 files in the layout of S2R (Stoffregen et al., Reducing the sim-to-real gap for event cameras, 2020).

    events/xs, ys (int16), ts (float64 [s]), ps (bool)       shape (N,)
    events/labels (int8, where known)                        shape (N,), places in `dase.events.LABELS`
    images/image%09d (uint8 or 16, H x W)                    attributes size, timestamp, type, event_idx
    flow/flow%09d (float32 [px/s], 2 x H x W, x then y)      attributes size, timestamp, event_idx
    dase/thresholds (float32, 2 x H x W), attribute configuration
    root attributes num_events, num_pos, num_neg, duration, t0, tk, num_imgs, num_flow,
    sensor_resolution (height, width)

`event_idx` is the index of the last event before the frame, 0 where there is none. `labels` are our addition
to the events, and `exposure` [s] to the attributes of an image that was not taken in an instant.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from functools import lru_cache
from io import FileIO
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import h5py
import numpy as np
from h5py import h5a, h5d, h5p, h5s, h5t
from isal import isal_zlib
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io import columns
from dase.io.rules import sensor_events
from dase.io.sequence import GREYS, Grey, Sequence, Writer, checked_coordinates, reading_file, writing_file
from dase.io.source import Beside, Piece, Source, refuse_bomb
from dase.kernels.threads import thread_count

CHUNK = 1 << 16  # events; 512 KiB of times fit HDF5's default chunk cache of 1 MiB
BLOCK = 4 * CHUNK  # events gathered before they are written

# Measured on 7.2 M events of a DAVIS240C, one core (bytes per event with times in whole us / exact;
# written and read per second, decoded size of 13 bytes per event):
#   none             13.1 / 13.1    1000-1500 MB/s written   2500-3500 MB/s read
#   lzf               6.0 / 10.4          240                       470
#   lzf + shuffle     5.0 /  6.7          185                       310-420
#   gzip-1 + shuffle  4.1 /  6.1          90-115                    355-500
# lzf would be twice as fast, but reads its hash table uninitialised: the same events give files that differ
# by some bytes. Smooth flow shrinks by 4.3. Frames do not shrink. Whole chunks go past HDF5's own filter, to
# ISA-L (`deflate_bytes`), which makes the same kind of stream, of about the same size, six to nine times as
# fast.
COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

LATE = -1  # marks a frame that came after later events had been written

EVENT_TYPES: dict[str, type[np.generic]] = {
    "ts": np.float64,
    "xs": np.int16,
    "ys": np.int16,
    "ps": np.bool_,
}
LABEL_TYPE: dict[str, type[np.generic]] = {"labels": np.int8}


class _Disk:
    """A file for HDF5 to write to that never fails, but remembers the first failure.

    HDF5 2.0 does not survive a failed write: h5py swallows some of the errors and the process crashes later.
    An exception such as KeyboardInterrupt that arrives in these methods would be a failed write too.
    """

    def __init__(self, path: Path) -> None:
        self._file = FileIO(path, "w+")
        self.failure: BaseException | None = None

    def check(self) -> None:
        """Raise what went wrong so far."""
        if self.failure is not None:
            raise self.failure

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: memoryview) -> int:
        """Fill all of `buffer`, with zeros where the file has nothing because writing failed."""
        count = self._file.readinto(buffer) or 0
        buffer[count:] = bytes(len(buffer) - count)
        return len(buffer)

    def read(self, size: int) -> bytes:
        return self._file.read(size) or b""

    def write(self, buffer: memoryview) -> int:
        """Write all of `buffer`, or nothing any more once something failed."""
        try:
            done = 0
            while self.failure is None and done < len(buffer):
                done += self._file.write(buffer[done:])
        except BaseException as error:
            self.failure = error
        return len(buffer)

    def truncate(self, size: int) -> None:
        try:
            if self.failure is None:
                self._file.truncate(size)
        except BaseException as error:
            self.failure = error

    def flush(self) -> None:
        """Nothing is buffered."""

    def close(self) -> None:
        self._file.close()


def deflate_bytes(data: NDArray[np.uint8]) -> bytes:
    """Return a zlib stream of `data`, shape (N,); the same data give the same bytes in every process.

    ISA-L 2.32 for x86-64 enters the third position of a stream in its hash table under the hash of an address
    on the stack instead of that of the data (`.write_first_byte` in igzip_icf_body_h1_gr_bt.asm). At times
    that displaces another position and a match is missed: the stream is right, but another process or thread
    would write other bytes. Where at most 16 bytes are left, ISA-L uses code without that error, so a stream
    begins with a few bytes that are flushed on their own. It costs 4 % of the time of deflating, and no room.
    """
    stream = isal_zlib.compressobj(1)
    few = 4  # enough for a first entry of the hash table, and at most 16
    head = stream.compress(data[:few]) + stream.flush(isal_zlib.Z_SYNC_FLUSH)
    return b"".join((head, stream.compress(data[few:]), stream.flush()))


def pack_chunk(values: NDArray[Any]) -> bytes:
    """Return a whole chunk, `values` having its shape, as `COMPRESSION` says: shuffled, then deflated."""
    return deflate_bytes(shuffle_bytes(values))


def shuffle_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the first bytes of all numbers of an array without gaps, then the second ones, and so on, (N,).

    OpenCV splits up to four channels with vectors, four times as fast as NumPy transposes.
    """
    flat, each = values.reshape(-1), values.itemsize
    if each == 1:
        return flat.view(np.uint8)
    if each not in (2, 4, 8) or not len(flat):
        return np.ascontiguousarray(flat.view(np.uint8).reshape(-1, each).T).reshape(-1)
    parts = cv2.split(flat.view(np.int32).reshape(-1, 1, 2)) if each == 8 else [flat]
    whole = [part.reshape(-1).view(np.uint8).reshape(-1, 1, min(each, 4)) for part in parts]
    return np.concatenate([plane.reshape(-1) for part in whole for plane in cv2.split(part)])


PACKERS = 5
"""Most threads of a process that pack chunks. Each chunk takes Python's lock some thirty times: 1, 2, 4, 6, 8
and 16 threads of a Xeon with 16 cores packed 420, 820, 1460, 1480, 1150 and 520 MB/s, and the more of them
there are, the longer does everything else wait."""


@lru_cache(maxsize=1)
def _packing_threads(count: int) -> ThreadPoolExecutor:
    """Return the threads that pack the chunks of all open files."""
    return ThreadPoolExecutor(count, thread_name_prefix="dase pack")


if hasattr(os, "register_at_fork"):  # a process that is forked has none of these threads
    os.register_at_fork(after_in_child=_packing_threads.cache_clear)


class _PackingLine:
    """Steps that write to a file, in the order in which they came, each as soon as its chunks are packed.

    Chunks are packed beside whatever the caller does next, by threads that all open files share; the steps
    themselves run on the caller's thread. With one thread all is done at once. The file is the same.

    Args:
        most: Steps that may wait; more hold the caller up, so that memory does not grow.
    """

    def __init__(self, most: int = 16) -> None:
        threads = min(thread_count(), PACKERS)
        self._pool = _packing_threads(threads) if threads > 1 else None
        self._most = most
        self._steps: deque[tuple[list[Future[bytes]], Callable[[list[bytes]], None]]] = deque()

    def add(self, chunks: Iterable[NDArray[Any]], write: Callable[[list[bytes]], None]) -> None:
        """Pack chunks, which must not change any more, and have `write` called with what became of them."""
        if self._pool is None:
            write([pack_chunk(chunk) for chunk in chunks])
            return
        self._steps.append(([self._pool.submit(pack_chunk, chunk) for chunk in chunks], write))
        while self._steps and (len(self._steps) > self._most or all(f.done() for f in self._steps[0][0])):
            self._write_next()

    def keep(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values that stay as they are, although the caller may change his if they can be changed."""
        return values.copy() if self._pool is not None and values.flags.writeable else values

    def finish(self) -> None:
        """Write what still waits."""
        while self._steps:
            self._write_next()

    def abandon(self) -> None:
        """Forget what still waits; what is being packed is waited for, so that nothing holds its arrays."""
        waiting = [chunk for chunks, _ in self._steps for chunk in chunks]
        self._steps.clear()
        wait([chunk for chunk in waiting if not chunk.cancel()])

    def _write_next(self) -> None:
        packed, write = self._steps.popleft()
        write([chunk.result() for chunk in packed])


class _NumberedMembers:
    """Datasets `images/image%09d` and `flow/flow%09d`, made by HDF5's own calls with types made once.

    h5py's `create_dataset` and `attrs` make the same bytes and take four times as long, with Python's lock
    held, which what goes on beside wants, too.

    Args:
        file: Open for writing.
    """

    def __init__(self, file: h5py.File) -> None:
        self._file = file
        self._groups: dict[str, h5py.h5g.GroupID] = {}
        self._made: dict[tuple[str, tuple[int, ...], np.dtype[Any]], tuple[Any, Any, Any]] = {}

    def create(
        self, group: str, index: int, shape: tuple[int, ...], kind: np.dtype[Any]
    ) -> h5py.h5d.DatasetID:
        """Return a new dataset; those of `flow` are one chunk, packed as `COMPRESSION` says."""
        if group not in self._groups:
            self._groups[group] = self._file.require_group(group).id
        key = (group, shape, kind)
        if key not in self._made:
            how = h5p.create(h5p.DATASET_CREATE)
            if group == "flow":
                how.set_chunk(shape)
                how.set_shuffle()
                how.set_deflate(COMPRESSION["compression_opts"])
            how.set_obj_track_times(False)
            self._made[key] = h5t.py_create(kind, logical=True), h5s.create_simple(shape), how
        type_, space, how = self._made[key]
        return h5d.create(self._groups[group], _member_name(group, index), type_, space, dcpl=how)

    def find(self, index: int) -> list[h5py.h5d.DatasetID]:
        """Return the datasets of a number that are there."""
        names = [(found, _member_name(name, index)) for name, found in self._groups.items()]
        return [h5d.open(group, name) for group, name in names if name in group]


def _member_name(group: str, index: int) -> bytes:
    return b"%s%09d" % ({"images": b"image", "flow": b"flow"}[group], index)


def set_attributes(member: h5py.h5d.DatasetID, values: dict[str, Any]) -> None:
    """Give a dataset attributes that it does not have yet: numbers of NumPy with their shape, or texts."""
    for name, value in values.items():
        kind = TEXT if isinstance(value, str) else value.dtype
        array = np.asarray(value, kind)
        logical, stored, space = _attribute_types(kind, array.shape)
        h5a.create(member, name.encode(), logical, space).write(array, mtype=stored)


TEXT = h5py.string_dtype()


@lru_cache(maxsize=64)
def _attribute_types(kind: np.dtype[Any], shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Return the type of an attribute in a file and in memory, and its space."""
    return h5t.py_create(kind, logical=True), h5t.py_create(kind), h5s.create_simple(shape)


Columns: TypeAlias = tuple[NDArray[Any], ...]
"""Columns of some events, each of shape (N,)."""


def _own_column(values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return a column of a type, (N,), that nobody changes: read-only ones as they are."""
    if values.flags.writeable:
        return values.astype(kind)
    # coordinates are below the greatest number of either type
    same = values.dtype.kind in "iu" and kind.kind in "iu" and values.dtype.itemsize == kind.itemsize
    return values.view(kind) if same else values.astype(kind, copy=False)


def _split_parts(parts: list[Columns], count: int) -> tuple[list[Columns], list[Columns]]:
    """Return parts with the first `count` events, and what is left, as copies: it is little."""
    taken: list[Columns] = []
    for n, part in enumerate(parts):
        here = min(len(part[0]), count)
        count -= here
        taken.append(tuple(column[:here] for column in part))
        if not count:
            left = [tuple(column[here:].copy() for column in part), *parts[n + 1 :]]
            return taken, [some for some in left if len(some[0])]
    raise AssertionError("fewer events than asked for")


def _cut_chunks(pieces: Iterable[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return a column cut into chunks, copied only where two pieces meet in one; the last may be short."""
    chunks: list[list[NDArray[Any]]] = []
    room = 0  # in the last chunk
    for piece in pieces:
        begin = 0
        while begin < len(piece):
            if not room:
                chunks.append([])
                room = CHUNK
            chunks[-1].append(piece[begin : begin + room])
            begin, room = begin + len(chunks[-1][-1]), room - len(chunks[-1][-1])
    return [some[0] if len(some) == 1 else np.concatenate(some) for some in chunks]


class _Writer(Writer):
    """Appends whole blocks of events, and frames as they come."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._disk = _Disk(path)
        self._file = h5py.File(self._disk, "w")
        self._line = _PackingLine()
        self._types = dict(EVENT_TYPES)
        for name in EVENT_TYPES:
            self._create(name)
        self._file.create_group("images")  # readers list it even where it is empty
        self._numbered = _NumberedMembers(self._file)
        self._parts: list[Columns] = []
        self._waiting = 0
        self._written = 0
        self._on = 0
        self._last_written = -math.inf  # time of the last event in the file
        self._times: list[float] = []  # of frames
        self._before: list[int] = []  # events in the file before each frame; LATE where it must be looked up

    def _create(self, name: str) -> None:
        kind = self._types[name]
        self._file.create_dataset(
            f"events/{name}", (0,), kind, maxshape=(None,), chunks=(CHUNK,), **COMPRESSION
        )

    def _put_events(self, part: Events) -> None:
        if max(part.width, part.height) > 32767:
            raise InputError(f"HDF5: the sensor must be at most 32767 wide, got {part.width}x{part.height}")
        columns: list[NDArray[Any]] = [part.t, part.x, part.y, part.p]
        if part.label is not None:
            self._types = EVENT_TYPES | LABEL_TYPE
            columns.append(part.label)
        kinds: list[np.dtype[Any]] = [np.dtype(kind) for kind in self._types.values()]
        self._parts.append(tuple(_own_column(a, kind) for a, kind in zip(columns, kinds, strict=True)))
        self._on += int(np.count_nonzero(part.p))
        self._waiting += len(part)
        if self._waiting >= BLOCK:
            self._flush(self._waiting // CHUNK * CHUNK)

    def _flush(self, count: int) -> None:
        """Write the first `count` of the events waiting; whole chunks are compressed once only."""
        if not count:
            return
        parts, rest = _split_parts(self._parts, count)
        end = self._written + count
        for t, *_ in parts:
            for index, more in enumerate(np.searchsorted(t, self._times)):
                self._before[index] += int(more) if self._before[index] != LATE else 0
        chunks = [_cut_chunks(column) for column in zip(*parts, strict=True)]
        whole, written = count // CHUNK, self._written
        tails = {name: column[whole:] for name, column in zip(self._types, chunks, strict=True)}

        def write(packed: list[bytes]) -> None:
            left = iter(packed)
            for name, tail in tails.items():
                if f"events/{name}" not in self._file:
                    self._create(name)
                dataset = self._file[f"events/{name}"]
                dataset.resize((end,))
                for begin in range(written, written + whole * CHUNK, CHUNK):
                    dataset.id.write_direct_chunk((begin,), next(left))
                for values in tail:
                    dataset[written + whole * CHUNK : end] = values

        self._line.add((chunk for column in chunks for chunk in column[:whole]), write)
        self._written, self._last_written = end, float(parts[-1][0][-1])
        self._waiting -= count
        self._parts = rest
        self._disk.check()

    def _put_frame(
        self,
        index: int,
        time: float,
        grey: NDArray[Grey],
        flow: NDArray[np.float32] | None,
        exposure: float,
    ) -> None:
        grey = self._line.keep(grey)
        fields = [] if flow is None else [self._line.keep(flow.astype(np.float32, copy=False))]

        def write(packed: list[bytes]) -> None:
            numbered, said = self._numbered, {"timestamp": np.float64(time)}
            image = numbered.create("images", index, grey.shape, grey.dtype)
            image.write(h5s.ALL, h5s.ALL, np.ascontiguousarray(grey))
            set_attributes(image, {"size": np.array(grey.shape), **said, "type": "greyscale"})
            if exposure:
                set_attributes(image, {"exposure": np.float64(exposure)})
            for values, chunk in zip(fields, packed, strict=True):
                field = numbered.create("flow", index, values.shape, values.dtype)
                field.write_direct_chunk((0, 0, 0), chunk)
                set_attributes(field, {"size": np.array(values.shape), **said})

        self._times.append(float(time))
        self._before.append(self._written if time > self._last_written else LATE)
        self._line.add(fields, write)
        self._disk.check()

    def _put_thresholds(self, values: NDArray[np.float32]) -> None:
        values = self._line.keep(values)
        self._line.add((), lambda _: self._file.create_dataset("dase/thresholds", data=values))

    def _put_configuration(self, text: str) -> None:
        def write(_: list[bytes]) -> None:
            self._file.require_group("dase").attrs["configuration"] = text

        self._line.add((), write)

    def finish(self) -> None:
        """Write the rest of the events, the index of every frame and the totals."""
        self._flush(self._waiting)
        self._line.finish()
        if self._with_labels and not self._written:
            self._types = EVENT_TYPES | LABEL_TYPE
            self._create("labels")
        ts, written = self._file["events/ts"], self._written
        if LATE in self._before:
            self._before = sum(
                (np.searchsorted(ts[i : i + BLOCK], self._times) for i in range(0, written, BLOCK)),
                np.zeros(len(self._times), np.int64),
            ).tolist()
        for index, count in enumerate(self._before):
            for member in self._numbered.find(index):
                set_attributes(member, {"event_idx": np.int64(max(count - 1, 0))})
        t0, tk = (float(ts[0]), float(ts[-1])) if written else (0.0, 0.0)
        flows = len(self._times) if self._with_flow else 0
        self._file.attrs.update(
            {"num_events": written, "num_pos": self._on, "num_neg": written - self._on}
            | {"duration": tk - t0, "t0": t0, "tk": tk}
            | {"num_imgs": len(self._times), "num_flow": flows}
            | {"sensor_resolution": np.array(self.size, np.int64)}
        )
        self._file.close()
        self._disk.check()
        self._disk.close()

    def abandon(self) -> None:
        """Close the file handles."""
        self._line.abandon()
        with suppress(Exception):
            self._file.close()
        self._disk.close()


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open an HDF5 file for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


def read(source: Source) -> Sequence:
    """Read an HDF5 file of the S2R layout; raises InputError where it is damaged or incomplete."""
    with reading_file(source.path, "HDF5"), columns.open_hdf5(source.path) as file:
        return _parse_file(source, file)


def _parse_file(source: Source, file: Any) -> Sequence:
    t, x, y, p = (columns.read_slice(columns.checked_dataset(file, f"events/{name}")) for name in EVENT_TYPES)
    labels = columns.checked_dataset(file, "events/labels") if "events/labels" in file else None
    label = None if labels is None else columns.read_slice(labels)
    images, flows = numbered_members(file, "images"), numbered_members(file, "flow")
    frames = _stack_members(images, GREYS, 2) if images else None
    flow = _stack_flow(images, flows) if source.flow or not images else None
    exposure = np.array([exposure_of(image) for image in images.values()])
    size = columns.size_attribute(file, "sensor_resolution")
    x, y = checked_coordinates(x, "events/xs"), checked_coordinates(y, "events/ys")
    found = sensor_events(
        source,
        Piece(t.astype(np.float64, copy=False), x, y, p, label),
        size=size,
        maps=(frames, flow, file.get("dase/thresholds")),
    )
    times = np.array([time_of(image) for image in images.values()]) if images else None
    return Sequence(found, frames, times, flow, *read_beside(file), exposure if exposure.any() else None)


def read_beside(file: Any) -> Beside:
    """Return the thresholds and the configuration."""
    thresholds = None
    if "dase/thresholds" in file:
        thresholds = columns.checked_dataset(file, "dase/thresholds")[:].astype(np.float32)
    configuration = columns.read_attribute(file["dase"], "configuration") if "dase" in file else None
    return thresholds, None if configuration is None else str(configuration)


def time_of(image: Any) -> float:
    """Return the time of an image or flow [s]; raises InputError where there is none."""
    value = columns.read_attribute(image, "timestamp")
    if value is None:
        raise InputError(f"'{image.name}' has no attribute 'timestamp'")
    return float(value)


def exposure_of(image: Any) -> float:
    """Return the duration of the exposure of an image [s], 0 where it was taken in an instant."""
    value = columns.read_attribute(image, "exposure")
    return 0.0 if value is None else float(value)


def numbered_members(file: Any, group: str) -> dict[str, Any]:
    """Return datasets of a group by the nine digits that end their names, in their order.

    Raises:
        InputError: Together they unpack to something absurd: many names may be links to one dataset.
    """
    found = {name[-9:]: columns.checked_dataset(file[group], name) for name in file.names(group)}
    unpacked = sum(member.size * member.dtype.itemsize for member in found.values())
    length = next((member.file.id.get_filesize() for member in found.values()), 0)
    try:
        refuse_bomb(length, unpacked)
    except InputError as error:
        raise InputError(f"all of '{group}' {error}") from None
    return found


def _stack_members(members: dict[str, Any], kinds: tuple[type[Any], ...], ndim: int) -> NDArray[Any]:
    first = next(iter(members.values()))
    out = np.empty((len(members), *first.shape), first.dtype)
    for index, member in enumerate(members.values()):
        if member.shape != first.shape or member.dtype != first.dtype:
            raise InputError(f"'{member.name}' must be {first.dtype} of shape {first.shape} like the first")
        out[index] = checked_member(member, kinds, ndim)
    return out


def checked_member(member: Any, kinds: tuple[type[Any], ...], ndim: int) -> NDArray[Any]:
    """Return what a dataset holds, of any shape; raises InputError for another type or number of axes."""
    if member.ndim != ndim or member.dtype not in kinds:
        names = " or ".join(np.dtype(kind).name for kind in kinds)
        raise InputError(f"'{member.name}' must be {names} with {ndim} axes")
    return np.asarray(member[:])


def _stack_flow(images: dict[str, Any], flows: dict[str, Any]) -> NDArray[np.float32] | None:
    """Flow of every image, shape (F, 2, H, W); not a number where an image has none."""
    if not flows:
        return None
    stacked = _stack_members(flows, (np.float32,), 3)
    if not images or list(images) == list(flows):
        return stacked
    out = np.full((len(images), *stacked.shape[1:]), np.nan, np.float32)
    for index, name in enumerate(images):
        if name in flows:
            out[index] = stacked[list(flows).index(name)]
    return out
