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
from typing import Unpack

from dase.errors import InputError, checked_integer, nearest
from dase.events import Events
from dase.files.text_files import stands_for
from dase.io import (
    aedat2,
    aedat3,
    aedat4,
    arrays,
    dat,
    dsec,
    ecf,
    event_stream,
    evt2,
    evt3,
    evt21,
    frames,
    ijrr,
    matlab,
    mvsec,
    nmnist,
    ros,
    s2r,
    table,
    v2e,
)
from dase.io import h5 as h5
from dase.io import npz as npz
from dase.io.format import Format as Format
from dase.io.format import closed_after, collect_pictures, sequence_of
from dase.io.parts import cut_beside, cut_motion, cut_pictures, cut_sequence, cut_stream, note_part
from dase.io.rules import TooLateError
from dase.io.sequence import Sequence as Sequence
from dase.io.sequence import Writer as Writer
from dase.io.sequence import reading_file
from dase.io.sequence import replacing as replacing
from dase.io.source import CHUNK, Source
from dase.io.source import Motion as Motion
from dase.io.source import Note as Note
from dase.io.source import Part as Part
from dase.io.source import Picture as Picture
from dase.io.source import ReadOptions as ReadOptions

FORMATS: tuple[Format, ...] = (
    ecf.FORMAT,
    dsec.FORMAT,
    mvsec.FORMAT,
    v2e.FORMAT,
    s2r.FORMAT,  # any other HDF5
    table.FORMAT,
    arrays.TABLE,
    ijrr.ZIPPED,
    arrays.OWN,  # any other zip
    evt3.FORMAT,
    evt2.FORMAT,
    evt21.FORMAT,
    dat.FORMAT,
    aedat4.FORMAT,
    aedat3.FORMAT,
    aedat2.FORMAT,
    event_stream.FORMAT,
    matlab.FORMAT,
    nmnist.FORMAT,
    ros.FORMAT,
    ijrr.TEXT,
    frames.FORMAT,
)
"""All formats. Content is asked in this order; of several with one suffix the first that can is taken."""


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
                head = file.read(1 << 16)  # enough for every format to be told by
        pointer = stands_for(head)
        if pointer:
            raise InputError(f"{path}: {pointer}")
        found = next((format for format in FORMATS if format.matches(path, head)), None)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if found is not None:
        return found
    if path.is_dir():
        raise InputError(f"{path}: is a folder with neither events.txt, nor a ROS 2 bag, nor pictures")
    return _of_suffix(path, (s2r.FORMAT, arrays.OWN, *FORMATS))


def read(
    path: str | PathLike[str], *, notes: list[str] | None = None, **options: Unpack[ReadOptions]
) -> Sequence:
    """Read a file or folder whole, or a part of it.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        notes: Gets sentences about what was skipped, repaired or guessed.
        options: What is known about the file, and the part to read, see `ReadOptions`.

    Raises:
        InputError: It is missing, of unknown format, damaged or incomplete, or needs an optional library; an
            option does not fit it.
    """
    format, source = _opened(path, notes, options)
    part = source.part
    if part is None:
        return format.read(source)
    note_part(source, part)
    with reading_file(source.path, format.name):
        if "flow" in format.keeps:  # which a stream does not give without frames
            return cut_sequence(source, format.read(source), part)
        try:
            with closed_after(format.stream(source, CHUNK)) as chunks:
                events = Events.concatenate(cut_stream(chunks, part, CHUNK))
        except TooLateError:
            return cut_sequence(source, format.read(source), part)
        with closed_after(format.pictures(source)) as pictures:
            frames = collect_pictures(cut_pictures(source, pictures, part))
        return sequence_of(events, frames)


def stream(
    path: str | PathLike[str],
    *,
    chunk: int = CHUNK,
    notes: list[str] | None = None,
    **options: Unpack[ReadOptions],
) -> Iterator[Events]:
    """Yield the events of a file in chunks, so that the file may be larger than the memory.

    Chunks are sorted and follow each other in time; all but the last hold `chunk` events. There is at least
    one, if empty. Joined they are the events of `read`.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        chunk: Events in a chunk.
        notes: Gets sentences about what was skipped, repaired or guessed; complete after the last chunk.
        options: What is known about the file, and the part to read, see `ReadOptions`.

    Raises:
        InputError: As for `read`; also where times go back too far to be sorted on the way.
    """
    chunk = checked_integer("chunk", chunk, 1)
    format, source = _opened(path, notes, options)
    return _stream_part(format, source, chunk)


def _stream_part(format: Format, source: Source, chunk: int) -> Iterator[Events]:
    if source.part is None:
        yield from format.stream(source, chunk)
        return
    note_part(source, source.part)
    with reading_file(source.path, format.name), closed_after(format.stream(source, chunk)) as chunks:
        yield from cut_stream(chunks, source.part, chunk)


def pictures(
    path: str | PathLike[str], *, notes: list[str] | None = None, **options: Unpack[ReadOptions]
) -> Iterator[Picture]:
    """Yield the frames of a file one by one, as `read` gives them.

    Times [s] are not a number where nothing tells them.

    Args:
        path: What to read; its content chooses the format, then its suffix.
        notes: Gets sentences about what was skipped, repaired or guessed.
        options: What is known about the file, and the part to read, see `ReadOptions`.

    Raises:
        InputError: As for `read`.
    """
    return _picture_part(*_opened(path, notes, options))


def _picture_part(format: Format, source: Source) -> Iterator[Picture]:
    if source.part is None:
        yield from format.pictures(source)
        return
    with reading_file(source.path, format.name), closed_after(format.pictures(source)) as pictures:
        yield from cut_pictures(source, pictures, source.part)


def motion(
    path: str | PathLike[str], *, notes: list[str] | None = None, **options: Unpack[ReadOptions]
) -> Motion | None:
    """Read the samples of a camera's motion sensor, times [s] on the clock of the events; None without any.

    Args:
        path: What to read; of the formats AEDAT 4 has them.
        notes: Gets sentences about what was skipped, repaired or guessed.
        options: What is known about the file, and the part to read, see `ReadOptions`.

    Raises:
        InputError: As for `read`.
    """
    format, source = _opened(path, notes, options)
    found = format.motion(source)
    return found if source.part is None else cut_motion(found, source.part)


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


def write(path: str | PathLike[str], sequence: Sequence | Events, *, format: str | None = None) -> None:
    """Write a whole sequence, or events alone.

    Thresholds and configuration are left out where the format has no place for them.

    Raises:
        InputError: Frames have no times, flow has no frames, or the format holds no frames.
    """
    keeps = find_writable_format(path, format).keeps
    sequence = Sequence(sequence) if isinstance(sequence, Events) else sequence
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
        # in parts, as a writer makes copies; once also where there are none, for the size of the sensor
        part = 1 << 20
        for i in range(0, max(len(events), 1), part):
            writer.events(events.select(slice(i, i + part)))
        if sequence.thresholds is not None and "thresholds" in keeps:
            writer.thresholds(sequence.thresholds)
        if sequence.configuration is not None and "configuration" in keeps:
            writer.configuration(sequence.configuration)


def convert(
    source: str | PathLike[str],
    target: str | PathLike[str],
    *,
    format: str | None = None,
    with_frames: bool = True,
    notes: list[str] | None = None,
    progress: Callable[[int], object] = lambda count: None,
    **options: Unpack[ReadOptions],
) -> int:
    """Convert a file piece by piece, whatever its size, and return its number of events.

    Only a file whose times go back by more than a moment is held in memory to be sorted, and what goes into
    an archive of NumPy.

    Args:
        source: Any file that `read` takes.
        target: File to write.
        format: Name of its format; None goes by its suffix.
        with_frames: Take frames along where `target` can hold them.
        notes: Gets sentences about what was skipped, repaired or guessed.
        progress: Is told how many events were written since it was told last.
        options: What is known about `source`, and the part to convert, see `ReadOptions`.

    Raises:
        InputError: As for `read` and `create`.
    """
    notes = [] if notes is None else notes
    (reader, taken), keeps = _opened(source, notes, options), find_writable_format(target, format).keeps
    total = 0
    try:
        with create(target, format=format) as writer:
            for part in _stream_part(reader, taken, CHUNK):
                writer.events(part)
                total += len(part)
                progress(len(part))
            if with_frames and "frames" in keeps:
                _add_frames(reader, taken, writer)
                _add_beside(reader, taken, writer)
    except TooLateError:
        sequence = replace(read(source, notes=notes, **options), flow=None)
        keeps_frames = with_frames and "frames" in keeps and sequence.frame_times is not None
        write(target, sequence if keeps_frames else Sequence(sequence.events), format=format)
        total = len(sequence.events)
    return total


def _add_frames(reader: Format, source: Source, writer: Writer) -> None:
    for grey, time, exposure, flow in _picture_part(reader, source):
        if not isfinite(time):
            return source.note("frames without times cannot be converted: left out", "refused", "frames")
        writer.frame(float(time), grey, flow, exposure=exposure)


def _add_beside(reader: Format, source: Source, writer: Writer) -> None:
    beside = reader.beside(source)
    thresholds, configuration = beside if source.part is None else cut_beside(beside, source.part)
    if thresholds is not None:
        writer.thresholds(thresholds)
    if configuration is not None:
        writer.configuration(configuration)


def _opened(
    path: str | PathLike[str], notes: list[str] | None, options: ReadOptions
) -> tuple[Format, Source]:
    """Return the format of a file and what is known about it; refuses an option that means nothing to it."""
    source = Source(Path(path), notes=[] if notes is None else notes, **options)
    found = find_format(source.path)
    for name in ("chip", "columns"):
        if getattr(source, name) is not None and name not in found.asks:
            takers = ", ".join(one.name for one in FORMATS if name in one.asks)
            raise InputError(f"{path}: is {found.name}, which takes no {name}; {takers} do")
    return found, source


def _of_suffix(path: Path, formats: Iterable[Format]) -> Format:
    known: dict[str, Format] = {}
    for format in formats:
        for suffix in format.suffixes:
            known.setdefault(suffix, format)
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InputError(f"{path}: unknown format '{path.suffix}', known: {', '.join(known)}")
    return known[suffix]
