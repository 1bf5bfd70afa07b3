"""One optimiser step of many weight matrices whose gradients are sums of a few outer products.

A critic of a bank sees a handful of patches per step, so the gradient of its first layer, by far the largest,
has a rank of a handful. Storing it would cost as much memory traffic as reading the weights; here it lives in
registers only: a weight is read, moved and written once.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE = 4
"""A thread works on TILE x TILE weights."""


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const float4 q = *reinterpret_cast<const float4*>(&wp::index(a, c, j, k));
    return wp::vec_t<4, wp::float32>(q.x, q.y, q.z, q.w);
#else
    return wp::vec_t<4, wp::float32>(
        wp::index(a, c, j, k), wp::index(a, c, j, k + 1), wp::index(a, c, j, k + 2), wp::index(a, c, j, k + 3));
#endif
"""
)
def load(a: wp.array3d[float], c: int, j: int, k: int) -> wp.vec4:
    """Return a[c, j, k : k + 4] by one load of 16 bytes."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    *reinterpret_cast<float4*>(&wp::index(a, c, j, k)) = make_float4(q[0], q[1], q[2], q[3]);
#else
    for (int n = 0; n < 4; ++n) wp::index(a, c, j, k + n) = q[n];
#endif
"""
)
def store(a: wp.array3d[float], c: int, j: int, k: int, q: wp.vec4):
    """Set a[c, j, k : k + 4] by one store of 16 bytes."""
    ...


@wp.func
def widen(low: int, high: int) -> wp.vec4:
    """Return four bfloat16 that lie in two words, the first in the low half of the first."""
    a = wp.cast(low, wp.uint32)
    b = wp.cast(high, wp.uint32)
    half = wp.uint32(16)
    return wp.vec4(
        wp.cast(a << half, float),
        wp.cast((a >> half) << half, float),
        wp.cast(b << half, float),
        wp.cast((b >> half) << half, float),
    )


@wp.func
def rounded(value: float) -> int:
    """Return a float32's nearest bfloat16, ties to even, in the high half of a word; no NaN."""
    bits = wp.cast(value, wp.uint32)
    half = wp.uint32(16)
    bits += wp.uint32(32767) + ((bits >> half) & wp.uint32(1))
    return wp.cast((bits >> half) << half, wp.int32)


@wp.func
def pair(low: float, high: float) -> int:
    """Return two floats as bfloat16 in one word."""
    first = wp.cast(wp.cast(rounded(low), wp.uint32) >> wp.uint32(16), wp.int32)
    return first | rounded(high)


@wp.kernel
def adam(
    first: int,
    # in
    left: wp.array3d[float],  # (C, R, J) rows of the outer products
    right: wp.array3d[int],  # (C, R, K / 2) their other rows, two bfloat16 in a word
    rows: wp.array2d[int],  # (C, G) of each of G equal groups of the R rows, how many come first and count
    rate: wp.array[float],  # (C,) learning rate, 0 leaves a critic alone
    correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
    decay: float,  # of the mean square
    tiny: float,  # added to the root
    # inout
    weight: wp.array3d[float],  # (C, J, K)
    square: wp.array3d[float],  # (C, J, K) running mean of the gradient's square
    # out
    copy: wp.array3d[int],  # (C, J, K / 2) the weights in bfloat16, two in a word
):
    """Adam without momentum (Kingma and Ba, Adam, 2015), TILE x TILE weights per thread."""
    c, i = wp.tid()
    if rate[c] == 0.0:
        return
    i += first
    across = weight.shape[2] / TILE
    k = TILE * (i % across)
    j = TILE * (i / across)
    gradient = wp.mat44()
    group = left.shape[1] / rows.shape[1]
    for g in range(rows.shape[1]):
        for r in range(g * group, g * group + rows[c, g]):
            y = widen(right[c, r, k / 2], right[c, r, k / 2 + 1])
            gradient += wp.outer(load(left, c, r, j), y)
    for n in range(TILE):
        slope = gradient[n]
        mean = decay * load(square, c, j + n, k) + (1.0 - decay) * wp.cw_mul(slope, slope)
        store(square, c, j + n, k, mean)
        w = load(weight, c, j + n, k)
        for m in range(TILE):
            w[m] = w[m] - rate[c] * slope[m] / (wp.sqrt(mean[m] * correction[c]) + tiny)
        store(weight, c, j + n, k, w)
        copy[c, j + n, k / 2] = pair(w[0], w[1])
        copy[c, j + n, k / 2 + 1] = pair(w[2], w[3])
