"""Representations that remember when events came: time surfaces, frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from dase.errors import InputError, checked_integer
from dase.representations.base import Representation
from dase.representations.columns import EventColumns


def _last_of_window(events: EventColumns, windows: int, channels: int, index: Any, values: Any) -> Any:
    """Return the largest values over `index` (N,) = window · C + channel, -inf for none, (W, C, H, W)."""
    pixels = events.width * events.height
    flat = events.arrays.largest(index * pixels + events.place, values, windows * channels * pixels)
    return flat.reshape(windows, channels, events.height, events.width)


@dataclass(frozen=True)
class TimeSurface(Representation):
    """How long ago the last event of every pixel was, exp(-(end - t) / tau), shape (2, H, W): OFF, ON.

    0 where there was none yet. Windows that follow each other remember: what a window has no event for goes
    on fading. Lagorce et al., HOTS: a hierarchy of event-based time-surfaces, 2017; tonic's `ToTimesurface`
    with exponential decay, whose `dt` is the window.

    Args:
        tau: In which it fades to 1/e, in the unit of the times: [s] for `Events`.
    """

    tau: float
    deposit: ClassVar[str] = "latest"

    def __post_init__(self) -> None:
        if not self.tau > 0 or not math.isfinite(self.tau):
            raise InputError(f"tau must be > 0, got {self.tau}")

    @property
    def channels(self) -> int:
        """Number of polarities."""
        return 2

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return where in the window the last event lies, shape (W, 2, H, W); 0 for none, else 1 + share."""
        last = _last_of_window(events, len(edges) - 1, 2, 2 * window + events.p, 1.0 + share)
        return last.clip(0)

    def finish(self, grids: Any, window: float, before: Any = None) -> Any:
        """Return the surfaces (W, ..., 2, H, W) at the ends of windows."""
        fade = math.exp(-window / self.tau)
        # 1 + share of the last event, 0 for none
        fresh = (grids > 0) * 2.718281828459045 ** ((grids - 2.0) * (window / self.tau))
        out = fresh.astype("float32") if hasattr(fresh, "astype") else fresh.float()
        past = before
        for n in range(len(out)):
            if past is not None:
                out[n] = out[n] + (grids[n] == 0) * (past * fade)
            past = out[n]
        return out


@dataclass(frozen=True)
class EventFrame(Representation):
    """Polarity of the last event of every pixel, shape (1, H, W): 1 for ON, -1 for OFF, 0 for none.

    What OpenEB's frame generation and most viewers draw.
    """

    deposit: ClassVar[str] = "last_polarity"

    @property
    def channels(self) -> int:
        """One."""
        return 1

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return the polarities, shape (W, 1, H, W), see `Representation.sums`."""
        # of several events at one time the one that stands last, whatever order sums are made in
        at = events.arrays.order(events.t)
        rank = 0.0 * share
        rank[at] = (rank + 1.0).cumsum(0)
        last = _last_of_window(events, len(edges) - 1, 1, window, 2.0 * rank + events.p).clip(0)
        out = (last > 0) * (2.0 * (last % 2) - 1.0)
        return out.astype("float32") if hasattr(out, "astype") else out.float()


@dataclass(frozen=True)
class AveragedTimeSurface(Representation):
    """Averages of what the events around an event have left, shape (2 · S², rows, columns) of cells.

    Cells are squares of the sensor. For every event of a cell, those before it of the same cell and polarity,
    at most `span` earlier, leave exp(-age / tau) where they lie around it, in a square of S pixels; this is
    averaged over the events of cell and polarity: Sironi et al., HATS: histograms of averaged time surfaces,
    2018. tonic's `to_averaged_timesurface` has (cells, 2, S, S) of the same numbers: OFF, ON, rows, columns.
    Cells that the sensor cuts off are left out. It needs pairs of events, so no kernel makes it on the way.

    Args:
        tau: In which what is left fades to 1/e, in the unit of the times: [s] for `Events`.
        span: Age at which an event is forgotten; None for three times `tau`.
        cell: Side of a cell [px].
        surface: Side S of the square around an event [px], odd.
    """

    tau: float
    span: float | None = None
    cell: int = 10
    surface: int = 7

    def __post_init__(self) -> None:
        checked_integer("cell", self.cell, 1)
        if checked_integer("surface", self.surface, 1) % 2 == 0:
            raise InputError(f"surface must be odd, got {self.surface}")
        for name, value in (("tau", self.tau), ("span", self.tau if self.span is None else self.span)):
            if not value > 0 or not math.isfinite(value):
                raise InputError(f"{name} must be > 0, got {value}")

    @property
    def channels(self) -> int:
        """Polarities times pixels of a surface."""
        return 2 * self.surface**2

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return the averages, shape (W, 2 · S², rows, columns) of cells, see `Representation.sums`."""
        wide, high = events.width // self.cell, events.height // self.cell
        x, y = events.place % events.width, events.place // events.width
        column, row = x // self.cell, y // self.cell
        group = ((window * high + row) * wide + column) * 2 + events.p
        # group by group, in order of time
        inside = (column < wide) & (row < high)
        at = events.arrays.order(events.t)
        at = at[inside[at]]
        at = at[events.arrays.order(group[at])]
        group, x, y, t = group[at], x[at], y[at], events.t[at]
        cells, side = (len(edges) - 1) * high * wide, self.surface
        total = events.arrays.sums(group[:0], t[:0], cells * self.channels)
        span = 3 * self.tau if self.span is None else self.span
        for back in range(1, len(t)):
            age = t[back:] - t[:-back]
            near = (group[back:] == group[:-back]) & (age <= span)
            if not bool(near.any()):
                break  # who comes still earlier is too old, or of another cell
            dx = x[:-back] - x[back:] + side // 2
            dy = y[:-back] - y[back:] + side // 2
            near &= (dx >= 0) & (dx < side) & (dy >= 0) & (dy < side)
            index = ((group[back:] * side + dy) * side + dx)[near]
            weight = 2.718281828459045 ** (-age[near] / self.tau)
            total = total + events.arrays.sums(index, weight, cells * self.channels)
        number = events.arrays.sums(group, 0.0 * t + 1.0, 2 * cells).clip(1)
        mean = total.reshape(2 * cells, -1) / number[:, None]
        mean = mean.reshape(len(edges) - 1, high, wide, self.channels)
        return events.arrays.module.moveaxis(mean, -1, 1)
