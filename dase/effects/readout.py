"""The bus from the pixels to the world, which takes one event at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.stream import Others, SharedReader, StreamEffect
from dase.events import Events
from dase.kernels import launch
from dase.kernels.event_queue import NEVER, ONE, send_over_bus


class Bus(SharedReader):
    """Sends events one after the other."""

    def __init__(self, service: int, patience: int):
        self._service, self._patience = service, patience  # [ps]
        self._cpu = launch.find_device("cpu")
        self._busy = np.array([NEVER], np.int64)  # until when [ps]

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give all events that find room, at the times at which they are through, be it after `until`."""
        empty = Others(np.empty(0, np.int64), np.empty(0, np.uint8))
        return self.beside(events, empty, np.ones(2)), until

    def beside(self, events: Events, others: Others, weight: NDArray[np.float64]) -> Events:
        """Return those of some events that find room beside others, see `SharedReader.beside`.

        Args:
            events: Sorted by time.
            others: They take room and time, and are not returned.
            weight: How many OFF and ON events each of the others stands for, shape (2,).
        """
        through = np.empty(len(events))
        columns = (
            (events.t, wp.float64), (others.time, wp.int64), (others.polarity, wp.uint8),
            (np.rint(weight * ONE).astype(np.int64), wp.int64), (self._busy, wp.int64), (through, wp.float64),
        )  # fmt: skip
        arrays = [wp.array(a, dtype=d, device=self._cpu, copy=False) for a, d in columns]
        inputs = [*arrays[:4], wp.int64(self._service), wp.int64(self._patience), *arrays[4:]]
        wp.launch(send_over_bus, dim=1, inputs=inputs, device=self._cpu)
        sent = ~np.isnan(through)
        if not sent.all():
            events, through = events.select(sent), through[sent]
        return replace(events, t=through)


@dataclass(frozen=True, kw_only=True)
class Readout(StreamEffect):
    """A bus of limited bandwidth between the pixels and the file.

    All pixels share one way out, which takes one event at a time. When many ask at once, as when the whole
    scene moves or flickers, events queue up and come late, and when the queue is full they are lost. Then
    the event rate stays at its limit whatever happens in the scene.

    Sending an event takes 1/`rate`, and its time is that at which it is through. With `mode = "delay"`, up
    to `depth` events are in the queue, the one being sent among them; an event that finds no place is lost.
    With `mode = "drop"` there is no queue: an event that finds the bus busy is lost.
    """

    name: ClassVar[str] = "readout"
    source: ClassVar[str] = (
        "Boahen: Point-to-point connectivity between neuromorphic chips using address events, 2000; "
        "Finateu et al.: A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor "
        "with 4.86 um pixels, 1.066 GEPS readout, programmable event-rate controller and compressive "
        "data-formatting pipeline, 2020"
    )
    per_pixel: ClassVar[bool] = False

    rate: float = parameter(
        1e7,
        unit="Hz",
        off=math.inf,
        bounds=(1.0, math.inf),
        plausible=(5e5, 1e9),
        about="most events per second, of the whole sensor",
        starts="above",  # the most events per second that were seen are the least it can send
    )
    depth: float = parameter(
        4096.0,
        unit="1",
        bounds=(1.0, math.inf),
        plausible=(1.0, 1e6),
        about="events that the queue holds in mode delay",
        fitted=False,  # of a queue that is never full, nothing tells the length
    )
    mode: str = choice("delay", among=("delay", "drop"), about="what becomes of events while the bus is busy")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return buses of the highest rate that was seen, none where even that leaves any bus idle."""
        if observed.bus_is_idle:
            return []
        return [replace(bus, rate=observed.highest_event_rate) for bus in cls.variants()]

    def for_share(self, share: float) -> Readout:
        """Return the bus with as much of its bandwidth and of its queue as a share of the pixels has."""
        return replace(self, rate=self.rate * share, depth=max(1.0, self.depth * share))

    def reader(self, width: int, height: int, seed: int) -> Bus:
        """Return the bus of one sensor."""
        service = 0 if self.rate == math.inf else round(1e12 / self.rate)
        room = 0.0 if self.mode == "drop" else self.depth - 1
        return Bus(service, round(min(room * service, 2.0**61)) if service else 0)
