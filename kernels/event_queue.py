"""Events that wait for each other on their way out of the sensor."""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

NEVER = -(2**62)
"""Time until when a bus is busy that has not sent anything yet [ps]: far from any overflow."""

ONE = 1 << 32
"""A weight of 1; weights have 32 binary places, so that sums are exact."""


@wp.func_native(
    """
    const long long ONE = 1ll << 32;
    // picoseconds in 64 bits: buses send an event in fractions of a nanosecond, for hours
    // others before and after a moment by which their rate is told there: of fewer the rate is chance, which
    // lets too much through, of more the ends of bursts are smeared
    const int NEAR = 32;
    const long long* __restrict__ due = other.data;
    const unsigned char* __restrict__ sign = polarity.data;
    const int count = other.shape[0];
    // what an event stands for beside itself comes at random times: evenly spread, it would meet a full queue
    // more rarely and a busy bus more often than events of pixels that know nothing of each other
    long long beside[2], excess = 0;
    for (int p = 0; p < 2; ++p) beside[p] = weight.data[p] > ONE ? weight.data[p] - ONE : 0;
    const bool alone = beside[0] == 0 && beside[1] == 0;
    unsigned long long drawn = 0x9e3779b97f4a7c15ull;
    auto wait = [&]() {
        // an exponential of mean 1
        drawn ^= drawn << 13;
        drawn ^= drawn >> 7;
        drawn ^= drawn << 17;
        return -log(((double)(drawn >> 11) + 0.5) * 0x1p-53);
    };
    long long free = busy.data[0];
    auto take = [&](long long at) {
        const long long after = (free > at ? free : at) + service;
        free = free - at <= patience ? after : free;
    };
    int turn = 0;  // of the others
    int low = 0, high = 0;  // the first and the last that tell the rate
    bool begun = alone;  // whether it is known how many come since the other before
    double many = 0.0, gone = 0.0, left = wait();  // in the mean; up to now; until the next
    for (int i = 0; i < arrival.shape[0]; ++i) {
        // all others that come before, or at the same time, go first
        const long long mine = 1000 * (long long)rint(1e9 * arrival.data[i]);
        while (turn < count) {
            const long long now = due[turn];
            if (!begun) {
                for (; high + 1 < count && high < turn + NEAR - 1; ++high) excess += beside[sign[high + 1]];
                for (; low < turn - NEAR; ++low) excess -= beside[sign[low + 1]];
                const long long before = turn > 0 ? due[turn - 1] : now;
                const double span = (double)(due[high] - due[low]);
                const double share = span > 0.0 ? (double)(now - before) / span : 1.0 / (high - low + 1);
                many = share * (double)excess / (double)ONE;
                gone = 0.0;
                begun = true;
                // where the queue is full all the time, all are lost
                if (free - now > patience) many = 0.0;
            }
            if (many > 0.0) {
                const long long before = turn > 0 ? due[turn - 1] : now;
                bool later = false;
                while (gone + left <= many) {
                    const long long at = before + (long long)((gone + left) / many * (double)(now - before));
                    later = at > mine;
                    if (later) break;
                    gone += left;
                    left = wait();
                    take(at);
                }
                if (later) break;
                // waiting has no memory
                left -= many - gone;
                gone = many = 0.0;
            }
            if (now > mine) break;
            // the golden ratio, so that any run of numbers is spread evenly: right in the mean
            const long long whole = (weight.data[sign[turn]] + ((turn * 2654435769ll) & 0xffffffffll)) >> 32;
            // without a branch on what is lost
            const long long after = (free > now ? free : now) + service;
            free = ((whole >= 1) & (free - now <= patience)) ? after : free;
            ++turn;
            begun = alone;
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
