"""Events that wait for each other on their way out of the sensor."""

from __future__ import annotations

import warp as wp

NEVER = -(2**62)
"""Time at which a lost event is through [ps]."""

LOST = wp.constant(wp.int64(NEVER))


ONE = 1 << 32
"""A weight of 1."""

SPREAD = wp.constant(wp.int64(2654435769))  # the golden ratio, so that any run of numbers is spread evenly
PARTS = wp.constant(wp.int64(ONE - 1))


@wp.func
def copies(number: int, weight: wp.int64) -> int:
    """Return how often an event that stands for `weight` / ONE events is sent: whole, right in the mean."""
    return int((weight + ((wp.int64(number) * SPREAD) & PARTS)) >> wp.int64(32))


@wp.kernel(enable_backward=False)
def queue(
    # in
    arrival: wp.array[wp.int64],  # (N,) [ps], not decreasing
    other: wp.array[wp.int64],  # (M,) [ps], not decreasing: events of which only what they delay matters
    polarity: wp.array[wp.uint8],  # (M,) of those
    weight: wp.array[wp.int64],  # (2,) how many events one of those stands for, times ONE, by polarity
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
    turn = int(0)
    sent = int(0)  # copies of the one of the others whose turn it is
    before = wp.int64(0)  # the one before it
    count = other.shape[0]
    if count > 0:
        before = other[0]
    for i in range(arrival.shape[0]):
        at = arrival[i]
        early = bool(True)
        while early and turn < count:
            many = copies(turn, weight[int(polarity[turn])])
            # copies keep apart: events at one time would collide more often than the events they stand for
            due = other[turn]
            if many > 1:
                due = before + (due - before) * wp.int64(sent + 1) / wp.int64(many)
            early = due <= at
            if early:
                if many > 0 and free - due <= patience:
                    free = wp.max(free, due) + service
                sent += 1
                if sent >= many:
                    before = other[turn]
                    turn += 1
                    sent = 0
        if free - at > patience:
            through[i] = LOST
        else:
            free = wp.max(free, at) + service
            through[i] = free
    busy[0] = free
