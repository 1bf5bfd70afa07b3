"""When frames are exposed, read from the bursts that they make."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.signatures.frame_coupling import BurstClock


@dataclass(frozen=True)
class BurstTimes:
    """Frames at even times whose exposures are seen in the events.

    Args:
        interval: From one to the next [s].
        begin: When a burst of ON events comes [s].
        exposure: From there to the next burst of OFF events [s].
    """

    interval: float
    begin: float
    exposure: float

    def around(self, begin: float, end: float, reach: float) -> BurstClock:
        """Return when bursts come between two times [s], `reach` [s] before and after both edges."""
        first, last = (math.floor((t - self.begin) / self.interval) for t in (begin, end))
        begins: NDArray[np.float64] = self.begin + self.interval * np.arange(first - 1.0, last + 1.0)
        bursts = [[edge - reach, edge + reach] for edge in (0.0, self.exposure)]
        return BurstClock(begins, self.interval, np.array(bursts, np.float64))


@dataclass(frozen=True)
class BurstTimeSettings:
    """How far bursts are from the time at which they are looked for."""

    reaches: tuple[float, ...] = (2.5e-3, 1e-3)  # [s] bursts last 1 to 3 ms; other events lie evenly in less
    fewest_events: int = 8  # in a burst: of less, the middle tells no time
    uneven: float = 2e-3  # [s] bursts farther from even times, in the median, have no period
    shortest: float = 5e-4  # [s] edges of an exposure that lie closer are one burst of both polarities


def find_burst_times(
    events: Events,
    details: Mapping[str, Any],
    exposure: float | None = None,
    settings: BurstTimeSettings | None = None,
) -> BurstTimes | None:
    """Return the even times of frames; None where they are not even or only one edge is seen.

    The signature tells times in steps of half a millisecond; here the middle of each burst does.

    Args:
        events: In which the bursts are.
        details: Of the signature `frame coupling`.
        exposure: Duration of the exposures [s] as the file gives it, for where one polarity alone shows;
            None where unknown.
        settings: How far bursts are from the time at which they are looked for.
    """
    s = settings or BurstTimeSettings()
    begins = np.asarray(details["begins"], np.float64)
    begins = begins[begins <= events.t[-1]]
    found = {}
    for name, phase in details["phases"].items():
        times, middles = events.t[events.p == (name == "ON")], begins + phase
        for reach in s.reaches:
            middles = _burst_middles(times, middles, reach, s.fewest_events)
        line = _even_times(middles, float(details["interval"]), s)
        if line is not None:
            found[name] = line
    if not found:
        return None
    interval = float(np.mean([slope for slope, _ in found.values()]))
    if len(found) == 2:
        lasts = (found["OFF"][1] - found["ON"][1]) % interval
        # from OFF to ON and back may be less than a burst lasts: nobody sees which of the two came first
        wide = min(max(lasts, s.shortest), max(interval - s.shortest, 0.5 * interval))
        return BurstTimes(interval, found["ON"][1] - 0.5 * (wide - lasts), wide)
    if exposure is None or not 0 < exposure < interval:
        return None
    at = found["ON"][1] if "ON" in found else found["OFF"][1] - exposure
    return BurstTimes(interval, at, exposure)


def _burst_middles(
    times: NDArray[np.float64], expected: NDArray[np.float64], reach: float, least: int
) -> NDArray[np.float64]:
    """Return the median time of the events around each expected burst [s], shape (F,); NaN for too few."""
    low = np.searchsorted(times, expected - reach)
    high = np.searchsorted(times, expected + reach)
    out = np.full(len(expected), math.nan)
    for n in np.flatnonzero(high - low >= least):
        out[n] = np.median(times[low[n] : high[n]])
    return out


def _even_times(
    middles: NDArray[np.float64], interval: float, s: BurstTimeSettings
) -> tuple[float, float] | None:
    """Return the period and one time [s] of bursts at even times; None where they are not."""
    known = middles[np.isfinite(middles)]
    if len(known) < 3:
        return None
    middle = known[len(known) // 2]
    # a dropped frame leaves a gap of whole intervals
    turns = np.round((known - middle) / interval)
    slope, start = interval, middle
    for _ in range(3):
        off = np.abs(known - start - slope * turns)
        near = off <= 2.5 * np.median(off) + 1e-9
        if np.ptp(turns[near]) == 0:
            return None
        slope, start = (float(value) for value in np.polyfit(turns[near], known[near], 1))
    off = np.abs(known - start - slope * turns)
    return (slope, start) if np.median(off) <= s.uneven else None
