"""Whether a tone that all events follow is in the light of a clip by itself, and no lamp's that it lacks.

A pan at an even speed shows each pixel of its picture between two others and on them in turns: at 130 pixels
per second it is sharp and blurred 130 times per second, all over the array. Pixels that answer to a rise
otherwise than to a fall send that as a tone of one phase, as they do a lamp's. A simulation with equal
thresholds need not: so the light itself is asked, which rises and falls that much more at some times.
"""

from __future__ import annotations

import numpy as np

from dase.probes.stimulus import log_light_of
from dase.scenes.video import VideoScene
from dase.signatures.result import Signature

PIXELS = 4000
"""Pixels whose light is looked at: a tone of the whole array shows in few."""

SHARE = 0.5
"""Swing of the light, relative to that of the events, from which on a tone is the scene's: 0.6 to 1.4 in four
clips of two pans, 0.01 at most of the lamps of six clips (development)."""


def is_tone_of_light(entry: Signature, scene: VideoScene, *, log_eps: float, share: float = SHARE) -> bool:
    """Return whether the light of a clip swings at a frequency about as much as its events do.

    Args:
        entry: Flicker that is seen in the events.
        scene: What they are of.
        log_eps: Added to intensities before the logarithm.
        share: Of the swing of the events that the light has to have.
    """
    return swing_of_light(scene, entry.details["frequency"], log_eps=log_eps) >= share * entry.size


def swing_of_light(scene: VideoScene, frequency: float, *, log_eps: float) -> float:
    """Return by how much a tone moves the change of the light of all pixels, relative to all that changes.

    Of events the same is the swing of ON less OFF, relative to their rate.

    Args:
        scene: A clip.
        frequency: Of the tone [Hz].
        log_eps: Added to intensities before the logarithm.
    """
    times, number = scene.sample_times(), scene.width * scene.height
    pixels = np.arange(0, number, max(1, number // PIXELS), dtype=np.int32)
    change = np.diff(log_light_of(scene, times, pixels, log_eps=log_eps), axis=0)
    net, whole = change.sum(1, dtype=np.float64), float(np.abs(change).sum(dtype=np.float64))
    if whole <= 0 or len(net) < 2:
        return 0.0
    net -= net.mean()
    # the frequency is read off the events, and no better known than they are long
    resolved = 1 / float(times[-1] - times[0])
    middle = 0.5 * (times[1:] + times[:-1])
    near = [np.exp(-2j * np.pi * (frequency + turn * resolved) * middle) for turn in (-0.5, 0.0, 0.5)]
    return max(float(abs(net @ wave)) for wave in near) / whole
