"""HDF5 event files of Prophesee's Metavision, packed with ECF (filter 0x8ECF), unpacked here.

    CD/events         compound x u16, y u16, p i16, t i64 [us]; each HDF5 chunk is one ECF buffer
    attribute         geometry "1280x720" or format "EVT3;height=720;width=1280"

    u32 4 n + flags (bit 1: all packed, bit 0: columns and polarities packed), u64 first time
    times      byte 0xF_: 4 bits more of a step, low ones first; other byte: high 4 bits step, low 4 bits how
               many events, 15: that many follow as u16
    packed     3 u32 hold 4 events of 24 bits: row 22..12, column 11..1, polarity 0
    rows       u16: row 15..5, how many events 4..0, 31: that many follow as u16
    columns, polarities      packed: 3 u16 hold 4 events of 12 bits, else
    columns    u16: column 15..5, then bit 4 - i set: one more event at column + 1 + i
    polarities byte: polarity 7, how many events 6..0, 127: that many follow as u16

Plain compounds are read too. Triggers are skipped. Source: github.com/prophesee-ai/hdf5_ecf (Apache-2.0).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io import raw
from dase.io.columns import PART, check_whole, has_datasets, open_hdf5, pieces_reader, read_attribute
from dase.io.format import camera_format
from dase.io.sequence import checked_coordinates
from dase.io.source import Piece, Size, Source, refuse_bomb

FILTER = 0x8ECF
MOST = 65535  # events of a buffer

Counts = NDArray[np.int64]


def unpack_buffer(data: bytes) -> Piece:
    """Return the events of one buffer [us]; raises InputError where it ends too early."""
    buffer = np.frombuffer(data, np.uint8)
    if len(buffer) < 12:
        raise InputError(f"a buffer of {len(buffer)} bytes is too short for ECF")
    word = int(buffer[:4].view("<u4")[0])
    count, all_packed, packed = word >> 2, bool(word & 2), bool(word & 1)
    if count > MOST:
        raise InputError(f"a buffer claims {count} events, ECF holds at most {MOST}")
    t, place = _decode_times(buffer[4:], count)
    rest = buffer[4 + place :]
    if all_packed:
        a, b, c = _take_words(rest, 3 * -(-count // 4), "<u4").astype(np.int64).reshape(-1, 3).T
        four = (a >> 8, (a & 0xFF) | (b >> 16 << 8), (b & 0xFFFF) | (c >> 24 << 16), c & 0xFFFFFF)
        v = np.stack(four, axis=1).reshape(-1)[:count]
        return Piece(t, _as_u16(v >> 1 & 2047), _as_u16(v >> 12 & 2047), (v & 1).astype(np.bool_))
    y, used = _decode_runs(rest[: len(rest) // 2 * 2].view("<u2"), count, 5)
    rest = rest[2 * used :]
    if packed:
        a, b, c = _take_words(rest, 3 * -(-count // 4), "<u2").astype(np.int64).reshape(-1, 3).T
        four = (a >> 4, (a & 0xF) | (b >> 8 << 4), (b & 0xFF) | (c >> 12 << 8), c & 0xFFF)
        v = np.stack(four, axis=1).reshape(-1)[:count]
        return Piece(t, _as_u16(v >> 1), _as_u16(y), (v & 1).astype(np.bool_))
    x, used = _decode_masks(rest[: len(rest) // 2 * 2].view("<u2"), count)
    p, _ = _decode_runs(rest[2 * used :], count, 7)
    return Piece(t, _as_u16(x), _as_u16(y), p > 0)


def _as_u16(values: Counts) -> NDArray[np.uint16]:
    return values.astype(np.uint16)


def _take_words(buffer: NDArray[np.uint8], count: int, kind: str) -> NDArray[Any]:
    size = count * np.dtype(kind).itemsize
    if len(buffer) < size:
        raise _too_short()
    return buffer[:size].view(kind)


def _too_short() -> InputError:
    return InputError("an ECF buffer ends before its events do")


def _find_escapes(marks: NDArray[np.bool_], follow: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the marks that stand for themselves, not for data of one before, and which words are data."""
    kept = []
    free = 0
    for place in np.flatnonzero(marks).tolist():
        if place >= free:
            kept.append(place)
            free = place + 1 + follow
    escapes = np.array(kept, np.intp)
    data = np.zeros(len(marks) + follow, np.bool_)
    for k in range(1, follow + 1):
        data[escapes + k] = True
    return escapes, data[: len(marks)]


def _long_counts(words: NDArray[Any], escapes: NDArray[np.intp]) -> Counts:
    """Return the numbers that follow escapes, as one u16 or as two bytes; 0 beyond the end."""
    padded = np.concatenate((words, np.zeros(2, words.dtype))).astype(np.int64)
    if words.dtype.itemsize == 2:
        return padded[escapes + 1]
    return padded[escapes + 1] | padded[escapes + 2] << 8


def _find_holder(lengths: NDArray[Any], count: int) -> int:
    """Return which of the words, each for so many events, holds the last of `count`."""
    total = np.cumsum(lengths)
    last = int(np.searchsorted(total, count))
    if count and last >= len(total):
        raise _too_short()
    return last


def _decode_runs(words: NDArray[Any], count: int, bits: int) -> tuple[Counts, int]:
    """Return the values of `count` events coded as runs, and the number of words they took."""
    most = (1 << bits) - 1
    words = words[: count * (3 if words.dtype.itemsize == 1 else 2)]
    lengths = words.astype(np.int64) & most
    escapes, data = _find_escapes(lengths == most, 2 if words.dtype.itemsize == 1 else 1)
    lengths[escapes] = _long_counts(words, escapes)
    lengths[data] = 0
    last = _find_holder(lengths, count)
    values = np.repeat(words[: last + 1].astype(np.int64) >> bits, lengths[: last + 1])[:count]
    follow = int(np.argmin(np.append(data[last + 1 :], False))) if last + 1 < len(data) else 0
    return values, (last + 1 + follow) if count else 0


def _decode_masks(words: NDArray[Any], count: int) -> tuple[Counts, int]:
    words = words[:count].astype(np.int64)
    bits = np.ones((len(words), 6), np.bool_)
    bits[:, 1:] = (words[:, None] >> np.arange(4, -1, -1)) & 1 > 0
    used = _find_holder(bits.sum(axis=1), count) + 1 if count else 0
    values = ((words[:used] >> 5)[:, None] + np.arange(6))[bits[:used]]
    return values[:count], used


def _decode_times(buffer: NDArray[np.uint8], count: int) -> tuple[Counts, int]:
    """Return the times of the events and the number of bytes they took."""
    first = int(buffer[:8].view("<i8")[0])
    bytes_ = buffer[8:]
    high, low = (bytes_ >> 4).astype(np.int64), (bytes_ & 15).astype(np.int64)
    escapes, data = _find_escapes((high != 15) & (low == 15), 2)
    steps = (high == 15) & ~data
    lengths = np.where(steps, 0, low)
    lengths[escapes] = _long_counts(bytes_, escapes)
    lengths[data] = 0
    end = _find_holder(lengths, count) + 1 if count else 0
    place = np.arange(end)
    steps = steps[:end]
    before = np.maximum.accumulate(np.where(steps, -1, place))  # last byte that is no step
    nth = place - before - 1
    if np.any(nth[steps] > 15):
        raise InputError("an ECF buffer has a step of time beyond 64 bits")
    moved = np.where(steps, low[:end] << (4 * np.minimum(nth, 15)), np.where(data[:end], 0, high[:end]))
    t = first + np.cumsum(moved)
    used = 8 + end + (2 if end and end - 1 in escapes else 0)
    return np.repeat(t, lengths[:end])[:count], used


def _read_parts(file: Any, source: Source) -> Iterator[Piece]:
    events = file["CD/events"]
    kinds = {name: events.dtype[name].kind for name in events.dtype.names or ()}
    if events.ndim != 1 or not {"x", "y", "p", "t"} <= set(kinds) or not set(kinds.values()) <= set("biu"):
        raise InputError(f"'CD/events' must have the fields x, y, p and t, got {events.dtype}")
    properties = events.id.get_create_plist()
    filters = [properties.get_filter(k)[0] for k in range(properties.get_nfilters())]
    if FILTER not in filters:
        check_whole(events, "CD/events")
        for i in range(0, len(events), PART):
            part = events[i : i + PART]
            t, x, y = (
                part["t"].astype(np.int64),
                checked_coordinates(part["x"], "x"),
                checked_coordinates(part["y"], "y"),
            )
            yield Piece(t, x, y, part["p"])
        return
    if filters != [FILTER]:
        raise InputError("'CD/events' is packed with ECF and more, which is not known here")
    length, chunk = len(events), events.chunks[0]
    refuse_bomb(events.id.get_storage_size() + 1, 16 * length)
    for i in range(0, length, chunk):
        mask, data = events.id.read_direct_chunk((i,))
        if mask:
            plain = np.frombuffer(data, events.dtype)[: length - i]
            yield Piece(plain["t"].astype(np.int64), plain["x"], plain["y"], plain["p"])
        else:
            yield unpack_buffer(data).take(slice(length - i))


def read_size(source: Source) -> Size | None:
    """Return columns and rows as the attributes tell them, or None."""
    with open_hdf5(source.path) as file:
        keys = {}
        for node in (file, file["CD"]):
            for name in ("geometry", "format", "system_ID"):
                value = read_attribute(node, name)
                if isinstance(value, bytes):
                    value = value.decode("latin-1")
                if isinstance(value, str):
                    keys[name] = value
        return raw.Header(0, keys).size


FORMAT = camera_format(
    name="Prophesee HDF5",
    suffixes=(".hdf5", ".h5"),
    matches=lambda path, head: has_datasets(path, head, "CD/events"),
    pieces=pieces_reader(_read_parts),
    size=read_size,
)
