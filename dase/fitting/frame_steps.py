"""Whether events come in step with the frames of a clip, as those of a simulator that knows these alone do.

Cameras and simulators that know the light at all times send events at any time between two frames. One that
looks at frames alone gives events times of its own making: all of those of a frame share a few time stamps,
at the same places from frame to frame. What is asked of these times between frames is no matter of physics;
from frame to frame it is.
"""

from __future__ import annotations

from dataclasses import dataclass

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


FRAME_STEPS = FrameStepSettings()


def frame_step_of(events: Events, scene: Scene, settings: FrameStepSettings = FRAME_STEPS) -> float | None:
    """Return the time from frame to frame of a clip in step with which events come [s]; None if they do not.

    Asked only of clips whose frames are even.

    Args:
        events: Sorted.
        scene: What they are of.
        settings: When they are in step.
    """
    if not isinstance(scene, VideoScene):
        return None
    times = scene.sample_times()
    gaps = np.diff(times)
    step = float(gaps.mean()) if len(gaps) else 0.0
    if not 0 < step <= settings.slowest or np.ptp(gaps) >= 1e-3 * step:
        return None
    t = events.t[(events.t >= times[0]) & (events.t <= times[-1])][: settings.events]
    if len(t) < settings.least:
        return None
    microseconds = max(1e6 * float(t[-1] - t[0]), 1.0)
    anywhere = microseconds * -np.expm1(-len(t) / microseconds)
    if len(np.unique(np.round(1e6 * t))) > settings.distinct * anywhere:
        return None
    phase = ((t - times[0]) / step) % 1.0
    counts = np.histogram(phase, settings.parts, (0.0, 1.0))[0]
    emptiest = float(counts.min()) * settings.parts / len(t)
    together = float(np.abs(np.exp(2j * np.pi * phase).mean()))
    return step if emptiest < settings.empty and together > settings.together else None


def is_too_slow(step: float) -> bool:
    """Return whether frames [s] are farther apart than the steps of a comparison are otherwise."""
    return step > STIMULUS.coarsest_step


def is_in_step(frequency: float, step: float, near: float = 0.02) -> bool:
    """Return whether a tone [Hz] is that of frames which come every `step` [s], or an overtone of it."""
    turns = frequency * step
    return round(turns) >= 1 and abs(turns - round(turns)) < near
