"""Event Stream files (.es) of the International Centre for Neuromorphic Systems: DVS and ATIS events.

    "Event Stream", 3 bytes of version (2.x.y), u8 type: 1 DVS, 2 ATIS; u16 columns, rows
    DVS     byte 0xFF: 127 us more; 0xFE: nothing; else high 7 bits: us since the last event, bit 0: ON;
            then u16 column, u16 row
    ATIS    byte 111111nn: n times 63 us more; else high 6 bits: us, bit 1: ON, bit 0: of exposure;
            then u16 column, u16 row

Exposures of an ATIS are no changes of light and are skipped. Generic and colour streams have no polarity and
are refused. Source: the specification of Event Stream 2.0; sepia (by A. Marcireau).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.format import camera_format
from dase.io.source import Piece, Size, Source

MAGIC = b"Event Stream"
HEADER = len(MAGIC) + 8  # [bytes]


class Kind(IntEnum):
    """Types of streams whose events have a polarity."""

    DVS = 1
    ATIS = 2


@dataclass(frozen=True)
class _Header:
    """Type of the stream, and columns and rows."""

    kind: Kind
    size: Size


def _read_header(source: Source) -> _Header:
    with source.path.open("rb") as file:
        head = file.read(HEADER)
    if len(head) < HEADER or not head.startswith(MAGIC):
        raise InputError("has no header of an Event Stream")
    if head[12] != 2:
        raise InputError(f"is Event Stream {head[12]}.{head[13]}.{head[14]}, of which version 2 is read")
    if head[15] not in list(Kind):
        name = {0: "generic", 3: "colour (amd)", 4: "colour"}.get(head[15], f"unknown ({head[15]})")
        raise InputError(f"holds events of the type {name}, which have no polarity: DVS and ATIS are read")
    size = int.from_bytes(head[16:18], "little"), int.from_bytes(head[18:20], "little")
    return _Header(Kind(head[15]), size)


def read_pieces(source: Source) -> Iterator[Piece]:
    """Yield the events [us]."""
    kind = _read_header(source).kind
    time = exposures = 0
    with source.path.open("rb") as file:
        file.seek(HEADER)
        rest = b""
        while block := file.read(1 << 16):
            data = np.frombuffer(rest + block, np.uint8)
            place = _begins(data, kind)
            byte = data[place]
            steps, is_event = _steps(byte, kind)
            whole = ~is_event | (place + 5 <= len(data))
            used = int(place[-1] + np.where(is_event[-1], 5, 1)) if whole.all() else int(place[~whole][0])
            rest = data[used:].tobytes()
            place, byte, steps, is_event = place[whole], byte[whole], steps[whole], is_event[whole]
            t = time + np.cumsum(steps)
            time = int(t[-1]) if len(t) else time
            if kind == Kind.ATIS:
                light = byte & 1 == 0
                exposures += int(np.count_nonzero(is_event & ~light))
                is_event = is_event & light
            at = place[is_event]
            x, y = (
                data[at + k].astype(np.uint16) | data[at + k + 1].astype(np.uint16) << np.uint16(8)
                for k in (1, 3)
            )
            on = byte[is_event] & (1 if kind == Kind.DVS else 2) > 0
            yield Piece(t[is_event], x, y, on)
    if rest:
        source.note(f"{len(rest)} bytes at the end are no whole event: skipped", "refused", "damage", 1)
    if exposures:
        sentence = f"{exposures} events of exposure, which are no changes of light: skipped"
        source.note(sentence, "refused", "exposures", exposures)


def _is_step(byte: NDArray[np.uint8], kind: Kind) -> NDArray[np.bool_]:
    """Whether bytes at the begin of a record are only steps of time."""
    return byte >= (0xFE if kind == Kind.DVS else 0xFC)


def _steps(byte: NDArray[np.uint8], kind: Kind) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return how far each record moves the time [us], and which of them are events, each (N,)."""
    first, step = byte.astype(np.int64), _is_step(byte, kind)
    if kind == Kind.DVS:
        return np.where(step, np.where(first == 0xFF, 127, 0), first >> 1), ~step
    return np.where(step, 63 * (first & 3), first >> 2), ~step


def _begins(data: NDArray[np.uint8], kind: Kind) -> NDArray[np.int64]:
    """Return where records begin, (N,): each tells how long it is, so the next is known from it alone.

    All places are followed at once, and twice as far with every round: from the first 1, 2, 4, ... records
    those as many further are looked up.
    """
    jump = np.minimum(np.arange(len(data)) + np.where(_is_step(data, kind), 1, 5), len(data))
    jump = np.append(jump, len(data))  # behind the end all stay there
    found = np.zeros(1, np.int64)
    while found[-1] < len(data):
        found = np.concatenate((found, jump[found]))
        jump = jump[jump]
    return found[: int(np.searchsorted(found, len(data)))]


def matches_format(path: Path, head: bytes) -> bool:
    """Whether a file begins as an Event Stream does."""
    return head.startswith(MAGIC)


FORMAT = camera_format(
    name="Event Stream",
    suffixes=(".es",),
    matches=matches_format,
    pieces=read_pieces,
    size=lambda source: _read_header(source).size,
)
