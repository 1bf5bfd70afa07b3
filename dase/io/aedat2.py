"""AEDAT 2.0 of jAER and v2e: big-endian records behind a header of `#` lines.

    #!AER-DAT2.0, # AEChip: eu.seebetter.ini.chips.davis.DAVIS240C, ...   each line ends with CR LF
    record    u32 address, u32 time [us], starts over after 71 min

    address     31   30..22   21..12    11         10        9..0
    DAVIS       0    row      column    1 = ON     special   -         bit 31 set: frame or IMU sample
    DVS128      -    14..8    7..1      bit 0: 0 = ON        bit 15: special
    DVS640      -    20..11   10..1     bit 0: 1 = ON        as v2e writes it

AEDAT 1.0 differs by 16-bit addresses, always of a DVS128. Rows count from below, columns from the right, and
are turned here. Special events and IMU samples are skipped. Without an AEChip line the layout is told from
the bits in use, and said; `chip` decides.

    frames      31 = 1   30..22 row   21..12 column   11..10 which read   9..0 sample of the converter

Every pixel of a frame is read twice: read 0 after its reset, read 1 at the end of the exposure; 3 is an IMU
sample. Grey is the first minus the second. Here columns count from the left. Frames become 16 bits, all that
the converter can say being white. Sources: docs.inivation.com, "AEDAT file formats"; jAER's extractors; v2e
(MIT).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError, nearest
from dase.events import Events
from dase.io.binary import EventWriter, Rollover, read_records
from dase.io.format import camera_format
from dase.io.sequence import Writer, writing_file
from dase.io.source import Picture, Piece, Size, Source, guess_size

LEAST_READ = 0.5
"""Share of the pixels that must have been read twice; frames with less, cut off, are left out."""
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


@dataclass(frozen=True)
class SampleLayout:
    """Bits of an address that is a sample of a frame, first bit and number of bits of each.

    Args:
        frame: 1 in samples.
        y: Row.
        x: Column.
        read: Which read of the pixel it is.
        value: What the converter says.
    """

    frame: tuple[int, int]
    y: tuple[int, int]
    x: tuple[int, int]
    read: tuple[int, int]
    value: tuple[int, int]

    @property
    def white(self) -> int:
        """Largest value of the converter."""
        return (1 << self.value[1]) - 1


DAVIS = Layout((12, 10), (22, 9), 11, 1, 1 << 31 | 1 << 10)
DVS128 = Layout((1, 7), (8, 7), 0, 0, 1 << 15)
DVS640 = Layout((1, 10), (11, 10), 0, 1, 0)
SAMPLES = SampleLayout(frame=(31, 1), y=(22, 9), x=(12, 10), read=(10, 2), value=(0, 10))

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
                raise InputError(f"is AEDAT {match[1]}, which is not read")
            address = 2 if match[1] == "1.0" else 4
        if match := re.match(r"# *AEChip: *(\S+)", text):
            chip = match[1].lower().rpartition(".")[2]
        if line + b"\n" == END:
            break
    return Header(place, address, chip)


def read_header(source: Source) -> Header:
    """Read the header of a file."""
    with source.path.open("rb") as file:
        head = file.read(1 << 21)  # so long, as jAER stores all its preferences in a header
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
    name = (source.chip or head.chip).lower()
    known = [entry for entry in CHIPS if entry[0] in name]
    if known:
        return known[0][1], source.size or known[0][2]
    if name:
        names = [chip for chip, *_ in CHIPS]
        raise InputError(f"chip '{name}' is not known: {nearest(name, names)}")
    return _told_from_addresses(source, head)


def _told_from_addresses(source: Source, head: Header) -> tuple[Layout, Size]:
    """Return layout and size where no chip is named; a note says which were possible, and why this one."""
    total = 0
    fits = dict.fromkeys((DVS128, DAVIS, DVS640), 0)
    largest = dict.fromkeys(fits, (0, 0))  # column and row
    for address, _ in _read_records(source, head):
        total += len(address)
        for form in fits:
            good = _fitting(address, form)
            fits[form] += int(np.count_nonzero(good))
            events = address[good & (address & np.uint32(form.special) == 0)]
            if len(events):
                x, y = (int(_extract_bits(events, place).max()) for place in (form.x, form.y))
                largest[form] = max(largest[form][0], x), max(largest[form][1], y)
    possible = [form for form in fits if fits[form] >= 0.99 * total]  # damaged addresses fit none
    form = possible[0] if possible else max(fits, key=lambda one: fits[one])
    chips = [
        (name, one, size)
        for name, one, size in CHIPS
        if one in (possible or [form]) and largest[one][0] < size[0] and largest[one][1] < size[1]
    ]
    # of one layout the smallest that holds all events
    taken = min((entry for entry in chips if entry[1] is form), key=lambda entry: entry[2], default=None)
    if taken is None:
        return form, source.size or guess_size(source, (largest[form][0] + 1, largest[form][1] + 1))
    if len(chips) > 1:
        names = ", ".join(name for name, *_ in chips)
        why = f"{taken[0]} was taken, the smallest that holds all events; chip decides"
        source.note(f"the file names no chip, its addresses fit {names}: {why}", "assumed", "chip")
    else:
        source.note(f"the file names no chip, its addresses fit {taken[0]} alone", "assumed", "chip")
    return form, source.size or taken[2]


def _fitting(address: NDArray[np.uint32], form: Layout) -> NDArray[np.bool_]:
    """Return which addresses could be of a layout: without bits that it never sets, (N,)."""
    good: NDArray[np.bool_]
    if form is DAVIS:  # what is no event of a pixel may have any bits
        good = (address & np.uint32(form.special) != 0) | (address & np.uint32(1023) == 0)
    elif form is DVS128:
        good = address < 1 << 16
    else:
        good = (address < 1 << 21) & (_extract_bits(address, form.x) < 640)
        good &= _extract_bits(address, form.y) < 480
    return good


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events."""
    form, (width, height) = find_layout(source)
    turns = Rollover(32)
    motion = special = 0
    for address, time in _read_records(source, read_header(source)):
        t = turns(time)
        if form.special:
            other = (address & form.special) != 0
            if other.any():
                marked = address[other]
                sample = _extract_bits(marked, SAMPLES.frame) > 0
                if form is DAVIS:  # reads 0 and 1 are of frames
                    motion += int(np.count_nonzero(sample & (_extract_bits(marked, SAMPLES.read) > 1)))
                special += int(np.count_nonzero(~sample))
                address, t = address[~other], t[~other]
        # what lies beyond the sensor turns over to a large number, and is left out as that
        x = np.uint16(width - 1) - _extract_bits(address, form.x)
        y = np.uint16(height - 1) - _extract_bits(address, form.y)
        yield Piece(t, x, y, (address >> form.p) & 1 == form.on)
    if motion:
        sentence = f"{motion} samples of the motion sensor: skipped"
        source.note(sentence, "refused", "samples", motion)
    if special:
        sentence = f"{special} special events (external signals, or noise labelled by v2e): skipped"
        source.note(sentence, "refused", "special", special)


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames [us]; none where the chip has no frames."""
    form, size = find_layout(source)
    if form is not DAVIS:
        return
    cut_off = 0
    for samples in _frame_samples(source, size):
        picture = _picture_of(samples, size)
        if picture is None:
            cut_off += 1
        else:
            yield picture
    if cut_off:
        source.note(f"{cut_off} frames are cut off: left out", "refused", "frames", cut_off)


class _Samples(NamedTuple):
    """Samples of the converter, each (N,).

    Place in the first reads of a frame, or behind them in the second ones; value; time [us].
    """

    key: NDArray[np.int64]
    value: NDArray[np.int64]
    t: NDArray[np.int64]

    def take(self, part: slice) -> _Samples:
        """Return the samples of a slice."""
        return _Samples(self.key[part], self.value[part], self.t[part])


def _frame_samples(source: Source, size: Size) -> Iterator[_Samples]:
    """Yield the samples of one frame after the other.

    A frame ends where a read of a pixel comes that it already has, whatever the order in which chips with a
    global or a rolling shutter read their pixels.
    """
    turns = Rollover(32)
    pixels = size[0] * size[1]
    none = np.empty(0, np.int64)
    held = _Samples(none, none, none)
    for address, time in _read_records(source, read_header(source)):
        t = turns(time)
        read, x, y, value = (
            _extract_bits(address, place).astype(np.int64)
            for place in (SAMPLES.read, SAMPLES.x, SAMPLES.y, SAMPLES.value)
        )
        is_sample = _extract_bits(address, SAMPLES.frame) > 0
        chosen = np.flatnonzero(is_sample & (read < 2) & (x < size[0]) & (y < size[1]))
        key = read[chosen] * pixels + (size[1] - 1 - y[chosen]) * size[0] + x[chosen]
        pairs = zip(held, (key, value[chosen], t[chosen]), strict=True)
        held = _Samples(*(np.concatenate(pair) for pair in pairs))
        begin = 0
        for end in _frame_ends(held.key):
            yield held.take(slice(begin, end))
            begin = end
        held = held.take(slice(begin, None))
    if len(held.key):
        yield held


def _frame_ends(key: NDArray[np.int64]) -> Iterator[int]:
    """Yield where frames begin but the first: at a key that the frame it would belong to already holds."""
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    again, before = order[same + 1], order[same]  # places of a key, and of the same one the time before
    by_place = np.argsort(again)
    begin = 0
    for place, last in zip(again[by_place].tolist(), before[by_place].tolist(), strict=True):
        if last >= begin:
            begin = place
            yield place


def _picture_of(samples: _Samples, size: Size) -> Picture | None:
    """Return the frame of the samples, None where too few pixels were read twice."""
    (key, value, t), pixels = samples, size[0] * size[1]
    if len(key) < 2 * LEAST_READ * pixels:
        return None  # before anything as large as the sensor is made for a handful of samples
    reads = np.full(2 * pixels, -1, np.int64)
    reads[key] = value
    both = (reads[:pixels] >= 0) & (reads[pixels:] >= 0)
    if np.count_nonzero(both) < LEAST_READ * pixels:
        return None
    # light takes charge away; noise makes some of the darkest negative
    grey = np.where(both, np.clip(reads[:pixels] - reads[pixels:], 0, None), 0)
    scaled = np.rint(grey * (65535 / SAMPLES.white)).astype(np.uint16)
    begin, end = float(np.median(t[key < pixels])), float(np.median(t[key >= pixels]))
    return Picture(scaled.reshape(size[::-1]), (begin + end) / 2, max(end - begin, 0.0) / 1e6)


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
    matches=lambda path, head: head.startswith(b"#!AER-DAT") and head[9:10] not in (b"3", b"4"),
    pieces=read_pieces,
    pictures=read_pictures,
    asks=frozenset({"chip"}),
    size=lambda source: find_layout(source)[1],
)
