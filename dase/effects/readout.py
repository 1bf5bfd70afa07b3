"""The bus from the pixels to the world, which takes one event at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.stream import Others, SharedReader, StreamEffect, to_nanosecond
from dase.events import Events
from dase.kernels import launch, line_arbiter
from dase.kernels.event_queue import NEVER, ONE, send_over_bus
from dase.kernels.line_arbiter import ArbiterNumber, PixelByte, PixelColumn

BUSY = 0.8
"""Share of the time for which a bus that makes events wait is busy before that shows: with random arrivals an
event waits for two others on average there, and ever longer above."""


class Bus(SharedReader):
    """Sends events one after the other."""

    def __init__(self, service: int, patience: int):
        self._service, self._patience = service, patience  # [ps]
        self._cpu = launch.find_device("cpu")
        self._busy = np.array([NEVER], np.int64)  # until when [ps]

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give all events that find room, at the times at which they are through, be it after `until`."""
        return self.beside(events, Others.none(), np.ones(2)), until

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


class LineArbiter(SharedReader):
    """Reads a line of pixels at a time, and holds those that wait.

    Args:
        per_line: Time to take a line [ps].
        per_event: Time to send one of its events [ps].
        width: Columns of the sensor.
        height: Rows of the sensor.
        by_columns: Whether lines are columns.
    """

    def __init__(self, per_line: int, per_event: int, width: int, height: int, by_columns: bool):
        self._per_line, self._per_event, self._by_columns = per_line, per_event, by_columns
        self._width, self._height = width, height
        lines, across = (width, height) if by_columns else (height, width)
        self._shift = (across - 1).bit_length()
        size = lines << self._shift
        self._labelled = False
        numbers = np.zeros(len(ArbiterNumber), np.int64)
        # pixels of half a cache line, none of which lies in two
        store = np.zeros(4 * size + 7, np.int64)
        known = store[-(store.ctypes.data // 8) % 8 :][: 4 * size].reshape(size, 4)
        known[:, [PixelColumn.LAST, PixelColumn.FREED]] = line_arbiter.NEVER
        numbers[ArbiterNumber.FREE] = line_arbiter.NEVER
        room = 2 * width * height + 64  # requests that come late, those taken back among them
        slots, nodes = line_arbiter.SLOTS, line_arbiter.NODES
        self._state: dict[str, NDArray[Any]] = {
            "known": known, "waiting": np.zeros((lines, -(-across // 64)), np.int64),
            "line_words": np.zeros(lines, np.int64), "line_since": np.zeros(lines, np.int64),
            "line_count": np.zeros(lines, np.int32), "line_queue": np.zeros(lines, np.int32),
            "heap_due": np.zeros(room, np.int64), "heap_what": np.zeros(room, np.int64),
            "wheel": np.zeros(slots, np.int32), "wheel_bits": np.zeros(slots // 64, np.int64),
            "node_due": np.zeros(nodes, np.int64), "node_what": np.zeros(nodes, np.int64),
            "node_after": np.zeros(nodes, np.int32), "recent": np.zeros(line_arbiter.RECENT, np.int32),
            "numbers": numbers,
        }  # fmt: skip

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events of lines that are taken before `until`."""
        return self._read(events, Others.none(), np.ones(2), until), until

    def beside(self, events: Events, others: Others, weight: NDArray[np.float64]) -> Events:
        """Return those of some events that find room beside others, see `SharedReader.beside`.

        Args:
            events: Sorted by time.
            others: Their pixels wait and are read as well, and are not returned.
            weight: How many OFF and ON events each of the others stands for, shape (2,).
        """
        return self._read(events, others, weight, math.inf)

    def _read(self, events: Events, others: Others, weight: NDArray[np.float64], until: float) -> Events:
        self._labelled |= events.label is not None
        label = np.empty(0, np.int8) if events.label is None else events.label
        if len(others.time):
            pixel_bytes = self._state["known"].view(np.uint8)
            pixel_bytes[self._places(others.x, others.y), PixelByte.OTHER] = 1
        room = len(events) + int(self._state["numbers"][ArbiterNumber.HELD])
        out_time, out_label = np.empty(room, np.float64), np.empty(room, np.int8)
        out_x, out_y = np.empty(room, np.uint16), np.empty(room, np.uint16)
        out_polarity = np.empty(room, np.bool_)
        end = line_arbiter.END if until == math.inf else 1000 * to_nanosecond(until)
        if len(events):
            # pixels with a latency hold events back, and give them up at the end: later than is simulated
            end = max(end, 1000 * to_nanosecond(float(events.t[-1])))
        device = launch.find_device("cpu")

        def array(values: NDArray[Any], dtype: Any) -> Any:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device, copy=False)

        inputs = [
            array(events.t, wp.float64), array(events.x, wp.uint16), array(events.y, wp.uint16),
            array(events.p.view(np.uint8), wp.uint8), array(label, wp.int8), array(others.time, wp.int64),
            array(self._places(others.x, others.y), wp.int32), array(others.polarity, wp.uint8),
            array(np.rint(weight * ONE).astype(np.int64), wp.int64), wp.int64(end), self._shift,
            self._by_columns, wp.int64(self._per_line), wp.int64(self._per_event),
            line_arbiter.slot_shift(self._per_line, self._per_event),
            *(array(v, wp.dtype_from_numpy(v.dtype)) for v in self._state.values()),
            array(out_time, wp.float64), array(out_x, wp.uint16), array(out_y, wp.uint16),
            array(out_polarity.view(np.uint8), wp.uint8), array(out_label, wp.int8),
        ]  # fmt: skip
        wp.launch(line_arbiter.send_by_lines, dim=1, inputs=inputs, device=device)
        sent = slice(int(self._state["numbers"][ArbiterNumber.SENT]))
        return Events(
            out_time[sent], out_x[sent], out_y[sent], out_polarity[sent], self._width, self._height,
            out_label[sent] if self._labelled else None,
        )  # fmt: skip

    def _places(self, x: NDArray[np.uint16], y: NDArray[np.uint16]) -> NDArray[np.int32]:
        line, across = (x, y) if self._by_columns else (y, x)
        return (line.astype(np.int32) << self._shift) + across


@dataclass(frozen=True, kw_only=True)
class Readout(StreamEffect):
    """A bus of limited bandwidth between the pixels and the file.

    All pixels share one way out. When many ask at once, as when the whole scene moves or flickers, events
    queue up and come late, and what finds no room is lost. Then the event rate stays at its limit whatever
    happens in the scene.

    With `mode = "rows"` or `"columns"` an arbiter takes a line of pixels at a time, as those of DAVIS cameras
    do: the line whose first request is oldest, with all its pixels that ask by then. Their events get one
    time stamp, that at which the line is taken, so many events tie with the one before. Reading it takes
    `line` and 1/`rate` for each event. A pixel that waits or is being read is held in reset: it asks once,
    however much the light changes meanwhile, and its memory is the light at the end. On a steady ramp it
    sends at intervals of its own plus the time for which it was held. A sensor that all pixels fill sends
    W / (`line` + W / `rate`) events per second from lines of W pixels, each pixel one in L (`line` +
    W / `rate`) of L lines. Pixels are simulated before the readout, so how far the light has gone on when a
    pixel is let go is told by its own events, by a parabola through three of them.

    With `mode = "delay"` events are sent one by one whatever row they come from, each in 1/`rate`, and its
    time is that at which it is through. Up to `depth` events are in the queue, the one being sent among them;
    an event that finds no place is lost. With `mode = "drop"` there is no queue: an event that finds the bus
    busy is lost.
    """

    name: ClassVar[str] = "readout"
    source: ClassVar[str] = (
        "Boahen: Point-to-point connectivity between neuromorphic chips using address events, 2000; "
        "Boahen: A burst-mode word-serial address-event link, 2004 (a row at a time); "
        "Finateu et al.: A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor "
        "with 4.86 um pixels, 1.066 GEPS readout, programmable event-rate controller and compressive "
        "data-formatting pipeline, 2020"
    )
    per_pixel: ClassVar[bool] = False
    signatures: ClassVar = (
        Makes("full bus", tells=True),
        Makes("grouping"),
        Makes("time stamps"),
    )
    screen_limits: ClassVar = {
        "": "a full bus wants more events at once: flashes of an LED that all pixels see, or a fast print",
    }

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
    line: float = parameter(
        4.2e-7,
        unit="s",
        bounds=(0.0, 1e-2),
        plausible=(1e-8, 5e-6),
        about="time to take a row or column, in modes rows and columns; default from a DAVIS240C whose bus "
        "was never free: 0.53 us for 1.27 events",
        fitted=False,  # beside the rate, it needs lines of few and of many events, each on a full bus
    )
    mode: str = choice(
        "delay",
        among=("delay", "drop", "rows", "columns"),
        about="what becomes of events while the bus is busy",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return buses of the highest rate that was seen, without those that the time stamps show idle."""
        rate = observed.highest_event_rate
        # taking lines must leave time for as many events as were seen
        buses = [replace(bus, rate=rate, line=min(bus.line, 0.1 / rate)) for bus in cls.variants()]
        # one that sends one event after the other is no slower than the closest of them
        least = max(rate, observed.least_bus_rate)
        buses = [bus if bus.by_lines else replace(bus, rate=least) for bus in buses]
        return [bus for bus in buses if bus.is_seen_busy(observed)]

    def is_seen_busy(self, observed: Observations) -> bool:
        """Whether a bus of its kind can have been busy enough to lose events or to make them late.

        However fast the bus is: as it has sent some events in a short time, it can send others as fast.
        """
        if not self.makes_wait:
            return not observed.bus_is_idle
        loads = {"rows": observed.row_load, "columns": observed.column_load}
        return loads.get(self.mode, observed.bus_load) >= BUSY

    def is_idle(self, highest_rate: float) -> bool:
        """Whether the bus is free so often that a wait is some events long, and none is lost."""
        if not self.makes_wait:
            return False  # what finds it busy is lost
        line = self.line if self.by_lines else 0.0
        return highest_rate * (line + 1 / self.rate) < BUSY

    def for_share(self, share: float) -> Readout:
        """Return the bus with as much of its bandwidth and of its queue as a share of the pixels has.

        Lines are taken as often: while the bus is full, each has fewer events.
        """
        return replace(self, rate=self.rate * share, depth=max(1.0, self.depth * share))

    @property
    def makes_wait(self) -> bool:
        """Whether events that find it busy wait, and are hardly ever lost before it is full."""
        return self.by_lines or (self.mode == "delay" and self.depth >= 32)

    @property
    def by_lines(self) -> bool:
        """Whether it reads a row or column at a time."""
        return self.mode in ("rows", "columns")

    def reader(self, width: int, height: int, seed: int) -> SharedReader:
        """Return the bus of one sensor."""
        service = 0 if self.rate == math.inf else round(1e12 / self.rate)
        if self.by_lines:
            return LineArbiter(round(1e12 * self.line), service, width, height, self.mode == "columns")
        room = 0.0 if self.mode == "drop" else self.depth - 1
        return Bus(service, round(min(room * service, 2.0**61)) if service else 0)
