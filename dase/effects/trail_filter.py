"""The filter of a camera's own logic that thins out bursts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.stream import Reader, StreamEffect, to_nanosecond, to_nanoseconds
from dase.events import Events
from dase.kernels import event_filters, launch


class BurstFilter(Reader):
    """Passes events by their place in the burst of their pixel.

    Args:
        gap: Events of one polarity no farther apart are of one burst [ns].
        keep: First and last place that passes.
        pixels: Of the sensor.
    """

    def __init__(self, gap: int, keep: tuple[int, int], pixels: int):
        self._gap, self._keep = gap, keep
        self._last, self._sign = np.zeros(pixels, np.int64), np.zeros(pixels, np.uint8)
        self._place = np.zeros(pixels, np.int32)

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events whose place passes, at once."""
        place = self._places(events)
        return events.select((place >= self._keep[0]) & (place <= self._keep[1])), until

    def _places(self, events: Events) -> NDArray[np.int32]:
        found, device = np.empty(len(events), np.int32), launch.find_device("cpu")
        pixel = events.y.astype(np.int32) * events.width + events.x
        columns = (
            (to_nanoseconds(events.t), wp.int64), (pixel, wp.int32), (events.p.astype(np.uint8), wp.uint8)
        )  # fmt: skip
        state = ((self._last, wp.int64), (self._sign, wp.uint8), (self._place, wp.int32), (found, wp.int32))
        first, rest = (
            [wp.array(a, dtype=d, device=device, copy=False) for a, d in some] for some in (columns, state)
        )
        inputs = [*first, wp.int64(self._gap), *rest]
        wp.launch(event_filters.place_in_bursts, dim=1, inputs=inputs, device=device)
        return found


@dataclass(frozen=True, kw_only=True)
class TrailFilter(StreamEffect):
    """A camera's filter that thins out bursts.

    An edge of high contrast makes a burst of events of one polarity at each pixel, which tell little more
    than its first; single events are mostly noise. Prophesee's sensors have a filter that uses both, which
    users often have switched on. A burst goes on as long as the next event of the pixel has the same polarity
    and comes within `threshold` of the last one, whether that passed or not.

    With `mode = "trail"` the first event of each burst passes. With `"stc_cut"` (spatio-temporal contrast)
    the second passes alone, with `"stc_keep"` the second and all that follow: single events are lost. Of
    independent ON and OFF events with shares s and 1 - s, R per second in all, the shares that pass are
    1 - J with J = (s² + (1 - s)²) (1 - exp(-R `threshold`)) for trail, J for stc_keep, and the sum over
    polarities of s q (1 - q), q = s (1 - exp(-R `threshold`)), for stc_cut.

    Sensors take whole milliseconds from 1 to 100. That intervals are measured from event to event is so in
    IMX636 and GenX320; how a Gen4.1 measures them is not published.
    """

    name: ClassVar[str] = "trail_filter"
    source: ClassVar[str] = (
        "Prophesee: Metavision documentation, Event Signal Processing (event trail filter), 2024; "
        "OpenEB, facility I_EventTrailFilterModule, 2024"
    )
    signatures: ClassVar = ()

    threshold: float = parameter(
        0.01,
        unit="s",
        off=0.0,
        bounds=(0.0, 10.0),
        plausible=(1e-3, 0.1),
        about="longest time between two events of a burst",
        fitted=False,  # it is set by the user, and cuts intervals off sharply
    )
    mode: str = choice("trail", among=("trail", "stc_cut", "stc_keep"), about="which events of a burst pass")

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return nothing: whoever has switched it on knows it, and others' dead times look alike."""
        return []

    def reader(self, width: int, height: int, seed: int) -> BurstFilter:
        """Return the filter of one sensor."""
        keep = {"trail": (1, 1), "stc_cut": (2, 2), "stc_keep": (2, 1 << 31)}[self.mode]
        return BurstFilter(to_nanosecond(self.threshold), keep, width * height)
