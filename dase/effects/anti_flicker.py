"""The filter of a camera's own logic against flickering light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import warp as wp

from dase.effects.base import Observations, choice, parameter
from dase.effects.stream import Reader, StreamEffect, to_nanoseconds
from dase.errors import InputError
from dase.events import Events
from dase.kernels import event_filters, launch

SIDE = 4
"""Pixels of a region's side: published."""

MOST = 7
"""Bursts that are counted: the largest threshold that a sensor takes."""


class FlickerFilter(Reader):
    """Stops or passes the events of regions that flicker.

    Args:
        periods: Shortest and longest of the band [ns].
        start: Bursts in step from which on a region flickers.
        stop: Bursts in step below which it does not any more.
        passes: Whether events of regions that flicker pass, and no others.
        width: Columns of the sensor.
        height: Rows of the sensor.
    """

    def __init__(
        self, periods: tuple[int, int], start: int, stop: int, passes: bool, width: int, height: int
    ):
        self._settings = (*(wp.int64(p) for p in periods), start, stop, max(MOST, start))
        self._passes, self._columns = passes, -(-width // SIDE)
        regions = self._columns * -(-height // SIDE)
        self._sign, self._begin = np.full(regions, 2, np.uint8), np.zeros(regions, np.int64)
        self._count, self._active = np.full(regions, -1, np.int32), np.zeros(regions, np.uint8)

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events that pass, at once."""
        flickers, device = np.empty(len(events), np.uint8), launch.find_device("cpu")
        region = (events.y // SIDE).astype(np.int32) * self._columns + events.x // SIDE
        columns = (
            (to_nanoseconds(events.t), wp.int64), (region, wp.int32), (events.p.astype(np.uint8), wp.uint8)
        )  # fmt: skip
        state = (
            (self._sign, wp.uint8), (self._begin, wp.int64), (self._count, wp.int32),
            (self._active, wp.uint8), (flickers, wp.uint8),
        )  # fmt: skip
        first, rest = (
            [wp.array(a, dtype=d, device=device, copy=False) for a, d in some] for some in (columns, state)
        )
        inputs = [*first, *self._settings, *rest]
        wp.launch(event_filters.follow_flicker, dim=1, inputs=inputs, device=device)
        return events.select((flickers == 1) == self._passes), until


@dataclass(frozen=True, kw_only=True)
class AntiFlicker(StreamEffect):
    """A camera's filter against flickering light.

    Prophesee's sensors can leave out what lamps make: regions of 4x4 pixels whose events come in bursts with
    the period of a lamp are muted. Of what moves there, too, nothing is seen any more, and fast regular
    motion is taken for a lamp.

    A burst of a region begins with its first ON event after an OFF event. Its time since the last such begin
    is a period; one within the band, 1/`high` to 1/`low`, counts one up, any other one down, between 0 and 7.
    From a count of `start` on the region flickers, below `stop` it does not any more. With
    `mode = "band_stop"` events of regions that flicker are lost, with `"band_pass"` all others. So a lamp is
    seen for `start` + 1 periods after it is switched on.

    Band, regions, both thresholds (6 and 4) and modes are published; how a sensor counts down, and what its
    setting of a duty cycle does, is not: the first is the plainest rule with both thresholds, the second is
    left out.
    """

    name: ClassVar[str] = "anti_flicker"
    source: ClassVar[str] = (
        "Prophesee: Metavision documentation, Event Signal Processing (anti-flicker), 2024; OpenEB, facility "
        "I_AntiFlickerModule, 2024"
    )
    per_pixel: ClassVar[bool] = False
    signatures: ClassVar = ()

    low: float = parameter(
        50.0,
        unit="Hz",
        bounds=(0.01, 1e6),
        plausible=(50.0, 150.0),
        about="lowest frequency of the band",
        fitted=False,  # set by the user
    )
    high: float = parameter(
        520.0,
        unit="Hz",
        bounds=(0.01, 1e6),
        plausible=(200.0, 520.0),
        about="highest frequency of the band",
        fitted=False,
    )
    start: float = parameter(
        6.0,
        unit="1",
        off=math.inf,
        bounds=(1.0, math.inf),
        plausible=(1.0, 7.0),
        about="bursts in step from which on a region flickers",
        fitted=False,
    )
    stop: float = parameter(
        4.0,
        unit="1",
        bounds=(0.0, 1e6),
        plausible=(0.0, 7.0),
        about="bursts in step below which it does not any more",
        fitted=False,
    )
    mode: str = choice("band_stop", among=("band_stop", "band_pass"), about="which events are lost")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low > self.high:
            raise InputError(f"anti_flicker.low must not exceed high, {self.high:g} Hz, got {self.low:g}")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return nothing: of events that were left out nothing can be read off."""
        return []

    def reader(self, width: int, height: int, seed: int) -> FlickerFilter:
        """Return the filter of one sensor."""
        # a period may be off by the rounding of both its ends
        periods = math.floor(1e9 / self.high) - 1, math.ceil(1e9 / self.low) + 1
        start, stop = (math.ceil(min(n, 1e6)) for n in (self.start, self.stop))
        return FlickerFilter(periods, start, stop, self.mode == "band_pass", width, height)
