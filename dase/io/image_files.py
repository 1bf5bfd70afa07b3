"""Picture files to grey values."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.files.text_files import stands_for
from dase.io.source import refuse_bomb

SUFFIXES = ("jpg", "jpeg", "png", "bmp", "tif", "tiff", "webp", "ppm", "pgm")
"""Picture files, whatever their case."""

PNG = b"\x89PNG\r\n\x1a\n"
LUMA = (0.21, 0.72, 0.07)
"""Of red, green and blue; S2R takes luma for intensity."""
BAND = 1 << 18
"""Pixels turned to grey at once: the numbers in between take little memory, and stay in the cache."""


def list_pictures(folder: Path) -> list[Path]:
    """Return the picture files below a folder by name, without hidden ones."""
    suffixed = (path for path in folder.rglob("*") if path.suffix.lower()[1:] in SUFFIXES and path.is_file())
    names = sorted(path.relative_to(folder).as_posix() for path in suffixed)
    return [folder / name for name in names if "/." not in f"/{name}"]


def to_grey(pixels: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return grey values and alpha in [0, 1].

    Args:
        pixels: (H, W) or (H, W, channels), BGR or BGRA, uint8 or uint16, or real numbers in [0, 1].
    """
    # each plane by itself: numbers that lie side by side become vectors, every third one does not
    planes = list(cv2.split(pixels))
    full = _full_scale(pixels)
    alpha = planes.pop() / full if len(planes) in (2, 4) else None
    weights = weights_of(pixels)
    grey = np.empty(planes[0].shape, np.float32)
    for band in _row_bands(grey.shape):
        grey[band] = planes[0][band]
        grey[band] *= weights[0]
        for weight, plane in zip(weights[1:], planes[1:], strict=True):
            # real numbers first: mixed types are multiplied piece by piece
            more = plane[band].astype(np.float32)
            more *= weight
            grey[band] += more
    return grey, alpha


def weights_of(pixels: NDArray[Any]) -> list[np.float32]:
    """Return what blue, green and red, or the only value, weigh in the grey of pixels [1 / full scale].

    Args:
        pixels: As `to_grey` takes them, shape (H, W) or (H, W, C).
    """
    luma = LUMA[::-1] if pixels.ndim == 3 and pixels.shape[2] >= 3 else (1.0,)
    return [np.float32(weight) / _full_scale(pixels) for weight in luma]


def to_colour(pixels: NDArray[Any], grey: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Return red, green and blue in [0, 1], shape (3, H, W), None where a picture has no colour.

    Where the three are equal they are `grey` to the bit: what differs from it is worked out by itself.

    Args:
        pixels: As `to_grey` takes them.
        grey: What it made of them, shape (H, W).
    """
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        return None
    full = _full_scale(pixels)
    colours = [plane / full for plane in reversed(cv2.split(pixels)[:3])]
    out = np.zeros((3, *grey.shape), np.float32)
    for plane, own in zip(out, colours, strict=True):
        for weight, other in zip(LUMA, colours, strict=True):
            plane += np.float32(weight) * (own - other)
    return np.clip(out + grey, 0, 1) if out.any() else None


def _full_scale(pixels: NDArray[Any]) -> np.float32:
    """Return the value of white of an array of any shape."""
    return np.float32(np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1)


def grey_and_colour(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Return grey, red, green and blue in [0, 1], shape (4, H, W); all are the grey where there is no colour.

    Args:
        pixels: As `to_grey` takes them.
    """
    grey, _ = to_grey(pixels)
    colour = to_colour(pixels, grey)
    return np.stack([grey] * 4) if colour is None else np.concatenate([grey[None], colour])


def to_levels(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return grey values in 0..255, shape (H, W), of pixels as `to_grey` takes them; needs no memory beside.

    Args:
        pixels: (H, W) or (H, W, channels), uint8 or uint16, BGR or BGRA.
    """
    out = np.empty(pixels.shape[:2], np.uint8)
    for band in _row_bands(pixels.shape):
        out[band] = np.rint(255 * to_grey(pixels[band])[0])
    return out


def cut_and_resize(picture: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Return the middle of a picture (H, W), cut to the shape of `size` (columns, rows), in that size."""
    height, width = picture.shape
    columns = min(width, max(1, round(height * size[0] / size[1])))
    rows = min(height, max(1, round(width * size[1] / size[0])))
    left, top = (width - columns) // 2, (height - rows) // 2
    part = picture[top : top + rows, left : left + columns]
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA))


def _row_bands(shape: tuple[int, ...]) -> Iterator[slice]:
    rows = max(1, BAND // max(1, shape[1]))
    return (slice(top, top + rows) for top in range(0, shape[0], rows))


def decode_file(path: Path) -> NDArray[Any]:
    """Return pixels as they are in the file: (H, W) or (H, W, channels), uint8 or uint16, BGR or BGRA."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"images: cannot read '{path}': {error.strerror}") from error
    pointer = stands_for(data[:1024])
    if pointer:
        raise InputError(f"images: '{path}' {pointer}")
    try:
        pixels = None if head_size(data) is None else decode_bytes(data, cv2.IMREAD_UNCHANGED)
    except InputError as error:
        raise InputError(f"images: cannot decode '{path}': {error}") from None
    if pixels is None:
        raise InputError(f"images: cannot decode '{path}': damaged, cut off or too large")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"images: '{path}' must hold 8- or 16-bit values, holds {pixels.dtype}")
    return np.asarray(pixels)


def head_size(data: bytes) -> tuple[int, int] | None:
    """Return columns and rows of a picture as its head tells them, None where it is damaged.

    Nothing is decoded. Raises InputError where a small file claims a picture of absurd size.

    Args:
        data: The content of a file.
    """
    from PIL import Image  # events have no pictures, and most recordings no folder of them

    size: tuple[int, int] | None
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # ours goes with the size of the file
    try:
        with Image.open(io.BytesIO(data)) as picture:
            size = int(picture.size[0]), int(picture.size[1])
            # Pillow's names of pixels whose values have 8 bits
            shallow = picture.mode in ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
    except Exception:  # whatever Pillow makes of a damaged head
        size, shallow = _tiff_size(data), False
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    if size is None:
        return None
    if data.startswith(PNG) and data[24:25] == b"\x10":
        shallow = False
    taken = 13 if shallow else 20  # bytes of a pixel at most: decoded, as it is, as grey and as alpha
    try:
        refuse_bomb(len(data), taken * size[0] * size[1])
    except InputError as error:
        raise InputError(f"a picture of {size[0]}x{size[1]} {error}") from None
    return size


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Return columns and rows of a TIFF that Pillow cannot decode, as of three colours of 16 bits."""
    # as above
    from PIL.TiffImagePlugin import IMAGELENGTH, IMAGEWIDTH, ImageFileDirectory_v2

    if not data.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):  # + in those of 64 bits
        return None
    try:
        tags = ImageFileDirectory_v2(data[: 16 if b"+" in data[2:4] else 8])
        stream = io.BytesIO(data)
        stream.seek(tags.next)
        tags.load(stream)
        return int(tags[IMAGEWIDTH]), int(tags[IMAGELENGTH])
    except Exception:  # whatever Pillow makes of a damaged head
        return None


def decode_bytes(data: bytes, how: int) -> NDArray[Any] | None:
    """Return what OpenCV makes of the bytes of a picture, None where it is damaged.

    Args:
        data: The content of a file.
        how: Flags of `cv2.imdecode`.

    Returns:
        Pixels, shape (H, W) or (H, W, channels), BGR or BGRA, of the type of the file unless `how` asks else.
    """
    if data.startswith(PNG) and not _is_whole_png(data):
        return None  # OpenCV 5 takes as much memory as a part says it is long
    try:
        with quiet_opencv():
            pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:  # an empty file, or more pixels than OpenCV takes
        return None
    return pixels


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing about damaged files to the terminal: our sentence is enough."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _is_whole_png(data: bytes) -> bool:
    """Whether all parts of a PNG are there: u32 length, 4 letters, content, u32 sum; the last is IEND."""
    place = len(PNG)
    while place + 12 <= len(data):
        length, name = int.from_bytes(data[place : place + 4], "big"), data[place + 4 : place + 8]
        place += 12 + length
        if name == b"IEND":
            break
    return place <= len(data)
