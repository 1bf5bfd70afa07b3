"""What the layouts in HDF5 share: columns read slice by slice, and checks before anything is read."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.sequence import checked_coordinates
from dase.io.source import Piece, Size, Source, missing_extra, refuse_bomb

HDF5 = b"\x89HDF\r\n\x1a\n"
USER_BLOCK = 512  # [bytes] that MATLAB puts before the mark of HDF5
PART = 1 << 20  # events read at once
FILTERS = {1: 1, 2: 0, 3: 0, 32000: 0, 32001: 4, 32004: 0, 32015: 0, 32026: 4}
"""Number of a filter to how many parameters it needs: gzip, shuffle, Fletcher's sum, LZF; of hdf5plugin
Blosc, LZ4, Zstandard, Blosc 2. Blosc crashes without its parameters."""

TELLING = (
    "CD/events",
    *("events/t", "events/x", "events/y", "events/p"),
    *("prophesee/left/t", "prophesee/left/x", "prophesee/left/y", "prophesee/left/p"),
    *("davis/left/events", "davis/right/events"),
    "events",
)
"""Datasets that tell layouts apart; what `has_datasets` can be asked for."""


@dataclass(frozen=True)
class Hdf5Checks:
    """What the checks of a file before anything of it is read take and refuse."""

    block: int = 1 << 24
    """Bytes searched at once."""

    text: int = 1 << 26
    """Bytes of the largest attribute."""

    settled: int = 2_000_000_000
    """Age of a change from which on the next has another time, however coarse the clock of the disk [ns]."""

    slack: int = 1 << 10
    """Bytes by which what is packed may be longer than twice what it holds."""


CHECKS = Hdf5Checks()

_asked: tuple[bytes, frozenset[str]] = b"", frozenset()  # first bytes of a file, and which of these it holds
_plugin_tried = False
_sound: dict[Path, tuple[int, ...]] = {}  # files whose heaps were checked, and their state then


class HeapMark(Enum):
    """The first bytes of a heap."""

    TEXTS = b"GCOL\x01\0\0\0"
    NAMES = b"HEAP\0\0\0\0"


class Hdf5Group:
    """A group, or the root, of an HDF5 file, from which nothing outside of that file can be reached.

    h5py follows whatever link lies on the way to a name, also one into another file, and a dataset may keep
    its values in other files. No reader gets an object of h5py but by this class, so none can forget to look.

    Args:
        group: The group as h5py has it.
    """

    def __init__(self, group: Any) -> None:
        self._h5 = group
        self.attrs = group.attrs
        self.name = group.name

    def get(self, name: str, default: Any = None) -> Any:
        """Return a dataset of h5py or an `Hdf5Group`, else `default` where there is nothing of this name.

        Raises:
            InputError: It lies in another file, or links lead nowhere for too long.
        """
        found = self._reach(self._h5, name, [16], name)  # HDF5 itself follows as many links
        return default if found is None else found

    def __getitem__(self, name: str) -> Any:
        found = self.get(name)
        if found is None:
            raise InputError(f"has no '{name}'")
        return found

    def names(self, group: str) -> list[str]:
        """Return the sorted names in a group, none where there is no such group.

        Raises:
            InputError: It is a dataset: its values, which it would yield, may be as many as it claims.
        """
        found = self.get(group)
        if found is not None and not isinstance(found, Hdf5Group):
            raise InputError(f"'{group}' is a dataset, and must be a group")
        return sorted(found or ())

    def __contains__(self, name: str) -> bool:
        return self.get(name) is not None

    def __iter__(self) -> Iterator[str]:
        return iter(self._h5)

    def _reach(self, node: Any, name: str, left: list[int], asked: str) -> Any:
        """Walk from a group along a name; `left[0]` counts down the links that may still be followed.

        One count for the whole walk: were it one per link, two links to the next two would double the work
        with every further pair.
        """
        if name.startswith("/"):
            node = node.file
        for part in name.split("/"):
            if part in ("", "."):
                continue
            if not isinstance(node, h5py.Group) or not node.id.links.exists(part.encode()):
                return None
            kind = node.id.links.get_info(part.encode()).type
            if kind == h5py.h5l.TYPE_SOFT:
                left[0] -= 1
                if left[0] < 0:
                    raise InputError(f"'{asked}' is a link to a link, again and again")
                target = node.id.links.get_val(part.encode()).decode("utf-8", "replace")
                node = self._reach(node, target, left, asked)
                node = node._h5 if isinstance(node, Hdf5Group) else node
            elif kind == h5py.h5l.TYPE_HARD:
                node = node[part]
            else:
                raise InputError(f"'{asked}' is a link to another file, which is not read")
        if isinstance(node, h5py.Dataset):
            _check_place(node, asked)
        return Hdf5Group(node) if isinstance(node, h5py.Group) else node


def _check_place(found: Any, name: str) -> None:
    """Raise InputError where the values of a dataset lie in another file; that is asked before its shape.

    HDF5 opens the sources of a virtual dataset to tell how large it is.
    """
    properties = found.id.get_create_plist()
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise InputError(f"'{name}' lies in another file, which is not read")


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5Group]:
    """Open a file for reading, with the filters of hdf5plugin where that is installed."""
    global _plugin_tried
    if not _plugin_tried:
        _plugin_tried = True
        with suppress(ImportError):
            import_module("hdf5plugin")  # registers its filters
    check_head(path)
    check_heaps(path)
    with h5py.File(path, "r") as file:
        yield Hdf5Group(file)


def check_head(path: Path) -> None:
    """Raise InputError where the first block of a file asks for what no single file needs.

    8 bytes that mark the file, then u8 version of the block. In versions 0 and 1: at byte 13 u8 bytes of an
    address and of a length; at 24, in version 1 at 28, u64 begin, free space, end, driver. HDF5 2.0 takes as
    much memory for the driver as it finds there; only files in several parts have one, others all ones.
    """
    with path.open("rb") as file:
        if file.read(len(HDF5)) != HDF5:
            file.seek(USER_BLOCK)  # of MATLAB
        else:
            file.seek(0)
        head = file.read(64)
    if len(head) < 64:
        raise InputError(f"cannot be read as HDF5, damaged or cut short: it ends after {len(head)} bytes")
    if head[8] > 1:
        return
    if head[13:15] != b"\x08\x08":
        raise InputError(
            "cannot be read as HDF5, damaged or cut short: "
            f"it claims addresses of {head[13]} bytes and lengths of {head[14]}"
        )
    place = 48 + 4 * head[8]
    if head[place : place + 8] != b"\xff" * 8:
        raise InputError("is HDF5 in several files, which is not read, or damaged")


def check_heaps(path: Path) -> None:
    """Raise InputError where a heap of texts or of names is damaged: HDF5 2.0 reads some for ever.

    A heap of texts is "GCOL", version 1, three zeros, u64 size with this head; then objects: u16 number, 6
    bytes, u64 length, data padded to 8 bytes; number 0 is the hole at the end, whose length counts its head.
    That of the names in a group is "HEAP", four zeros, u64 size of its data, place in them of the first hole,
    address of the data; a hole is u64 place of the next one, 1 for none, and u64 length.
    """
    place, found = path.resolve(), path.stat()
    # the second time is that of any change on Unix, so that setting the first one back hides none
    state = found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
    if _sound.get(place) == state:
        return
    now = time.time_ns()
    with path.open("rb") as file:
        base = 0 if file.read(len(HDF5)) == HDF5 else USER_BLOCK
        file.seek(0)
        for kind, begin in _find_heaps(file):
            if kind is HeapMark.TEXTS:
                _check_heap(file, begin, found.st_size)
            else:
                _check_names(file, begin, found.st_size, base)
    # a small one may change once more before the clock of its times goes on
    if found.st_size > CHECKS.block or max(state[2:]) < now - CHECKS.settled:
        if len(_sound) >= 1000:  # a run over a data set need not remember all of it
            _sound.clear()
        _sound[place] = state


def _find_heaps(file: BinaryIO) -> Iterator[tuple[HeapMark, int]]:
    """Yield kinds of heaps and where they begin; in blocks, for a file may be larger than the memory."""
    place, tail = 0, b""
    while block := file.read(CHECKS.block):
        text = tail + block
        for kind in HeapMark:
            found = -1
            while (found := text.find(kind.value, found + 1)) >= 0:
                yield kind, place - len(tail) + found
        file.seek(place := place + len(block))
        tail = text[-7:]  # all but one byte of what is looked for


def _check_heap(file: BinaryIO, begin: int, length: int) -> None:
    file.seek(begin + 8)
    end = begin + int.from_bytes(file.read(8), "little")
    place = begin + 16
    while place + 16 <= min(end, length):
        file.seek(place)
        head = file.read(16)
        size = int.from_bytes(head[8:], "little")
        step = size if head[:2] == b"\0\0" else 16 + -(-size // 8) * 8
        if step < 16 or place + step > end:
            raise InputError("a heap of texts is damaged")
        place += step


def _check_names(file: BinaryIO, begin: int, length: int, base: int) -> None:
    file.seek(begin + 8)
    size, hole, data = (int.from_bytes(file.read(8), "little") for _ in range(3))
    data += base  # addresses count from the mark of HDF5
    seen = set()
    # what looks like a heap but lies elsewhere, among numbers, has no data in the file
    while hole + 16 <= size and data + size <= length:
        if hole in seen:
            raise InputError("a heap of names is damaged")
        seen.add(hole)
        file.seek(data + hole)
        hole = int.from_bytes(file.read(8), "little")


def has_datasets(path: Path, head: bytes, *names: str) -> bool:
    """Whether a file is HDF5 and holds datasets of all these names."""
    global _asked
    if not head.startswith(HDF5):
        return False
    asked = _asked
    if asked[0] is not head:  # all formats are asked about one file in a row, which need not be opened again
        asked = _asked = head, _telling_datasets(path)
    return set(names) <= asked[1]


def _telling_datasets(path: Path) -> frozenset[str]:
    try:
        check_head(path)
        check_heaps(path)
        with h5py.File(path, "r") as file:
            root = Hdf5Group(file)
            return frozenset(name for name in TELLING if _is_there(root, name))
    except Exception:  # damaged: left to the reader that is tried at last
        return frozenset()


def _is_there(root: Hdf5Group, name: str) -> bool:
    try:
        return isinstance(root.get(name), h5py.Dataset)
    except InputError:  # elsewhere: its reader, which is to be found, says so
        return True


def checked_dataset(file: Any, name: str, ndim: int | None = None) -> Any:
    """Return a dataset; raises InputError where it is missing, absurdly large or needs a filter."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"has no '{name}'")
    if ndim is not None and found.ndim != ndim:
        raise InputError(f"'{name}' must have {ndim} axes, got shape {found.shape}")
    if (found.dtype.kind not in "biuf" and found.dtype.names is None) or found.dtype.hasobject:
        raise InputError(f"'{name}' must hold numbers, got {found.dtype}")
    check_whole(found, name)
    _check_filters(found, name)
    return found


def check_whole(found: Any, name: str) -> None:
    """Raise InputError where a dataset unpacks to something absurd or is not all there."""
    stored, kind, length = found.id.get_storage_size(), found.dtype, found.file.id.get_filesize()
    if stored > length:
        raise InputError(f"'{name}' claims {stored} bytes of a file of {length}")
    chunk = math.prod(found.chunks or (0,))
    refuse_bomb(stored, max(found.size, chunk) * kind.itemsize)
    if found.chunks:
        wanted = math.prod(-(-n // m) for n, m in zip(found.shape, found.chunks, strict=True))
        if found.id.get_num_chunks() < wanted:
            raise InputError(f"'{name}' has {found.id.get_num_chunks()} of its {wanted} chunks")
    elif stored < found.size * kind.itemsize:
        raise InputError(f"'{name}' has {stored} of its {found.size * kind.itemsize} bytes")


def _check_filters(found: Any, name: str) -> None:
    properties = found.id.get_create_plist()
    for k in range(properties.get_nfilters()):
        number, _, parameters, _ = properties.get_filter(k)
        if number not in FILTERS:
            raise InputError(f"'{name}' is packed with HDF5 filter {number}, which is not known here")
        if not h5py.h5z.filter_avail(number):
            raise missing_extra(f"'{name}' is packed in a way that", "hdf5")
        if len(parameters) < FILTERS[number]:
            raise InputError(f"'{name}' is damaged: its filter has {len(parameters)} parameters")


def read_attribute(node: Any, name: str) -> Any:
    """Return the value of an attribute of a file, group or dataset, None where it is absent."""
    if name not in node.attrs:
        return None
    found = node.attrs.get_id(name)
    if found.get_storage_size() > CHECKS.text:
        raise InputError(f"its attribute '{name}' has {found.get_storage_size()} bytes")
    # HDF5 2.0 crashes on a list whose kind of length is unknown
    plain = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if found.get_type().get_class() not in plain:
        raise InputError(f"its attribute '{name}' holds neither numbers nor a text")
    with _little_memory() if found.dtype.hasobject else nullcontext():
        return node.attrs[name]


@contextmanager
def _little_memory() -> Iterator[None]:
    """While this is open the process gets no more than a little memory, on Linux.

    HDF5 takes as much as the length of a text says, up to 4 GB, before it looks whether there is a text.
    """
    try:
        import resource

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    limits = resource.getrlimit(resource.RLIMIT_AS)
    most = taken + CHECKS.text
    if limits[0] != resource.RLIM_INFINITY:
        most = min(most, limits[0])
    resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def read_columns(
    file: Any, names: tuple[str, str, str, str], beside: tuple[str, ...] = ()
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield slices (n,) of columns t, x, y, p and others beside; all but x and y as the file holds them."""
    found = [checked_dataset(file, name, 1) for name in (*names, *beside)]
    length = len(found[0])
    for name, column in zip((*names, *beside), found, strict=True):
        if len(column) != length:
            raise InputError(f"'{name}' has {len(column)} entries, '{names[0]}' {length}")
    for i in range(0, length, PART):
        t, x, y, *others = (read_slice(column, i, i + PART) for column in found)
        yield t, checked_coordinates(x, names[1]), checked_coordinates(y, names[2]), *others


def read_slice(column: Any, begin: int = 0, end: int | None = None) -> NDArray[Any]:
    """Return values of a column of h5py, shape (n,), as `column[begin:end]` does."""
    end = len(column) if end is None else min(end, len(column))
    with suppress(Exception):  # whatever is damaged: HDF5 finds it, too, and says what it is
        values = unpack_chunks(column, begin, end)
        if values is not None:
            return values
    return np.asarray(column[begin:end])


def unpack_chunks(column: Any, begin: int, end: int) -> NDArray[Any] | None:
    """Return values of a column that is deflated, unpacked by ISA-L in a third of the time that HDF5 takes.

    Args:
        column: Of h5py, shape (N,).
        begin: First value.
        end: Last value and one, at most N.

    Returns:
        Shape (end - begin,); None where the column is packed in another way, or its packing is damaged.
    """
    properties, kind = column.id.get_create_plist(), column.dtype
    filters = [properties.get_filter(k)[0] for k in range(properties.get_nfilters())]
    shuffled = filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
    plain = column.id.get_type() == h5py.h5t.py_create(kind, logical=True) and kind.isnative
    if not (shuffled or filters == [h5py.h5z.FILTER_DEFLATE]) or column.ndim != 1 or not plain:
        return None
    size = column.chunks[0]
    length, first = size * kind.itemsize, begin // size * size
    chunks = range(first, end, size)
    out = np.empty((len(chunks), size, kind.itemsize), np.uint8)
    for number, start in enumerate(chunks):
        # a length that is damaged would be taken as memory
        if column.id.get_chunk_info_by_coord((start,)).size > 2 * length + CHECKS.slack:
            return None
        skipped, data = column.id.read_direct_chunk((start,))
        unpacker = isal_zlib.decompressobj()
        # one byte more shows what is too long, and asks for the checksum behind the last one
        unpacked = unpacker.decompress(data, length + 1)
        if skipped or len(unpacked) != length or not unpacker.eof:
            return None
        values = np.frombuffer(unpacked, np.uint8)
        if shuffled:
            for place, plane in enumerate(values.reshape(kind.itemsize, size)):
                out[number, :, place] = plane
        else:
            out[number] = values.reshape(size, kind.itemsize)
    if kind.kind == "b" and out.max(initial=0) > 1:
        return None
    unpacked_values: NDArray[Any] = out.reshape(-1).view(kind)
    return unpacked_values[begin - first : end - first]


def find_largest(file: Any, x: str, y: str) -> Size:
    """Return one more than the largest column and row."""
    out = []
    for name in (x, y):
        column = checked_dataset(file, name, 1)
        parts = (read_slice(column, i, i + PART) for i in range(0, len(column), PART))
        out.append(max((int(part.max()) for part in parts), default=0) + 1)
    return out[0], out[1]


def size_attribute(file: Any, name: str) -> Size | None:
    """Return columns and rows from an attribute of the file that holds rows and columns, or None."""
    value = np.asarray(read_attribute(file, name))
    if value.ndim != 1 or len(value) < 2 or value.dtype.kind not in "iu":
        return None
    return int(value[1]), int(value[0])


def read_scalar(file: Any, name: str) -> int:
    """Return a whole number that a dataset holds, 0 where it is absent."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        return 0
    if found.size != 1 or found.dtype.kind not in "iuf":
        raise InputError(f"'{name}' must be one number, got {found.dtype} of shape {found.shape}")
    return int(np.asarray(found[()]).reshape(-1)[0])


def pieces_reader(
    parts: Callable[[Any, Source], Iterator[Piece]],
) -> Callable[[Source], Iterator[Piece]]:
    """Return a reader of pieces that opens the file of a source and keeps it open while it yields."""

    def pieces(source: Source) -> Iterator[Piece]:
        with open_hdf5(source.path) as file:
            yield from parts(file, source)

    return pieces
