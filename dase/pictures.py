"""Picture files to grey values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError

SUFFIXES = ("jpg", "jpeg", "png", "bmp", "tif", "tiff", "webp", "ppm", "pgm")
"""Picture files, whatever their case."""


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
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # our sentence is enough
    try:
        pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise InputError(f"images: cannot read '{path}': {error.strerror}") from error
    except cv2.error:  # an empty file, or more pixels than OpenCV takes
        pixels = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if pixels is None:
        raise InputError(f"images: cannot decode '{path}': damaged, cut off or too large")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"images: '{path}' must hold 8- or 16-bit values, holds {pixels.dtype}")
    return np.asarray(pixels)
