"""Frames alone: videos (AVI, MP4, MOV, MKV) and folders of pictures, as OpenCV decodes them.

A folder is in the order of its names. Times are those of `timestamps.txt` in it, where there is one (a line
per picture; its first or its last word is the time [s]), or come from the rate of a video; else they are not
known.
Nothing says how long such frames were exposed.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence, reading
from dase.io.source import Format, Source, checked_size
from dase.pictures import SUFFIXES

LIMIT = 4 << 30  # [bytes] of frames taken into memory


def grey(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a picture to 8-bit grey, (H, W); raises InputError where it is damaged or absurdly large."""
    import cv2
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as picture:
            checked_size(picture.size)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    except Exception as error:  # whatever Pillow makes of a damaged head
        raise InputError(f"{name}: cannot be decoded as a picture ({error})") from None
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # our sentence is enough
    try:
        out = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if out is None:
        raise InputError(f"{name}: cannot be decoded as a picture, damaged or cut short")
    return np.asarray(out, np.uint8)


def stack(pictures: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Stack pictures of one size, (F, H, W); raises InputError where they differ or fill the memory."""
    out: list[NDArray[np.uint8]] = []
    total = 0
    for picture in pictures:
        total += picture.nbytes
        if total > LIMIT:
            raise InputError(f"its frames need more than {LIMIT >> 30} GiB of memory: cut it into parts")
        if out and picture.shape != out[0].shape:
            a, b = out[0].shape, picture.shape
            raise InputError(f"frame {len(out)} is {b[1]}x{b[0]}, those before are {a[1]}x{a[0]}")
        out.append(picture)
    return np.stack(out) if out else np.empty((0, 0, 0), np.uint8)


def matches(path: Path, head: bytes) -> bool:
    """Whether a file is a video, or a folder holds pictures."""
    if path.is_dir():
        return any(entry.suffix.lower()[1:] in SUFFIXES for entry in path.iterdir())
    avi = head[:4] == b"RIFF" and head[8:12] == b"AVI "
    return avi or head[4:8] == b"ftyp" or head.startswith(b"\x1aE\xdf\xa3")


def read(source: Source) -> Sequence:
    """Read all frames; times are None where nothing tells them."""
    from dase.video import FrameReader

    with reading(source.path, "frames"):
        reader = FrameReader(source.path)
        checked_size((reader.shape[2], reader.shape[1]))

        def decoded() -> Iterator[NDArray[np.uint8]]:
            for index in range(len(reader)):
                yield np.rint(255 * reader[np.array([index])][0]).astype(np.uint8)

        out = stack(decoded())
        times = _times(source.path / "timestamps.txt", len(out)) if source.path.is_dir() else None
        if times is None and 0 < reader.rate < 1e7:
            times = np.arange(len(out)) / reader.rate
        if times is None:
            source.note("nothing tells the times of the frames")
        return Sequence(Events.empty(out.shape[2], out.shape[1]), out, times)


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
    yield read(source).events


FORMAT = Format(
    name="frames",
    suffixes=(".avi", ".mp4", ".mov", ".mkv", ".webm"),
    matches=matches,
    read=read,
    stream=stream,
    keeps=frozenset({"frames"}),
)
