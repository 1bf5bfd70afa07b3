"""AEDAT 2.0 of jAER and v2e: big-endian records behind a header of `#` lines.

    #!AER-DAT2.0, # AEChip: eu.seebetter.ini.chips.davis.DAVIS240C, ...   each line ends with CR LF
    record    u32 address, u32 time [us], starts over after 71 min

    address     31   30..22   21..12    11         10        9..0
    DAVIS       0    row      column    1 = ON     special   -         bit 31 set: frame or IMU sample
    DVS128      -    14..8    7..1      bit 0: 0 = ON        bit 15: special
    DVS640      -    20..11   10..1     bit 0: 1 = ON        as v2e writes it

AEDAT 1.0 differs by 16-bit addresses, always of a DVS128. Rows count from below, columns from the right, and
are turned here. Frame samples, IMU samples and special events are skipped. Without an AEChip line the layout
is told from the bits in use. Sources: docs.inivation.com, "AEDAT file formats"; jAER's extractors; v2e (MIT).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.binary import EventWriter, Rollover, read_records
from dase.io.format import camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Piece, Size, Source, guess_size

LONGEST = 1 << 21  # [bytes] of a header: jAER stores all its preferences
END = b"#End Of ASCII Header\r\n"


@dataclass(frozen=True)
class Layout:
    """Bits of an address.

    Args:
        x: First bit and number of bits of the column.
        y: First bit and number of bits of the row.
        p: Bit of the polarity.
        on: Its value for ON.
        special: Bits that mark what is no event of a pixel.
    """

    x: tuple[int, int]
    y: tuple[int, int]
    p: int
    on: int
    special: int


DAVIS = Layout((12, 10), (22, 9), 11, 1, 1 << 31 | 1 << 10)
DVS128 = Layout((1, 7), (8, 7), 0, 0, 1 << 15)
DVS640 = Layout((1, 10), (11, 10), 0, 1, 0)

CHIPS: tuple[tuple[str, Layout, Size], ...] = (
    ("davis240", DAVIS, (240, 180)),
    ("davis346", DAVIS, (346, 260)),
    ("davis640", DAVIS, (640, 480)),
    ("davis128", DAVIS, (128, 128)),
    ("davis208", DAVIS, (208, 192)),
    ("dvs128", DVS128, (128, 128)),
    ("dvs640", DVS640, (640, 480)),
)
"""Part of the name of a chip class, in lower case, to its layout and size."""

WRITTEN = {
    (240, 180): (DAVIS, "eu.seebetter.ini.chips.davis.DAVIS240C"),
    (346, 260): (DAVIS, "eu.seebetter.ini.chips.davis.Davis346B"),
    (128, 128): (DVS128, "ch.unizh.ini.jaer.chip.retina.DVS128"),
}
"""Size to layout and chip class of files we write."""


@dataclass(frozen=True)
class Header:
    """What the header says: where it ends, bytes of an address, name of the chip class in lower case."""

    length: int
    address: int
    chip: str


def parse_header(head: bytes) -> Header:
    """Parse the first bytes of a file."""
    place, address, chip = 0, 4, ""
    while head[place : place + 1] == b"#":
        end = head.find(b"\n", place)
        line = head[place:end]
        if end < 0 or not all(32 <= byte < 127 or byte in (9, 13) or byte > 160 for byte in line):
            break  # data that happen to begin with the byte of a hash sign
        place = end + 1
        text = line.decode("latin-1").strip()
        if match := re.match(r"#!AER-DAT([0-9.]+)", text):
            if match[1] not in ("1.0", "2.0"):
                raise InputError(f"is AEDAT {match[1]}, which is not read: convert it to AEDAT 4 with DV")
            address = 2 if match[1] == "1.0" else 4
        if match := re.match(r"# *AEChip: *(\S+)", text):
            chip = match[1].lower().rpartition(".")[2]
        if line + b"\n" == END:
            break
    return Header(place, address, chip)


def read_header(source: Source) -> Header:
    """Read the header of a file."""
    with source.path.open("rb") as file:
        head = file.read(LONGEST)
    if not head.startswith(b"#!AER-DAT"):
        raise InputError("has no AEDAT header")
    return parse_header(head)


def _read_records(source: Source, head: Header) -> Iterator[tuple[NDArray[np.uint32], NDArray[np.uint32]]]:
    kind = np.dtype([("a", f">u{head.address}"), ("t", ">u4")])
    for block in read_records(source, head.length, kind):
        yield block["a"].astype(np.uint32), block["t"].astype(np.uint32)


def find_layout(source: Source) -> tuple[Layout, Size]:
    """Return the layout of the addresses, and columns and rows of the sensor."""
    head = read_header(source)
    known = [entry for entry in CHIPS if entry[0] in head.chip]
    if known:
        return known[0][1], source.size or known[0][2]
    if head.chip:
        raise InputError(f"chip '{head.chip}' is not known: {', '.join(name for name, *_ in CHIPS)} are")
    used = largest_x = largest_y = 0
    for address, _ in _read_records(source, head):
        events = address[address & DAVIS.special == 0]
        used |= int(np.bitwise_or.reduce(address[address < 1 << 31], initial=0))
        if len(events):
            largest_x = max(largest_x, int(_extract_bits(events, DAVIS.x).max()))
            largest_y = max(largest_y, int(_extract_bits(events, DAVIS.y).max()))
    if (used < 1 << 16 and used & 1023) or not used:
        return DVS128, source.size or (128, 128)
    if used & 1023:
        return DVS640, source.size or (640, 480)
    return DAVIS, source.size or guess_size(source, (largest_x + 1, largest_y + 1))


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    form, (width, height) = find_layout(source)
    turns = Rollover(32)
    samples = special = 0
    for address, time in _read_records(source, read_header(source)):
        t = turns(time)
        if form.special:
            other = (address & form.special) != 0
            if other.any():
                high = int(np.count_nonzero(address[other] >> 31))
                samples, special = samples + high, special + int(np.count_nonzero(other)) - high
                address, t = address[~other], t[~other]
        x = np.uint16(width - 1) - _extract_bits(
            address, form.x
        )  # beyond the sensor it turns over to a large number
        y = np.uint16(height - 1) - _extract_bits(address, form.y)
        yield Piece(t, x, y, (address >> form.p) & 1 == form.on)
    if samples:
        sentence = f"{samples} samples of frames and motion sensors: skipped"
        source.note(sentence, "refused", "samples", samples)
    if special:
        sentence = f"{special} special events (external signals, or noise labelled by v2e): skipped"
        source.note(sentence, "refused", "special", special)


def _extract_bits(address: NDArray[np.uint32], place: tuple[int, int]) -> NDArray[np.uint16]:
    return ((address >> place[0]) & ((1 << place[1]) - 1)).astype(np.uint16)


class _Writer(EventWriter):
    name = "AEDAT2"

    def _header(self, width: int, height: int) -> bytes:
        if (width, height) not in WRITTEN:
            sizes = ", ".join(f"{w}x{h}" for w, h in WRITTEN)
            raise InputError(f"AEDAT2: is known for sensors of {sizes}, got {width}x{height}")
        lines = (
            "#!AER-DAT2.0",
            "# This is a raw AE data file created by dase",
            "# Data format is int32 address, int32 timestamp (8 bytes total), repeated for each event",
            "# Timestamps tick is 1 us",
            f"# AEChip: {WRITTEN[width, height][1]}",
        )
        return "\r\n".join(lines).encode() + b"\r\n" + END

    def _encoded(self, part: Events, t_us: NDArray[np.int64]) -> bytes:
        if t_us[-1] >= 2**31:
            raise InputError(f"AEDAT2: times must stay below 2^31 us = 2147 s, got {part.t[-1]:g} s")
        form = WRITTEN[part.width, part.height][0]
        x = (part.width - 1 - part.x.astype(np.int64)) << form.x[0]
        y = (part.height - 1 - part.y.astype(np.int64)) << form.y[0]
        p = (part.p == form.on).astype(np.int64) << form.p
        out = np.empty((len(part), 2), ">u4")
        out[:, 0], out[:, 1] = x | y | p, t_us
        return out.tobytes()


def create(path: Path) -> AbstractContextManager[Writer]:
    """Open an AEDAT2 file for writing; it appears under its name when the block ends well."""
    return writing_file(path, _Writer)


FORMAT = camera_format(
    name="AEDAT2",
    suffixes=(".aedat", ".aedat2"),
    create=create,
    matches=lambda path, head: head.startswith(b"#!AER-DAT") and not head.startswith(b"#!AER-DAT4"),
    pieces=read_pieces,
    size=lambda source: find_layout(source)[1],
)
