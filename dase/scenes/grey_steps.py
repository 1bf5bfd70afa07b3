"""In which steps the greys of a clip come."""

from __future__ import annotations

import numpy as np

from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene

MOST_GREYS = 256
"""Greys of a clip of 8 bits; one of more tells black well enough."""


def grey_step_of(scene: Scene) -> float:
    """Return the least step between greys of a clip [intensity], as in the dark; 0 where they are not few.

    Args:
        scene: Any; only clips have such steps, those behind a lens as they are before it.
    """
    if not isinstance(scene, VideoScene):
        return 0.0
    scene = scene.sharp or scene
    times = scene.sample_times()
    values = np.unique(scene.frames(times[sorted({0, len(times) // 2, len(times) - 1})]))
    return float(np.diff(values).min()) if 1 < len(values) <= MOST_GREYS else 0.0
