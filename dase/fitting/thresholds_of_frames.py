"""The thresholds of a simulator that holds frames, event by event.

A pixel that takes the light of a held frame for its memory sends at the first frame that is a threshold away
from it. So each event says between which two changes of the light its threshold lay: the farthest that light
went before, and how far it went with the frame of the event. That tells the thresholds, by how much they
differ, and, from one event of a pixel to the next, whether they are drawn anew or are the pixel's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.special import ndtr

from dase.fitting.held_events import HeldEvents

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ThresholdSettings:
    """Which events are looked at."""

    least: int = 1_000
    """Events of a polarity below which nothing is said."""

    frames: int = 60
    """From event to event, at most: how far light went is looked up frame by frame."""

    near: float = 0.5
    """How far apart the two changes may lie, relative to the threshold."""

    odd: float = 0.02
    """Share of the events that come without a change."""

    far: float = 6.0
    """Standard deviations off from which on an event is odd."""

    pairs: int = 500
    """Events of a pixel that follow each other, at least, that say whether thresholds are its own."""

    told: float = 0.08
    """Share of their variance that is known of thresholds, at least, for that."""


THRESHOLDS = ThresholdSettings()


@dataclass(frozen=True)
class DrawnThresholds:
    """Thresholds of one polarity.

    Args:
        mean: Log intensity.
        spread: Standard deviation over the events, relative to the mean.
        own: Share of the variance that stays from one event of a pixel to the next; not a number where
            nothing tells it.
        events: That they rest on.
    """

    mean: float
    spread: float
    own: float
    events: int


def thresholds_of_frames(
    seen: HeldEvents, *, wait: int = 1, settings: ThresholdSettings = THRESHOLDS
) -> dict[int, DrawnThresholds]:
    """Return the thresholds of ON (1) and OFF events (-1); none of a polarity that has too few.

    Args:
        seen: Of pixels that take the light of a frame for their memory.
        wait: Frames after an event whose light that is.
        settings: Which events are looked at.
    """
    now = seen.frame - seen.before
    chosen = np.flatnonzero(seen.is_first & (now >= wait) & (now <= settings.frames))
    begin, pixel, sign, apart = (one[chosen] for one in (seen.before, seen.pixel, seen.sign, now))
    memory = seen.level[begin + wait, pixel]
    high = sign * (seen.level[begin + apart + 1, pixel] - memory)
    low = np.zeros(len(chosen))
    for frames in range(wait, settings.frames):
        on = np.flatnonzero(apart > frames)
        if not len(on):
            break
        went = sign[on] * (seen.level[begin[on] + frames + 1, pixel[on]] - memory[on])
        low[on] = np.maximum(low[on], went)
    out = {}
    for one in (1, -1):
        mine = np.flatnonzero((sign == one) & (high > low))
        if len(mine) < settings.least:
            continue
        typical = float(np.median(0.5 * (low[mine] + high[mine])))
        mine = mine[high[mine] - low[mine] < settings.near * typical]
        if len(mine) < settings.least:
            continue
        mean, spread = _normal_between(low[mine], high[mine], typical, settings)
        expected = np.full(len(seen.frame), np.nan)
        expected[chosen[mine]] = _expected_between(
            (low[mine] - mean) / spread, (high[mine] - mean) / spread, settings
        )
        out[one] = DrawnThresholds(mean, spread / mean, _own_share(seen, expected, settings), len(mine))
    return out


def spread_of_thresholds(seen: HeldEvents, *, wait: int = 1) -> float:
    """Return by how much thresholds differ in the mean of ON and OFF events, relative; inf where few tell.

    Args:
        seen: Of pixels that take the light of a frame for their memory.
        wait: Frames after an event whose light that is.
    """
    found = thresholds_of_frames(seen, wait=wait).values()
    return float(np.mean([one.spread for one in found])) if found else np.inf


def _normal_between(
    low: Array, high: Array, typical: float, settings: ThresholdSettings
) -> tuple[float, float]:
    """Return mean and standard deviation of normal numbers of which it is known between what they lie.

    Args:
        low: Of each, shape (N,).
        high: The same.
        typical: About the mean.
        settings: How many are odd.
    """

    def unlikely(logs: Array) -> float:
        mean, spread = np.exp(logs)
        inside = ndtr((high - mean) / spread) - ndtr((low - mean) / spread)
        chance = (1 - settings.odd) * inside + settings.odd * (high - low) / (2 * typical)
        return -float(np.log(np.maximum(chance, 1e-12)).sum())

    begin = np.log([typical, 0.05 * typical])
    found = optimize.minimize(unlikely, begin, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-2})
    mean, spread = np.exp(found.x)
    return float(mean), float(spread)


def _expected_between(low: Array, high: Array, settings: ThresholdSettings) -> Array:
    """Return the mean of a standard normal number between two, 0 where that is far off, shape (N,)."""
    inside = np.maximum(ndtr(high) - ndtr(low), 1e-9)
    density = np.exp(-0.5 * low**2) - np.exp(-0.5 * high**2)
    near = (np.abs(low) < settings.far) & (np.abs(high) < settings.far)
    return np.where(near, np.clip(density / (np.sqrt(2 * np.pi) * inside), -3.0, 3.0), 0.0)


def _own_share(seen: HeldEvents, expected: Array, settings: ThresholdSettings) -> float:
    """Return which share of the variance stays from one event of a pixel to the next of its polarity.

    Args:
        seen: The events.
        expected: What is known of the threshold of each, in standard deviations, shape (N,); not a number
            where nothing is.
        settings: How many must follow each other.
    """
    last, now = expected[:-1], expected[1:]
    pair = (seen.pixel[1:] == seen.pixel[:-1]) & np.isfinite(last) & np.isfinite(now)
    told = float(np.nanvar(expected))
    if pair.sum() < settings.pairs or told < settings.told:
        return float("nan")
    return float(np.mean(last[pair] * now[pair])) / told**2
