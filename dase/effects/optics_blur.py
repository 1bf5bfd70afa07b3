"""A lens that is not perfectly sharp."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import parameter
from dase.effects.optics import SceneEffect, rendered_pictures
from dase.kernels import launch, pixel_stages
from dase.kernels.scene_blur import blur_frames
from dase.scenes.scene import Scene


def blur_weights(sigma: float) -> NDArray[np.float32]:
    """Return the discrete Gaussian of variance sigma² [px²]: middle, first neighbours and so on, (R + 1,).

    Its variance is exact however narrow it is, where samples of the normal density would fall short, and
    two blurs make the blur of the sum of their variances (Lindeberg: Scale-space for discrete signals, 1990).
    """
    turns = np.fft.fftfreq(1024)
    line = np.fft.ifft(np.exp(sigma**2 * (np.cos(2 * np.pi * turns) - 1))).real
    line = line[: math.ceil(4 * sigma) + 2]
    return np.asarray(line / (2 * line.sum() - line[0]), np.float32)


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
        about="standard deviation of the point spread",
    )

    def seen(self, scene: Scene) -> Scene:
        """Return the scene through this lens."""
        return Unsharp(scene, self.sigma) if self.sigma else scene
