"""How far light goes from one event of a pixel to the next: its threshold, whatever a model fits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.probes.stimulus import light_of
from dase.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepSettings:
    """Which events are looked at."""

    darkest: float = 0.1
    """Light from which on events count, relative to the brightest: in the dark steps of 8 bits are as large
    as a threshold."""

    samples: int = 40_000_000
    """Intensities that are looked at, pixels times instants, at most."""

    events: int = 2_000_000
    """Events that are looked at, at most."""

    bins: int = 10
    """Of light and of its speed, with as many events in each."""


STEPS = StepSettings()


@dataclass(frozen=True, eq=False)
class LightSteps:
    """From each event of a pixel to the next one, pixel by pixel and in order of time.

    Args:
        pixel: Row-major within the rows that are looked at, shape (N,).
        change: Of the log intensity, shape (N,).
        gap: Time from one event to the next [s], shape (N,).
        level: Log intensity at the later event, shape (N,).
        speed: How fast it changes there [1/s], shape (N,).
        on: Whether the later event is ON, shape (N,).
        again: Whether the one before had the same polarity, shape (N,).
        counts: Whether both are in light that tells, shape (N,).
    """

    pixel: NDArray[np.int64]
    change: Array
    gap: Array
    level: Array
    speed: Array
    on: NDArray[np.bool_]
    again: NDArray[np.bool_]
    counts: NDArray[np.bool_]


def times_that_are_compared(measurement: Measurement) -> Array:
    """Return the instants at which the light of the time that is compared is known [s], shape (T,)."""
    times = measurement.scene.sample_times()
    if measurement.span is None:
        return times
    begin, end = measurement.span
    return times[(times >= begin) & (times <= end)]


def busiest_rows(events: Events, instants: int, settings: StepSettings = STEPS) -> tuple[int, int]:
    """Return the rows with the most events, as many as are looked at: the first, and the one after the last.

    Args:
        events: Of the whole sensor, at least one.
        instants: At which light is looked at.
        settings: How much that may be.
    """
    per_row = np.bincount(events.y, minlength=events.height)
    most = min(settings.samples // (instants * events.width), events.height * settings.events // len(events))
    most = min(max(most, 8), events.height)
    total = np.concatenate([[0], np.cumsum(per_row)])
    first = int(np.argmax(total[most:] - total[:-most]))
    return first, first + most


def light_steps(
    events: Events,
    scene: Scene,
    times: Array,
    *,
    rows: tuple[int, int],
    log_eps: float,
    settings: StepSettings = STEPS,
) -> LightSteps:
    """Return how far light went from each event of a pixel to the next.

    Args:
        events: In order of time.
        scene: What they are of.
        times: At which its light is known, ascending [s], shape (T,).
        rows: First row that is looked at, and the row after the last.
        log_eps: Added to intensities before the logarithm.
        settings: What counts.
    """
    width = scene.width
    events = events.select((events.y >= rows[0]) & (events.y < rows[1]))
    pixel = (events.y.astype(np.int64) - rows[0]) * width + events.x
    order = np.lexsort((events.x, events.y))
    pixel, t, p = pixel[order], events.t[order], np.asarray(events.p, bool)[order]
    level, speed = _light_at(scene, times, pixel + rows[0] * width, t, log_eps, settings)
    darkest = np.quantile(level, 0.99) + math.log(settings.darkest) if len(level) else 0.0
    gap = np.diff(t)
    counts = (pixel[1:] == pixel[:-1]) & (gap > 0) & (np.minimum(level[1:], level[:-1]) > darkest)
    return LightSteps(pixel[1:], np.diff(level), gap, level[1:], speed[1:], p[1:], p[1:] == p[:-1], counts)


def beyond_those_alike(
    off: Array, level: Array, speed: Array, again: NDArray[np.bool_], settings: StepSettings = STEPS
) -> Array:
    """Return values less the mean of the events that are alike in light, its speed, and the event before.

    Args:
        off: Of each event, shape (N,).
        level: Log intensity there, shape (N,).
        speed: How fast it changes there [1/s], shape (N,).
        again: Whether the event before had the same polarity, shape (N,).
        settings: How finely light and its speed are told apart.
    """
    bins = settings.bins

    def bin_of(values: Array) -> NDArray[np.int64]:
        edges = np.quantile(values, np.arange(1, bins) / bins)
        out: NDArray[np.int64] = np.searchsorted(edges, values)
        return out

    cell = (bin_of(level) * bins + bin_of(speed)) * 2 + again
    count = np.bincount(cell, minlength=2 * bins * bins)
    mean = np.bincount(cell, off, minlength=2 * bins * bins) / np.maximum(count, 1)
    out: Array = off - mean[cell]
    return out


def _light_at(
    scene: Scene, times: Array, pixel: NDArray[np.int64], t: Array, log_eps: float, settings: StepSettings
) -> tuple[Array, Array]:
    """Return the log intensity at events, and how fast it changes [1/s], shape (N,) each.

    Args:
        scene: What they are of.
        times: At which its light is known, ascending [s], shape (T,).
        pixel: Of each event, row-major, ascending, shape (N,).
        t: Time of each [s], shape (N,).
        log_eps: Added to intensities before the logarithm.
        settings: How many intensities are held at once.
    """
    at = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    share = np.clip((t - times[at]) / (times[at + 1] - times[at]), 0.0, 1.0)
    level, speed = np.empty(len(t)), np.empty(len(t))
    asked = np.unique(pixel)
    many = max(1, settings.samples // (8 * len(times)))
    for n in range(0, len(asked), many):
        some = asked[n : n + many].astype(np.int32)
        first, last = np.searchsorted(pixel, [some[0], some[-1] + 1])
        row = np.searchsorted(some, pixel[first:last])
        known = np.log(light_of(scene, times, some) + np.float32(log_eps))
        here, there = known[row, at[first:last]], known[row, at[first:last] + 1]
        level[first:last] = here + (there - here) * share[first:last]
        speed[first:last] = (there - here) / (times[at[first:last] + 1] - times[at[first:last]])
    return level, speed
