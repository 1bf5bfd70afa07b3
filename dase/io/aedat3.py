"""AEDAT 3.1 of iniVation's cAER: packets of events, frames and motion behind a header of `#` lines.

    #!AER-DAT3.1, #Format: RAW, #Source 1: DAVIS240C, ..., #!END-HEADER      each line ends with CR LF
    packet     i16 type, i16 source; i32 bytes of an event, place of its time, overflows, capacity, number,
               valid; then the events; times [us] go on by 2^31 with each overflow
    type 1     polarity: u32 with column 31..17, row 16..2, ON 1, valid 0; i32 time
    type 2     frame: u32 with channels 3..1, valid 0; i32 begin and end of the frame, begin and end of the
               exposure, columns, rows, left, top; then u16 pixels
    type 3     motion: u32, i32 time; f32 3 accelerations [g], 3 rotations [degrees/s], temperature

All little-endian; columns and rows count from the upper left. Special events and other packets are skipped,
a packet that cannot be ends the file, which is noted. Packed files (SerializedTS, PNGFrames) are refused.
Source: docs.inivation.com, "AEDAT 3.1"; libcaer.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.format import camera_format
from dase.io.source import STANDARD_GRAVITY, Motion, Picture, Piece, Size, Source

MAGIC = b"#!AER-DAT3."
END = b"#!END-HEADER\r\n"
FRAME_HEAD = struct.Struct("<I8i")
SIZES: tuple[tuple[str, Size], ...] = (
    ("dvs128", (128, 128)),
    ("davis240", (240, 180)),
    ("davis346", (346, 260)),
    ("davis640", (640, 480)),
    ("davis128", (128, 128)),
    ("davis208", (208, 192)),
    ("dvxplorer", (640, 480)),
)
"""Part of the name of a source, in small letters, to columns and rows."""


class Packet(IntEnum):
    """Types of packets that are read."""

    POLARITY = 1
    FRAME = 2
    IMU6 = 3


@dataclass(frozen=True)
class _Header:
    """Where packets begin, and what the sources are called, in small letters."""

    length: int
    sources: tuple[str, ...]


def _read_header(source: Source) -> _Header:
    with source.path.open("rb") as file:
        head = file.read(1 << 20)
    if not head.startswith(MAGIC):
        raise InputError("has no AEDAT 3 header")
    if not head.startswith(MAGIC + b"1"):
        version = head[9:12].decode("latin-1")
        raise InputError(f"is AEDAT {version}, of which only 3.1 is read")
    end = head.find(END)
    if end < 0:
        raise InputError("its header does not end")
    text = head[:end].decode("latin-1")
    format = re.search(r"^#Format: *(\S+)", text, re.MULTILINE)
    if format is not None and format[1] != "RAW":
        raise InputError(f"is packed ({format[1]}), which is not read")
    return _Header(end + len(END), tuple(re.findall(r"^#source +\d+: *(\S+)", text.lower(), re.MULTILINE)))


def _read_packets(source: Source, kind: Packet) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield the bytes of each packet of a kind, bytes of an event, their number, overflows of the clock."""
    length = source.path.stat().st_size
    place = _read_header(source).length
    with source.path.open("rb") as file:
        while place + 28 <= length:
            file.seek(place)
            numbers = struct.unpack("<hhiiiiii", file.read(28))
            found, _, size, _, overflows, _, number, _ = numbers
            total = size * number
            if size <= 0 or number < 0 or overflows < 0 or place + 28 + total > length:
                return source.note("damaged or cut short: read up to there", "refused", "damage", 1)
            place += 28 + total
            if found == kind:
                yield file.read(size * number), size, number, overflows
    if place != length:
        sentence = f"{length - place} bytes at the end are no whole packet: skipped"
        source.note(sentence, "refused", "damage", 1)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [us]."""
    invalid = 0
    for data, size, number, overflows in _read_packets(source, Packet.POLARITY):
        if size != 8:
            raise InputError(f"a packet claims {size} bytes for an event of 8")
        words = np.frombuffer(data, "<u4").reshape(number, 2)
        word, time = words[:, 0], words[:, 1]
        valid = word & 1 > 0
        invalid += int(np.count_nonzero(~valid))
        word, time = word[valid], time[valid]
        t = (time & 0x7FFFFFFF).astype(np.int64) + (overflows << 31)
        x, y = (((word >> shift) & 0x7FFF).astype(np.uint16) for shift in (17, 2))
        yield Piece(t, x, y, word & 2 > 0)
    if invalid:
        source.note(f"{invalid} events that the camera marks invalid: skipped", "refused", "invalid", invalid)


def read_size(source: Source) -> Size | None:
    """Return columns and rows of the camera that the header names, or None."""
    for name in _read_header(source).sources:
        for part, size in SIZES:
            if part in name:
                return size
    return None


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames with their exposures [us]."""
    damaged = 0
    for data, size, number, overflows in _read_packets(source, Packet.FRAME):
        for k in range(number):
            picture = _frame_of(data[k * size : (k + 1) * size], overflows)
            if picture is None:
                damaged += 1
            else:
                yield picture
    if damaged:
        source.note(f"{damaged} damaged or invalid frames: skipped", "refused", "damage", damaged)


def _frame_of(data: bytes, overflows: int) -> Picture | None:
    if len(data) < FRAME_HEAD.size:
        return None
    info, _, _, begin, end, width, height, _, _ = FRAME_HEAD.unpack_from(data)
    channels = info >> 1 & 7
    count = width * height * channels
    if not info & 1 or min(width, height) < 1 or channels not in (1, 3, 4) or begin > end:
        return None
    if FRAME_HEAD.size + 2 * count > len(data):
        return None
    values = np.frombuffer(data, "<u2", count, FRAME_HEAD.size).reshape(height, width, channels)
    grey: NDArray[Any] = values[..., 0].astype(np.uint16)
    if channels > 1:
        grey = np.rint(values[..., :3] @ np.array([0.21, 0.72, 0.07])).astype(
            np.uint16
        )  # of red, green, blue
    return Picture(grey, (overflows << 31) + begin + (end - begin) / 2, (end - begin) / 1e6)


def read_motion(source: Source) -> Motion | None:
    """Read the samples of the motion sensor, times [us]."""
    kind = np.dtype([("info", "<u4"), ("t", "<i4"), ("a", "<f4", 3), ("w", "<f4", 3), ("temperature", "<f4")])
    found = []
    for data, size, number, overflows in _read_packets(source, Packet.IMU6):
        if size != kind.itemsize:
            raise InputError(f"a packet claims {size} bytes for a sample of {kind.itemsize}")
        samples = np.frombuffer(data, kind, number)
        samples = samples[samples["info"] & 1 > 0]
        t = samples["t"].astype(np.int64) + (overflows << 31)
        found.append((t, samples["a"].astype(np.float64), samples["w"].astype(np.float64)))
    if not found:
        return None
    t, a, w = (np.concatenate(column) for column in zip(*found, strict=True))
    return Motion(t, STANDARD_GRAVITY * a, np.deg2rad(w)) if len(t) else None


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file begins as AEDAT 3 does."""
    return head.startswith(MAGIC)


FORMAT = camera_format(
    name="AEDAT3",
    suffixes=(),
    matches=matches_format,
    pieces=read_pieces,
    size=read_size,
    pictures=read_pictures,
    motion=read_motion,
)
