"""Where the rows of a bank of critics lie, and who moves.

Rows lie critic by critic, each critic's in the order fake, real, half way between; behind them lie rows of no
critic, whose class is the number of critics.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func
def count_below(keys: wp.array[int], key: int) -> int:
    """Return how many of the keys (N,), which are in order, are less."""
    place = wp.lower_bound(keys, key)
    # where all are less, Warp returns the last place
    return place + wp.where(keys[place] < key, 1, 0)


@wp.func
def pairs_of(number: wp.array2d[int], c: int) -> int:
    """Rows half way: one for each pair of a fake and a real one."""
    return wp.min(number[0, c], number[1, c])


@wp.func
def rows_of(number: wp.array2d[int], c: int) -> int:
    """Rows of a critic, of those of each class (2, C); without rows of both sides it has none."""
    pairs = pairs_of(number, c)
    return wp.where(pairs > 0, number[0, c] + number[1, c] + pairs, 0)


@wp.kernel
def count_rows(
    first: int,
    # in
    keys: wp.array[int],  # (N + M,) twice the class of each row, and 1 for real ones, in order
    # out
    number: wp.array2d[int],  # (2, C) rows of each class, fake and real
    size: wp.array2d[int],  # (2, C) rows of its critic: all, and those half way
):
    """Count the rows of both sides."""
    _, c = wp.tid()
    c += first
    real = count_below(keys, 2 * c + 1)
    number[0, c] = real - count_below(keys, 2 * c)
    number[1, c] = count_below(keys, 2 * c + 2) - real
    size[0, c] = rows_of(number, c)
    size[1, c] = pairs_of(number, c)


@wp.kernel
def place_rows(
    first: int,
    # in
    keys: wp.array[int],  # (N + M,) twice the class of each row, and 1 for real ones, in order
    row: wp.array[wp.int64],  # (N + M,) which row has that key, fake ones first
    number: wp.array2d[int],  # (2, C)
    end: wp.array2d[int],  # (2, C) where the rows of each critic end, among all and among those half way
    weights: wp.array[float],  # (C,)
    # out, preset for rows of no critic
    order: wp.array[int],  # (R,) which row lies here: fake, then real, then half way; -1
    of: wp.array[int],  # (R,) its critic; C
    gain: wp.array[float],  # (R,) derivative of the loss by its score; 0
    place: wp.array[int],  # (N,) where the rows half way lie, critic by critic; -1
    held: wp.array[float],  # (N,) what they weigh in the penalty; 0
):
    """Give every row its place; the i-th fake row of a class is paired with its i-th real one."""
    _, i = wp.tid()
    i += first
    key = keys[i]
    c = key / 2
    if c >= number.shape[1]:
        return
    pairs = pairs_of(number, c)
    if pairs == 0:
        return
    rank = i - count_below(keys, key)
    begin = end[0, c] - rows_of(number, c)
    if key % 2 == 0:
        order[begin + rank] = int(row[i])
        of[begin + rank] = c
        gain[begin + rank] = weights[c] / float(number[0, c])
        if rank < pairs:
            here = begin + number[0, c] + number[1, c] + rank
            order[here] = keys.shape[0] + int(row[i])
            of[here] = c
            slot = end[1, c] - pairs + rank
            place[slot] = here
            held[slot] = weights[c] / float(pairs)
    else:
        here = begin + number[0, c] + rank
        order[here] = int(row[i])
        of[here] = c
        gain[here] = -weights[c] / float(number[1, c])


@wp.kernel
def sum_rows(
    first: int,
    # in
    values: wp.array2d[float],  # (R, J)
    order: wp.array[int],  # (R,)
    end: wp.array2d[int],  # (2, C)
    before: int,  # rows from this one on are left out
    # out
    out: wp.array2d[float],  # (C, J)
):
    """Sum up the rows of each critic, one after the other."""
    c, j = wp.tid()
    j += first
    begin = int(0)
    if c > 0:
        begin = end[0, c - 1]
    total = float(0.0)
    for r in range(begin, end[0, c]):
        if order[r] < before:
            total += values[r, j]
    out[c, j] = total


@wp.kernel
def count_steps(
    first: int,
    # in
    number: wp.array2d[int],  # (2, C)
    rate: wp.array[float],  # (1,) learning rate
    decay: float,  # of the mean square
    momentum: float,  # decay of the mean
    # inout
    steps: wp.array[float],  # (C,) that each critic has made
    # out
    rates: wp.array[float],  # (C,) rate / (1 - momentum^steps), 0 for critics without rows
    correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
):
    """Count the step of the critics that make one."""
    _, c = wp.tid()
    c += first
    moves = pairs_of(number, c) > 0
    made = steps[c] + wp.where(moves, 1.0, 0.0)
    steps[c] = made
    count = wp.max(made, 1.0)
    rates[c] = wp.where(moves, rate[0] / (1.0 - wp.pow(momentum, count)), 0.0)
    correction[c] = 1.0 / (1.0 - wp.pow(decay, count))
