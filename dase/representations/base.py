"""What a representation of events is to dase."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from dase.errors import InputError
from dase.representations.columns import EventColumns, event_columns


@dataclass(frozen=True)
class Representation(ABC):
    """A grid of numbers (C, H, W) made of the events of a window of time.

    A frozen dataclass of what it depends on. `sums` fills the grids of some windows, `finish` does what needs
    whole grids; whoever fills them by other means, as a kernel on the way, calls `finish` alone.
    """

    deposit: ClassVar[str] = ""
    """Name of the function of `dase.kernels.window_sinks` that keeps one event; "" if there is none."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of channels C."""

    @abstractmethod
    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return grids that events have been added to.

        Args:
            events: Those of the windows.
            window: Window that each of them lies in, int64, shape (N,).
            share: Where in it, 0 at its begin and 1 at its end, float64, shape (N,).
            edges: Window edges, in the unit of the times, float64, shape (W + 1,).

        Returns:
            Shape (W, C, H, W) float32.
        """

    def finish(self, grids: Any, window: float, before: Any = None) -> Any:
        """Return what networks are given.

        Args:
            grids: Windows that follow each other, shape (W, ..., C, H, W).
            window: Duration of each, in the unit of `sums`.
            before: What was returned for the window before, shape (..., C, H, W); None where there is none.
        """
        return grids

    def __call__(
        self,
        events: Any,
        begin: float | None = None,
        end: float | None = None,
        *,
        edges: ArrayLike | None = None,
        size: tuple[int, int] | None = None,
    ) -> Any:
        """Return the representation of one window or of several.

        Args:
            events: `Events`; or columns t, x, y, p of shape (N,) in a tuple, a mapping or a structured array,
                NumPy's or PyTorch's.
            begin: Begin of the window, in the unit of the times; None for the first event's.
            end: Its end, which is part of it; None for the last event's.
            edges: Instead of both, edges of several windows, increasing, shape (T + 1,); a window holds
                edge <= t < next edge. They should have one duration where a representation remembers.
            size: Width and height of the sensor [px], which `Events` know.

        Returns:
            Shape (C, H, W) float32, or (T, C, H, W) for edges; on the device of the columns.

        Raises:
            InputError: Events are not such, or edges do not increase.
        """
        columns = event_columns(events, size)
        if edges is not None:
            if begin is not None or end is not None:
                raise InputError("windows are given by begin and end or by edges, not by both")
            return self._windows(columns, np.asarray(edges, np.float64), closed=False)
        if len(columns):
            begin = float(columns.t.min()) if begin is None else begin
            end = float(columns.t.max()) if end is None else end
        elif begin is None or end is None:
            begin, end = 0.0, 1.0  # no event is anywhere
        # a single event has no duration, and lies at the begin
        edge = np.array([begin, end if end != begin else np.nextafter(begin, np.inf)], np.float64)
        return self._windows(columns, edge, closed=True)[0]

    def _windows(self, events: EventColumns, edges: Any, *, closed: bool) -> Any:
        """Return the grids of windows, of which the last one holds its end where `closed`."""
        grids = self.raw_grids(events, edges, closed=closed)
        return self.finish(grids, float(edges[-1] - edges[0]) / (len(edges) - 1))

    def raw_grids(self, events: EventColumns, edges: Any, *, closed: bool = False) -> Any:
        """Return the grids of windows before `finish`.

        Args:
            events: Any; those outside of the windows count for nothing.
            edges: Window edges, in the unit of the times, float64, shape (W + 1,).
            closed: Whether the last window holds its end.

        Returns:
            Shape (W, C, H, W) float32.

        Raises:
            InputError: Edges do not increase.
        """
        if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
            raise InputError("window edges must increase, and there must be at least 2")
        arrays = events.arrays
        at, last = arrays.edges(edges), len(edges) - 2
        t = events.t
        inside = (t >= edges[0]) & ((t <= edges[-1]) if closed else (t < edges[-1]))
        part = EventColumns(
            t[inside], events.place[inside], events.p[inside], events.width, events.height, arrays
        )
        window = arrays.module.searchsorted(at, part.t, side="right") - 1
        window = window.clip(0, last)
        share = (part.t - at[window]) / (at[window + 1] - at[window])
        return self.sums(part, window, share, at)


def grid_of(events: EventColumns, windows: int, channels: int, index: Any, weight: Any) -> Any:
    """Return sums of weights (N,) over `index` (N,) = window · C + channel, shape (W, C, H, W)."""
    pixels = events.width * events.height
    flat = events.arrays.sums(index * pixels + events.place, weight, windows * channels * pixels)
    return flat.reshape(windows, channels, events.height, events.width)
