"""Frames alone: videos (AVI, MP4, MOV, MKV) and folders of pictures, as OpenCV decodes them.

A folder is in the order of its names. Times are those of `timestamps.txt` in it, where there is one (a line
per picture; its first or its last word is the time [s]), or come from the rate of a video; else they are not
known.
Nothing says how long such frames were exposed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.files.text_files import stands_for
from dase.io.ffmpeg import TAKEN
from dase.io.format import LIMIT, Format
from dase.io.image_files import SUFFIXES, decode_bytes, head_size
from dase.io.sequence import GREYS, Sequence, reading_file
from dase.io.source import Picture, Source, checked_size, refuse_bomb
from dase.io.video_file import FrameReader

TIMES = "timestamps.txt"
"""File in a folder of pictures with their times."""
FRAMES_RATIO = 1000
"""How many times its size the frames of a file may take together: ten times what one alone may, as frames of
a video repeat each other. Moving scenes stay far below."""


def decode_grey(data: bytes, name: str) -> NDArray[Any]:
    """Decode a picture to grey of 8 or 16 bits, (H, W); raises InputError where it is damaged or huge."""
    import cv2  # a quarter of a second that reading events alone need not wait for

    pointer = stands_for(data[:1024])
    if pointer:
        raise InputError(f"{name} {pointer}")
    try:
        size = head_size(data)
        if size is not None:
            checked_size(size)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    out = None if size is None else decode_bytes(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if out is None or out.dtype not in GREYS:
        raise InputError(f"{name}: cannot be decoded as a picture of 8 or 16 bits, damaged or cut short")
    return np.asarray(out)


def matches_format(path: Path, begin: bytes) -> bool:
    """Whether a file is a video, or a folder holds pictures."""
    if path.is_dir():
        return any(entry.suffix.lower()[1:] in SUFFIXES for entry in path.iterdir())
    avi = begin[:4] == b"RIFF" and begin[8:12] == b"AVI "
    return avi or begin[4:8] == b"ftyp" or begin.startswith(b"\x1aE\xdf\xa3")


def read_pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames; times [s] are not a number where nothing tells them."""
    reader = _open_reader(source)
    for levels, time in zip(reader.levels(), _frame_times(source, reader), strict=True):
        yield Picture(levels, time)


def _open_reader(source: Source) -> FrameReader:
    reader = FrameReader(source.path)
    checked_size((reader.shape[2], reader.shape[1]))
    return reader


def _stream_pictures(source: Source) -> Iterator[Picture]:
    with reading_file(source.path, "frames"):
        yield from read_pictures(source)


def read(source: Source) -> Sequence:
    """Read all frames; times are None where nothing tells them."""
    with reading_file(source.path, "frames"):
        reader = _open_reader(source)
        _refuse_many(reader)
        times = _frame_times(source, reader)
        frames = np.empty(reader.shape, np.uint8)  # filled as they come: none is there twice
        coming = reader.levels()
        for k in range(len(frames)):
            frames[k] = next(coming)
        height, width = reader.shape[1:]
        return Sequence(Events.empty(width, height), frames, None if np.isnan(times).any() else times)


def _refuse_many(reader: FrameReader) -> None:
    """Raise InputError where the frames would fill the memory, or are absurdly many for their file."""
    total = math.prod(reader.shape)
    if total > LIMIT:
        raise InputError(f"its frames need more than {LIMIT >> 30} GiB of memory: cut it into parts")
    further = total // len(reader) * max(len(reader) - TAKEN, 0)
    try:
        refuse_bomb(reader.packed, max(total, reader.decoding + further), FRAMES_RATIO)
    except InputError as error:
        why = f"all {len(reader)} frames at once: {error}; dase.io.pictures gives one by one"
        raise InputError(why) from None


def _frame_times(source: Source, reader: FrameReader) -> NDArray[np.float64]:
    """Return the times of the frames [s], not a number where nothing tells them, which is noted."""
    listed = source.path / TIMES
    if source.path.is_dir() and listed.is_file():
        return listed_times(listed, len(reader))
    if reader.times is not None:
        return reader.times
    if 0 < reader.rate < 1e7:
        return np.arange(len(reader)) / reader.rate
    source.note("nothing tells the times of the frames", "assumed", "frames")
    return np.full(len(reader), np.nan)


def listed_times(path: Path, count: int) -> NDArray[np.float64]:
    """Return the times of pictures [s] that a text says; raises InputError where it does not."""
    rows = [line.split() for line in path.read_text("latin-1").splitlines() if line.split("#")[0].strip()]
    for k in (0, -1):
        try:
            times = np.array([float(row[k]) for row in rows])
        except ValueError:
            continue
        if len(times) == count and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0):
            return times
    raise InputError(f"{path.name}: needs one increasing time for each of the {count} pictures")


def _stream_empty(source: Source, chunk: int) -> Iterator[Events]:
    """Yield the one empty chunk of a file without events."""
    with reading_file(source.path, "frames"):
        shape = _open_reader(source).shape
    yield Events.empty(shape[2], shape[1])


FORMAT = Format(
    name="frames",
    suffixes=(".avi", ".mp4", ".mov", ".mkv", ".webm"),
    matches=matches_format,
    read=read,
    stream=_stream_empty,
    pictures=_stream_pictures,
    keeps=frozenset({"frames"}),
)
