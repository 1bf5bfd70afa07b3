"""Events that wait for each other on their way out of the sensor."""

from __future__ import annotations

import warp as wp

NEVER = -(2**62)
"""Time until when a bus is busy that has not sent anything yet [ps]: far from any overflow."""

ONE = 1 << 32
"""A weight of 1; weights have 32 binary places, so that sums and copies are exact."""


@wp.func_native(
    """
    // picoseconds in 64 bits: buses send an event in fractions of a nanosecond, for hours
    const long long* __restrict__ due = other.data;
    const unsigned char* __restrict__ sign = polarity.data;
    const int count = other.shape[0];
    long long free = busy.data[0];
    int turn = 0;  // of the others
    long long sent = 0;  // copies of the one whose turn it is
    long long at = count > 0 ? due[0] : 0;  // when the last copy got there
    long long step = 0, rest = 0, part = 0;  // from copy to copy, and what is left over by whole numbers
    for (int i = 0; i < arrival.shape[0]; ++i) {
        // all others that come before, or at the same time, go first
        const long long mine = 1000 * (long long)rint(1e9 * arrival.data[i]);
        while (turn < count) {
            // the golden ratio, so that any run of numbers is spread evenly: whole, right in the mean
            const long long many = (weight.data[sign[turn]] + ((turn * 2654435769ll) & 0xffffffffll)) >> 32;
            if (many <= 1) {
                // the common case without a loop over copies, and without a branch on what is lost
                if (due[turn] > mine) break;
                at = due[turn++];
                const long long after = (free > at ? free : at) + service;
                free = ((many == 1) & (free - at <= patience)) ? after : free;
                continue;
            }
            // the queue is full until after its last copy: all are lost
            if (sent == 0 && free - due[turn] > patience && due[turn] <= mine) {
                at = due[turn++];
                continue;
            }
            // copies keep apart: events at one time would collide more often than the events they stand for
            if (sent == 0) {
                step = (due[turn] - at) / many;
                rest = (due[turn] - at) % many;
                part = 0;
            }
            // the copies are interrupted by an event that comes between them, and go on after it
            while (sent < many) {
                const bool over = part + rest >= many;
                const long long next = at + step + over;
                if (next > mine) break;
                at = next;
                part += rest - (over ? many : 0);
                const long long after = (free > at ? free : at) + service;
                free = free - at <= patience ? after : free;
                ++sent;
            }
            if (sent < many) break;
            sent = 0;
            ++turn;
        }
        if (free - mine > patience) {
            through.data[i] = NAN;
        } else {
            free = (free > mine ? free : mine) + service;
            // rounded down to whole nanoseconds, below zero, too
            const long long whole = free / 1000 - (free % 1000 < 0);
            through.data[i] = 1e-9 * (double)whole;
        }
    }
    busy.data[0] = free;
"""
)
def send_in_turn(
    arrival: wp.array[wp.float64],
    other: wp.array[wp.int64],
    polarity: wp.array[wp.uint8],
    weight: wp.array[wp.int64],
    service: wp.int64,
    patience: wp.int64,
    busy: wp.array[wp.int64],
    through: wp.array[wp.float64],
):
    """Do what `send_over_bus` does; arguments have the shape and unit that it says."""
    ...


@wp.kernel(enable_backward=False)
def send_over_bus(
    # in
    arrival: wp.array[wp.float64],  # (N,) [s], taken as whole nanoseconds, not decreasing
    other: wp.array[wp.int64],  # (M,) [ps], not decreasing: events of which only what they delay matters
    polarity: wp.array[wp.uint8],  # (M,) of those
    weight: wp.array[wp.int64],  # (2,) how many events one of those stands for, times ONE, by polarity
    service: wp.int64,  # time to send one event [ps]
    patience: wp.int64,  # an event that would have to wait longer is lost [ps]
    # in and out
    busy: wp.array[wp.int64],  # (1,) until when the bus is busy [ps]
    # out
    through: wp.array[wp.float64],  # (N,) when the event is through [s], in whole nanoseconds, NaN where lost
):
    """Send events one after the other, on one thread.

    Which events are lost depends on all that were sent before, so this is no scan. On one CPU thread it is
    faster than the copies around it, and the events are on the host anyway, on their way to a file.
    """
    send_in_turn(arrival, other, polarity, weight, service, patience, busy, through)
