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
    const float* q = &wp::index(a, c, j, k);
    return wp::vec_t<4, wp::float32>(q[0], q[1], q[2], q[3]);
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
    for (int n = 0; n < 4; ++n) (&wp::index(a, c, j, k))[n] = q[n];
#endif
"""
)
def store(a: wp.array3d[float], c: int, j: int, k: int, q: wp.vec4):
    """Set a[c, j, k : k + 4] by one store of 16 bytes."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    *reinterpret_cast<int2*>(&wp::index(a, c, j, k)) = make_int2(low, high);
#else
    (&wp::index(a, c, j, k))[0] = low;
    (&wp::index(a, c, j, k))[1] = high;
#endif
"""
)
def store_pairs(a: wp.array3d[int], c: int, j: int, k: int, low: int, high: int):
    """Set a[c, j, k : k + 2] by one store of 8 bytes."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const float4 q = __ldg(reinterpret_cast<const float4*>(&wp::index(a, r, k)));
    return wp::vec_t<4, wp::float32>(q.x, q.y, q.z, q.w);
#else
    const float* q = &wp::index(a, r, k);
    return wp::vec_t<4, wp::float32>(q[0], q[1], q[2], q[3]);
#endif
"""
)
def row(a: wp.array2d[float], r: int, k: int) -> wp.vec4:
    """Return a[r, k : k + 4] by one load of 16 bytes."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const float4 q = __ldg(reinterpret_cast<const float4*>(&wp::index(a, r, k)));
    return wp::vec_t<4, wp::float32>(q.x, q.y, q.z, q.w);
#else
    wp::vec_t<4, wp::float32> q;
    __builtin_memcpy(&q, &wp::index(a, r, k), sizeof(q));
    return q;
#endif
"""
)
def full_row(a: wp.array2d[int], r: int, k: int) -> wp.vec4:
    """Return the four float32 at [r, k : k + 4] of rows that are handed over as words."""
    ...


@wp.func_native(
    """
    typedef unsigned int word;
#ifdef __CUDA_ARCH__
    const uint2 q = __ldg(reinterpret_cast<const uint2*>(&wp::index(a, r, k / 2)));
    const word low = q.x, high = q.y;
    #define DASE_AS_FLOAT __uint_as_float
#else
    const word low = (&wp::index(a, r, k / 2))[0], high = (&wp::index(a, r, k / 2))[1];
    #define DASE_AS_FLOAT(bits) __builtin_bit_cast(float, (word)(bits))
#endif
    return wp::vec_t<4, wp::float32>(
        DASE_AS_FLOAT(low << 16), DASE_AS_FLOAT(low & 0xffff0000u), DASE_AS_FLOAT(high << 16),
        DASE_AS_FLOAT(high & 0xffff0000u));
"""
)
def half_row(a: wp.array2d[int], r: int, k: int) -> wp.vec4:
    """Return the four bfloat16 at [r, k : k + 4] of rows that are handed over as words of two."""
    ...


@wp.func
def rounded(value: float) -> wp.uint32:
    """Return a float32's nearest bfloat16, ties to even; no NaN."""
    bits = wp.cast(value, wp.uint32)
    half = wp.uint32(16)
    return (bits + wp.uint32(32767) + ((bits >> half) & wp.uint32(1))) >> half


@wp.func
def pair(low: float, high: float) -> int:
    """Return two floats as bfloat16 in one word."""
    return wp.cast(rounded(low) | (rounded(high) << wp.uint32(16)), wp.int32)


def _adam(half: bool) -> wp.Kernel:
    """Return the kernel for right rows in bfloat16, or in float32."""
    right_row = half_row if half else full_row

    @wp.kernel(enable_backward=False, module="unique")
    def adam(
        first: int,
        # in
        left: wp.array2d[float],  # (R, J) rows of the outer products, critic by critic
        right: wp.array2d[int],  # (R, K) their other rows, as words of a float32 or two bfloat16
        end: wp.array[int],  # (C,) where the rows of a critic end, and the next one's begin
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
        # everything is asked for before anything is worked out: no load may pass a store
        means = wp.mat44()
        weights = wp.mat44()
        for n in range(TILE):
            means[n] = load(square, c, j + n, k)
            weights[n] = load(weight, c, j + n, k)
        gradient = wp.mat44()
        begin = int(0)
        if c > 0:
            begin = end[c - 1]
        for r in range(begin, end[c]):
            gradient += wp.outer(row(left, r, j), right_row(right, r, k))
        for n in range(TILE):
            slope = gradient[n]
            mean = decay * means[n] + (1.0 - decay) * wp.cw_mul(slope, slope)
            store(square, c, j + n, k, mean)
            w = weights[n]
            for m in range(TILE):
                w[m] = w[m] - rate[c] * slope[m] / (wp.sqrt(mean[m] * correction[c]) + tiny)
            store(weight, c, j + n, k, w)
            store_pairs(copy, c, j + n, k / 2, pair(w[0], w[1]), pair(w[2], w[3]))

    return adam


@wp.kernel(enable_backward=False)
def adam_of(
    first: int,
    # in
    gradient: wp.array2d[float],  # (C, J)
    rate: wp.array[float],  # (C,) learning rate, 0 leaves a critic alone
    correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
    decay: float,  # of the mean square
    tiny: float,  # added to the root
    # inout
    weight: wp.array2d[float],  # (C, J)
    square: wp.array2d[float],  # (C, J) running mean of the gradient's square
):
    """The step of `adam` where the gradient is known."""
    c, i = wp.tid()
    if rate[c] == 0.0:
        return
    i += first
    slope = gradient[c, i]
    mean = decay * square[c, i] + (1.0 - decay) * slope * slope
    square[c, i] = mean
    weight[c, i] = weight[c, i] - rate[c] * slope / (wp.sqrt(mean * correction[c]) + tiny)


adam = {half: _adam(half) for half in (True, False)}
"""Kernels by whether the right rows are bfloat16."""
