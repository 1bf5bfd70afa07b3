"""Events by time: how many each tile of the sensor sends in each half millisecond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events


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
        self._column = np.arange(width) * self.settings.tiles // width
        self._row = np.arange(height) * self.settings.tiles // height * self.settings.tiles
        self._counts = np.zeros((0, 2, self.settings.tiles**2), np.uint32)
        self._used = 0

    def push(self, events: Events) -> None:
        """Take events that follow those before."""
        if not len(events):
            return
        if not self._used:
            self.begin = float(events.t[0])
        step = self.settings.step
        inside = np.searchsorted(events.t, self.begin + self.settings.longest)
        bins = ((events.t[:inside] - self.begin) / step).astype(np.int64)
        start = 0
        while start < inside:
            # the table of a quiet recording is mostly empty: not more than two seconds of it at once
            first = int(bins[start])
            stop = int(np.searchsorted(bins, first + int(2 / step)))
            self._add(events, bins, slice(start, stop))
            start = stop

    def _add(self, events: Events, bins: NDArray[np.int64], part: slice) -> None:
        cells = 2 * self.settings.tiles**2
        first, last = int(bins[part.start]), int(bins[part.stop - 1])
        tile = self._row[events.y[part]] + self._column[events.x[part]]
        place = (bins[part] - first) * cells + events.p[part] * (cells // 2) + tile
        found = np.bincount(place, minlength=(last + 1 - first) * cells)
        if last >= len(self._counts):
            most = int(round(self.settings.longest / self.settings.step)) + 1
            room = np.zeros((min(max(2 * last, 2000), most), *self._counts.shape[1:]), np.uint32)
            room[: len(self._counts)] = self._counts
            self._counts = room
        self._counts[first : last + 1] += found.reshape(-1, 2, cells // 2).astype(np.uint32)
        self._used = max(self._used, last + 1)

    @property
    def counts(self) -> NDArray[np.uint32]:
        """Events by step, polarity (OFF, ON) and row-major tile, shape (K, 2, tiles²)."""
        return self._counts[: self._used]

    @property
    def times(self) -> NDArray[np.float64]:
        """Middle of each step [s], shape (K,)."""
        steps = np.arange(self._used, dtype=np.float64)
        return self.begin + (steps + 0.5) * self.settings.step
