"""Events put into grids where they happen: no event is ever stored, and its time stays exact.

A pixel belongs to one thread, so that the sums of a grid do not depend on what other threads do. The grids
are those of `dase.representations`, before `finish`.
"""

from __future__ import annotations

import warp as wp


@wp.struct
class WindowGrids:
    """Sink of grids, one for each window of time."""

    grids: wp.array4d[float]  # (W, B, C, N), to which events are added
    window: wp.float64  # duration of a window [ns]
    bins: int  # of time, in a window


@wp.func
def window_of(sink: WindowGrids, time: wp.int64) -> int:
    """Window that an event falls in; what happens at the very end belongs to the last one."""
    return wp.min(int(wp.float64(time) / sink.window), sink.grids.shape[0] - 1)


@wp.func
def share_of(sink: WindowGrids, time: wp.int64, window: int) -> float:
    """Where in its window an event lies: 0 at the begin, 1 at the end."""
    return float(wp.float64(time) / sink.window - wp.float64(window))


@wp.func
def add_to_own(sink: WindowGrids, window: int, row: int, channel: int, i: int, weight: float):
    """Add to a number that no other thread changes."""
    # not `+=`, which is atomic: on an H100 adding so took 3.5 times as long as setting numbers
    sink.grids[window, row, channel, i] = sink.grids[window, row, channel, i] + weight


@wp.func
def deposit_voxels(sink: WindowGrids, row: int, i: int, size: int, time: wp.int64, code: int):
    """Spread a polarity linearly over two bins."""
    w = window_of(sink, time)
    at = share_of(sink, time, w) * float(sink.bins - 1)
    low = wp.min(int(at), sink.bins - 1)
    upper = at - float(low)
    sign = float(2 * code - 1)
    add_to_own(sink, w, row, low, i, sign * (1.0 - upper))
    if low + 1 < sink.bins:
        add_to_own(sink, w, row, low + 1, i, sign * upper)


@wp.func
def deposit_counts(sink: WindowGrids, row: int, i: int, size: int, time: wp.int64, code: int):
    """Count an event by its polarity."""
    add_to_own(sink, window_of(sink, time), row, code, i, 1.0)


@wp.func
def deposit_histogram(sink: WindowGrids, row: int, i: int, size: int, time: wp.int64, code: int):
    """Count an event by its polarity and bin of time."""
    w = window_of(sink, time)
    b = wp.min(int(share_of(sink, time, w) * float(sink.bins)), sink.bins - 1)
    add_to_own(sink, w, row, code * sink.bins + b, i, 1.0)


@wp.func
def deposit_latest(sink: WindowGrids, row: int, i: int, size: int, time: wp.int64, code: int):
    """Note where in the window the last event of a polarity lies, as 1 + share."""
    w = window_of(sink, time)
    sink.grids[w, row, code, i] = 1.0 + share_of(sink, time, w)


@wp.func
def deposit_last_polarity(sink: WindowGrids, row: int, i: int, size: int, time: wp.int64, code: int):
    """Note the polarity of the last event."""
    sink.grids[window_of(sink, time), row, 0, i] = float(2 * code - 1)


DEPOSITS = {
    "voxels": deposit_voxels,
    "counts": deposit_counts,
    "histogram": deposit_histogram,
    "latest": deposit_latest,
    "last_polarity": deposit_last_polarity,
}
"""What is done with an event, by the name that a representation gives it."""
