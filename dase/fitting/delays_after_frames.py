"""How long after a held frame events come, by how much of the way to its light a pixel has to go.

A simulator that holds frames knows when light jumps, so its events tell directly how late a pixel is: at once
where it must go a small part of the way in bright light, and later behind a low-pass, by ln(1 / (1 - part))
times its time constant. What is left without any way is the latency, and by how much that differs from event
to event the error of the stamps. Light that goes straight from frame to frame shows nothing of the kind: its
events come at all times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.effects.vignetting import square_from_middle
from dase.events import Events
from dase.fitting.held_events import HeldEvents
from dase.scenes.video import VideoScene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DelaySettings:
    """Which events are looked at.

    Chosen on sets y, z and k to s of other simulators: the width of the 15 clips of IEBCS that send at their
    own times is 0.01 to 0.20, that of all others 0.28 and more but for stamps at parts of a frame.
    """

    least: int = 2_000
    """Events below which nothing is said."""

    change: float = 0.02
    """Of the logarithm from frame to frame, at least: less is a step of 8 bits."""

    beyond: float = 0.3
    """How far the part of the way may lie outside 0 to 1; what is farther is noise."""

    parts: tuple[float, float] = (0.02, 0.95)
    """Of the way, that are told apart."""

    edges: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
    """Between the bins of ways, as shares of the events."""

    straight: int = 6
    """Such bins whose delays grow with the way: after longer ones a pixel is not yet at rest."""

    blocks: int = 8
    """Groups of pixels whose estimates differ by chance."""

    rows: int = 8
    """Rows beside each other that are of one group."""

    levels: int = 6
    """Of light, as many events in each, within which delays in corners are compared with those elsewhere."""

    turns: int = 8
    """Steps by which the light of corners is told."""

    steepest: float = 9.0
    """Square of the tangent of the angle to a corner, at most: 0.99 of the light are lost there."""

    most_parts: int = 8
    """Parts of the time from frame to frame in which a simulator may look at light that goes on, at most."""

    of_one_part: float = 0.3
    """Share of the events that tells where in a part they come."""

    of_others: float = 0.2
    """Share of the events outside the part with most, at least: 0.37 to 0.6 in four clips of v2e."""

    part_width: float = 0.25
    """Share of a part in which most of those come, at most: 0.00 to 0.15 there, 0.68 if they come at any
    time."""


DELAYS = DelaySettings()


@dataclass(frozen=True, eq=False)
class DelaysAfterFrames:
    """Delays of events after held frames.

    Args:
        way: ln(1 / (1 - part of the way to the new light)) / intensity, shape (N,).
        late: Time after the frame [s], shape (N,).
        level: Log intensity of the new light, shape (N,).
        gap: Time from frame to frame [s].
        group: Of the pixel, shape (N,): groups differ by chance.
        square: Square distance of the pixel from the middle, in units of the corner's, shape (N,).
    """

    way: Array
    late: Array
    level: Array
    gap: float
    group: NDArray[np.int64]
    square: Array

    def quantiles(self, shares: tuple[float, ...], settings: DelaySettings = DELAYS) -> tuple[Array, Array]:
        """Return the median way, and quantiles of the delay [s], per bin of ways.

        Args:
            shares: Which quantiles.
            settings: Between which ways bins are.

        Returns:
            Shapes (B,) and (B, len(shares)).
        """
        bins = np.searchsorted(np.quantile(self.way, settings.edges), self.way)
        used = [bins == n for n in range(len(settings.edges) + 1)]
        used = [one for one in used if one.sum() >= 20]
        ways = np.array([np.median(self.way[one]) for one in used])
        return ways, np.array([np.quantile(self.late[one], shares) for one in used])

    def width(self, share: float = 0.68, part: float = 0.1) -> float:
        """Return in which share of the time from frame to frame most events with the shortest way come.

        Args:
            share: Of the events.
            part: Of the events that have the shortest way.
        """
        short = self.way <= np.quantile(self.way, part)
        return _shortest_turn(self.late[short] / self.gap, share)[1]

    def come_in_parts(self, settings: DelaySettings = DELAYS) -> bool:
        """Return whether events come at even parts of the time from frame to frame, and in several of them.

        Then light goes on between frames, and a simulator looks at it in each part: what has further to go is
        sent in a later part, as a low-pass would, and none need be there.
        """
        for parts in range(2, settings.most_parts + 1):
            phase = self.late / self.gap * parts
            first, wide = _shortest_turn(phase, settings.of_one_part)
            part = np.floor(phase - first - 0.5 * wide + 0.5).astype(np.int64)
            numbers, many = np.unique(part, return_counts=True)
            others = phase[part != numbers[many.argmax()]]
            if len(others) < settings.of_others * len(phase):
                continue
            if _shortest_turn(others, 0.68)[1] <= settings.part_width:
                return True
        return False

    def line(self, settings: DelaySettings = DELAYS) -> tuple[float, float]:
        """Return the delay without any way [s], and by how much it grows with that [s]."""
        ways, late = self.quantiles((0.5,), settings)
        slope, begin = np.polyfit(ways[: settings.straight], late[: settings.straight, 0], 1)
        return float(begin), float(slope)

    def slope_in_errors(self) -> float:
        """Return by how many standard errors delays grow with the way; 0 of too few groups to tell."""
        slopes = np.array([one.line()[1] for one in self.of_groups()])
        if len(slopes) < 3:
            return 0.0
        return float(slopes.mean() / max(slopes.std(ddof=1) / math.sqrt(len(slopes)), 1e-12))

    def tangent(self, settings: DelaySettings = DELAYS) -> float:
        """Return the square of the tangent of the angle at which light gets to the corner, by the cos⁴ law.

        A low-pass is slower where less light gets, so in a clip's light that is alike delays grow with the
        way by more in a corner. What light does by itself, as a low-pass that follows it in another way, is
        the same there as in the middle.

        Args:
            settings: How finely light is told apart.
        """
        edges = np.quantile(self.level, np.arange(1, settings.levels) / settings.levels)
        bins = np.searchsorted(edges, self.level)
        cells = [self._select(bins == n) for n in range(settings.levels)]
        cells = [one for one in cells if len(one.way) >= 60]
        tangent = 0.0
        for _ in range(settings.turns):
            found = np.array([one._growth_left(tangent) for one in cells])
            found = found[np.isfinite(found).all(1)] if len(found) else np.empty((0, 2))
            if not len(found):
                return 0.0
            step = float(np.average(found[:, 0], weights=found[:, 1]))
            # a growth by g from the middle to the corner, about the mean square distance
            tangent = float(np.clip(tangent + 0.5 * step, -0.5, settings.steepest))
        return tangent

    def _growth_left(self, tangent: float) -> tuple[float, float]:
        """Return by which part a slope still grows from the middle to the corner, and its weight.

        Args:
            tangent: With which the light of a corner is counted already.
        """
        way = self.way * (1.0 + tangent * self.square) ** 2
        way, square = way / max(float(np.mean(way)), 1e-300), self.square - np.mean(self.square)
        level = self.level - np.mean(self.level)
        factors = np.stack([np.ones_like(way), way, way * square, level, way * level], 1)
        late = self.late / max(float(np.median(self.late)), 1e-9)
        weight = np.ones_like(late)
        for _ in range(6):  # what is late by far is of another way
            root = np.sqrt(weight)
            slopes = np.linalg.lstsq(factors * root[:, None], late * root, rcond=None)[0]
            off = late - factors @ slopes
            # long delays differ by more, of which there are more in the corners
            size = np.maximum(factors @ slopes, 0.3)
            weight = 1 / (1 + (off / size / (3 * np.median(np.abs(off / size)) + 1e-12)) ** 2) / size**2
        if slopes[1] <= 0:
            return math.nan, 0.0
        bare = factors.T @ (factors * weight[:, None])
        error = np.linalg.pinv(bare)[2, 2] * np.average(off**2, weights=weight)
        return float(slopes[2] / slopes[1]), float(slopes[1] ** 2 / max(error, 1e-300))

    def brighter_half(self) -> DelaysAfterFrames:
        """Return those in brighter light, where pixels are at rest when they take their memory."""
        return self._select(self.level > np.median(self.level))

    def of_groups(self, settings: DelaySettings = DELAYS) -> list[DelaysAfterFrames]:
        """Return the delays of each group of pixels that has enough of them."""
        least = settings.least / settings.blocks
        groups = (self.group == one for one in np.unique(self.group))
        return [self._select(mine) for mine in groups if mine.sum() >= least]

    def _select(self, used: NDArray[np.bool_]) -> DelaysAfterFrames:
        return DelaysAfterFrames(
            self.way[used], self.late[used], self.level[used], self.gap, self.group[used], self.square[used]
        )


def _shortest_turn(phase: Array, share: float) -> tuple[float, float]:
    """Return where the shortest stretch of a turn with a share of some phases begins, and how long it is.

    Args:
        phase: In turns, shape (N,).
        share: Of them.
    """
    turn = np.sort(phase % 1.0)
    many = int(share * len(turn))
    around = np.concatenate([turn, turn + 1])
    wide = around[many : many + len(turn)] - turn
    best = int(wide.argmin())
    return float(turn[best]), float(wide[best])


def delays_after_frames(
    events: Events, scene: VideoScene, settings: DelaySettings = DELAYS, *, wait: int = 1
) -> DelaysAfterFrames | None:
    """Return the delays of the first events of pixels after frames, each held from the one before on.

    Args:
        events: In order of time.
        scene: A clip, held or as its frames are written down.
        settings: Which events are looked at.
        wait: Frames after the one before an event whose light its pixel remembers.

    Returns:
        None where there are too few.
    """
    seen = HeldEvents.of(events, scene)
    first = np.flatnonzero(seen.is_first)
    frame, pixel, sign = (one[first] for one in (seen.frame, seen.pixel, seen.sign))
    now = seen.level[frame + 1, pixel]
    step = sign * (now - seen.level[frame, pixel])
    # a pixel that has sent goes on from the light of that frame, or of the one at which its event is out
    remembered = np.minimum(seen.before[first] + wait, frame)
    whole = sign * (now - seen.level[remembered, pixel])
    ways, chosen = [], []
    for one in (1.0, -1.0):
        used = np.flatnonzero((sign == one) & (step > settings.change))
        if len(used) < settings.least // 4:
            continue
        threshold = float(np.median(whole[used] - 0.5 * step[used]))
        part = (threshold - (whole[used] - step[used])) / step[used]
        inside = (part > -settings.beyond) & (part < 1 + settings.beyond)
        used, part = used[inside], np.clip(part[inside], *settings.parts)
        ways.append(-np.log(1 - part) / np.exp(now[used]))
        chosen.append(used)
    if sum(map(len, chosen)) < settings.least:
        return None
    used = np.concatenate(chosen)
    row = seen.row[first[used]]
    square = square_from_middle(pixel[used] % scene.width, row, scene.width, scene.height)
    group = row // settings.rows % settings.blocks
    return DelaysAfterFrames(np.concatenate(ways), seen.late[first[used]], now[used], seen.gap, group, square)
