"""What an effect between the scene and the pixels is to dase: it changes what the pixels see."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import Effect
from dase.errors import InputError
from dase.kernels.scene_render import render_frames
from dase.kernels.stored_levels import light_of_levels
from dase.scenes.scene import Scene


@dataclass(frozen=True, kw_only=True)
class SceneEffect(Effect):
    """A physical effect of the light before it falls on single pixels, where neighbours matter.

    Its stages are empty; `seen` wraps the scene. Its parameters have no place in a parameter vector, for all
    rows of a batch see the same.
    """

    stages: ClassVar = {}
    in_frames: ClassVar[bool] = False
    """Whether frames that are stored beside the events show it: it belongs to the sensor, not to the lens."""
    needs_colour: ClassVar[bool] = False
    """Whether it acts on colours, which are kept for it only where that is said."""

    @abstractmethod
    def seen(self, scene: Scene) -> Scene:
        """Return what the pixels see of `scene`; the scene itself where the effect is off."""


def rendered_pictures(scene: Scene, times: NDArray[np.float64], device: Any) -> wp.array:
    """Return the linear intensity of all pixels of a scene at samples [s] (K,), shape (K, H · W).

    Args:
        scene: What is looked at.
        times: As `Scene.source` takes them.
        device: Warp device of the result.
    """
    every = np.arange(scene.width * scene.height, dtype=np.int32)
    kind, source = scene.source(times, every, device)
    if kind in ("layers", "background"):
        return render_frames(source, scene.width, scene.height, device)
    if kind == "frames":
        return source.values
    if kind == "levels":
        return light_of_levels(source, device)
    raise InputError("optics_blur and bayer need intensities, and this scene gives log intensities")
