"""Whether a simulator that was given more pictures than a clip has frames held each of them.

IEBCS may be fed with pictures between the frames of a clip, straight from one to the next, and holds each as
it holds frames (`dase.fitting.held_clips`). Then events come soon after even parts of the time from frame to
frame; and with the light of those pictures for the memory of a pixel its thresholds, by what light went
before an event and with it (`dase.fitting.thresholds_of_frames`), hardly differ, with that of others much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.fitting.frame_steps import clip_step_of
from dase.fitting.held_clips import come_at_even_parts, even_parts, most_beside
from dase.fitting.held_events import HeldEvents, rows_with_most_events
from dase.fitting.thresholds_of_frames import spread_of_thresholds
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeldPartSettings:
    """When parts of frames are held.

    Chosen on three sets of a twelfth program of other simulators, with nine clips of IEBCS.
    """

    most: int = 10
    """Pictures from frame to frame, at most."""

    least: int = 2_000
    """Events below which nothing is said."""

    events: int = 100_000
    """Events whose times are looked at, at most, evenly spread."""

    bins: int = 50
    """Of the time from picture to picture."""

    quarter: int = 12
    """Such bins beside each other that are denser than others."""

    dense: float = 0.4
    """Share of the events in these from which on thresholds are asked: a quarter of those that come at any
    time."""

    most_events: float = 0.5
    """Share of the events in these from which on most of them come together: 0.24 to 0.29 in ten clips of
    simulators that look at light between frames, 0.96 and more of five of IEBCS."""

    shares: int = 12
    """Into how many parts, at most, a simulator that knows pictures alone puts the events of one, evenly."""

    even: float = 0.5
    """Share of the events at such parts, to the microsecond, from which on it is one of these (v2e)."""

    at_once: float = 0.3
    """Share of the events at one microsecond of it, at most."""

    intensities: int = 400_000
    """Pixels times frames that tell thresholds, about."""

    room: int = 1 << 28
    """Pixels times pictures that are held in memory, at most."""

    apart: float = 0.12
    """What thresholds differ by, relative, at most: 0.0004 to 0.05 in five clips of IEBCS with 4 to 10
    pictures."""

    decided: float = 0.6
    """The same, relative to the least with any other number of pictures: 0.003 to 0.48."""


HELD_PARTS = HeldPartSettings()


def parts_that_are_held(events: Events, scene: Scene, settings: HeldPartSettings = HELD_PARTS) -> int:
    """Return how many pictures from frame to frame of a clip a simulator held each; 0 where it did not.

    Args:
        events: Sorted.
        scene: What they are of; only clips with even frames are asked, and none whose frames are held.
        settings: When parts are held.
    """
    if not isinstance(scene, VideoScene) or scene.held_for or scene.by_frames or scene.sharp is not None:
        return 0
    step, times = clip_step_of(scene), scene.sample_times()
    inside = slice(*np.searchsorted(events.t, (times[0], times[-1])))
    many = inside.stop - inside.start
    if not step or len(times) < 4 or many < settings.least:
        return 0
    t = events.t[inside][:: max(1, many // settings.events)]
    room = settings.room // (len(times) * scene.width * scene.height)
    numbers = range(2, min(settings.most, room) + 1)
    likely = [n for n in numbers if _come_together(t - times[0], step / n, settings)]
    at = np.floor((t - times[0]) / step)
    if not likely or come_at_even_parts(at.astype(np.int64), t - times[0] - at * step, step):
        return 0
    events, scene = _of_busiest_rows(events, scene, settings)
    differ = {parts: _thresholds_differ(events, scene, parts) for parts in likely}
    best = min(likely, key=differ.__getitem__)
    if differ[best] > settings.apart:
        return 0
    others = [n for n in range(1, settings.most + 1) if n not in likely]
    differ |= {parts: _thresholds_differ(events, scene, parts) for parts in others}
    next_best = min(value for parts, value in differ.items() if parts != best)
    return best if differ[best] <= settings.decided * next_best else 0


def come_together_at_pictures(events: Events, scene: Scene, settings: HeldPartSettings = HELD_PARTS) -> bool:
    """Return whether most events of a clip come in a quarter of the time from picture to picture.

    Then light goes by pictures that were held, as many from frame to frame as `most` at most, or at their
    times, even where thresholds do not tell how many they are: what it does between events is not known.

    Args:
        events: Sorted.
        scene: What they are of.
        settings: How many pictures are asked for.
    """
    step = clip_step_of(scene) if isinstance(scene, VideoScene) else 0.0
    t = events.t
    if not step or len(t) < settings.least:
        return False
    late = t[:: max(1, len(t) // settings.events)] - scene.sample_times()[0]
    phases = (late % (step / n) / (step / n) for n in range(1, settings.most + 1))
    together = (most_beside(phase, settings.bins, settings.quarter) for phase in phases)
    return max(together) >= settings.most_events * len(late)


def _of_busiest_rows(
    events: Events, scene: VideoScene, settings: HeldPartSettings
) -> tuple[Events, VideoScene]:
    """Return the events and the clip of the rows with the most events, as many as tell thresholds."""
    most = max(1, settings.intensities // (len(scene.sample_times()) * scene.width))
    first, after = rows_with_most_events(events, most)
    mine = events.select((events.y >= first) & (events.y < after))
    moved = Events(mine.t, mine.x, mine.y - first, mine.p, mine.width, after - first)
    return moved, scene.of_rows(first, after)


def _come_together(t: Array, step: float, settings: HeldPartSettings) -> bool:
    """Return whether more events come in a quarter of each time than if they came at any time.

    Those at its begin, to the microsecond, do not count: noise that is drawn at each picture, and what a
    simulator that knows pictures alone sends at parts of it.

    Args:
        t: Of the events, since the first picture [s], shape (N,).
        step: From picture to picture [s].
        settings: How many more.
    """
    late = t % step
    parts, exact = even_parts(late, step)
    even = exact & (parts <= settings.shares)
    late = late[(late > 0.6e-6) & (late < step - 0.6e-6)]
    if len(late) < settings.least or even.mean() >= settings.even:
        return False
    if np.bincount(np.round(1e6 * late).astype(np.int64)).max() > settings.at_once * len(late):
        return False  # a clock's ticks
    return most_beside(late / step, settings.bins, settings.quarter) >= settings.dense * len(late)


def _thresholds_differ(events: Events, scene: VideoScene, parts: int) -> float:
    """Return what thresholds differ by if so many pictures per frame are held; inf where few tell."""
    return spread_of_thresholds(HeldEvents.of(events, scene.in_parts(parts)))
