"""Where the frames of a camera rest: what its pixels send there, no light between the frames has made.

Between two frames light is a guess, and a thin thing that passes is in neither. Where the frames before and
after show the same, over as long as a slow pixel may be late, nothing can have passed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from dase.events import Events
from dase.scenes.between_frames import CameraScene


@dataclass(frozen=True)
class FramesAtRest:
    """What rest is."""

    still: float = 0.1
    """How far light at rest goes, a fraction of a usual contrast threshold [log intensity]."""

    before: float = 0.1
    """Time before an event for which light must rest [s]: a slow pixel sends late what passed."""

    smooth: int = 3
    """Columns and rows whose mean is looked at [px]: frames have noise."""

    reach: int = 5
    """Columns and rows around a pixel that must rest with it [px]: what `calm` events have around them."""

    grain: float = 0.004
    """Added to intensities before the logarithm: a step of an 8-bit frame is no motion in the dark."""


FRAMES_AT_REST = FramesAtRest()


def events_where_frames_rest(
    events: Events, scene: CameraScene, settings: FramesAtRest = FRAMES_AT_REST
) -> Events:
    """Return the events of pixels and times at which the frames around rest.

    Args:
        events: Of the sensor of the frames, on their clock.
        scene: The frames.
        settings: What rest is.
    """
    interval = np.searchsorted(scene.times, events.t, side="right") - 1
    inside = (interval >= 0) & (interval < len(scene.times) - 1)
    kept = np.zeros(len(events), bool)
    levels: dict[int, NDArray[np.float32]] = {}
    for k in np.unique(interval[inside]):
        first = max(int(np.searchsorted(scene.times, scene.times[k] - settings.before, side="right")) - 1, 0)
        needed = range(first, int(k) + 2)
        levels = {n: levels[n] if n in levels else _level(scene, n, settings) for n in needed}
        some = np.stack([levels[n] for n in needed])
        still = maximum_filter(some.max(0) - some.min(0), settings.reach) <= settings.still
        here = np.flatnonzero(interval == k)
        kept[here] = still[events.y[here], events.x[here]]
    return events.select(kept)


def _level(scene: CameraScene, frame: int, settings: FramesAtRest) -> NDArray[np.float32]:
    """Return the logarithm of a frame without most of its noise, shape (H, W)."""
    smooth: NDArray[np.float32] = uniform_filter(scene.intensity(frame), settings.smooth)
    return np.log(np.maximum(smooth, 0) + np.float32(settings.grain))
