"""Files of cameras and of simulations: one module per format, chosen by content first, by suffix second.

    sequence = read("recording.raw")                     all of it
    for events in stream("recording.aedat4"):            chunks of it, in memory that does not grow
        ...
    with create("scene.h5") as writer:
        writer.events(part)
        writer.frame(time, grey, flow)

A new format is a module with a `Format`, and one line in FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from math import isfinite
from os import PathLike
from pathlib import Path

from dase.errors import InputError, nearest
from dase.events import Events
from dase.io import (
    aedat2,
    aedat4,
    arrays,
    dat,
    dsec,
    ecf,
    evt2,
    evt3,
    evt21,
    frames,
    ijrr,
    mvsec,
    ros,
    s2r,
    v2e,
)
from dase.io import h5 as h5
from dase.io import npz as npz
from dase.io.format import Format as Format
from dase.io.rules import TooLateError
from dase.io.sequence import Sequence as Sequence
from dase.io.sequence import Writer as Writer
from dase.io.sequence import replacing as replacing
from dase.io.source import CHUNK, Size, Source
from dase.io.source import Motion as Motion
from dase.io.source import Note as Note
from dase.io.source import Picture as Picture

FORMATS: tuple[Format, ...] = (
    ecf.FORMAT,
    dsec.FORMAT,
    mvsec.FORMAT,
    v2e.FORMAT,
    s2r.FORMAT,  # any other HDF5
    arrays.TABLE,
    ijrr.ZIPPED,
    arrays.OWN,  # any other zip
    evt3.FORMAT,
    evt2.FORMAT,
    evt21.FORMAT,
    dat.FORMAT,
    aedat4.FORMAT,
    aedat2.FORMAT,
    ros.FORMAT,
    ijrr.TEXT,
    frames.FORMAT,
)
"""All formats. Content is asked in this order; of several with one suffix the first that can is taken."""

HEAD = 1 << 16  # [bytes] of a file that formats are told by
PART = 1 << 20  # events handed to a writer at once


def find_format(path: str | PathLike[str]) -> Format:
    """Return the format of an existing file or folder: by its content, else by its suffix.

    Raises:
        InputError: It is missing, cannot be read, or is of no known format.
    """
    path = Path(path)
    try:
        head = b""
        if not path.is_dir():
            with path.open("rb") as file:
                head = file.read(HEAD)
        found = next((format for format in FORMATS if format.matches(path, head)), None)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if found is not None:
        return found
    if path.is_dir():
        raise InputError(f"{path}: is a folder with neither events.txt, nor a ROS 2 bag, nor pictures")
    return _of_suffix(path, (s2r.FORMAT, arrays.OWN, *FORMATS))


def read(path: str | PathLike[str], *, size: Size | None = None, notes: list[str] | None = None) -> Sequence:
    """Read a file or folder whole.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        size: Columns and rows of the sensor, where the file does not say or says it wrongly.
        notes: Gets sentences about what was skipped, repaired or guessed.

    Raises:
        InputError: It is missing, of unknown format, damaged or incomplete, or needs an optional library.
    """
    source = _make_source(path, size, notes)
    return find_format(path).read(source)


def stream(
    path: str | PathLike[str],
    *,
    chunk: int = CHUNK,
    size: Size | None = None,
    notes: list[str] | None = None,
) -> Iterator[Events]:
    """Yield the events of a file in chunks, so that the file may be larger than the memory.

    Chunks are sorted and follow each other in time; all but the last hold `chunk` events. There is at least
    one, if empty. Joined they are the events of `read`.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        chunk: Events in a chunk.
        size: Columns and rows of the sensor, where the file does not say or says it wrongly.
        notes: Gets sentences about what was skipped, repaired or guessed; complete after the last chunk.

    Raises:
        InputError: As for `read`; also where times go back too far to be sorted on the way.
    """
    if chunk < 1:
        raise InputError(f"chunk must be at least 1 event, got {chunk}")
    source = _make_source(path, size, notes)
    return find_format(path).stream(source, chunk)


def pictures(
    path: str | PathLike[str], *, size: Size | None = None, notes: list[str] | None = None
) -> Iterator[Picture]:
    """Yield the frames of a file one by one, as `read` gives them.

    Times [s] are not a number where nothing tells them.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        size: Columns and rows of the sensor, where the file does not say or says it wrongly.
        notes: Gets sentences about what was skipped, repaired or guessed.

    Raises:
        InputError: As for `read`.
    """
    return find_format(path).pictures(_make_source(path, size, notes))


def motion(
    path: str | PathLike[str], *, size: Size | None = None, notes: list[str] | None = None
) -> Motion | None:
    """Read the samples of a camera's motion sensor, times [s] on the clock of the events; None without any.

    Args:
        path: What to read; of the formats AEDAT 4 has them.
        size: Columns and rows of the sensor, where the file does not say or says it wrongly.
        notes: Gets sentences about what was skipped, repaired or guessed.

    Raises:
        InputError: As for `read`.
    """
    return find_format(path).motion(_make_source(path, size, notes))


def create(path: str | PathLike[str], *, format: str | None = None) -> AbstractContextManager[Writer]:
    """Open a file for writing, in the format of its suffix or of a name.

    The file appears under its name when the block ends well; when it raises, nothing is left behind.

    Args:
        path: File to write.
        format: Name of the format, as EVT2, where the suffix does not decide.

    Raises:
        InputError: The format is unknown or the folder missing; later, from the writer, on bad content.
    """
    path = Path(path)
    found = find_writable_format(path, format)
    assert found.create is not None
    return found.create(path)


def find_writable_format(path: str | PathLike[str], format: str | None = None) -> Format:
    """Return the format that `create` would write; raises InputError where there is none."""
    writers = [known for known in (s2r.FORMAT, arrays.OWN, *FORMATS) if known.create is not None]
    if format is None:
        return _of_suffix(Path(path), writers)
    for known in writers:
        if known.name.lower() == format.lower():
            return known
    raise InputError(f"format '{format}' cannot be written, {nearest(format, [w.name for w in writers])}")


def write(path: str | PathLike[str], sequence: Sequence, *, format: str | None = None) -> None:
    """Write a whole sequence.

    Thresholds and configuration are left out where the format has no place for them.

    Raises:
        InputError: Frames have no times, flow has no frames, or the format holds no frames.
    """
    keeps = find_writable_format(path, format).keeps
    if sequence.frames is not None and sequence.frame_times is None:
        raise InputError(f"{path}: frames cannot be written without their times")
    if sequence.frames is None and sequence.flow is not None:
        raise InputError(f"{path}: flow cannot be written without frames")
    events, flow, exposure = sequence.events, sequence.flow, sequence.frame_exposure
    with create(path, format=format) as writer:
        if sequence.frames is not None and sequence.frame_times is not None:
            for index, (time, grey) in enumerate(zip(sequence.frame_times, sequence.frames, strict=True)):
                span = 0.0 if exposure is None else float(exposure[index])
                writer.frame(float(time), grey, None if flow is None else flow[index], exposure=span)
        for i in range(0, max(len(events), 1), PART):
            writer.events(events.select(slice(i, i + PART)))
        if sequence.thresholds is not None and "thresholds" in keeps:
            writer.thresholds(sequence.thresholds)
        if sequence.configuration is not None and "configuration" in keeps:
            writer.configuration(sequence.configuration)


def convert(
    source: str | PathLike[str],
    target: str | PathLike[str],
    *,
    format: str | None = None,
    size: Size | None = None,
    with_frames: bool = True,
    notes: list[str] | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> int:
    """Convert a file piece by piece, whatever its size, and return its number of events.

    Only a file whose times go back by more than a moment is held in memory to be sorted, and what goes into
    an archive of NumPy.

    Args:
        source: Any file that `read` takes.
        target: File to write.
        format: Name of its format; None goes by its suffix.
        size: Columns and rows of the sensor, where `source` does not say or says it wrongly.
        with_frames: Take frames along where `target` can hold them.
        notes: Gets sentences about what was skipped, repaired or guessed.
        progress: Is told how many events were written since it was told last.

    Raises:
        InputError: As for `read` and `create`.
    """
    notes = [] if notes is None else notes
    taken, keeps = _make_source(source, size, notes), find_writable_format(target, format).keeps
    total = 0
    try:
        with create(target, format=format) as writer:
            for part in find_format(source).stream(taken, CHUNK):
                writer.events(part)
                total += len(part)
                progress(len(part))
            if with_frames and "frames" in keeps:
                _add_frames(taken, writer)
                _add_beside(taken, writer)
    except TooLateError:
        sequence = replace(find_format(source).read(taken), flow=None)
        keeps_frames = with_frames and "frames" in keeps and sequence.frame_times is not None
        write(target, sequence if keeps_frames else Sequence(sequence.events), format=format)
        total = len(sequence.events)
    return total


def _add_frames(source: Source, writer: Writer) -> None:
    for grey, time, exposure, flow in find_format(source.path).pictures(source):
        if not isfinite(time):
            return source.note("frames without times cannot be converted: left out", "refused", "frames")
        writer.frame(float(time), grey, flow, exposure=exposure)


def _add_beside(source: Source, writer: Writer) -> None:
    thresholds, configuration = find_format(source.path).beside(source)
    if thresholds is not None:
        writer.thresholds(thresholds)
    if configuration is not None:
        writer.configuration(configuration)


def _make_source(path: str | PathLike[str], size: Size | None, notes: list[str] | None) -> Source:
    return Source(Path(path), size, [] if notes is None else notes)


def _of_suffix(path: Path, formats: Iterable[Format]) -> Format:
    known: dict[str, Format] = {}
    for format in formats:
        for suffix in format.suffixes:
            known.setdefault(suffix, format)
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InputError(f"{path}: unknown format '{path.suffix}', known: {', '.join(known)}")
    return known[suffix]
