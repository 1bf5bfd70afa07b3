"""Corners darker than the middle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.effects.base import Effect, parameter
from dase.effects.made_signatures import Makes

Array = NDArray[np.float64]


def square_from_middle(x: ArrayLike, y: ArrayLike, width: int, height: int) -> Array:
    """Return the square distance of pixels from the middle, in units of that of a corner's pixel, shape (N,).

    Args:
        x: Columns, shape (N,).
        y: Rows, shape (N,).
        width: Columns of the sensor.
        height: Rows of it.
    """
    middle_x, middle_y = 0.5 * (width - 1), 0.5 * (height - 1)
    square = (np.asarray(x) - middle_x) ** 2 + (np.asarray(y) - middle_y) ** 2
    out: Array = square / max(middle_x**2 + middle_y**2, 1.0)
    return out


@wp.func
def vignetted_light(intensity: float, radius: float, loss: float):
    """Intensity after the cos⁴ law."""
    # cos²(angle) = 1 / (1 + tan²(angle)), and the tangent grows with the distance from the middle
    tangent = (1.0 / wp.sqrt(1.0 - loss) - 1.0) * radius * radius
    return intensity / ((1.0 + tangent) * (1.0 + tangent))


@dataclass(frozen=True, kw_only=True)
class Vignetting(Effect):
    """Corners darker than the middle.

    Light reaches the corners of a picture at an angle, through a lens that looks narrower from there, and on
    a smaller part of a pixel. A change of log intensity is the same in a darker corner; but the slower
    photoreceptor and the stronger noise of dark pixels make corners differ from the middle.

    The intensity follows the cos⁴ law of the angle to the optical axis, which passes through the middle of
    the sensor; `loss` is the share lost in the corner. Lenses of wide aperture lose more.
    """

    name: ClassVar[str] = "vignetting"
    source: ClassVar[str] = "Goldman, Chen: Vignette and exposure calibration and compensation, 2005"
    stages: ClassVar = {"light": vignetted_light}
    signatures: ClassVar = (
        Makes("kink at the corners", tells=True, absence=False),
        Makes("current at the corners", tells=True, absence=False),
    )
    screen_limits: ClassVar = {
        "": (
            "vignetting cannot be told from a screen that is darker at its corners: an evenly lit sheet "
            "tells it"
        ),
    }

    loss: float = parameter(
        0.4,
        unit="1",
        off=0.0,
        bounds=(0.0, 0.99),
        plausible=(0.05, 0.8),
        about="share of the light lost at the corner of the sensor",
    )

    def light_left(self) -> tuple[float, float]:
        """Return the light at the mean square distance from the middle, of all pixels and of the outer half.

        It depends on the picture which of them send the most events in the dark.
        """
        # of a rectangle these are a third and about half of the corner's, whatever its sides
        whole, outer = self.light_at(np.array([1 / 3, 1 / 2]))
        return float(whole), float(outer)

    def light_at(self, square: Array) -> Array:
        """Return the share of the light that is left, shape (N,).

        Args:
            square: Of the distance from the middle, in units of the corner's, see `square_from_middle`.
        """
        tangent = 1.0 / math.sqrt(max(1.0 - self.loss, 1e-12)) - 1.0
        out: Array = (1.0 + tangent * square) ** -2.0
        return out
