"""Cameras that move as in a hand or on a vehicle: smooth random paths with a spectrum, turns and pauses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.scenes.layers import QUANTITIES, Motion, Wave

Span = tuple[float, float]


@dataclass(frozen=True)
class Shake:
    """How a camera moves: sums of sines, whose frequencies lie anywhere in a band, log-uniformly.

    The velocity of a sine is normally distributed and falls as 1/√frequency, so that its way falls as f^-1.5:
    large sways are slow, as those of a hand. The direction turns with every sine, so that paths bend and turn
    back. None of the numbers is taken from a recording; they span what hand-held and driven cameras do.

    Args:
        speed: Least and greatest root mean square of the speed of the picture [px/s], log-uniform.
        spin: The same of the rotation about the middle [°/s].
        zoom: The same of the change of scale [1/s].
        band: Least and greatest frequency [Hz].
        waves: Sines in each quantity.
        reach: The way of a sine at most, in widths of the picture; slower ones become faster in rhythm.
        pauses: Times per second that everything stands still, on average.
        pause: Mean duration of it [s], exponential.
    """

    speed: Span = (30.0, 1000.0)
    spin: Span = (1.0, 60.0)
    zoom: Span = (0.005, 0.2)
    band: Span = (0.4, 12.0)
    waves: int = 4
    reach: float = 0.15
    pauses: float = 0.25
    pause: float = 0.2


MOST_PAUSES = 4
"""Of a scene; further ones are left out."""
LARGEST_ZOOM = 0.4
"""Sum of the amplitudes of the scale, which must stay above 0."""


@dataclass(frozen=True)
class CameraMotions:
    """Motions of the cameras of B scenes.

    Args:
        ends: The straight part, in the order of `QUANTITIES`, from begin to end, shape (B, 5, 2).
        waves: Amplitude, frequency [Hz] and phase [rad] of J sines each, shape (B, 5, J, 3).
        pauses: Begin and end [s], shape (B, P, 2); nothing happens where both are equal.
    """

    ends: NDArray[np.float64]
    waves: NDArray[np.float64]
    pauses: NDArray[np.float64]

    def motion(self, scene: int) -> Motion:
        """Return the motion of one camera."""
        pairs = {
            name: tuple(map(float, pair)) for name, pair in zip(QUANTITIES, self.ends[scene], strict=True)
        }
        waves = tuple(
            Wave(name, *map(float, wave))
            for name, sines in zip(QUANTITIES, self.waves[scene], strict=True)
            for wave in sines
            if wave[0] != 0
        )
        pauses = tuple((float(a), float(b)) for a, b in self.pauses[scene] if b > a)
        return Motion(**pairs, waves=waves, pauses=pauses)  # type: ignore[arg-type]  # pairs have two numbers


def draw_cameras(
    rng: np.random.Generator, shakes: Sequence[Shake | None], *, width: int, duration: float
) -> CameraMotions:
    """Draw the motions of cameras, one for each of `shakes`; None is a camera at rest.

    Args:
        rng: Draws everything, as many numbers whatever is None.
        shakes: How each moves.
        width: Columns of the picture, the unit of lengths [px].
        duration: Of the scenes [s].
    """
    count = len(shakes)
    hows = [Shake() if shake is None else shake for shake in shakes]
    moves = np.array([shake is not None for shake in shakes], float)
    most = max(how.waves for how in hows)
    used = np.arange(most) < np.array([how.waves for how in hows])[:, None]

    def strength(name: str) -> NDArray[np.float64]:
        """Return root mean squares, log-uniform, shape (B,)."""
        low, high = np.log([getattr(how, name) for how in hows]).T
        return np.asarray(np.exp(rng.uniform(low, high)) * moves)

    def sines(rms: NDArray[np.float64], slowest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return sines whose rates of change have root mean squares, shape (B, J, 3)."""
        band = np.array([how.band for how in hows])
        low = np.clip(slowest, band[:, 0], band[:, 1])[:, None]
        frequency = np.exp(rng.uniform(np.log(low), np.log(band[:, 1:]), (count, most)))
        rate = rng.normal(size=(count, most)) / np.sqrt(frequency) * used
        size = np.sqrt(0.5 * np.sum(rate**2, 1, keepdims=True))
        rate = rate * rms[:, None] / np.maximum(size, 1e-12)
        phase = rng.uniform(0, 2 * np.pi, (count, most))
        return np.stack([rate / (2 * np.pi * frequency), frequency, phase], -1)

    reach = np.array([how.reach for how in hows])
    speed, heading = strength("speed") / width, rng.uniform(0, 2 * np.pi, count)
    # a slow sine of this speed would go too far
    slowest = speed / (2 * np.pi * reach)
    waves = np.zeros((count, len(QUANTITIES), most, 3))
    # root mean squares of two directions that are not alike, as a hand's are not
    waves[:, 0] = sines(speed * np.hypot(np.cos(heading), 0.3) / np.sqrt(1.18), slowest)
    waves[:, 1] = sines(speed * np.hypot(np.sin(heading), 0.3) / np.sqrt(1.18), slowest)
    waves[:, 2] = sines(np.radians(strength("spin")), np.zeros(count))
    zoom = sines(strength("zoom"), np.zeros(count))
    total = np.abs(zoom[..., 0]).sum(1, keepdims=True)
    zoom[..., 0] *= np.minimum(1, LARGEST_ZOOM / np.maximum(total, 1e-12))
    waves[:, 3] = waves[:, 4] = zoom
    ends = np.zeros((count, len(QUANTITIES), 2))
    ends[:, 3:] = 1.0
    return CameraMotions(ends, waves, _draw_pauses(rng, hows, moves, duration))


def _draw_pauses(
    rng: np.random.Generator, hows: Sequence[Shake], moves: NDArray[np.float64], duration: float
) -> NDArray[np.float64]:
    """Return begin and end of pauses [s], one after the other, shape (B, P, 2)."""
    expected = np.array([how.pauses for how in hows]) * duration * moves
    number = np.minimum(rng.poisson(expected), MOST_PAUSES)
    begin = rng.uniform(0, duration, (len(hows), MOST_PAUSES))
    begin = np.sort(np.where(np.arange(MOST_PAUSES) < number[:, None], begin, duration), 1)
    length = rng.exponential(np.array([how.pause for how in hows])[:, None], begin.shape)
    end = np.minimum(begin + length, np.c_[begin[:, 1:], np.full(len(hows), duration)])
    return np.stack([begin, end], -1)
