"""Unpacking what others packed, never to more than is sensible.

`rosbags` unpacks whatever it is given. While one of our readers has a bag open, its unpackers are these.
"""

from __future__ import annotations

import bz2
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from dase.errors import InputError
from dase.io.source import missing_extra, refuse_bomb

LARGEST = 1 << 26  # [bytes] of an unpacked packet, message or chunk

_lock = threading.Lock()
_open_bags = 0
_originals: list[tuple[Any, Any]] = []


def make_unpacker(make: Callable[[], Any]) -> Callable[[bytes], bytes]:
    """Return a function that unpacks bytes with a decompressor that `make` gives, to at most `LARGEST`."""

    def unpack(data: bytes) -> bytes:
        one = make()
        out = bytes(one.decompress(data, max_length=LARGEST))
        if not one.eof:
            raise InputError("a packet is cut short, or larger than it may be")
        return out

    return unpack


def lz4_decompressor() -> Any:
    """Return a decompressor of LZ4; raises InputError naming the extra where it is not installed."""
    return _import_first("lz4.frame").LZ4FrameDecompressor()


def zstd_decompressor() -> Any:
    """Return a decompressor of Zstandard; raises InputError naming the extra where it is not installed."""
    return _import_first("compression.zstd", "backports.zstd").ZstdDecompressor()


def _import_first(*names: str) -> Any:
    """Return the first of these modules that is installed."""
    for name in names:
        with suppress(ImportError):
            return import_module(name)
    raise missing_extra("a packed AEDAT 4", "aedat")


class _Counted:
    """A file that is being unpacked, until it becomes absurdly much."""

    def __init__(self, file: Any, packed: int) -> None:
        self._file, self._packed, self._total = file, packed, 0

    def read(self, size: int = -1) -> bytes:
        data = bytes(self._file.read(size))
        self._total += len(data)
        refuse_bomb(self._packed, self._total)
        return data


@contextmanager
def _open_counted(file: Any, mode: str) -> Iterator[_Counted]:
    length = file.seek(0, 2)
    file.seek(0)
    with _import_first("compression.zstd", "backports.zstd").open(file, mode) as inner:
        yield _Counted(inner, length)


@contextmanager
def bounded_bags() -> Iterator[None]:
    """While this is open, rosbags unpacks chunks, messages and files only to what is sensible."""
    global _open_bags
    # an extra, and only bags need it
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    unpack_lz4, unpack_zstd = make_unpacker(lz4_decompressor), make_unpacker(zstd_decompressor)
    with _lock:
        _open_bags += 1
        if _open_bags == 1:
            tables = (rosbag1.decompressors, storage_mcap.DECOMPRESSORS)
            _originals[:] = [(table, dict(table)) for table in tables]
            tables[0].update(bz2=make_unpacker(bz2.BZ2Decompressor), lz4=unpack_lz4)
            tables[1].update(lz4=lambda x, _: unpack_lz4(x), zstd=lambda x, _: unpack_zstd(x))
            _originals.append((rosbag2, rosbag2.zstd))
            rosbag2.zstd = SimpleNamespace(decompress=unpack_zstd, open=_open_counted)
    try:
        yield
    finally:
        with _lock:
            _open_bags -= 1
            if not _open_bags:
                for place, original in _originals:
                    if isinstance(original, dict):
                        place.update(original)
                    else:
                        place.zstd = original
