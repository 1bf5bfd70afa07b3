"""What a model sends at some pixels, to be held against what was measured there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dase.effects.stream import StreamEffect
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate


def count_at_pixels(events: Events, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many events pixels send, shape (K,).

    Args:
        events: Of the whole sensor.
        pixels: Row-major, shape (K,).
    """
    at = events.y.astype(np.int64) * events.width + events.x
    return np.bincount(at, minlength=events.width * events.height)[pixels]


def count_of_model(
    measurement: Measurement, sensor: Sensor, pixels: NDArray[np.int64], *, seed: int
) -> NDArray[np.int64]:
    """Return how many events a model without its bus sends at pixels while it is compared, shape (K,).

    A bus needs the events of all pixels, and leaves of these what tells of them.

    Args:
        measurement: Its scene is simulated.
        sensor: The model.
        pixels: Row-major, ascending, shape (K,).
        seed: Of its random numbers.
    """
    alone = replace(sensor, effects=tuple(e for e in sensor.effects if not isinstance(e, StreamEffect)))
    made = simulate(measurement.scene, alone, seed=seed, pixels=pixels)
    return count_at_pixels(replace(measurement, events=made).compared_events(), pixels)
