"""How far light goes from one event of a pixel to the next: its threshold, whatever a model fits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.effects.vignetting import square_from_middle
from dase.events import Events
from dase.fitting.held_events import rows_with_most_events
from dase.fitting.measurement import Measurement
from dase.probes.stimulus import log_light_beside, log_light_of
from dase.scenes.between_frames import CameraScene
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate

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

    def blocks(self, width: int, size: int) -> NDArray[np.int64]:
        """Return the block of `size` x `size` pixels that each event is in, shape (N,).

        Args:
            width: Columns of the sensor.
            size: Of a block [px].
        """
        rows, columns = np.divmod(self.pixel, width)
        out: NDArray[np.int64] = rows // size * (width // size + 1) + columns // size
        return out


@dataclass(frozen=True, eq=False)
class LightBetweenEvents:
    """The light of the rows of a measurement that are looked at, and how far it goes between events there.

    Args:
        measurement: Its scene is known at all times.
        times: At which light is known, ascending [s], shape (T,).
        rows: First row that is looked at, and the row after the last.
        log_eps: Added to intensities before the logarithm.
        settings: What counts.
    """

    measurement: Measurement
    times: Array
    rows: tuple[int, int]
    log_eps: float
    settings: StepSettings = STEPS

    @classmethod
    def of(
        cls, measurement: Measurement, *, log_eps: float, settings: StepSettings = STEPS
    ) -> LightBetweenEvents | None:
        """Return that of the rows with the most events; None where light is known in part, or none is sent.

        Args:
            measurement: Of which the time that is compared is looked at.
            log_eps: Added to intensities before the logarithm.
            settings: What counts.
        """
        if isinstance(measurement.scene, CameraScene) or measurement.trust is not None:
            return None
        events, times = measurement.compared_events(), times_that_are_compared(measurement)
        if len(times) < 2 or not len(events):
            return None
        return cls(measurement, times, busiest_rows(events, len(times), settings), log_eps, settings)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows that are looked at, and columns."""
        return self.rows[1] - self.rows[0], self.measurement.scene.width

    @cached_property
    def brightest(self) -> float:
        """Log intensity of the brightest light of the rows but for a hundredth, at some fifty instants."""
        return float(np.quantile(self.level(every=max(1, len(self.times) // 50)), 0.99))

    def level(self, every: int = 1) -> NDArray[np.float32]:
        """Return the log intensity of the pixels of the rows, of every so many instants, shape (T, P)."""
        return log_light_of(
            self.measurement.scene, self.times[::every], self._pixels.astype(np.int32), log_eps=self.log_eps
        )

    @cached_property
    def seen(self) -> LightSteps:
        """What light does between the events of the measurement."""
        return self.steps_between(self.measurement.compared_events())

    def square_from_middle(self, steps: LightSteps) -> Array:
        """Return the square distance of the pixels of steps from the middle, in units of the corner's, (N,).

        Args:
            steps: In light of these rows.
        """
        scene = self.measurement.scene
        row, column = np.divmod(steps.pixel, scene.width)
        return square_from_middle(column, row + self.rows[0], scene.width, scene.height)

    def of_model(self, sensor: Sensor, *, seed: int) -> LightSteps:
        """Return what light does between the events that a model sends over the same scene.

        Args:
            sensor: The model.
            seed: Of its random numbers.

        Raises:
            InputError: It cannot be simulated.
        """
        made = simulate(self.measurement.scene, sensor, seed=seed, pixels=self._pixels)
        return self.steps_between(replace(self.measurement, events=made).compared_events())

    def steps_between(self, events: Events) -> LightSteps:
        """Return how far light went from each event of a pixel to the next.

        Args:
            events: Of the whole sensor, in order of time.
        """
        first, after = self.rows
        events = events.select((events.y >= first) & (events.y < after))
        pixel = (events.y.astype(np.int64) - first) * events.width + events.x
        level, speed = self._level_and_speed(pixel, events.t)
        order = np.lexsort((events.x, events.y))
        pixel, t, p = pixel[order], events.t[order], np.asarray(events.p, bool)[order]
        level, speed = level[order], speed[order]
        darkest = np.quantile(level, 0.99) + math.log(self.settings.darkest) if len(level) else 0.0
        gap = np.diff(t)
        counts = (pixel[1:] == pixel[:-1]) & (gap > 0) & (np.minimum(level[1:], level[:-1]) > darkest)
        return LightSteps(
            pixel[1:], np.diff(level), gap, level[1:], speed[1:], p[1:], p[1:] == p[:-1], counts
        )

    @property
    def _pixels(self) -> NDArray[np.int64]:
        """Row-major indices of the pixels of the rows, shape (P,)."""
        width = self.measurement.scene.width
        return np.arange(self.rows[0] * width, self.rows[1] * width, dtype=np.int64)

    def _level_and_speed(self, pixel: NDArray[np.int64], t: Array) -> tuple[Array, Array]:
        """Return the log intensity at events, and how fast it changes [1/s], shape (N,) each.

        Args:
            pixel: Of each event, row-major within the rows, shape (N,).
            t: Time of each, ascending [s], shape (N,).
        """
        times = self.times
        at = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        gap = times[at + 1] - times[at]
        share = np.clip((t - times[at]) / gap, 0.0, 1.0)
        here, there = log_light_beside(
            self.measurement.scene, times, self._pixels.astype(np.int32), at, pixel, log_eps=self.log_eps
        )
        step = there - here
        return here + step * share, step / gap


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
    most = min(settings.samples // (instants * events.width), events.height * settings.events // len(events))
    return rows_with_most_events(events, most)


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
