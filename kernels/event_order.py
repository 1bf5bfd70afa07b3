"""Stored events in the order of their pixels."""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.func_native(
    """
    const int count = start.shape[0] - 1;
    const int events = t.shape[0];
    int* __restrict__ at = start.data;
    for (int i = 0; i <= count; ++i) at[i] = 0;
    // the next place of pixel i is kept at i + 1, so that it ends up where the pixel's events end
    for (int n = 0; n < events; ++n) {
        const int i = place.data[(size_t)y.data[n] * width + x.data[n]];
        if (i >= 0 && i + 2 <= count) ++at[i + 2];
    }
    for (int i = 0; i < count; ++i) at[i + 1] += at[i];
    for (int n = 0; n < events; ++n) {
        const int i = place.data[(size_t)y.data[n] * width + x.data[n]];
        if (i < 0) continue;
        const int to = at[i + 1]++;
        time.data[to] = (long long)rint((t.data[n] - begin) * 1e9);
        polarity.data[to] = p.data[n];
    }
"""
)
def counting_sort(
    t: wp.array[wp.float64],
    x: wp.array[wp.uint16],
    y: wp.array[wp.uint16],
    p: wp.array[wp.uint8],
    place: wp.array[int],
    width: int,
    begin: wp.float64,
    start: wp.array[int],
    time: wp.array[wp.int64],
    polarity: wp.array[wp.uint8],
):
    """Do what `sort_into_pixels` does; arguments have the shape and unit that it says."""
    ...


@wp.kernel(enable_backward=False)
def sort_into_pixels(
    # in
    t: wp.array[wp.float64],  # (M,) [s], not decreasing
    x: wp.array[wp.uint16],  # (M,)
    y: wp.array[wp.uint16],  # (M,)
    p: wp.array[wp.uint8],  # (M,)
    place: wp.array[int],  # (width · height,) which of the N pixels each is, -1 for none of them
    width: int,
    begin: wp.float64,  # of the time that is looked at [s]
    # out
    start: wp.array[int],  # (N + 1,) first event of each pixel, and the end
    time: wp.array[wp.int64],  # (M,) [ns since the begin] in order of pixel, time
    polarity: wp.array[wp.uint8],  # (M,)
):
    """Bring the events of some pixels in the order of the pixels, on one thread of a CPU."""
    counting_sort(t, x, y, p, place, width, begin, start, time, polarity)
