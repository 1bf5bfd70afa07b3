"""Events that wait for each other on their way out of the sensor."""

from __future__ import annotations

import warp as wp

NEVER = -(2**62)
"""Time at which a lost event is through [ps]."""

LOST = wp.constant(wp.int64(NEVER))


@wp.kernel(enable_backward=False)
def queue(
    # in
    arrival: wp.array[wp.int64],  # (N,) [ps], not decreasing
    service: wp.int64,  # time to send one event [ps]
    patience: wp.int64,  # an event that would have to wait longer is lost [ps]
    # in and out
    busy: wp.array[wp.int64],  # (1,) until when the bus is busy [ps]
    # out
    through: wp.array[wp.int64],  # (N,) when the event is through [ps], NEVER where it is lost
):
    """Send events one after the other, on one thread.

    Which events are lost depends on all that were sent before, so this is no scan. On one CPU thread it is
    faster than the copies around it, and the events are on the host anyway, on their way to a file.
    """
    free = busy[0]
    for i in range(arrival.shape[0]):
        at = arrival[i]
        if free - at > patience:
            through[i] = LOST
        else:
            free = wp.max(free, at) + service
            through[i] = free
    busy[0] = free
