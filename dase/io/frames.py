"""Frames alone: videos (AVI, MP4, MOV, MKV) and folders of pictures, as OpenCV decodes them.

A folder is in the order of its names. Times are those of `timestamps.txt` in it, where there is one (a line
per picture; its first or its last word is the time [s]), or come from the rate of a video; else they are not
known.
Nothing says how long such frames were exposed.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.format import Format, sequence_of, taken
from dase.io.sequence import GREYS, Sequence, reading
from dase.io.source import Picture, Source, checked_size, refuse_bomb
from dase.pictures import SUFFIXES, unpack

if TYPE_CHECKING:
    from dase.video import FrameReader


WIDEST = 8
"""Bytes of a pixel, at most: red, green, blue and alpha of 16 bits."""


def grey(data: bytes, name: str) -> NDArray[Any]:
    """Decode a picture to grey of 8 or 16 bits, (H, W); raises InputError where it is damaged or huge."""
    import cv2
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as picture:
            width, height = checked_size(picture.size)
            refuse_bomb(len(data), WIDEST * width * height)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    except Exception as error:  # whatever Pillow makes of a damaged head
        raise InputError(f"{name}: cannot be decoded as a picture ({error})") from None
    out = unpack(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if out is None or out.dtype not in GREYS:
        raise InputError(f"{name}: cannot be decoded as a picture of 8 or 16 bits, damaged or cut short")
    return np.asarray(out)


def matches(path: Path, head: bytes) -> bool:
    """Whether a file is a video, or a folder holds pictures."""
    if path.is_dir():
        return any(entry.suffix.lower()[1:] in SUFFIXES for entry in path.iterdir())
    avi = head[:4] == b"RIFF" and head[8:12] == b"AVI "
    return avi or head[4:8] == b"ftyp" or head.startswith(b"\x1aE\xdf\xa3")


def pictures(source: Source) -> Iterator[Picture]:
    """Yield the frames; times [s] are not a number where nothing tells them."""
    reader = _reader(source)
    times = _times(source.path / "timestamps.txt", len(reader)) if source.path.is_dir() else None
    if times is None and 0 < reader.rate < 1e7:
        times = np.arange(len(reader)) / reader.rate
    if times is None:
        source.note("nothing tells the times of the frames", "assumed", "frames")
        times = np.full(len(reader), np.nan)
    for index, time in enumerate(times):
        yield Picture(np.rint(255 * reader[np.array([index])][0]).astype(np.uint8), time)


def _reader(source: Source) -> FrameReader:
    from dase.video import FrameReader

    reader = FrameReader(source.path)
    checked_size((reader.shape[2], reader.shape[1]))
    return reader


def _shown(source: Source) -> Iterator[Picture]:
    with reading(source.path, "frames"):
        yield from pictures(source)


def read(source: Source) -> Sequence:
    """Read all frames; times are None where nothing tells them."""
    with reading(source.path, "frames"):
        found = taken(pictures(source))
        height, width = found[0].grey.shape
        return sequence_of(Events.empty(width, height), found)


def _times(path: Path, count: int) -> NDArray[np.float64] | None:
    if not path.is_file():
        return None
    rows = [line.split() for line in path.read_text("latin-1").splitlines() if line.split("#")[0].strip()]
    for k in (0, -1):
        try:
            times = np.array([float(row[k]) for row in rows])
        except ValueError:
            continue
        if len(times) == count and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0):
            return times
    raise InputError(f"{path.name}: needs one increasing time for each of the {count} pictures")


def stream(source: Source, chunk: int) -> Iterator[Events]:
    """Yield the one empty chunk of a file without events."""
    with reading(source.path, "frames"):
        shape = _reader(source).shape
    yield Events.empty(shape[2], shape[1])


FORMAT = Format(
    name="frames",
    suffixes=(".avi", ".mp4", ".mov", ".mkv", ".webm"),
    matches=matches,
    read=read,
    stream=stream,
    pictures=_shown,
    keeps=frozenset({"frames"}),
)
