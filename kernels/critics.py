"""What a bank of critics does between its products: rows in order, layers, and what follows from them.

Every kernel stands for a dozen small ones of a tensor library, which a critic step would spend a quarter of
its time on. Rows lie critic by critic, each critic's in the order fake, real, half way between; behind them
lie rows of no critic, whose class is the number of critics, and whose values are 0.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from types import SimpleNamespace

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def leaky(x: float, slope: float) -> float:
    """Return the leaky rectifier."""
    return wp.where(x > 0.0, x, slope * x)


@wp.func
def incline(x: float, slope: float) -> float:
    """Slope of the leaky rectifier."""
    return wp.where(x > 0.0, 1.0, slope)


@wp.func
def class_of(fake: wp.array[wp.int64], real: wp.array[wp.int64], i: int) -> int:
    """Return the class of the i-th row, fake ones first."""
    if i < fake.shape[0]:
        return int(fake[i])
    return int(real[i - fake.shape[0]])


@wp.kernel
def count_rows(
    first: int,
    # in
    fake: wp.array[wp.int64],  # (N,) class of each row, C for none
    real: wp.array[wp.int64],  # (M,)
    # out
    number: wp.array2d[int],  # (2, C) rows of each class, fake and real
):
    """Count the rows of both sides."""
    side, i = wp.tid()
    c = wp.int64(i + first)
    found = int(0)
    if side == 0:
        for n in range(fake.shape[0]):
            found += wp.where(fake[n] == c, 1, 0)
    else:
        for n in range(real.shape[0]):
            found += wp.where(real[n] == c, 1, 0)
    number[side, i + first] = found


@wp.func
def pairs_of(number: wp.array2d[int], c: int) -> int:
    """Rows half way: one for each pair of a fake and a real one."""
    return wp.min(number[0, c], number[1, c])


@wp.func
def rows_of(number: wp.array2d[int], c: int) -> int:
    """Rows of a critic; without rows of both sides it has none."""
    pairs = pairs_of(number, c)
    return wp.where(pairs > 0, number[0, c] + number[1, c] + pairs, 0)


@wp.kernel
def lay_out(
    first: int,
    # in
    number: wp.array2d[int],  # (2, C)
    # out
    end: wp.array2d[int],  # (2, C) where a critic's rows end, among all and among those half way
):
    """Find where the rows of each critic end."""
    side, i = wp.tid()
    i += first
    total = int(0)
    for c in range(i + 1):
        total += wp.where(side == 0, rows_of(number, c), pairs_of(number, c))
    end[side, i] = total


@wp.kernel
def place_rows(
    first: int,
    # in
    fake: wp.array[wp.int64],  # (N,) class of each row, C for none
    real: wp.array[wp.int64],  # (M,)
    number: wp.array2d[int],  # (2, C)
    end: wp.array2d[int],  # (2, C)
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
    fakes = fake.shape[0]
    is_fake = i < fakes
    c = class_of(fake, real, i)
    if c >= number.shape[1]:
        return
    pairs = pairs_of(number, c)
    if pairs == 0:
        return
    begin = end[0, c] - rows_of(number, c)
    rank = int(0)
    if is_fake:
        for n in range(i):
            rank += wp.where(fake[n] == fake[i], 1, 0)
        order[begin + rank] = i
        of[begin + rank] = c
        gain[begin + rank] = weights[c] / float(number[0, c])
        if rank < pairs:
            here = begin + number[0, c] + number[1, c] + rank
            order[here] = fakes + real.shape[0] + i
            of[here] = c
            slot = end[1, c] - pairs + rank
            place[slot] = here
            held[slot] = weights[c] / float(pairs)
    else:
        mine = i - fakes
        for n in range(mine):
            rank += wp.where(real[n] == real[mine], 1, 0)
        here = begin + number[0, c] + rank
        order[here] = i
        of[here] = c
        gain[here] = -weights[c] / float(number[1, c])


@wp.kernel
def pace(
    first: int,
    # in
    number: wp.array2d[int],  # (2, C)
    rate: wp.array[float],  # (1,) learning rate
    decay: float,  # of the mean square
    # inout
    steps: wp.array[float],  # (C,) that each critic has made
    # out
    rates: wp.array[float],  # (C,) 0 for critics without rows
    correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
):
    """Count the step of the critics that make one."""
    _, c = wp.tid()
    c += first
    moves = pairs_of(number, c) > 0
    made = steps[c] + wp.where(moves, 1.0, 0.0)
    steps[c] = made
    rates[c] = wp.where(moves, rate[0], 0.0)
    correction[c] = 1.0 / (1.0 - wp.pow(decay, wp.max(made, 1.0)))


@wp.kernel
def score(
    first: int,
    # in
    second: wp.array2d[float],  # (R, J) sums of the second layer
    of: wp.array[int],  # (R,)
    last: wp.array2d[float],  # (C, J) weights of the third layer
    bias: wp.array2d[float],  # (C, 1)
    slope: float,
    # out
    out: wp.array[float],  # (R,)
):
    """Work out the scores."""
    _, r = wp.tid()
    r += first
    total = float(0.0)
    c = of[r]
    if c < last.shape[0]:
        total = bias[c, 0]
        for j in range(second.shape[1]):
            total += last[c, j] * leaky(second[r, j], slope)
    out[r] = total


@wp.kernel
def weigh_first(
    first: int,
    # in
    by_first: wp.array2d[float],  # (R, J) derivative of the scores by the first layer's sums
    order: wp.array[int],  # (R,)
    gain: wp.array[float],  # (R,)
    between: int,  # rows from this one on are half way
    # out
    left: wp.array2d[float],  # (R, J)
):
    """Make the left rows of the first layer's gradient."""
    r, j = wp.tid()
    j += first
    left[r, j] = by_first[r, j] * wp.where(order[r] >= between, 1.0, gain[r])


@wp.kernel
def weigh_second(
    first: int,
    # in
    second: wp.array2d[float],  # (R, J) sums of the second layer
    by_second: wp.array2d[float],  # (R, J) derivative of the scores by them
    order: wp.array[int],  # (R,)
    gain: wp.array[float],  # (R,)
    between: int,  # rows from this one on are half way
    slope: float,
    # out
    left: wp.array2d[float],  # (R, J)
    last: wp.array2d[float],  # (R, J) terms of the third layer's gradient, but for rows half way
):
    """Make the left rows of the second layer's gradient, and what the third layer's is a sum of."""
    r, j = wp.tid()
    j += first
    left[r, j] = by_second[r, j] * wp.where(order[r] >= between, 1.0, gain[r])
    last[r, j] = leaky(second[r, j], slope) * gain[r]


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


def _layers(half: bool) -> SimpleNamespace:
    """Return the kernels that read or write rows in the type of the products, bfloat16 or float32."""
    Number = wp.bfloat16 if half else wp.float32

    @wp.kernel(enable_backward=False, module="unique")
    def gather(
        first: int,
        # in
        fake: wp.array2d[float],  # (N, K)
        real: wp.array2d[float],  # (M, K)
        share: wp.array2d[float],  # (N, 1) of the fake row in the one half way
        order: wp.array[int],  # (R,)
        of: wp.array[int],  # (R,)
        number: wp.array2d[int],  # (2, C)
        # out
        rows: wp.array2d[Number],  # (R, K)
    ):
        """Put all rows in order."""
        r, k = wp.tid()
        k += first
        i = order[r]
        fakes = fake.shape[0]
        sides = fakes + real.shape[0]
        value = float(0.0)
        if i >= sides:
            # real rows of a critic lie as far before those half way as there are
            partner = order[r - number[1, of[r]]] - fakes
            value = real[partner, k]
            value += share[i - sides, 0] * (fake[i - sides, k] - value)
        elif i >= fakes:
            value = real[i - fakes, k]
        elif i >= 0:
            value = fake[i, k]
        rows[r, k] = Number(value)

    @wp.kernel(enable_backward=False, module="unique")
    def first_layer(
        first: int,
        # in
        product: wp.array2d[Number],  # (R, J)
        of: wp.array[int],  # (R,)
        bias: wp.array2d[float],  # (C, J)
        slope: float,
        # out
        total: wp.array2d[float],  # (R, J) sums
        hidden: wp.array2d[Number],  # (R, J) what goes on
    ):
        """Work out the first layer."""
        r, j = wp.tid()
        j += first
        value = float(0.0)
        if of[r] < bias.shape[0]:
            value = float(product[r, j]) + bias[of[r], j]
        total[r, j] = value
        hidden[r, j] = Number(leaky(value, slope))

    @wp.kernel(enable_backward=False, module="unique")
    def second_layer(
        first: int,
        # in
        product: wp.array2d[Number],  # (R, J)
        of: wp.array[int],  # (R,)
        bias: wp.array2d[float],  # (C, J)
        last: wp.array2d[float],  # (C, J) weights of the third layer
        slope: float,
        # out
        total: wp.array2d[float],  # (R, J) sums
        by_total: wp.array2d[float],  # (R, J) derivative of the scores by them
        back: wp.array2d[Number],  # (R, J) the same, for the product
    ):
        """Work out the second layer, and the way back from the third."""
        r, j = wp.tid()
        j += first
        value = float(0.0)
        by_value = float(0.0)
        c = of[r]
        if c < bias.shape[0]:
            value = float(product[r, j]) + bias[c, j]
            by_value = last[c, j] * incline(value, slope)
        total[r, j] = value
        by_total[r, j] = by_value
        back[r, j] = Number(by_value)

    @wp.kernel(enable_backward=False, module="unique")
    def way_back(
        first: int,
        # in
        product: wp.array2d[Number],  # (R, J)
        of: wp.array[int],  # (R,)
        total: wp.array2d[float],  # (R, J) sums of the first layer
        slope: float,
        critics: int,
        # out
        by_total: wp.array2d[float],  # (R, J) derivative of the scores by them
    ):
        """Go back to the first layer."""
        r, j = wp.tid()
        j += first
        value = float(0.0)
        if of[r] < critics:
            value = float(product[r, j]) * incline(total[r, j], slope)
        by_total[r, j] = value

    @wp.kernel(enable_backward=False, module="unique")
    def half_way(
        first: int,
        # in
        values: wp.array2d[float],  # (R, J)
        place: wp.array[int],  # (N,)
        # out
        out: wp.array2d[Number],  # (N, J)
    ):
        """Take the rows half way out of all."""
        n, j = wp.tid()
        j += first
        value = float(0.0)
        if place[n] >= 0:
            value = values[place[n], j]
        out[n, j] = Number(value)

    @wp.kernel(enable_backward=False, module="unique")
    def penalise(
        first: int,
        # in
        gradient: wp.array2d[Number],  # (N, K) of the scores by the rows half way
        place: wp.array[int],  # (N,)
        held: wp.array[float],  # (N,)
        penalty: float,
        # out
        by_gradient: wp.array2d[Number],  # (N, K) derivative of the loss by it
        rows: wp.array2d[Number],  # (R, K) set to it where these rows lie
    ):
        """Differentiate the penalty; its rows are the right ones of the first layer's gradient."""
        n, k = wp.tid()
        k += first
        value = float(0.0)
        p = place[n]
        if p >= 0:
            value = 2.0 * penalty * held[n] * float(gradient[n, k])
            rows[p, k] = Number(value)
        by_gradient[n, k] = Number(value)

    @wp.kernel(enable_backward=False, module="unique")
    def again_first(
        first: int,
        # in
        product: wp.array2d[Number],  # (N, J)
        total: wp.array2d[float],  # (R, J) sums of the first layer
        place: wp.array[int],  # (N,)
        slope: float,
        # out
        out: wp.array2d[Number],  # (N, J)
        hidden: wp.array2d[Number],  # (R, J) set to it where these rows lie
    ):
        """Go through the first layer once more with the penalty's derivative."""
        n, j = wp.tid()
        j += first
        value = float(0.0)
        p = place[n]
        if p >= 0:
            value = float(product[n, j]) * incline(total[p, j], slope)
            hidden[p, j] = Number(value)
        out[n, j] = Number(value)

    @wp.kernel(enable_backward=False, module="unique")
    def again_second(
        first: int,
        # in
        second: wp.array2d[float],  # (R, J) sums of the second layer
        place: wp.array[int],  # (N,)
        slope: float,
        product: wp.array2d[Number],  # (N, J)
        # out
        last: wp.array2d[float],  # (R, J)
    ):
        """Set the terms of the third layer's gradient that come from the penalty."""
        n, j = wp.tid()
        j += first
        p = place[n]
        if p >= 0:
            last[p, j] = float(product[n, j]) * incline(second[p, j], slope)

    return SimpleNamespace(
        gather=gather,
        first_layer=first_layer,
        second_layer=second_layer,
        way_back=way_back,
        half_way=half_way,
        penalise=penalise,
        again_first=again_first,
        again_second=again_second,
    )


layers = {half: _layers(half) for half in (True, False)}
"""Kernels by whether products are of bfloat16."""
