"""Times of samples as kernels want them: steps in whole nanoseconds."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels.pixel_stages import REST, SampleClock


def upload_clock(edges: NDArray[np.float64], fresh: bool, run: Any, window: Any, device: wp.Device) -> Any:
    """Return the clock of a chunk of samples on a device.

    Args:
        edges: End of the last step before, and the samples that follow [s], shape (K + 1,).
        fresh: Whether pixels have seen no sample yet, so that no time passes before the first.
        run: Samples at which runs of one window begin, and K, int32, shape (R + 1,).
        window: Window that each run counts for, int32, shape (R,).
        device: Where to.
    """
    dt = np.diff(edges)
    clock = SampleClock()
    if fresh:
        dt[0] = REST
    # times in whole nanoseconds, counted from the begin of the chunk: float32 could not tell them apart
    stamps = np.round(edges * 1e9)
    begin, length = stamps[:-1] - stamps[0], np.diff(stamps)
    # rounded down, so that no event comes after the end of its step
    short = length.astype(np.float32)
    short = np.where(short > length, np.nextafter(short, np.float32(0)), short)
    times = edges[1:]
    clock.t = wp.array(times.astype(np.float32), dtype=float, device=device)
    clock.t64 = wp.array(times, dtype=wp.float64, device=device)
    clock.dt = wp.array(dt.astype(np.float32), dtype=float, device=device)
    clock.begin = wp.array(begin.astype(np.int64), dtype=wp.int64, device=device)
    clock.span = wp.int64(int(stamps[-1] - stamps[0]))
    clock.length = wp.array(short, dtype=float, device=device)
    clock.run, clock.window = run, window
    return clock
