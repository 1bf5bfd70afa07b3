"""What every reader of a camera's file shares: the file, what was noticed in it, events, pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError, checked_integer, how_to_install, printable

Size = tuple[int, int]
"""Columns and rows."""

CHUNK = 1 << 20  # events that `stream` hands on at once
LARGEST = 8192  # columns or rows of a sensor that a file may claim
STANDARD_GRAVITY = 9.80665  # [m/s^2]
SIZES: tuple[Size, ...] = (
    (128, 128),
    (240, 180),
    (304, 240),
    (320, 320),
    (346, 260),
    (640, 480),
    (1280, 720),
)
"""Sensors that were built, from small to large: the first that holds all events is the guess."""

BOMB_BYTES = 200 << 20
BOMB_RATIO = 100

Kind = Literal["repaired", "refused", "assumed", "said", "odd"]
"""What a note tells: something was put right, left out, taken for granted, is said by the file, or looks
wrong but was left alone."""


class Note(str):
    """A sentence about a recording, with what it says in fields.

    Args:
        text: The sentence.
        kind: What it tells, see `Kind`.
        rule: Name of the rule that found it, as "order" or "bounds".
        number: How many events, words or packets; 0 where there is nothing to count.
    """

    kind: Kind
    rule: str
    number: int

    def __new__(cls, text: str, kind: Kind = "said", rule: str = "", number: int = 0) -> Note:
        """Return the sentence with its fields."""
        note = super().__new__(cls, printable(text))
        note.kind, note.rule, note.number = kind, rule, number
        return note

    def fields(self) -> dict[str, str | int]:
        """Return what is to be written for machines to read."""
        return {"kind": self.kind, "rule": self.rule, "number": self.number, "text": str(self)}


@dataclass(frozen=True)
class Part:
    """The part of a recording that is read; its clock stays that of the file.

    Args:
        begin: First time [s].
        end: End of the time [s], which is not read.
        region: First column, first row, columns and rows; None for the whole sensor. What is read begins at
            column and row 0.

    Raises:
        InputError: The part has no time, or no pixel.
    """

    begin: float = -math.inf
    end: float = math.inf
    region: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        if not self.begin < self.end:
            raise InputError(f"the part of time must end after it begins, got {self.begin:g}..{self.end:g} s")
        if self.region is not None:
            if len(self.region) != 4:
                raise InputError(f"a region is x, y, columns and rows, got {self.region}")
            for name, value, least in zip(
                ("x", "y", "columns", "rows"), self.region, (0, 0, 1, 1), strict=True
            ):
                checked_integer(f"region: {name}", value, least)


class ReadOptions(TypedDict, total=False):
    """What a user may say about a file that is read."""

    size: Size | None
    """Columns and rows of the sensor, where the file does not say or says it wrongly."""
    chip: str | None
    """Name of the chip, as davis240, where a file of AEDAT 1 or 2 does not say or says it wrongly."""
    columns: str | None
    """Order of the columns, as txyp or xytp, of a table whose columns have no names."""
    part: Part | None
    """The part of time and sensor to read; None for all."""
    flow: bool
    """Whether flow is read that belongs to frames: it may take more memory and time than all else."""


@dataclass(frozen=True)
class Source:
    """A file to read, what the user knows about it, and what the reader saw.

    Args:
        path: File or folder.
        size: Columns and rows where the user says so; it wins over what the file says.
        notes: What was skipped, repaired or guessed, each a `Note`; readers append to it.
        chip: Name of the chip where the user says so, for AEDAT 1 and 2.
        columns: Order of columns without names where the user says so, four letters of t, x, y and p.
        part: The part to read; readers may leave out what lies outside, `dase.io` does.
        flow: Whether somebody wants flow that belongs to frames; readers that keep it need not leave it out.
    """

    path: Path
    size: Size | None = None
    notes: list[str] = field(default_factory=list)
    chip: str | None = None
    columns: str | None = None
    part: Part | None = None
    flow: bool = True

    def note(self, sentence: str, kind: Kind = "said", rule: str = "", number: int = 0) -> None:
        """Append a note, once."""
        if sentence not in self.notes:
            self.notes.append(Note(sentence, kind, rule, number))


class Piece(NamedTuple):
    """Some events in the order of the file; each (N,).

    Ticks (int64 or float64), columns, rows, polarities (ON or any number above zero), labels where known.
    """

    t: NDArray[Any]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[Any]
    label: NDArray[Any] | None = None

    def take(self, index: Any) -> Piece:
        """Return the events of an index, mask or slice."""
        label = None if self.label is None else self.label[index]
        return Piece(self.t[index], self.x[index], self.y[index], self.p[index], label)


class Picture(NamedTuple):
    """A frame of a camera.

    Grey (H, W), uint8 or uint16; middle of the exposure [ticks], its duration [s]; flow (2, H, W).
    """

    grey: NDArray[Any]
    t: Any
    exposure: float = 0.0
    flow: NDArray[np.float32] | None = None


class Motion(NamedTuple):
    """Samples of a camera's motion sensor, in the axes of its maker.

    Times [ticks or s] (N,), acceleration with that of gravity [m/s^2] (N, 3), rotation [rad/s] (N, 3).
    """

    t: NDArray[Any]
    acceleration: NDArray[np.float64]
    rotation: NDArray[np.float64]


Beside = tuple[NDArray[np.float32] | None, str | None]
"""Thresholds (2, H, W) and configuration of a simulated sequence; None where unknown."""


def join_pieces(pieces: list[Piece]) -> Piece:
    """Join pieces; none make an empty one. Labels stay where all have them."""
    if len(pieces) == 1:
        return pieces[0]
    if not pieces:
        none = np.empty(0, np.uint16)
        return Piece(np.empty(0, np.int64), none, none, np.empty(0, np.bool_))
    *columns, labels = zip(*pieces, strict=True)
    t, x, y, p = (np.concatenate(column) for column in columns)
    known = [label for label in labels if label is not None]
    return Piece(t, x, y, p, np.concatenate(known) if len(known) == len(pieces) else None)


def guess_size(source: Source, extent: Size) -> Size:
    """Return the smallest sensor that holds all events, of those that were built."""
    for size in SIZES:
        if extent[0] <= size[0] and extent[1] <= size[1]:
            break
    else:
        size = extent
    source.note(
        f"the file does not say how large the sensor is: {size[0]}x{size[1]} holds all its events",
        "assumed",
        "size",
    )
    return size


def checked_size(size: Size) -> Size:
    """Return the size; raises InputError where no sensor is so small or so large."""
    if not (1 <= size[0] <= LARGEST and 1 <= size[1] <= LARGEST):
        raise InputError(f"a sensor must be 1x1 to {LARGEST}x{LARGEST}, got {size[0]}x{size[1]}")
    return size


def refuse_bomb(packed: int, unpacked: int, ratio: int = BOMB_RATIO) -> None:
    """Raise InputError where a small file claims to unpack to something absurd [bytes]."""
    if unpacked > BOMB_BYTES and unpacked > ratio * packed:
        raise InputError(
            f"unpacks from {packed / 1e6:.3g} to {unpacked / 1e6:.0f} MB: more than {ratio} times is refused"
        )


def missing_extra(what: str, extra: str) -> InputError:
    """Return the error for a library that is not installed."""
    return InputError(f"{what} needs an optional library: {how_to_install(extra)}")
