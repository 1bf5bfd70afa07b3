"""A pair of cameras side by side before layers at depths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.scenes.layers import LayerScene


@dataclass(frozen=True)
class StereoPair:
    """What two rectified cameras see; iterating gives the left scene, then the right one.

    Args:
        left: The scene as it was given, to the bit.
        right: What the camera to its right sees.
        depths: Of each layer [m], background first.
        disparities: Of each layer [px]: how much further left the right camera sees it.
    """

    left: LayerScene
    right: LayerScene
    depths: tuple[float, ...]
    disparities: tuple[float, ...]

    def __iter__(self) -> Iterator[LayerScene]:
        return iter((self.left, self.right))

    def labels(
        self, times: NDArray[np.float64], device: str = "cpu", *, right: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return disparity [px] and depth [m] at every pixel, of the foremost layer, (K, height, width) each.

        Args:
            times: When [s], shape (K,).
            device: `cpu`, `cuda` or a Warp name.
            right: Of the right camera's pixels instead of the left one's.
        """
        values = np.stack([self.disparities, self.depths], axis=-1)
        scene = self.right if right else self.left
        found = scene.values_of_foremost(np.asarray(times, np.float64), values, device)
        return found[:, 0], found[:, 1]


def stereo_pair(scene: LayerScene, depths: Sequence[float], *, baseline: float, focal: float) -> StereoPair:
    """Return two rectified pinhole cameras before a scene whose layers are planes that face them.

    A plane at depth Z is seen with a disparity of focal · baseline / Z (Hartley and Zisserman, Multiple View
    Geometry in Computer Vision, 2004).

    Args:
        scene: What the left camera sees.
        depths: Of each layer [m], background first, > 0 and not growing, shape (L,).
        baseline: From the left camera to the right one [m], >= 0.
        focal: Focal length [px], > 0.

    Raises:
        InputError: A depth, baseline or focal length that cannot be.
    """
    far = np.asarray(depths, np.float64)
    if far.shape != (len(scene.layers),):
        raise InputError(f"stereo: {len(scene.layers)} layers need as many depths, got {far.size}")
    if not (np.all(np.isfinite(far)) and np.all(far > 0) and np.all(np.diff(far) <= 0)):
        raise InputError(f"stereo: depths must be > 0 m and not grow towards the foreground, got {depths}")
    if not (np.isfinite(baseline) and baseline >= 0 and np.isfinite(focal) and focal > 0):
        raise InputError(f"stereo: baseline must be >= 0 m and focal > 0 px, got {baseline:g} and {focal:g}")
    disparities = focal * baseline / far
    shifts = np.zeros(len(far)) if scene.shifts is None else np.array(scene.shifts)
    right = scene.like(shifts=(shifts - disparities).tolist())
    return StereoPair(scene, right, tuple(far.tolist()), tuple(disparities.tolist()))
