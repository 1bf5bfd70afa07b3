"""Picture files to grey values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError

SUFFIXES = ("jpg", "jpeg", "png", "bmp", "tif", "tiff", "webp", "ppm", "pgm")
"""Picture files, whatever their case."""

PNG = b"\x89PNG\r\n\x1a\n"


def list_pictures(folder: Path) -> list[Path]:
    """Return the picture files below a folder by name, without hidden ones."""
    suffixed = (path for path in folder.rglob("*") if path.suffix.lower()[1:] in SUFFIXES and path.is_file())
    names = sorted(path.relative_to(folder).as_posix() for path in suffixed)
    return [folder / name for name in names if "/." not in f"/{name}"]


def read_grey(path: Path) -> NDArray[np.float32]:
    """Return the grey values of a file in [0, 1], shape (H, W)."""
    return to_grey(decode(path))[0]


def to_grey(pixels: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return grey values and alpha in [0, 1].

    Args:
        pixels: (H, W) or (H, W, channels), uint8 or uint16, BGR or BGRA.
    """
    planes = list(np.moveaxis(np.atleast_3d(pixels), 2, 0))
    full = np.float32(np.iinfo(pixels.dtype).max)
    alpha = planes.pop() / full if len(planes) in (2, 4) else None
    weights = (0.07, 0.72, 0.21) if len(planes) == 3 else (1.0,)  # of BGR; S2R takes luma for intensity
    grey = np.zeros(planes[0].shape, np.float32)
    for weight, plane in zip(weights, planes, strict=True):
        grey += np.float32(weight) / full * plane
    return grey, alpha


def decode(path: Path) -> NDArray[Any]:
    """Return pixels as they are in the file: (H, W) or (H, W, channels), uint8 or uint16, BGR or BGRA."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"images: cannot read '{path}': {error.strerror}") from error
    pixels = unpack(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"images: cannot decode '{path}': damaged, cut off or too large")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"images: '{path}' must hold 8- or 16-bit values, holds {pixels.dtype}")
    return np.asarray(pixels)


def unpack(data: bytes, how: int) -> NDArray[Any] | None:
    """Return what OpenCV makes of the bytes of a picture, None where it is damaged.

    Args:
        data: The content of a file.
        how: Flags of `cv2.imdecode`.
    """
    if data.startswith(PNG) and not _whole(data):
        return None  # OpenCV 5 takes as much memory as a part says it is long
    try:
        with quiet():
            pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:  # an empty file, or more pixels than OpenCV takes
        return None
    return pixels


@contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV from writing about damaged files to the terminal: our sentence is enough."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _whole(data: bytes) -> bool:
    """Whether all parts of a PNG are there: u32 length, 4 letters, content, u32 sum; the last is IEND."""
    place = len(PNG)
    while place + 12 <= len(data):
        length, name = int.from_bytes(data[place : place + 4], "big"), data[place + 4 : place + 8]
        place += 12 + length
        if name == b"IEND":
            break
    return place <= len(data)
