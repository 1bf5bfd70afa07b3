"""Sequence files: one module per format, chosen by suffix when writing, by content first when reading.

    with create("scene.h5") as writer:
        writer.events(part)
        writer.frame(time, grey, flow)
    sequence = read("scene.h5")

A new format is a module with `create` and `read`, and one line in FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from os import PathLike
from pathlib import Path

from dase.errors import InputError
from dase.io import h5, npz
from dase.io.sequence import Sequence as Sequence
from dase.io.sequence import Writer as Writer
from dase.io.sequence import replacing as replacing

FORMATS: dict[str, tuple[Callable[[Path], AbstractContextManager[Writer]], Callable[[Path], Sequence]]] = {
    ".h5": (h5.create, h5.read),
    ".hdf5": (h5.create, h5.read),
    ".npz": (npz.create, npz.read),
}
"""Suffix to (create, read)."""

SIGNATURES = {b"\x89HDF\r\n\x1a\n": ".h5", b"PK\x03\x04": ".npz"}
"""First bytes of a file to the suffix of its format."""

PART = 1 << 20  # events handed to a writer at once


def create(path: str | PathLike[str]) -> AbstractContextManager[Writer]:
    """Open a sequence file for writing, in the format of its suffix.

    The file appears under its name when the block ends well; when it raises, nothing is left behind.

    Raises:
        InputError: The suffix is unknown or the folder missing; later, from the writer, on bad content.
    """
    path = Path(path)
    return FORMATS[_known_suffix(path)][0](path)


def read(path: str | PathLike[str]) -> Sequence:
    """Read a sequence file; its first bytes choose the format, then its suffix.

    Raises:
        InputError: The file is missing, of unknown format, damaged or incomplete.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    for signature, suffix in SIGNATURES.items():
        if head.startswith(signature):
            return FORMATS[suffix][1](path)
    return FORMATS[_known_suffix(path)][1](path)


def write(path: str | PathLike[str], sequence: Sequence) -> None:
    """Write a whole sequence; raises InputError for frames without times and flow without frames."""
    if sequence.frames is not None and sequence.frame_times is None:
        raise InputError(f"{path}: frames cannot be written without their times")
    if sequence.frames is None and sequence.flow is not None:
        raise InputError(f"{path}: flow cannot be written without frames")
    events, flow, exposure = sequence.events, sequence.flow, sequence.frame_exposure
    with create(path) as writer:
        if sequence.frames is not None and sequence.frame_times is not None:
            for index, (time, grey) in enumerate(zip(sequence.frame_times, sequence.frames, strict=True)):
                span = 0.0 if exposure is None else float(exposure[index])
                writer.frame(float(time), grey, None if flow is None else flow[index], exposure=span)
        for i in range(0, max(len(events), 1), PART):
            writer.events(events.select(slice(i, i + PART)))
        if sequence.thresholds is not None:
            writer.thresholds(sequence.thresholds)
        if sequence.configuration is not None:
            writer.configuration(sequence.configuration)


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path}: unknown format '{path.suffix}', known: {', '.join(sorted(FORMATS))}")
    return suffix
