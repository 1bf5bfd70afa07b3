"""Whether events come before the light of a clip that makes them.

A simulator that is given a frame and the time since the last one shows the frame for that time: from the time
of the frame before on. Written beside the times of the frames, its events then come up to a frame before the
light changes, which no pixel can do, and no effect explains. It is seen where all events come at the same
time after a frame, as light that is held from frame to frame makes them, and tell of the frame that follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dase.events import Events
from dase.probes.stimulus import light_of
from dase.scenes.scene import LOG_EPS, Scene
from dase.scenes.video import VideoScene


@dataclass(frozen=True)
class ClipLeadSettings:
    """When a clip is shown a frame early.

    Chosen on sets a to c, x, y, z, k and g to j of other simulators: of IEBCS 0.92 to 1.00 of the events come
    in 0.06 of a frame, of all others 0.70 at most but for those that stamp events by the frame they tell of.
    """

    events: int = 100_000
    """Events that are looked at, at most, evenly spread."""

    least: int = 2_000
    """Events below which nothing is said."""

    parts: int = 50
    """Of the time from frame to frame."""

    near: int = 3
    """Such parts beside each other in which events come alike."""

    together: float = 0.85
    """Share of the events in these, at least."""

    shares: int = 12
    """Into how many parts of a frame, at most, a simulator that knows frames alone puts the events of one,
    evenly; it is not early."""

    spread_out: float = 0.5
    """Share of the events at such parts, to the microsecond, from which on it is one of these: clips of v2e
    in which most pixels send the first of four or five events had 0.9 and more."""

    tick: float = 0.02
    """Of a frame before its end: rounded stamps of the next frame's time."""

    exact: float = 0.98
    """Share of the events that have the time of a frame to the microsecond, from which on that is a clock
    whose ticks are frames: it shows the tick before an event. IEBCS has 0.94 at most."""

    sooner: float = 1.03
    """How much farther light goes after the frame than before it, at least, in the direction of events."""

    change: float = 0.3
    """Of the logarithm that counts, at most: edges say no more than slopes."""


CLIP_LEAD = ClipLeadSettings()


def is_shown_early(events: Events, scene: Scene, settings: ClipLeadSettings = CLIP_LEAD) -> bool:
    """Return whether events tell of a clip's next frame at one phase of the time before it.

    Args:
        events: Sorted.
        scene: What they are of; only clips are asked.
        settings: When a clip is early.
    """
    if not isinstance(scene, VideoScene) or len(scene.sample_times()) < 4:
        return False
    times = scene.sample_times()
    first, last = np.searchsorted(events.t, [times[1], times[-2]])
    chosen = np.unique(np.linspace(first, last - 1, settings.events).astype(np.int64))
    if last - first < settings.least:
        return False
    t, p = events.t[chosen], np.asarray(events.p, bool)[chosen]
    pixel = events.y[chosen].astype(np.int64) * events.width + events.x[chosen]
    frame = np.searchsorted(times, t, side="right") - 1
    late, gap = t - times[frame], times[frame + 1] - times[frame]
    phase = late / gap
    parts = np.round(gap / np.maximum(late, 1e-9))
    even = (parts <= settings.shares) & (np.abs(late * parts - gap) < 1.1e-6 * parts)
    if (late < 0.6e-6).mean() >= settings.exact or even.mean() >= settings.spread_out:
        return False
    frame += phase > 1 - settings.tick
    counts = np.histogram(phase % 1.0, settings.parts, (0.0, 1.0))[0]
    around = sum(np.roll(counts, shift) for shift in range(settings.near))
    if np.max(around) < settings.together * len(t):
        return False
    before = after = 0.0
    for one in np.unique(frame[(frame > 0) & (frame < len(times) - 1)]):
        here = frame == one
        some, place = np.unique(pixel[here], return_inverse=True)
        light = light_of(scene, times[one - 1 : one + 2], some.astype(np.int32))
        ways = np.diff(np.log(light + np.float32(LOG_EPS)), axis=1)
        ways = np.clip(ways, -settings.change, settings.change)[place] * np.where(p[here], 1, -1)[:, None]
        before, after = before + float(ways[:, 0].sum()), after + float(ways[:, 1].sum())
    return after > settings.sooner * max(before, 0.0)
