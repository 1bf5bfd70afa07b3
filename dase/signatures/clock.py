"""Events by time: how many each tile of the sensor sends in each half millisecond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.kernels import launch
from dase.kernels.event_groups import count_by_time_and_tile


@dataclass(frozen=True)
class ClockSettings:
    """How time and sensor are divided."""

    step: float = 5e-4  # [s] tones up to 900 Hz; bursts of a whole array last 1 to 3 ms
    tiles: int = 8  # on each side: enough that what moves fills few of them, few enough that each has events
    longest: float = 60.0  # [s] a table of more would grow with the recording; lamps and frames need no more


class ClockCounts:
    """Counts events by time, polarity and tile.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        settings: How time and sensor are divided.
    """

    def __init__(self, width: int, height: int, settings: ClockSettings | None = None):
        self.settings = settings or ClockSettings()
        self.begin = 0.0
        """When the first step begins [s]."""
        tiles = self.settings.tiles
        self._column = np.arange(width, dtype=np.int32) * tiles // width
        self._row = np.arange(height, dtype=np.int32) * tiles // height * tiles
        self._counts = np.zeros((0, 2, self.settings.tiles**2), np.uint32)
        self._used = 0

    def push(self, events: Events) -> None:
        """Take events that follow those before."""
        if not len(events):
            return
        if not self._used:
            self.begin = float(events.t[0])
        step = self.settings.step
        part = events.select(slice(int(np.searchsorted(events.t, self.begin + self.settings.longest))))
        if not len(part):
            return
        self._make_room(int((part.t[-1] - self.begin) / step) + 1)
        columns = part.t, part.x, part.y, part.p
        launch.run_on_arrays(
            count_by_time_and_tile, *columns, self.begin, step, self._row, self._column, self._counts
        )

    def _make_room(self, steps: int) -> None:
        """Take up so many steps of the table, which grows by doubling up to the longest time."""
        if steps > len(self._counts):
            most = int(round(self.settings.longest / self.settings.step)) + 1
            room = np.zeros((min(max(2 * steps, 2000), most), *self._counts.shape[1:]), np.uint32)
            room[: len(self._counts)] = self._counts
            self._counts = room
        self._used = max(self._used, steps)

    @property
    def counts(self) -> NDArray[np.uint32]:
        """Events by step, polarity (OFF, ON) and row-major tile, shape (K, 2, tiles²)."""
        return self._counts[: self._used]

    @property
    def times(self) -> NDArray[np.float64]:
        """Middle of each step [s], shape (K,)."""
        steps = np.arange(self._used, dtype=np.float64)
        return self.begin + (steps + 0.5) * self.settings.step
