"""Events among others: at one time, of one pixel, on one line, in one cell of space and time.

Events are looked at one after the other, as they come, by one thread: each needs what the one before left.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func
def move_to(
    place: int,  # of a time below the limit, or of the first that is not
    limit: wp.float64,  # [s]
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
):
    """Place of the first time that is not below a limit."""
    while place < time.shape[0]:
        if time[place] >= limit:
            break
        place += 1
    return place


@wp.func
def move_behind(
    place: int,  # of a time up to the limit, or of the first beyond it
    limit: wp.float64,  # [s]
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
):
    """Place of the first time beyond a limit."""
    while place < time.shape[0]:
        if time[place] > limit:
            break
        place += 1
    return place


@wp.kernel
def mark_times_of_many(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    tie: wp.float64,  # [s]
    far: wp.float64,  # [s]
    share: wp.float64,
    # out
    out: wp.array[wp.bool],  # (N,)
):
    """Mark events with more others within `tie` than a share of those within `far`. Called with dim=1."""
    tie_begin = int(0)
    tie_end = int(0)
    far_begin = int(0)
    far_end = int(0)
    for i in range(time.shape[0]):
        tie_begin = move_to(tie_begin, time[i] - tie, time)
        tie_end = move_behind(tie_end, time[i] + tie, time)
        far_begin = move_to(far_begin, time[i] - far, time)
        far_end = move_behind(far_end, time[i] + far, time)
        others = wp.float64(far_end - far_begin - 1)
        out[i] = wp.float64(tie_end - tie_begin - 1) > share * others


@wp.kernel
def count_by_time_and_tile(
    # in
    time: wp.array[wp.float64],  # (N,) [s]
    x: wp.array[wp.uint16],  # (N,)
    y: wp.array[wp.uint16],  # (N,)
    polarity: wp.array[wp.bool],  # (N,)
    begin: wp.float64,  # [s]
    step: wp.float64,  # [s]
    row: wp.array[int],  # (H,) first tile of the row of tiles that each row lies in
    column: wp.array[int],  # (W,) column of tiles
    # out
    count_out: wp.array3d[wp.uint32],  # (K, 2, T) by step, OFF and ON, tile
):
    """Count events by time, polarity and tile. Called with dim=1."""
    for i in range(time.shape[0]):
        tile = row[int(y[i])] + column[int(x[i])]
        count_out[int((time[i] - begin) / step), int(polarity[i]), tile] += wp.uint32(1)


@wp.kernel
def count_busy_cells(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    x: wp.array[wp.uint16],  # (N,)
    y: wp.array[wp.uint16],  # (N,)
    begin: wp.float64,  # [s]
    span: wp.float64,  # of a cell [s]
    side: int,  # of a cell [px]
    # in and out
    newest: wp.array2d[wp.int64],  # (rows, columns) span in which each block was last seen, -1 before
    count_out: wp.array[int],  # (1,)
):
    """Count cells of space and time with events. Called with dim=1."""
    for i in range(time.shape[0]):
        now = wp.int64((time[i] - begin) / span)
        row = int(y[i]) / side
        column = int(x[i]) / side
        if newest[row, column] != now:
            count_out[0] += 1
            newest[row, column] = now


@wp.kernel
def order_within_stamps(
    # in
    first: wp.array[int],  # (N,) place of the first event of each one's stamp
    drawn: wp.array[int],  # (K,) events, as they were drawn
    # in and out
    free: wp.array[int],  # (N,) next place in the stamp that begins there
    # out
    order_out: wp.array[int],  # (N,)
):
    """Put events at places of their stamps, those that were drawn earlier before others. With dim=1."""
    for k in range(drawn.shape[0]):
        stamp = first[drawn[k]]
        order_out[free[stamp]] = drawn[k]
        free[stamp] += 1


@wp.kernel
def measure_intervals(
    # in
    time: wp.array[wp.float64],  # (N,) [s]
    pixel: wp.array[int],  # (N,) row-major
    # in and out
    last: wp.array[wp.float64],  # (H * W,) [s], when each pixel was last seen
    # out
    interval_out: wp.array[wp.float64],  # (N,) [s]
):
    """Measure the time since the event before of the same pixel. Called with dim=1."""
    for i in range(time.shape[0]):
        interval_out[i] = time[i] - last[pixel[i]]
        last[pixel[i]] = time[i]


@wp.kernel
def measure_own_gaps(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    place: wp.array2d[int],  # (2, N) columns and rows
    longest: wp.float64,  # [s]
    # in and out
    seen: wp.array2d[int],  # (H, W) where each pixel was last seen, -1 before
    # out
    gap_out: wp.array[wp.float64],  # (N,) [s]
):
    """Measure the time from each event to the nearer of its pixel's other events. Called with dim=1."""
    for i in range(time.shape[0]):
        gap_out[i] = longest
        before = seen[place[1, i], place[0, i]]
        if before >= 0:
            gap = time[i] - time[before]
            gap_out[i] = wp.min(gap, longest)
            gap_out[before] = wp.min(gap, gap_out[before])
        seen[place[1, i], place[0, i]] = i


@wp.func
def is_near(
    order: int,  # of another event, from `begin` on, -1 for none
    begin: int,
    sign: int,
    index: int,
    limit: wp.float64,  # [s]
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
):
    """Whether another event does not come before `index` and `limit`; for a sign of -1, not after these."""
    other = begin + sign * order
    if order < 0:
        return False
    if sign * other >= sign * index:
        return True
    return wp.float64(sign) * time[other] >= wp.float64(sign) * limit


@wp.kernel
def mark_with_neighbours(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    place: wp.array2d[int],  # (2, N) columns and rows
    gap: wp.array[wp.float64],  # (N,) [s]
    reach: int,  # events
    away: int,  # [px]
    sign: int,  # 1 for neighbours that send before, -1 for those that send after
    # in and out
    seen: wp.array2d[int],  # (H + 2 away, W + 2 away) how many came before each pixel's last, -1 for none
    out: wp.array[int],  # (N,) 1 for one on the row, 2 for one on the column, 3 for both
):
    """Mark events with others on their line near by, within `gap` or `reach` of their stamp. With dim=1.

    And those of which it is not known, as it is too long until the begin or the end.
    """
    count = time.shape[0]
    begin = wp.where(sign > 0, 0, count - 1)
    stamp = begin
    for k in range(count):
        i = begin + sign * k
        if time[i] != time[stamp]:
            stamp = i
        x = place[0, i] + away
        y = place[1, i] + away
        index = stamp - sign * reach
        limit = time[i] - wp.float64(sign) * gap[i]
        if wp.float64(sign) * limit < wp.float64(sign) * time[begin]:
            out[i] = 3
        if out[i] != 3:
            # places of those that were seen last, in this order: without branches, which would cost more
            row = int(-1)
            column = int(-1)
            for step in range(1, away + 1):
                row = wp.max(row, wp.max(seen[y, x - step], seen[y, x + step]))
                column = wp.max(column, wp.max(seen[y - step, x], seen[y + step, x]))
            out[i] = out[i] | int(is_near(row, begin, sign, index, limit, time))
            out[i] = out[i] | 2 * int(is_near(column, begin, sign, index, limit, time))
        seen[y, x] = k


@wp.kernel
def count_line_pairs(
    # in
    time: wp.array[wp.float64],  # (N,) [s], not decreasing
    place: wp.array2d[int],  # (2, N) columns and rows
    lines: wp.array[int],  # (N,) left out on: 1 for the row, 2 for the column, 3 for both
    begins: wp.array[int],  # (R + 1,) of runs of events, and the end of the last
    lags: wp.array[int],  # (L,) from one event of a pair to the other
    span: wp.float64,  # [s] that a pair may take
    beside: int,  # [px] lines near by
    away: int,  # [px] that a pair must be apart on its line
    # out
    free_out: wp.array3d[int],  # (R, 2, L) pairs that are not left out, on a row and on a column
    pairs_out: wp.array4d[int],  # (R, 2, L, 2) of these, those on one line, and on lines near by
):
    """Count pairs of events that share a row or column, a run and a lag per thread."""
    run, lag = wp.tid()
    for i in range(begins[run], begins[run + 1] - lags[lag]):
        other = i + lags[lag]
        closed = lines[i] | lines[other]
        if closed != 3 and time[other] - time[i] < span:
            for axis in range(2):
                if (closed >> axis) & 1 == 0:
                    free_out[run, axis, lag] += 1
                    apart = wp.abs(place[1 - axis, other] - place[1 - axis, i])
                    if apart <= beside and wp.abs(place[axis, other] - place[axis, i]) > away:
                        pairs_out[run, axis, lag, wp.min(apart, 1)] += 1
