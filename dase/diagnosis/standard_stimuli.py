"""Standard recordings: what anybody can show a camera, as light at its pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Light = Callable[[np.random.Generator, int, Array], NDArray[np.float32]]


@dataclass(frozen=True)
class StandardStimulus:
    """A recording that anybody can make.

    Args:
        name: In the table.
        how: To make it, in words.
        step: Between samples [s].
        light: Random numbers, pixels N and times (T,) to linear intensity, shape (N, T).
        command: Writes what shows it on a screen or a print, or what says how to make it.
    """

    name: str
    how: str
    step: float
    light: Light
    command: str


def _static_light(low: float, high: float) -> Light:
    def light(rng: np.random.Generator, count: int, times: Array) -> NDArray[np.float32]:
        level = np.exp(rng.uniform(math.log(low), math.log(high), (count, 1)))
        return np.repeat(level.astype(np.float32), len(times), 1)

    return light


def _edge_light(speed: float, width: float, blur: float = 1.5) -> Light:
    """Bars of random brightness, `width` wide, that go by at `speed` [px/s]; their edges are `blur` wide."""

    def light(rng: np.random.Generator, count: int, times: Array) -> NDArray[np.float32]:
        at = times * speed / width + rng.uniform(0, 1, (count, 1))
        bar = at.astype(np.int64)
        log = rng.uniform(math.log(0.02), math.log(0.9), (count, int(bar.max()) + 2)).astype(np.float32)
        share = np.clip((at - bar) * width / blur, 0, 1).astype(np.float32)
        before, after = (np.take_along_axis(log, bar + n, 1) for n in (0, 1))
        # the edge is at the beginning of a bar
        return np.exp(before + (after - before) * share)

    return light


def _flicker_light(frequency: float, depth: float) -> Light:
    def light(rng: np.random.Generator, count: int, times: Array) -> NDArray[np.float32]:
        level = np.exp(rng.uniform(math.log(0.02), math.log(0.6), (count, 1)))
        return (level * (1 + depth * np.sin(2 * np.pi * frequency * times))).astype(np.float32)

    return light


STANDARD_STIMULI = (
    StandardStimulus(
        "static dark",
        "a scene at rest in little light, 0.2 to 2 % of white",
        1e-3,
        _static_light(2e-3, 2e-2),
        "dase stimulus protocol.md",
    ),
    StandardStimulus(
        "static bright",
        "a scene at rest in full light, 30 to 100 % of white",
        1e-3,
        _static_light(0.3, 1.0),
        "dase stimulus protocol.md",
    ),
    StandardStimulus(
        "slow edge",
        "bars of many greys that go by at 20 px/s, 20 px wide",
        1e-3,
        _edge_light(20, 20),
        "dase stimulus edges.mkv --parts edges",
    ),
    StandardStimulus(
        "fast edge",
        "bars of many greys that go by at 1000 px/s, 100 px wide",
        5e-4,
        _edge_light(1000, 100),
        "dase stimulus sheet.pdf",  # a screen would jump by many pixels from frame to frame
    ),
    StandardStimulus(
        "flicker",
        "a scene at rest, its light going up and down by 50 % at 10 Hz",
        1e-3,
        _flicker_light(10, 0.5),
        "dase stimulus chirp.mkv --parts chirp",
    ),
)
"""What is tried, the easiest to record first."""
