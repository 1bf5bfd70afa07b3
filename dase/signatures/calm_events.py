"""Events with nothing around them: what a pixel sends by itself, where no edge passes."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.events import Events
from dase.kernels import launch
from dase.kernels.event_groups import count_busy_cells, measure_intervals
from dase.kernels.event_neighbours import mark_crowded


def row_major_pixels(events: Events) -> NDArray[np.int32]:
    """Return the pixel of each event, shape (N,)."""
    return events.y.astype(np.int32) * np.int32(events.width) + events.x


def intervals_of_pixels(events: Events) -> NDArray[np.float64]:
    """Return the time since the event before of the same pixel [s], shape (N,); inf where there is none."""
    last, out = np.full(events.width * events.height, -np.inf), np.empty(len(events))
    launch.run_on_arrays(measure_intervals, events.t, row_major_pixels(events), last, out)
    return out


class CalmFilter:
    """Tells which events are calm: no other pixel near by is active shortly before or after.

    Events come in pieces; an answer needs those that follow, so the last ones are held back.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        gap: How long before and after [s].
        reach: How many columns and rows away [px].
    """

    def __init__(self, width: int, height: int, *, gap: float = 0.02, reach: int = 2):
        self.gap, self.reach = gap, reach
        self._cpu = launch.find_device("cpu")
        self._last = np.full(width * height, -np.inf)
        self._held = Events.empty(width, height)
        self._crowded = np.empty(0, np.uint8)

    def push(self, events: Events) -> tuple[Events, NDArray[np.bool_]]:
        """Take events, and return those that are settled, and which of them are calm, shape (N,)."""
        before = np.zeros(len(events), np.uint8)
        self._mark(events.t, row_major_pixels(events), self._last, before, events)
        self._crowded = np.concatenate((self._crowded, before))
        self._held = Events.concatenate([self._held, events]) if len(self._held) else events
        newest = self._held.t[-1] if len(self._held) else 0.0
        return self._release(int(np.searchsorted(self._held.t, newest - self.gap)))

    def flush(self) -> tuple[Events, NDArray[np.bool_]]:
        """Return the events held back, when nothing follows them, and which of them are calm, shape (N,)."""
        return self._release(len(self._held))

    def _release(self, count: int) -> tuple[Events, NDArray[np.bool_]]:
        """Return the first of those held; all that may crowd them have come."""
        held = self._held
        later = np.zeros(len(held), np.uint8)
        backward = np.ascontiguousarray(row_major_pixels(held)[::-1])
        self._mark(-held.t[::-1], backward, np.full(len(self._last), -np.inf), later, held)
        calm = (self._crowded == 0) & (later[::-1] == 0)
        self._held, self._crowded = held.select(slice(count, None)), self._crowded[count:]
        return held.select(slice(0, count)), calm[:count]

    def _mark(
        self,
        t: NDArray[np.float64],
        pixel: NDArray[np.int32],
        last: NDArray[np.float64],
        crowded: NDArray[np.uint8],
        events: Events,
    ) -> None:
        if not len(t):
            return
        columns = (
            (np.ascontiguousarray(t), wp.float64),
            (pixel, int),
            (last, wp.float64),
            (crowded, wp.uint8),
        )
        time, place, seen, out = (wp.array(a, dtype=d, device=self._cpu, copy=False) for a, d in columns)
        inputs = [time, place, wp.float64(self.gap), self.reach, events.width, events.height, seen, out]
        wp.launch(mark_crowded, dim=1, inputs=inputs, device=self._cpu)


class CalmShare:
    """Estimates at which share of places and times an event would be calm: what could have been seen.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        begin: Of the recording [s].
        filter: What calm means.
    """

    def __init__(self, width: int, height: int, begin: float, filter: CalmFilter):
        self._side, self._span, self._begin = 2 * filter.reach + 1, 2 * filter.gap, begin
        self._newest = np.full((-(-height // self._side), -(-width // self._side)), -1)
        self._busy = np.zeros(1, np.int32)

    def push(self, events: Events) -> None:
        """Take events that follow those before."""
        where = events.t, events.x, events.y
        launch.run_on_arrays(
            count_busy_cells, *where, self._begin, self._span, self._side, self._newest, self._busy
        )

    def share(self, end: float) -> float:
        """Return the share of cells of space and time without an event, from begin to `end` [s]."""
        spans = int((end - self._begin) / self._span) + 1
        return max(0.0, 1 - int(self._busy[0]) / (spans * self._newest.size))
