"""A scene in which nothing happens: what noise is recorded of."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.kernels.pixel_stages import Frames
from dase.scenes.scene import Scene


class StaticScene(Scene):
    """Constant light.

    The intensity of a noise recording is rarely known: it is a free parameter then, one number for all pixels
    or one for each, which a fit may vary.

    Args:
        width: Columns [px].
        height: Rows [px].
        duration: Length [s].
        intensity: Linear intensity, one number >= 0 or shape (height, width).
        longest: Longest time between samples [s].
    """

    anytime = True

    def __init__(
        self, width: int, height: int, duration: float, intensity: ArrayLike = 0.5, *, longest: float = 0.1
    ):
        if width < 1 or height < 1:
            raise InputError(f"static scene: size must be at least 1x1, got {width}x{height}")
        for name, value in (("duration", duration), ("longest", longest)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"static scene: {name} must be > 0 s, got {value:g}")
        light = np.asarray(intensity, np.float32)
        if light.shape not in ((), (height, width)):
            raise InputError(
                f"static scene: intensity must be a number or ({height}, {width}), got {light.shape}"
            )
        if not np.all(np.isfinite(light)) or np.any(light < 0):
            raise InputError("static scene: intensity must be finite and >= 0")
        self.width, self.height, self.duration, self.longest = width, height, float(duration), longest
        self.intensity: NDArray[np.float32] = np.broadcast_to(light, (height, width))

    def sample_times(self) -> NDArray[np.float64]:
        """Return times `longest` apart [s]; sensors whose effects need more samples add them."""
        return np.linspace(0, self.duration, int(np.ceil(self.duration / self.longest)) + 1)

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the intensity of these pixels once for each time, shape (K, N); see `Scene.source`."""
        source = Frames()
        light = self.intensity.reshape(-1)[pixels]
        source.values = wp.array(np.tile(light, (len(times), 1)), dtype=float, device=device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the intensity once for each time, shape (K, height, width)."""
        return np.tile(self.intensity, (len(times), 1, 1))

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return zeros, shape (K, 2, height, width)."""
        return np.zeros((len(times), 2, self.height, self.width), np.float32)
