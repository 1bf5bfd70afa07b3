"""A lens that is not perfectly sharp."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.optimize import brentq

from dase.effects.base import parameter
from dase.effects.optics import SceneEffect, rendered_pictures
from dase.kernels import launch, pixel_stages
from dase.kernels.scene_blur import blur_frames
from dase.scenes.scene import Scene


def blur_weights(sigma: float) -> NDArray[np.float32]:
    """Return samples of a Gaussian with variance sigma² [px²]: middle, first neighbours and so on, (R + 1,).

    Their own variance is exact: below 0.7 px samples of the density of that width would fall short of it, so
    those of a wider one are taken.
    """
    reach = np.arange(math.ceil(4 * sigma) + 3)

    def line(width: float) -> NDArray[np.float64]:
        density = np.exp(-0.5 * (reach / width) ** 2)
        return np.asarray(density / (2 * density.sum() - density[0]))

    narrowest = 0.05  # of which the first neighbours have nothing
    width = brentq(lambda width: 2 * np.sum(line(width) * reach**2) - sigma**2, narrowest, sigma + 0.5)
    return np.asarray(line(width), np.float32)


class Unsharp(Scene):
    """A scene through a lens whose point spread is a Gaussian.

    The blur acts on the picture as it is at each time, so it is right where objects overlap, turn and zoom.
    It costs a stored picture per sample. Blurred textures would not, but are as wide as the zoom makes them.

    Args:
        scene: Without the lens.
        sigma: Standard deviation of the point spread [px].
    """

    def __init__(self, scene: Scene, sigma: float):
        self.scene = scene
        self.width, self.height, self.duration = scene.width, scene.height, scene.duration
        self.anytime = scene.anytime
        self._sigma, self._weights = sigma, blur_weights(sigma)
        self._every = np.arange(scene.width * scene.height, dtype=np.int32)

    def sample_times(self) -> NDArray[np.float64]:
        """Return when the scene itself asks to be sampled [s]."""
        return self.scene.sample_times()

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the blurred intensities of these pixels, shape (K, N); see `Scene.source`."""
        pictures = rendered_pictures(self.scene, times, device)
        frames = pixel_stages.Frames()
        frames.values = blur_frames(pictures, self._weights, self.width, pixels, device)
        return "frames", frames

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the blurred pictures at `times` [s], shape (K, height, width)."""
        where = launch.find_device(device)
        flat = self.scene.frames(times, device).reshape(len(times), -1)
        found = blur_frames(
            wp.array(flat, dtype=float, device=where), self._weights, self.width, self._every, where
        )
        return np.asarray(found.numpy().reshape(len(times), self.height, self.width))

    def filtered(self, purity: float) -> tuple[Scene, Scene, Scene] | None:
        """Return the blurred scene behind a red, a green and a blue filter; see `Scene.filtered`."""
        found = self.scene.filtered(purity)
        if found is None:
            return None
        red, green, blue = (Unsharp(scene, self._sigma) for scene in found)
        return red, green, blue

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32] | None:
        """Return the flow of the scene itself [px/s], shape (K, 2, height, width)."""
        return self.scene.flow(times, device)


@dataclass(frozen=True, kw_only=True)
class OpticsBlur(SceneEffect):
    """A lens that is not perfectly sharp.

    A point of the scene becomes a small disc on the sensor, by diffraction, aberrations and defocus. Edges
    turn into ramps, so fast edges send their events one after the other instead of all at once, and texture
    finer than the disc sends none.

    The point spread is a Gaussian of standard deviation `sigma`, the same everywhere. The picture is
    continued by reflection beyond its border.
    """

    name: ClassVar[str] = "optics_blur"
    source: ClassVar[str] = "Pentland: A new sense for depth of field, 1987 (Gaussian point spread of a lens)"
    signatures: ClassVar = ()

    sigma: float = parameter(
        0.7,
        unit="px",
        off=0.0,
        bounds=(0.0, 20.0),  # wider, the window of the blur would be slow and no lens
        plausible=(0.3, 3.0),
        fitted=False,  # a fit moves what pixels do with light, not the light
        about="standard deviation of the point spread",
    )

    def seen(self, scene: Scene) -> Scene:
        """Return the scene through this lens."""
        return Unsharp(scene, self.sigma) if self.sigma else scene
