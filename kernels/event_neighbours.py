"""What an event has near it: others of the same few pixels, and the one before of its own pixel.

Events are looked at one after the other, as they come, by one thread: each needs what the one before left.
"""

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func
def has_neighbour(
    time: wp.float64,
    place: int,
    last: wp.array[wp.float64],  # (H * W,) [s]
    gap: wp.float64,
    reach: int,
    width: int,
    height: int,
):
    """Whether another pixel up to `reach` columns and rows away was last seen at most `gap` before."""
    y = place // width
    x = place - y * width
    found = int(0)
    for row in range(wp.max(y - reach, 0), wp.min(y + reach + 1, height)):
        for column in range(wp.max(x - reach, 0), wp.min(x + reach + 1, width)):
            other = row * width + column
            if other != place and time - last[other] <= gap:
                found = 1
        if found == 1:
            break
    return found


@wp.kernel
def mark_crowded(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    pixel: wp.array[int],  # (N,) row-major
    gap: wp.float64,  # [s]
    reach: int,  # [px]
    width: int,
    height: int,
    # in and out
    last: wp.array[wp.float64],  # (H * W,) [s], when each pixel was last seen
    crowded_out: wp.array[wp.uint8],  # (N,) 1 where an event before is near
):
    """Mark events that follow one of a pixel nearby. Called with dim=1."""
    for i in range(time.shape[0]):
        if has_neighbour(time[i], pixel[i], last, gap, reach, width, height) == 1:
            crowded_out[i] = wp.uint8(1)
        last[pixel[i]] = time[i]


@wp.func
def bin_of(
    interval: wp.float64,  # [s], shorter than the last edge
    edges: wp.array[wp.float64],  # (K,) [s], increasing
):
    """Number of the bin that an interval lies in; 0 is below the first edge."""
    kind = int(0)
    while interval >= edges[kind]:
        kind += 1
    return kind


@wp.kernel
def count_short_intervals(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    pixel: wp.array[int],  # (N,) row-major
    polarity: wp.array[wp.uint8],  # (N,) 1 for ON
    shared: wp.array[wp.uint8],  # (N,) 1 where many pixels send at that time
    edges: wp.array[wp.float64],  # (K,) [s], increasing, between which intervals are counted
    late_edges: wp.array[wp.float64],  # (L,) [s], the same for late doubles, the last beyond those of `edges`
    # in and out
    last: wp.array[wp.float64],  # (H * W,) [s], when each pixel was last seen
    last_interval: wp.array[wp.float64],  # (H * W,) [s], from the event before to that
    last_polarity: wp.array[wp.uint8],  # (H * W,)
    count_out: wp.array4d[int],  # (3, K, 2, H * W): all intervals, those after a silence, and calm ones
    sum_out: wp.array[wp.float64],  # (K,) [s], of all intervals
    late_out: wp.array3d[int],  # (4, L, 2): as `count_out`, of all pixels together, and what follows them
    late_sum_out: wp.array[wp.float64],  # (L,) [s], of all intervals
    late_of_pixels_out: wp.array[int],  # (H * W,): after a silence, from the second to the last but one edge
):
    """Count how often a pixel is soon seen again with the same polarity. Called with dim=1.

    OFF and ON. After a silence is what follows an event before which the pixel was silent for as long as the
    last edge; calm is such an interval that ends at a time of its own. What follows an interval is another up
    to the last edge, of whatever length.
    """
    far = edges[edges.shape[0] - 1]
    beyond = late_edges.shape[0] - 1
    late_far = late_edges[beyond]
    for i in range(time.shape[0]):
        place = pixel[i]
        sign = polarity[i]
        interval = time[i] - last[place]
        if sign == last_polarity[place] and interval < far:
            kind = bin_of(interval, edges)
            count_out[0, kind, int(sign), place] += 1
            sum_out[kind] += interval
            if last_interval[place] >= far:
                count_out[1, kind, int(sign), place] += 1
                if shared[i] == wp.uint8(0):
                    count_out[2, kind, int(sign), place] += 1
        if sign == last_polarity[place] and interval < late_far:
            late = bin_of(interval, late_edges)
            late_out[0, late, int(sign)] += 1
            late_sum_out[late] += interval
            if last_interval[place] >= late_far:
                late_out[1, late, int(sign)] += 1
                if late > 1 and late < beyond:
                    late_of_pixels_out[place] += 1
                if shared[i] == wp.uint8(0):
                    late_out[2, late, int(sign)] += 1
            else:
                late_out[3, bin_of(last_interval[place], late_edges), int(sign)] += 1
        last_interval[place] = interval
        last[place] = time[i]
        last_polarity[place] = sign
