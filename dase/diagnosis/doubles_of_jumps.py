"""Which double events a jump of light cannot make.

Where a simulator holds the frames of a clip, light jumps, and a pixel sends as many events within
microseconds as the jump has thresholds. But after the first of them each needs a whole threshold more. So
where no jump was half as large, what a pixel sends twice within microseconds is sent twice. So it is with the
light of any clip from frame to frame: behind a latency nothing tells that frames were held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from dase.effects.threshold import Threshold
from dase.events import Events
from dase.probes.stimulus import log_light_of
from dase.scenes.scene import Scene
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.double_events import IntervalCounts, find_double_events
from dase.signatures.result import Signature
from dase.simulation.sensor import Sensor


@dataclass(frozen=True)
class JumpSettings:
    """Where light makes no two events."""

    small: float = 0.5
    """Jumps up to this are small, in thresholds of the sensor: pixels differ, and so do its fits."""

    before: float = 0.02
    """Time before an event in which all jumps must be small [s]: a pixel may be late."""

    level: float = 1e-5
    """p below which there are double events beside small jumps."""

    block: int = 4_000_000
    """Samples of the light that are looked at together, for their memory."""


JUMPS = JumpSettings()


def find_doubles_at_small_jumps(
    events: Events, scene: Scene, sensor: Sensor, settings: JumpSettings = JUMPS
) -> Signature:
    """Look for pixels that send twice within microseconds where light makes no two events.

    Args:
        events: Of the scene.
        scene: Light of which a step from sample to sample counts as a jump.
        sensor: Its thresholds tell which jumps are small.
        settings: Where light makes no two events.
    """
    counts = IntervalCounts(events.width, events.height)
    counts.push(events.select(are_at_small_jumps(events, scene, sensor, settings)))
    counts.finish()
    nowhere = np.zeros(events.width * events.height, bool)
    return find_double_events(counts, nowhere, settings.level)


def are_at_small_jumps(
    events: Events, scene: Scene, sensor: Sensor, settings: JumpSettings = JUMPS
) -> NDArray[np.bool_]:
    """Return which events come at and after small jumps alone, shape (N,).

    Args:
        events: Of the scene, N of them; outside its time none is chosen.
        scene: Light of which a step from sample to sample counts as a jump.
        sensor: Its thresholds tell which jumps are small.
        settings: Where light makes no two events.
    """
    threshold = sensor["threshold"]
    assert isinstance(threshold, Threshold)
    most = settings.small * min(threshold.on, threshold.off)
    times, pixel = scene.sample_times(), row_major_pixels(events)
    step = np.searchsorted(times, events.t, side="right") - 1
    inside = (step >= 0) & (step < len(times) - 1)
    width = 1 + int(np.ceil(settings.before / float(np.median(np.diff(times)))))
    out = np.zeros(len(events), bool)
    size, number = max(1, settings.block // len(times)), events.width * events.height
    for first in range(0, number, size):
        pixels = np.arange(first, min(first + size, number), dtype=np.int32)
        light = log_light_of(scene, times, pixels, log_eps=sensor.log_eps)
        jumps = np.abs(np.diff(light, axis=0))
        largest = maximum_filter1d(jumps, width, axis=0, origin=(width - 1) // 2)
        here = np.flatnonzero(inside & (pixel >= first) & (pixel < first + size))
        out[here] = largest[step[here], pixel[here] - first] <= most
    return out
