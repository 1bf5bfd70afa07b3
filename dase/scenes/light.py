"""From the values of pictures to light: one conversion for every source."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError

SRGB_GAMMA = 2.2
"""Of pictures and videos that do not say: their values are no light, but about its root of this order."""


def check_gamma(gamma: float) -> float:
    """Return a gamma; raises InputError where it is not one."""
    if not (np.isfinite(gamma) and 0.1 <= gamma <= 10):
        raise InputError(f"gamma must lie in 0.1..10 (1 is linear light, 2.2 video), got {gamma:g}")
    return float(gamma)


def check_light(values: NDArray[Any], what: str, *, most: float = 10.0) -> None:
    """Raise InputError where values cannot be light.

    Args:
        values: Of any shape. Whole numbers without a sign are light by the range of their type.
        what: What messages call them.
        most: Largest real number, where 1 is white; more are values 0 to 255 that were not divided.
    """
    if values.dtype.kind == "u":
        return
    if values.dtype.kind != "f":
        raise InputError(f"{what} must be uint8, uint16 or real numbers, got {values.dtype}")
    if values.size and not (np.all(np.isfinite(values)) and values.min() >= 0):
        raise InputError(f"{what}: {_place_of_bad(values)}intensities must be finite and >= 0")
    if values.size and values.max() > most:
        raise InputError(
            f"{what}: real numbers must lie in [0, 1], got up to {values.max():g}: "
            "divide them by the value of white"
        )


def _place_of_bad(values: NDArray[Any]) -> str:
    """Return the first frame that is no light, and of how many values, where values (F, H, W) are frames."""
    if values.ndim != 3:
        return ""
    bad = ~np.isfinite(values) | (values < 0)
    first = int(np.argmax(bad.any(axis=(1, 2))))
    return f"frame {first} has {int(bad[first].sum())} values below 0 or not numbers; "


def to_light(values: NDArray[Any], *, gamma: float = 1.0) -> NDArray[np.float32]:
    """Return linear intensity of checked values, 1 for white, of the same shape.

    Args:
        values: Whole numbers without a sign are taken by the range of their type: 255 or 65535 is white. Real
            numbers are shares of white.
        gamma: Light is the share to the power of this: 1 for a linear sensor, 2.2 for pictures and videos.
    """
    out = np.asarray(values, np.float32)
    if values.dtype.kind == "u":
        out = out / np.float32(np.iinfo(values.dtype).max)
    return out if gamma == 1 else out ** np.float32(gamma)
