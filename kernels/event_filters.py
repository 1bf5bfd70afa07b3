"""Filters of a camera's own logic: an event passes or not by what its pixel or region sent before."""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.kernel(enable_backward=False)
def place_in_bursts(
    # in
    time: wp.array[wp.int64],  # (N,) [ns], not decreasing
    pixel: wp.array[int],  # (N,)
    polarity: wp.array[wp.uint8],  # (N,)
    gap: wp.int64,  # events of one polarity no farther apart are of one burst [ns]
    # in and out
    last: wp.array[wp.int64],  # (pixels,) [ns]
    sign: wp.array[wp.uint8],  # (pixels,) of the last event
    place: wp.array[int],  # (pixels,) of the last event in its burst, 0 before the first of all
    # out
    found: wp.array[int],  # (N,) 1 for the first event of a burst
):
    """Tell each event's place in the burst of its pixel, on one thread."""
    for i in range(time.shape[0]):
        at = pixel[i]
        now = int(1)
        if place[at] > 0 and sign[at] == polarity[i] and time[i] - last[at] <= gap:
            now = wp.min(place[at] + 1, 1 << 30)
        place[at] = now
        last[at] = time[i]
        sign[at] = polarity[i]
        found[i] = now


@wp.kernel(enable_backward=False)
def follow_flicker(
    # in
    time: wp.array[wp.int64],  # (N,) [ns], not decreasing
    region: wp.array[int],  # (N,)
    polarity: wp.array[wp.uint8],  # (N,) 1 for ON
    shortest: wp.int64,  # period of the band [ns]
    longest: wp.int64,  # period of the band [ns]
    start: int,  # bursts in step from which on a region flickers
    stop: int,  # bursts in step below which it does not any more
    most: int,  # bursts that are counted
    # in and out
    sign: wp.array[wp.uint8],  # (regions,) of the last event, 2 before the first
    begin: wp.array[wp.int64],  # (regions,) of the last burst of ON events [ns]
    count: wp.array[int],  # (regions,) bursts in step, -1 before the first
    active: wp.array[wp.uint8],  # (regions,)
    # out
    flickers: wp.array[wp.uint8],  # (N,)
):
    """Tell of each event whether its region flickers, on one thread."""
    for i in range(time.shape[0]):
        at = region[i]
        if polarity[i] == wp.uint8(1) and sign[at] != wp.uint8(1):
            since = time[i] - begin[at]
            if count[at] < 0:
                count[at] = 0
            elif since >= shortest and since <= longest:
                count[at] = wp.min(count[at] + 1, most)
            else:
                count[at] = wp.max(count[at] - 1, 0)
            if count[at] >= start:
                active[at] = wp.uint8(1)
            elif count[at] < stop:
                active[at] = wp.uint8(0)
            begin[at] = time[i]
        sign[at] = polarity[i]
        flickers[i] = active[at]
