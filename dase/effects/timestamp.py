"""The clock that stamps the events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from dase.effects.base import Effect, Observations, parameter
from dase.effects.made_signatures import Makes
from dase.effects.stream import (
    FOREVER,
    Reader,
    StampPattern,
    StreamEffect,
    order_events,
    random_numbers,
    to_nanosecond,
    to_nanoseconds,
    to_seconds,
)
from dase.errors import InputError
from dase.events import Events

LEAST_JITTER = 2e-5
"""Errors of the stamps below this are far below the steps in which statistics see time [s]."""


class Stamp(Reader):
    """Gives events the time the clock shows."""

    widest: ClassVar[float] = 5.0
    """Largest jitter, in standard deviations; one normal number in two million lies beyond."""

    def __init__(self, jitter: float, step: float, random: np.random.Generator):
        self._jitter, self._random = jitter * 1e9, random  # [ns]
        self._step = round(step * 1e12)  # [ps]
        self._reach = math.ceil(self.widest * self._jitter)
        self._waiting = Events.empty(1, 1)
        self._at = np.empty(0, np.int64)

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events that no later one can precede any more."""
        at, bound = to_nanoseconds(events.t), to_nanosecond(until)
        if self._jitter > 0:
            events, at, bound = self._jittered(events, at, bound)
        if self._step:
            at = 1000 * at // self._step * self._step // 1000
            bound = bound if bound == FOREVER else 1000 * bound // self._step * self._step // 1000
        return replace(events, t=to_seconds(at)), math.inf if bound == FOREVER else 1e-9 * bound

    def _jittered(self, events: Events, at: np.ndarray, bound: int) -> tuple[Events, np.ndarray, int]:
        error = np.clip(self._random.standard_normal(len(at)), -self.widest, self.widest)
        at = at + np.rint(self._jitter * error).astype(np.int64)
        if len(self._at):
            events = Events.concatenate([self._waiting, events])
            at = np.concatenate([self._at, at])
        bound = bound if bound == FOREVER else bound - self._reach
        stays = np.flatnonzero(at >= bound)
        self._waiting, self._at = events.select(stays), at[stays]
        leaves = np.flatnonzero(at < bound)
        index = leaves[order_events(at[leaves])]
        return events.select(index), at[index], bound


@dataclass(frozen=True, kw_only=True)
class Timestamp(StreamEffect):
    """Time stamps that are not exact.

    An event is stamped when it has found its way out of the array, and that takes a little longer for some
    than for others; then a clock of limited resolution writes down its last tick. Small errors, which matter
    where events are compared to the microsecond: in stereo, in the decoding of flickering lights.

    Each stamp is off by a normally distributed error, cut at five standard deviations, then rounded down to
    a multiple of `step`. The stream is sorted by its stamps, as readers of files expect it to be.
    """

    name: ClassVar[str] = "timestamp"
    source: ClassVar[str] = (
        "Brandli, Berner, Yang, Liu, Delbruck: A 240x180 130 dB 3 us latency global shutter "
        "spatiotemporal vision sensor, 2014"
    )
    signatures: ClassVar = (Makes("time stamps", tells=True, by="step"),)
    screen_limits: ClassVar = {
        "": "jitter of time stamps wants an LED, whose edges last less than a microsecond",
    }

    jitter: float = parameter(
        2e-6,
        unit="s",
        off=0.0,
        bounds=(0.0, 0.1),
        plausible=(1e-6, 2e-3),
        about="standard deviation of the time stamps",
    )
    step: float = parameter(
        1e-6,
        unit="s",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-7, 1e-3),
        about="from tick to tick of the clock",
        fitted=False,  # stamps are at the ticks of one step only, and at none of those beside it
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.step < 1e-9:
            raise InputError(f"timestamp.step must be 0 or at least 1e-09 s, got {self.step:g}")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the clock that is seen in the time stamps; where none is, stamps that are off."""
        # as large as that, for a search leaves out what is small beside its steps of time
        return [cls(step=observed.clock_period, jitter=0.0 if observed.clock_period else 1e-3)]

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing, of errors too small for any statistic."""
        return ("jitter",) if self.jitter < LEAST_JITTER else ()

    def longest_delay(self, lines: int) -> float:
        """Return about how late it makes events [s]."""
        return max(self.step, self.jitter)

    def clock_period(self) -> float | None:
        """Return the ticks to which times are rounded down [s], None where there is jitter as well."""
        return None if self.jitter or not self.step else self.step

    def stamp_pattern(self) -> StampPattern | None:
        """Return the ticks of the clock."""
        return StampPattern(period=self.step) if self.step else None

    def reader(self, width: int, height: int, seed: int) -> Stamp:
        """Return the clock of one sensor."""
        return Stamp(self.jitter, self.step, random_numbers(seed, self.name))
