"""AEDAT 4.0 of iniVation's DV: packets of events, frames, motion and triggers, most often compressed.

    #!AER-DAT4.0 CR LF
    u32 size, FlatBuffer IOHE     compression i32 (0 none, 1 and 2 LZ4, 3 and 4 ZSTD), place of the table i64,
                                  XML that names the streams with type and size
    i32 stream, i32 size, packet  again and again up to the table or the end; a packet unpacks to
    u32 size, FlatBuffer EVTS     structs of 16 bytes: i64 t [Unix us], i16 column, i16 row, bool ON
    u32 size, FlatBuffer FRME     i64 t; begin, end of frame; begin, end of exposure [Unix us]; i8 format;
                                  i16 columns, rows, left, top; pixels; in newer files i64 exposure [us]
    u32 size, FlatBuffer IMUS     tables: i64 t [Unix us]; f32 temperature, 3 accelerations [g], 3 rotations
                                  [degrees/s], 3 magnetic fields

Of several streams the first of a kind is read; colour frames become grey; triggers are skipped. Damaged
packets are skipped and counted. Times count from the first event. LZ4 and ZSTD come with the extra "aedat".
Sources: docs.inivation.com, "AEDAT 4.0"; the schemas of dv-processing (Apache-2.0).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io import packed
from dase.io.flatbuffer import Table
from dase.io.format import camera_format
from dase.io.source import STANDARD_GRAVITY, Motion, Picture, Piece, Size, Source, join_pieces

T = TypeVar("T")

MAGIC = b"#!AER-DAT4.0\r\n"
EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("", "V3")])
PIXELS = {0: ("u1", 1), 16: ("u1", 3), 24: ("u1", 4), 2: ("<u2", 1), 18: ("<u2", 3), 26: ("<u2", 4)}
"""Format of a frame, a type of OpenCV, to NumPy type and channels."""


@dataclass(frozen=True)
class _Header:
    """Where packets begin and end, how they are compressed, and (number, type, size) of the streams."""

    begin: int
    end: int
    compression: int
    streams: tuple[tuple[int, str, Size | None], ...]

    def first(self, kind: str) -> tuple[int, Size | None] | None:
        """Return number and size of the first stream of a type."""
        return next(((number, size) for number, name, size in self.streams if name == kind), None)


def _read_header(source: Source) -> _Header:
    length = source.path.stat().st_size
    with source.path.open("rb") as file:
        head = file.read(len(MAGIC) + 4)
        if not head.startswith(MAGIC) or len(head) < len(MAGIC) + 4:
            raise InputError("has no AEDAT 4 header")
        size = int.from_bytes(head[len(MAGIC) :], "little")
        if size > min(1 << 24, length):
            raise InputError(f"its header claims {size} bytes of {length}")
        table = Table.root(file.read(size))
    place = table.number(1, "<q", -1)
    begin = len(MAGIC) + 4 + size
    streams = _parse_streams(table.text(2))
    return _Header(begin, place if begin <= place <= length else length, table.number(0, "<i", 0), streams)


def _parse_streams(text: bytes) -> tuple[tuple[int, str, Size | None], ...]:
    if b"<!" in text:
        raise InputError("its header holds declarations, which are refused")
    try:
        root = ElementTree.fromstring(text.rstrip(b"\0"))
    except ElementTree.ParseError as error:
        raise InputError(f"its header is damaged ({error})") from None
    out = []
    for node in root.iter("node"):
        keys = {attribute.get("key"): attribute.text or "" for attribute in node.findall("attr")}
        if "typeIdentifier" in keys and (node.get("name") or "").isdecimal():
            info = {a.get("key"): a.text or "" for a in node.findall("node[@name='info']/attr")}
            width, height = info.get("sizeX", ""), info.get("sizeY", "")
            known = width.isdecimal() and height.isdecimal()
            size = (int(width[:9]), int(height[:9])) if known else None
            out.append((int((node.get("name") or "0")[:9]), keys["typeIdentifier"], size))
    return tuple(sorted(out))


def _choose_unpacker(compression: int) -> Callable[[bytes], bytes]:
    if compression == 0:
        return lambda data: data
    make = {
        1: packed.lz4_decompressor,
        2: packed.lz4_decompressor,
        3: packed.zstd_decompressor,
        4: packed.zstd_decompressor,
    }.get(compression)
    if make is None:
        raise InputError(f"its compression has the unknown number {compression}")
    make()  # what is missing is said once, not for every packet
    return packed.make_unpacker(make)


def _read_packets(source: Source, kind: str, parse: Callable[[Table], T]) -> Iterator[T]:
    """Yield what `parse` makes of each packet of the first stream of a type; damage is noted."""
    header = _read_header(source)
    stream = header.first(kind)
    if stream is None:
        return
    if sum(name == kind for _, name, _ in header.streams) > 1:
        source.note(f"holds several streams of type {kind}: the first was read", "assumed", "streams")
    unpack = _choose_unpacker(header.compression)
    damaged = 0
    with source.path.open("rb") as file:
        place = header.begin
        while place + 8 <= header.end:
            file.seek(place)
            number, size = struct.unpack("<ii", file.read(8))
            place += 8 + size
            if size < 0 or place > header.end:
                source.note("damaged or cut short: read up to there", "refused", "damage", 1)
                break
            if number == stream[0]:
                try:
                    parsed = parse(Table.root(unpack(file.read(size))[4:]))
                except Exception:  # lz4 and zstd have no common error
                    damaged += 1
                    continue
                yield parsed
    if damaged:
        source.note(f"{damaged} damaged packets of type {kind}: skipped", "refused", "damage", damaged)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [us]."""
    waiting: list[NDArray[Any]] = []
    count = 0
    row = np.dtype(("V", EVENT.itemsize))  # NumPy joins these faster than fields
    for events in _read_packets(source, "EVTS", lambda packet: packet.structs(0, row)):
        waiting.append(events)
        count += len(events)
        if count >= 1 << 17:  # packets hold a few hundred
            yield _join_packets(waiting)
            waiting, count = [], 0
    yield _join_packets(waiting) if waiting else join_pieces([])


def _join_packets(parts: list[NDArray[Any]]) -> Piece:
    events = np.concatenate(parts).view(EVENT)
    x, y = (events[name].astype(np.uint16) for name in "xy")  # a negative one becomes large and lies outside
    return Piece(events["t"].astype(np.int64), x, y, events["p"] > 0)


def read_size(source: Source) -> Size | None:
    """Return columns and rows of the first stream of events, else of frames."""
    header = _read_header(source)
    stream = header.first("EVTS") or header.first("FRME")
    if stream is None:
        raise InputError("holds neither events nor frames")
    return stream[1]


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames with their exposures [us]."""
    for grey, (begin, end) in _read_packets(source, "FRME", _parse_frame):
        yield Picture(grey, begin + (end - begin) / 2, (end - begin) / 1e6)


def read_motion(source: Source) -> Motion | None:
    """Read the samples of the motion sensor, times [us]."""
    rows = [row for rows in _read_packets(source, "IMUS", _parse_samples) for row in rows]
    if not rows:
        return None
    values = np.array([row[1] for row in rows], np.float64)
    return Motion(
        np.array([row[0] for row in rows], np.int64),
        STANDARD_GRAVITY * values[:, :3],
        np.deg2rad(values[:, 3:]),
    )


def _parse_samples(packet: Table) -> list[tuple[int, list[float]]]:
    """Return time [us], acceleration [g] and rotation [degrees/s] of each sample."""
    return [
        (sample.number(0, "<q", 0), [sample.real(k, "<f", 0.0) for k in range(2, 8)])
        for sample in packet.tables(0)
    ]


def _parse_frame(packet: Table) -> tuple[NDArray[Any], tuple[int, int]]:
    """Return the pixels as grey of 8 or 16 bits, (H, W), and begin and end of the exposure [us]."""
    width, height = packet.number(6, "<h", 0), packet.number(7, "<h", 0)
    name, channels = PIXELS[packet.number(5, "<b", 0)]
    pixels = packet.structs(10, np.dtype("u1"))
    values = pixels.view(name).reshape(height, width, channels)
    t, begin, end = (packet.number(k, "<q", 0) for k in (0, 3, 4))
    if not 0 < begin <= end:
        begin, end = t, t + max(packet.number(11, "<q", 0), 0)
    if channels == 1:
        return values[..., 0], (begin, end)
    weights = np.array([0.07, 0.72, 0.21])  # of blue, green and red
    return np.rint(values[..., :3] @ weights).astype(values.dtype), (begin, end)


FORMAT = camera_format(
    name="AEDAT4",
    suffixes=(".aedat4",),
    extra="aedat",
    matches=lambda path, head: head.startswith(MAGIC[:10]),
    pieces=read_pieces,
    size=read_size,
    pictures=read_pictures,
    motion=read_motion,
)
