"""What a bank of critics does between its products: layers, and what follows from them.

Every kernel stands for a dozen small ones of a tensor library, which a critic step would spend a quarter of
its time on. Rows lie as `dase.kernels.critic_rows` lays them out; values of rows of no critic are 0.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from types import SimpleNamespace

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.vec4 import read_vec4, word_functions

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func
def leaky_relu(x: float, slope: float) -> float:
    """Return the leaky rectifier."""
    return wp.where(x > 0.0, x, slope * x)


@wp.func
def leaky_relu_slope(x: float, slope: float) -> float:
    """Slope of the leaky rectifier."""
    return wp.where(x > 0.0, 1.0, slope)


@wp.kernel
def score_rows(
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
        for j in range(0, second.shape[1], 4):
            value = read_vec4(second, r, j)
            for n in range(4):
                value[n] = leaky_relu(value[n], slope)
            total += wp.dot(read_vec4(last, c, j), value)
    out[r] = total


@wp.kernel
def weigh_first(
    first: int,
    # in
    by_first: wp.array2d[float],  # (R, J) derivative of the scores by the first layer's sums
    order: wp.array[int],  # (R,)
    gain: wp.array[float],  # (R,)
    between: int,  # rows from this one on are half way
    penalty: float,
    # out
    left: wp.array2d[float],  # (R, J)
):
    """Make the left rows of the first layer's gradient."""
    r, j = wp.tid()
    j += first
    left[r, j] = by_first[r, j] * wp.where(order[r] >= between, 2.0 * penalty, gain[r])


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
    last[r, j] = leaky_relu(second[r, j], slope) * gain[r]


def _make_layer_kernels(half: bool) -> SimpleNamespace:
    """Return the kernels that read or write rows in the type of the products, bfloat16 or float32."""
    Number = wp.bfloat16 if half else wp.float32
    get, put = word_functions[half]

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
        rows: wp.array2d[int],  # (R, K) as words
    ):
        """Put all rows in order."""
        r, k = wp.tid()
        k = 4 * (k + first)
        i = order[r]
        fakes = fake.shape[0]
        sides = fakes + real.shape[0]
        value = wp.vec4()
        if i >= sides:
            # real rows of a critic lie as far before those half way as there are
            partner = order[r - number[1, of[r]]] - fakes
            value = read_vec4(real, partner, k)
            value += share[i - sides, 0] * (read_vec4(fake, i - sides, k) - value)
        elif i >= fakes:
            value = read_vec4(real, i - fakes, k)
        elif i >= 0:
            value = read_vec4(fake, i, k)
        put(rows, r, k, value)

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
        hidden[r, j] = Number(leaky_relu(value, slope))

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
            by_value = last[c, j] * leaky_relu_slope(value, slope)
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
            value = float(product[r, j]) * leaky_relu_slope(total[r, j], slope)
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
        gradient: wp.array2d[int],  # (N, K) of the scores by the rows half way, as words
        place: wp.array[int],  # (N,)
        held: wp.array[float],  # (N,)
        # out
        by_gradient: wp.array2d[int],  # (N, K) half the derivative of the mean square by it, as words
        rows: wp.array2d[int],  # (R, K) set to it where these rows lie, as words
    ):
        """Differentiate the mean square; its rows are the right ones of the first layer's gradient."""
        n, k = wp.tid()
        k = 4 * (k + first)
        value = wp.vec4()
        p = place[n]
        if p >= 0:
            value = held[n] * get(gradient, n, k)
            put(rows, p, k, value)
        put(by_gradient, n, k, value)

    @wp.kernel(enable_backward=False, module="unique")
    def again_first(
        first: int,
        # in
        product: wp.array2d[Number],  # (N, J)
        total: wp.array2d[float],  # (R, J) sums of the first layer
        by_total: wp.array2d[float],  # (R, J) derivative of the scores by them
        place: wp.array[int],  # (N,)
        slope: float,
        penalty: float,
        # out
        out: wp.array2d[Number],  # (N, J)
        hidden: wp.array2d[Number],  # (R, J) set to it where these rows lie
        square: wp.array2d[float],  # (N, J) terms of the mean squared gradient
    ):
        """Go through the first layer once more with the penalty's derivative."""
        n, j = wp.tid()
        j += first
        value = float(0.0)
        term = float(0.0)
        p = place[n]
        if p >= 0:
            # the gradient is the weights' transpose times by_total, so this sums up to its square
            term = float(product[n, j]) * by_total[p, j]
            value = 2.0 * penalty * float(product[n, j]) * leaky_relu_slope(total[p, j], slope)
            hidden[p, j] = Number(value)
        out[n, j] = Number(value)
        square[n, j] = term

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
            last[p, j] = float(product[n, j]) * leaky_relu_slope(second[p, j], slope)

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


layer_kernels = {half: _make_layer_kernels(half) for half in (True, False)}
"""Kernels by whether products are of bfloat16."""
