"""What says that a measurement is not what it was declared to be: then nothing is to be announced of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events


@dataclass(frozen=True)
class MotionAtRestSettings:
    """When events contradict light that does not change.

    Pixels at rest send events each for itself. What moves passes over neighbours: of the pixels of a small
    tile, the black ones of a chessboard then have their events at the same times as the white ones.
    """

    tile: int = 8
    """Pixels along the side of a tile: few, so that things that move fill it, and enough to count."""
    window: float = 0.02
    """Time in which events are counted [s]: what moves slowly crosses a tile in more. A fiftieth of a shorter
    recording."""
    windows: int = 2000
    """Windows at most, spread over the recording."""
    events: int = 1_000_000
    """Events that are looked at, about: of a busy recording, fewer windows."""
    least: int = 300
    """Fewer events say nothing."""
    correlation: float = 0.1
    """Of the counts of black and white pixels; at rest it is 0 but for chance."""
    deviations: float = 8.0
    """It must also be so many of its standard errors."""


def motion_at_rest(events: Events, settings: MotionAtRestSettings = MotionAtRestSettings()) -> float:
    """Return the correlation of neighbours beyond what all pixels share; 0 where it may be chance.

    What the whole array does at once, as under a lamp, and what single pixels do does not count.

    Args:
        events: Of a scene that is said to be at rest.
        settings: When events contradict that.
    """
    if len(events) < settings.least:
        return 0.0
    begin, length = float(events.t[0]), float(events.t[-1] - events.t[0])
    if length <= 0:
        return 0.0
    span = min(settings.window, length / 50)
    count = max(1, int(length / span))
    most = min(settings.windows, max(50, count * settings.events // len(events)))
    starts = begin + span * np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64))
    first, last = (np.searchsorted(events.t, at) for at in (starts, starts + span))
    rows = len(starts)
    window = np.repeat(np.arange(rows), last - first)
    kept = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    x, y = events.x[kept].astype(np.int64), events.y[kept].astype(np.int64)
    across = -(-events.width // settings.tile)
    tile = (y // settings.tile) * across + x // settings.tile
    tiles = across * -(-events.height // settings.tile)
    black = (x + y) % 2 == 0
    counts = [
        np.bincount((tile * rows + window)[one], minlength=tiles * rows).reshape(tiles, rows)
        for one in (black, ~black)
    ]
    apart = [_beyond_shared(one) for one in counts]
    scale = float(np.sqrt((apart[0] ** 2).sum() * (apart[1] ** 2).sum()))
    if scale == 0:
        return 0.0
    correlation = float((apart[0] * apart[1]).sum()) / scale
    # by how much the sum of products scatters where black and white pixels know nothing of each other
    chance = float(np.sqrt(((apart[0] * apart[1]) ** 2).sum())) / scale
    sure = correlation > max(settings.correlation, settings.deviations * chance)
    return correlation if sure else 0.0


def _beyond_shared(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return counts less what tiles and times have in common, in standard errors, shape (tiles, windows)."""
    expected = np.outer(counts.sum(1), counts.sum(0)) / max(int(counts.sum()), 1)
    out: NDArray[np.float64] = (counts - expected) / np.sqrt(np.maximum(expected, 0.05))
    return out


def contradiction_of_rest(events: Events, light: NDArray[np.float32]) -> str:
    """Return what contradicts light that does not change, in a sentence; empty where nothing does.

    Args:
        events: The measurement.
        light: Of some pixels, shape (N, T).
    """
    if np.any(light != light[:, :1]):
        return ""
    found = motion_at_rest(events)
    if found == 0:
        return ""
    return (
        f"the events contradict a scene at rest: neighbouring pixels send theirs together (correlation "
        f"{found:.2f}), as where something moves; give what the camera saw, or record it with the cap on"
    )
