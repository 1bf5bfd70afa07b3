"""Whether events come in step with the frames of a clip, as those of a simulator that knows these alone do.

Cameras and simulators that know the light at all times send events at any time between two frames. One that
looks at frames alone gives events times of its own making: all of those of a frame share a few time stamps,
at the same places from frame to frame. What is asked of these times between frames is no matter of physics;
from frame to frame it is. Their ticks are no clock of a camera's either: that shows the tick before an event,
and such a simulator says what went on since the last frame at the next one or at some part of the way to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dase.events import Events
from dase.probes.stimulus import STIMULUS
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene


@dataclass(frozen=True)
class FrameStepSettings:
    """When events come in step with frames.

    Clips of v2e at 100 Hz have 0.0013 to 0.0018 of the time stamps, nothing in some twentieth of a frame, and
    0.75 to 0.93 of one phase; plain, noisy and flickering sensors of dase over the same clip, and a simulator
    that goes straight in the logarithm, have 0.88 to 0.99, 0.23 to 0.7, and 0.08 to 0.16.
    """

    slowest: float = 0.05
    """Longest time from frame to frame of which it is asked [s]."""

    events: int = 300_000
    """Events that are looked at, at most."""

    least: int = 2_000
    """Events below which nothing is said."""

    distinct: float = 0.1
    """Share of the time stamps there would be if events came at any time, in microseconds."""

    parts: int = 20
    """Of the time from frame to frame."""

    empty: float = 0.05
    """Events of the emptiest part, as a share of what it would have."""

    together: float = 0.3
    """Length of the mean of all phases: a camera's coarse clock alone has ticks all round."""

    most: float = 1.4
    """Events of the fullest part from which on few parts do as well, relative to what each of those with
    events would have if they were alike, as ticks of a clock are: a clip of v2e had half of its events at
    frames, a third in the middle between two, and a tenth at a third of the way."""

    few: float = 0.3
    """Share of the parts that then have events, at most."""

    follow: float = 0.7
    """Share of the events at a later part of a frame whose pixel has sent at the part before, from which on
    few parts do as well: a simulator that knows how many events a pixel sends in a frame goes through them in
    turn. Clips of v2e had 1.0 where it matters, clocks of a half or a third of a frame 0.46 at most."""

    looked: int = 60
    """Frames at which it is asked whether events tell of the light before them or after them."""

    near: float = 0.02
    """How far from a frame an event is of it, in steps from frame to frame."""

    drift: float = 0.5
    """By how many ticks those that are parts of a frame may go from these over all events, at most: rounded
    stamps tell ticks to much less."""

    elsewhere: float = 0.01
    """Share of the events at other times than frames from which on it is asked whether those at a frame tell
    of what comes after it: a clock whose ticks are frames has none."""

    in_the_middle: float = 0.05
    """Share of these that come in the middle between two frames: a simulator that holds frames sends nothing
    there, and what comes at any time is there by a chance of 0.002."""

    exact: float = 1.5e-6
    """How far from a frame an event is stamped with its time [s]."""

    many: float = 0.3
    """Share of the events that are stamped with times of frames, from which on the others may come at any
    time: hot pixels and noise beside a simulator by frames, or parts of frames of many lengths."""

    astray: float = 0.15
    """Share of these that may go against the light; of noise that is drawn once a frame half do."""

    clearly: float = 0.3
    """Events at a frame that go against the light after it, relative to those that go against the light
    before it, below which all are of what comes after it."""


FRAME_STEPS = FrameStepSettings()


class AgainstLight(NamedTuple):
    """How many events at frames go against the light.

    Args:
        events: At the frames that were looked at.
        before: Those against the light from the frame before on.
        after: Those against the light up to the next frame.
    """

    events: int
    before: int
    after: int


def frame_step_of(events: Events, scene: Scene, settings: FrameStepSettings = FRAME_STEPS) -> float | None:
    """Return the time from frame to frame of a clip in step with which events come [s]; None if they do not.

    Asked only of clips whose frames are even, and of none whose frames are held: of these it is known what
    goes on between them.

    Args:
        events: Sorted.
        scene: What they are of.
        settings: When they are in step.
    """
    step, times = clip_step_of(scene), scene.sample_times()
    if not 0 < step <= settings.slowest or is_held(scene):
        return None
    if isinstance(scene, VideoScene) and scene.by_frames:
        return step
    t = events.t[(events.t >= times[0]) & (events.t <= times[-1])][: settings.events]
    if len(t) < settings.least:
        return None
    microseconds = max(1e6 * float(t[-1] - t[0]), 1.0)
    anywhere = microseconds * -np.expm1(-len(t) / microseconds)
    if _come_at_frames(events, scene, step, settings):
        return step
    if 1 + np.count_nonzero(np.diff(np.round(1e6 * t))) > settings.distinct * anywhere:
        return None
    phase = ((t - times[0]) / step) % 1.0
    # frames and the middle between two lie in the middle of parts
    counts = np.histogram((phase + 0.5 / settings.parts) % 1.0, settings.parts, (0.0, 1.0))[0]
    emptiest = float(counts.min()) * settings.parts / len(t)
    together = float(np.abs(np.exp(2j * np.pi * phase).mean()))
    filled = counts > settings.empty * len(t) / settings.parts
    uneven = counts.max() * np.count_nonzero(filled) > settings.most * len(t)
    few = np.count_nonzero(filled) <= settings.few * settings.parts
    in_step = together > settings.together or (
        few and (uneven or _in_turn(events, times[0], step) > settings.follow)
    )
    return step if emptiest < settings.empty and in_step else None


def _come_at_frames(events: Events, scene: Scene, step: float, settings: FrameStepSettings) -> bool:
    """Whether many events are stamped with times of frames, and go with the light before or after these."""
    begin = scene.frame_times()[0] if isinstance(scene, VideoScene) else scene.sample_times()[0]
    phase = ((events.t - begin) / step + 0.5) % 1.0 - 0.5
    at_frame = np.abs(phase) * step < settings.exact
    if at_frame.mean() < settings.many:
        return False
    # ticks of a clock have all alike; the middle between two frames lies in the middle of a part
    bins = 2 * settings.parts
    others = np.histogram((phase[~at_frame] + 0.5 / bins) % 1.0, bins, (0.0, 1.0))[0]
    if others.max() * settings.most > np.count_nonzero(at_frame):
        return False
    against = _against_the_light(events.select(at_frame), scene, step, settings)
    return min(against.before, against.after) < settings.astray * against.events


def _in_turn(events: Events, begin: float, step: float, most: int = 300_000) -> float:
    """Return the share of events at a later time stamp of a frame whose pixel has sent at the stamp before.

    Args:
        events: Sorted.
        begin: Time of a frame [s].
        step: From frame to frame [s].
        most: Events that are looked at.
    """
    t, pixels = events.t[:most], events.width * events.height
    pixel = events.y[:most].astype(np.int64) * events.width + events.x[:most]
    # a frame's time is the last stamp of what went on before it
    frame = np.ceil((t - begin) / step - 1e-3).astype(np.int64)
    stamp = np.cumsum(np.diff(t, prepend=t[0]) > 1e-6)
    first = np.searchsorted(frame, frame)  # the first event of the same frame
    later = stamp > stamp[first]
    if not later.any():
        return 0.0
    return float(np.isin((stamp - 1)[later] * pixels + pixel[later], stamp * pixels + pixel).mean())


def clip_step_of(scene: Scene) -> float:
    """Return the time from frame to frame of a clip [s]; 0 for another scene, or if frames are not even.

    Two pictures are no clip: light that does not change is given as the same one at both ends.
    """
    if isinstance(scene, VideoScene) and scene.held_for:
        return scene.held_for
    gaps = np.diff(scene.sample_times()) if isinstance(scene, VideoScene) else np.empty(0)
    if len(gaps) < 2:
        return 0.0
    step = float(gaps.mean())
    return step if np.ptp(gaps) < 1e-3 * step else 0.0


def ticks_are_of_frames(
    tick: float, frame_step: float, events: Events, scene: Scene, settings: FrameStepSettings = FRAME_STEPS
) -> bool:
    """Return whether the ticks of time stamps are made from frame to frame, and are not those of a clock.

    Ticks of a clock that are finer than frames come at all parts of a frame alike, and such events are not in
    step with frames. One whose ticks are frames is in step, too, but tells at a frame of the light after it,
    where a simulator by frames tells of the light before.

    Args:
        tick: Time from tick to tick [s].
        frame_step: What `frame_step_of` says of the events, 0 or None where they are not in step.
        events: Sorted.
        scene: What they are of.
        settings: How many frames are looked at.
    """
    if not tick or not frame_step or tick > (1 + settings.near) * frame_step:
        return False
    if tick < (1 - settings.near) * frame_step:
        # ticks that drift from the frames are of a clock that rounds what is sent at frames
        ticks = frame_step / tick
        frames = float(events.t[-1] - events.t[0]) / frame_step
        return abs(ticks - round(ticks)) * frames < settings.drift
    against = _against_the_light(events, scene, frame_step, settings)
    return against.before < against.after


def comes_before_its_light(
    events: Events, scene: Scene, settings: FrameStepSettings = FRAME_STEPS
) -> float | None:
    """Return the time from frame to frame if events at a frame tell of what comes after it [s], else None.

    A simulator by frames may give the events of a frame times from that of the one before on (AirSim): those
    that it sends first are stamped with the time at which their light begins to change.

    Args:
        events: Sorted.
        scene: What they are of.
        settings: When they do.
    """
    step = frame_step_of(events, scene, settings)
    if step is None or (isinstance(scene, VideoScene) and scene.by_frames):
        return None
    phase = (events.t - scene.sample_times()[0]) / step % 1.0
    late = np.minimum(phase, 1.0 - phase) * step
    others = phase[late > settings.exact]
    if len(others) < settings.elsewhere * len(events):
        return None
    if np.mean(np.abs(others - 0.5) * step < settings.exact) < settings.in_the_middle:
        return None
    against = _against_the_light(events, scene, step, settings)
    return step if against.after < settings.clearly * against.before else None


def _against_the_light(
    events: Events, scene: Scene, frame_step: float, settings: FrameStepSettings
) -> AgainstLight:
    """Return how many events at some of the frames go against the light."""
    times = scene.sample_times()
    inner = np.unique(np.linspace(1, len(times) - 2, settings.looked).astype(int))
    before = after = count = 0
    for at in inner if len(times) > 2 else ():
        first, last = np.searchsorted(events.t, times[at] + np.array([-1, 1]) * settings.near * frame_step)
        y, x = events.y[first:last], events.x[first:last]
        light = scene.frames(times[at - 1 : at + 2])[:, y, x]
        ways = np.where(events.p[first:last], 1, -1) * np.sign(np.diff(light, axis=0))
        count += int(last - first)
        before += int(np.count_nonzero(ways[0] <= 0))
        after += int(np.count_nonzero(ways[1] <= 0))
    return AgainstLight(count, before, after)


def is_held(scene: Scene) -> bool:
    """Whether the light of a clip goes from frame to frame in jumps."""
    return isinstance(scene, VideoScene) and scene.held_for > 0


def is_too_slow(step: float) -> bool:
    """Return whether frames [s] are farther apart than the steps of a comparison are otherwise."""
    return step > STIMULUS.coarsest_step


def is_in_step(frequency: float, step: float, near: float = 0.02) -> bool:
    """Return whether a tone [Hz] is that of frames which come every `step` [s], or an overtone of it."""
    turns = frequency * step
    return round(turns) >= 1 and abs(turns - round(turns)) < near
