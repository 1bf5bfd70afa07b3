"""Thresholds that a network has learned from a camera's recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from dase.effects.base import Effect, asset, hidden, parameter
from dase.errors import InputError, how_to_install

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dase.scenes.scene import Scene


@wp.func
def learned_thresholds(
    on: float, off: float, factor: float, spread: float, strength: float, pixel_normal: float
):
    """Thresholds of one pixel, both moved by the same random number, as in the paper."""
    moved = 1.0 + strength * (factor * (1.0 + spread * pixel_normal) - 1.0)
    return wp.max(on * moved, 0.01), wp.max(off * moved, 0.01)


@dataclass(frozen=True, kw_only=True)
class LearnedThreshold(Effect):
    """Thresholds that a network tells from the picture, learned from a camera's recordings.

    For each pixel the network gives the mean and the spread of the threshold, from the middle frame of the
    scene; every pixel then has a threshold of its own, drawn once and never below 0.01. The network is what
    `dase train` makes; its weights lie beside the sensor file. The mean is relative: the table `threshold`
    holds its level, so ON and OFF can still be moved. Without weights the effect changes nothing.
    """

    name: ClassVar[str] = "learned_threshold"
    source: ClassVar[str] = "How to Learn a Domain-Adaptive Event Simulator?, 2021"
    stages: ClassVar = {"threshold": learned_thresholds}
    maps: ClassVar = ("factor", "spread")
    signatures: ClassVar = ()

    strength: float = parameter(
        1.0,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.5, 1.0),
        about="share of the way from equal pixels to the learned ones",
    )
    weights: str = asset(about="file of the network, beside the sensor file")
    bound: Any = hidden()  # noqa: RUF009  # a field, as those above

    def located(self, folder: Path) -> LearnedThreshold:
        """Return the effect with its file found from the folder of the sensor file."""
        return replace(self, weights=str((folder / self.weights).resolve())) if self.weights else self

    def bound_to(self, scene: Scene) -> LearnedThreshold:
        """Return the effect with the maps of this scene."""
        if not self.weights or self.bound is not None:
            return self
        try:
            # PyTorch is optional, and takes seconds to load: only sensors with learned thresholds need it
            from dase.networks.weights_file import predict_thresholds
        except ImportError:
            raise InputError(
                f"effect '{self.name}' needs PyTorch and safetensors: {how_to_install('learn')}"
            ) from None
        times = scene.sample_times()
        grey = scene.frames(times[len(times) // 2 :][:1])[0]
        mu, sigma, level = predict_thresholds(Path(self.weights), grey)
        return replace(self, bound=np.stack([mu / level, sigma / mu]).astype(np.float32))

    def map_values(self, pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return factor and spread of pixels, shape (2, N)."""
        if not self.weights:
            return np.stack([np.ones(len(pixels)), np.zeros(len(pixels))]).astype(np.float32)
        if self.bound is None:
            raise InputError(f"effect '{self.name}' depends on the scene, and none has been seen yet")
        return np.asarray(self.bound.reshape(2, -1)[:, pixels])
