"""Events as rows and as trains of pixels, and how far two lots of them differ."""

from __future__ import annotations

import numpy as np

import dase


def rows(events: dase.Events) -> np.ndarray:
    """Return events as whole numbers (t [ns], x, y, p), shape (N, 4)."""
    return np.stack([np.round(events.t * 1e9).astype(np.int64), events.x, events.y, events.p], -1)


def same(a: dase.Events, b: dase.Events) -> None:
    """Assert that two streams are equal, bit for bit."""
    assert len(a) > 0
    for name in "txyp":
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def by_pixel(events: dase.Events) -> list[np.ndarray]:
    """Return (t, p) of every pixel's events, in order."""
    place = events.y.astype(int) * events.width + events.x
    pairs = np.stack([events.t, events.p], -1)
    return [pairs[place == i] for i in range(events.width * events.height)]


def differing(a: np.ndarray, b: np.ndarray) -> float:
    """Return the share of counts that differ."""
    assert a.shape == b.shape
    assert a.sum() > 0
    return float(np.mean(a != b))


def tracks(events: dase.Events) -> list[np.ndarray]:
    """Return the event times of every pixel [s]."""
    place = events.y.astype(int) * events.width + events.x
    order = np.argsort(place, kind="stable")
    ends = np.cumsum(np.bincount(place, minlength=events.width * events.height))
    return np.split(events.t[order], ends[:-1])


def distance(values: np.ndarray, distribution: np.ndarray) -> float:
    """Return the Kolmogorov-Smirnov distance of sorted values to their distribution function, times √n."""
    n = len(values)
    steps = np.arange(n + 1) / n
    return float(max(np.max(steps[1:] - distribution), np.max(distribution - steps[:-1])) * np.sqrt(n))


KS = 1.63
"""Kolmogorov-Smirnov distance that one sample in a hundred exceeds."""
