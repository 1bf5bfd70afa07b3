"""Readout of one row of pixels after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.stream import (
    Reader,
    StampPattern,
    StreamEffect,
    order_events,
    to_nanosecond,
    to_nanoseconds,
    to_seconds,
)
from dase.errors import InputError
from dase.events import Events

DIRECTIONS = ("down", "up", "right", "left")

ROOM_FOR_ONE = 1e-3
"""Share of events that are not the first of their pixel at a reading, from which on all of them are sent."""


class Scan(Reader):
    """Holds events until their line is read.

    Lines are numbered for ever: line n is read at n times the line time, and is row or column n % lines.
    """

    def __init__(self, line: float, direction: str, width: int, height: int, keeps: str = "first"):
        self._keeps_all = keeps == "all"
        self._line = round(line * 1e12)  # [ps], so that 640 lines of 304.94 ns make a scan of 195.16 µs
        self._direction = direction
        self._lines = height if direction in ("down", "up") else width
        self._waiting = Events.empty(width, height)
        self._due = np.empty(0, np.int64)

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events whose line is read before `until`, one or all of each pixel and scan."""
        waiting = Events.concatenate([self._waiting, events])
        due = np.concatenate([self._due, self.next_line(events)])
        leaves = due * self._line // 1000 < to_nanosecond(until)
        self._waiting, self._due = waiting.select(~leaves), due[~leaves]
        waiting, due = waiting.select(leaves), due[leaves]
        across = waiting.x if self._direction in ("down", "up") else waiting.y
        index = order_events(due, across.astype(np.int64))
        line, across = due[index], across[index]
        # a pixel holds its first request until it is read, and does not look at the light meanwhile
        first = np.ones(len(index), np.bool_)
        first[1:] = self._keeps_all | (line[1:] != line[:-1]) | (across[1:] != across[:-1])
        return replace(waiting.select(index[first]), t=to_seconds(line[first] * self._line // 1000)), until

    def next_line(self, events: Events) -> NDArray[np.int64]:
        """Return the number of the line at whose reading each event leaves, shape (N,)."""
        place = (events.y if self._direction in ("down", "up") else events.x).astype(np.int64)
        if self._direction in ("up", "left"):
            place = self._lines - 1 - place
        late = 1000 * to_nanoseconds(events.t) - place * self._line
        scans = -(-late // (self._lines * self._line))
        return scans * self._lines + place


@dataclass(frozen=True, kw_only=True)
class RowScan(StreamEffect):
    """Readout of one row of pixels after the other, over and over.

    Some sensors do not answer a pixel when it asks, but visit their rows (or columns) in turn. An event gets
    the time at which its row is read next, so events come in lines, the intervals of a pixel are multiples of
    the scan time, and fast motion is sheared. A pixel has room for one event: of several within one scan, the
    first is sent and the others are lost. Simulators that only move time stamps send all of them at once.

    Row n of N is read at the times (n + k N) * `line` for whole k; `direction` says where the scan goes.
    """

    name: ClassVar[str] = "row_scan"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "Son et al.: A 640x480 dynamic vision sensor with a 9 um pixel and 300 Meps address-event "
        "representation, 2017; default from a recording of a 640x480 camera that visits its 640 columns "
        "every 195.16 us, from right to left"
    )
    signatures: ClassVar = (
        # what waits for the bus afterwards, or for a tick, is not on the scan any more
        Makes("time stamps", tells=True, by="line", absence=False),
        Makes("grouping"),
    )
    screen_limits: ClassVar = {
        "": "the order of rows wants an LED: a screen is drawn row after row itself",
    }

    line: float = parameter(
        3.05e-7,
        unit="s",
        off=0.0,
        bounds=(0.0, 0.1),
        plausible=(3e-8, 3e-5),
        about="time from row to row",
        fitted=False,  # the scans of any other line time soon are out of step with the measured ones
    )
    direction: str = choice("down", among=DIRECTIONS, about="where the scan goes; right and left: columns")
    keeps: str = choice("first", among=("first", "all"), about="what is sent of a pixel's events of one scan")

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.line < 1e-9:
            raise InputError(f"row_scan.line must be 0 or at least 1e-09 s, got {self.line:g}")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the scan that is seen in the time stamps, if any is."""
        if not observed.line_time:
            return []
        keeps = "all" if observed.stamped_again > ROOM_FOR_ONE else "first"
        return [cls(line=observed.line_time, direction=observed.scan_direction, keeps=keeps)]

    def longest_delay(self, lines: int) -> float:
        """Return about how late it makes events: the time of a scan [s]."""
        return lines * self.line

    def stamp_pattern(self) -> StampPattern | None:
        """Return the times at which lines are read."""
        return StampPattern(line_time=self.line, direction=self.direction)

    def reader(self, width: int, height: int, seed: int) -> Scan:
        """Return the scan of one sensor."""
        return Scan(self.line, self.direction, width, height, self.keeps)
