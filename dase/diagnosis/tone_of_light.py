"""Whether a tone that all events follow is in the light of a clip by itself, and no lamp's that it lacks.

A pan at an even speed shows each pixel of its picture between two others and on them in turns: at 130 pixels
per second it is sharp and blurred 130 times per second, all over the array. Pixels that answer to a rise
otherwise than to a fall send that as a tone of one phase, as they do a lamp's. A simulation with equal
thresholds need not: so the light itself is asked, which rises and falls that much more at some times.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.light_between_events import times_that_are_compared
from dase.fitting.measurement import Measurement
from dase.probes.stimulus import log_light_of
from dase.signatures.result import Signature

SAMPLES = 8_000_000
"""Pixels times instants that are looked at, at most: a tone of the whole array shows in few pixels."""

SHARE = 0.5
"""Swing of the light, relative to that of the events, from which on a tone is the scene's: 0.6 to 1.4 in four
clips of two pans, 0.01 at most of the lamps of six clips (development)."""

SHARE_AT_HALF = 0.1
"""The same at half of the frame rate, as often as a fan shows other blades in turns: what light does between
two frames is a guess, and makes most of such a tone (0.19 in a fan's clip, development)."""


def is_tone_of_light(
    entry: Signature, measurement: Measurement, *, log_eps: float, in_step: bool = False
) -> bool:
    """Return whether the light of a clip swings at a frequency about as much as its events do.

    At half the rate of frames that a simulator holds, or in step with which it sends, there is no lamp: a
    clip of IEBCS with nothing hidden has such a tone, of which its light has less than a hundredth, and so
    has one of frame differences.

    Args:
        entry: Flicker that is seen in the events.
        measurement: Its scene is a clip.
        log_eps: Added to intensities before the logarithm.
        in_step: Whether events come in step with the frames.
    """
    known = entry.details
    low, high = (known.get(f"frequency_{end}", known["frequency"]) for end in ("low", "high"))
    fastest, resolved = _tones_of(times_that_are_compared(measurement))
    if measurement.held:  # several instants are of one frame
        fastest = 0.5 / measurement.held
    at_half = low - resolved < fastest < high + resolved
    if at_half and (measurement.held or in_step):
        return True  # what goes on in a pixel from one frame to the next may go on in turns
    share = SHARE_AT_HALF if at_half else SHARE
    return swing_of_light(measurement, low, high, log_eps=log_eps) >= share * entry.size


def _tones_of(times: NDArray[np.float64]) -> tuple[float, float]:
    """Return the fastest tone that instants tell, half of their rate, and how well: half a turn in all [Hz].

    Args:
        times: At which light is known, ascending [s], shape (T,).
    """
    if len(times) < 2:
        return 0.0, 0.0
    return 0.5 / float(np.median(np.diff(times))), 0.5 / float(times[-1] - times[0])


def swing_of_light(measurement: Measurement, low: float, high: float, *, log_eps: float) -> float:
    """Return by how much a tone moves the change of the light of all pixels, relative to all that changes.

    Of events the same is the swing of ON less OFF, relative to their rate. Frames cannot tell a tone above
    half of their rate from a slower one, so that there is none; at half of it, a fan shows other blades in
    turns.

    Args:
        measurement: Its scene is a clip; of the time that is compared.
        low: Least frequency of the tone [Hz].
        high: Highest frequency [Hz].
        log_eps: Added to intensities before the logarithm.
    """
    times, scene = times_that_are_compared(measurement), measurement.scene
    if len(times) < 3:
        return 0.0
    fastest, resolved = _tones_of(times)
    if low > fastest + resolved:
        return 0.0
    high = min(high, fastest)
    number = scene.width * scene.height
    every = max(1, -(-number * len(times) // SAMPLES))
    pixels = np.arange(0, number, every, dtype=np.int32)
    change = np.diff(log_light_of(scene, times, pixels, log_eps=log_eps), axis=0)
    net, whole = change.sum(1, dtype=np.float64), float(np.abs(change).sum(dtype=np.float64))
    if whole <= 0:
        return 0.0
    net -= net.mean()
    middle = 0.5 * (times[1:] + times[:-1])
    # the tone may lie a little above the fastest that frames tell
    tried = np.arange(min(low, high) - resolved, high + 1.1 * resolved, resolved)
    return max(float(abs(net @ np.exp(-2j * np.pi * one * middle))) for one in tried) / whole
