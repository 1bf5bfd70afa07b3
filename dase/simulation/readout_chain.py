"""What leaves a camera: the stream of its pixels' events behind its readout effects."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dase.effects.stream import StreamEffect, to_nanoseconds
from dase.errors import InputError
from dase.events import Events
from dase.simulation.sensor import Sensor


class ReadoutChain:
    """The way out of a camera: its readout effects in the order in which the sensor has them.

    Effects that are switched off are left out, so that the stream passes as it is, bit for bit.

    Args:
        sensor: Whose effects.
        width: Columns of the sensor.
        height: Rows of the sensor.
        pixels: How many pixels are simulated; None for all.
        seed: Of every random number.
        part: Events that go through the effects at once: few enough to be sorted within the caches.
    """

    def __init__(
        self,
        sensor: Sensor,
        width: int,
        height: int,
        *,
        pixels: int | None = None,
        seed: int = 0,
        part: int = 1 << 17,
    ):
        effects = [e for e in sensor.effects if isinstance(e, StreamEffect) and not e.is_off()]
        for effect in effects:
            if not effect.per_pixel and pixels not in (None, width * height):
                raise InputError(
                    f"effect '{effect.name}' needs all {width * height} pixels of the sensor, got {pixels}; "
                    "leave it out or simulate them all"
                )
        self._part = part
        self._empty = Events.empty(width, height)
        self._readers = [effect.reader(width, height, seed) for effect in effects]

    def push(self, events: Events, until: float) -> Events:
        """Return what leaves after a part of the stream; a later part brings what comes late.

        Args:
            events: Sorted by time; they follow those of the parts before.
            until: No later part begins earlier [s].

        Returns:
            Events sorted by time; they follow those returned before.
        """
        if not self._readers:
            return events
        latest = (
            4e6  # [s] readers reckon in whole picoseconds of 64 bits, which hold some nine million seconds
        )
        if len(events) and max(-events.t[0], events.t[-1]) > latest:
            raise InputError(
                f"readout effects need times within {latest:g} s of 0, "
                f"got {events.t[0]:g}..{events.t[-1]:g} s"
            )
        out = []
        for i in range(0, max(len(events), 1), self._part):
            # of a part, too, it is known that nothing earlier than the next event follows
            end = float(events.t[i + self._part]) if i + self._part < len(events) else until
            out.append(self._through_readers(events.select(slice(i, i + self._part)), end))
        return Events.concatenate(out)

    def _through_readers(self, events: Events, until: float) -> Events:
        for reader in self._readers:
            events, until = reader.push(events, until)
        return events

    def flush(self) -> Events:
        """Return what is still inside; the stream is over."""
        return self.push(self._empty, math.inf)  # nothing earlier than the end of time can follow


class WindowCounter:
    """Counts the events that leave a camera, per window and pixel.

    Args:
        edges: Window edges [s], increasing, shape (W + 1,); a window holds edge < t <= next edge, as counting
            at the pixels has it.
        pixels: Row-major indices of the pixels, no two alike, shape (N,).
        size: Pixels of the sensor.
    """

    def __init__(self, edges: NDArray[np.float64], pixels: NDArray[np.int32], size: int):
        self._edges = to_nanoseconds(edges)
        self._place = np.full(size, -1)
        self._place[pixels] = np.arange(len(pixels))
        if np.count_nonzero(self._place >= 0) != len(pixels):
            raise InputError("pixels must differ where events are counted behind a readout effect")
        self.counts = np.zeros((len(edges) - 1, 2, len(pixels)), np.int32)

    def add(self, events: Events) -> None:
        """Count a part of the stream."""
        windows = np.searchsorted(self._edges, to_nanoseconds(events.t), side="left") - 1
        inside = (windows >= 0) & (windows < len(self.counts))
        if not inside.any():
            return
        events, windows = events.select(inside), windows[inside]
        place = self._place[events.y.astype(np.int64) * events.width + events.x]
        # times ascend, and with them windows: only those of this part are touched
        low, high = int(windows[0]), int(windows[-1]) + 1
        shape = (high - low, *self.counts.shape[1:])
        flat = np.ravel_multi_index((windows - low, events.p.astype(np.int64), place), shape)
        self.counts[low:high] += np.bincount(flat, minlength=math.prod(shape)).reshape(shape).astype(np.int32)


def split_by_row(events: Events, row: NDArray[np.int32] | None, batch: int) -> Sequence[Events]:
    """Return the stream of each row of a batch; `row` (N,) has that of each event, None all in one."""
    if row is None:
        return [events]
    # stable, so that each stream stays in order of time; rows as small integers are sorted by their digits
    order = np.argsort(row.astype(np.uint16) if batch <= 1 << 16 else row, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(row, minlength=batch))[:-1])
    return [events.select(part) for part in parts]
