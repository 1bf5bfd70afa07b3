"""Bunched streams of events, and what a readout chain makes of them whole or in parts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

import dase
from dase.effects.threshold import Threshold
from dase.simulation.readout_chain import ReadoutChain

WIDTH, HEIGHT = 13, 11


def camera(*effects: dase.Effect) -> dase.Sensor:
    return dase.Sensor((Threshold(), *effects))


def bunched(rng: np.random.Generator, count: int = 3000, tick: int = 1) -> dase.Events:
    """Return events that come in bunches at whole ticks [ns], many at the same, labelled by their columns."""
    centres = rng.integers(0, 2_000_000, 40)
    t = np.sort(np.abs(rng.choice(centres, count) + rng.normal(0, 2000, count).astype(np.int64)))
    t[1::5] = t[:-1:5]
    t = t // tick * tick
    x, y = rng.integers(0, WIDTH, count, np.uint16), rng.integers(0, HEIGHT, count, np.uint16)
    label = (x % 4).astype(np.int8)
    return dase.Events(1e-9 * np.sort(t), x, y, rng.random(count) < 0.5, WIDTH, HEIGHT, label)


def through(sensor: dase.Sensor, events: dase.Events, cuts: list[int] | None = None, seed: int = 0):
    """Return what leaves a sensor whose pixels send `events`, cut into parts before some indices."""
    outlet = ReadoutChain(sensor, events.width, events.height, seed=seed)
    edges = [0, *(cuts or []), len(events)]
    parts = []
    for begin, end in pairwise(edges):
        later = events.t[end] if end < len(events) else events.t[-1]
        parts.append(outlet.push(events.select(slice(begin, end)), float(later)))
    return dase.Events.concatenate([*parts, outlet.flush()])


def same(a: dase.Events, b: dase.Events) -> None:
    assert len(a) > 0
    for name in ("t", "x", "y", "p", "label"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def ns(events: dase.Events) -> list[int]:
    return np.rint(events.t * 1e9).astype(int).tolist()


def moving(rng: np.random.Generator, samples: int = 200, size: tuple[int, int] = (HEIGHT, WIDTH)):
    """Return a video of wandering log intensities, samples whole 2^-12 s."""
    level = -np.abs(np.cumsum(rng.normal(0, 0.25, (samples, *size)), 0) + rng.uniform(-4, -0.5, size))
    return dase.VideoScene(np.exp(level).astype(np.float32), np.cumsum(rng.integers(4, 24, samples)) / 4096)
