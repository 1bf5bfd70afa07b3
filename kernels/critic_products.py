"""One optimiser step of many weight matrices whose gradients are sums of a few outer products.

A critic of a bank sees a handful of patches per step, so the gradient of its first layer, by far the largest,
has a rank of a handful. Storing it would cost as much memory traffic as reading the weights; here it lives in
registers only: a weight is read, moved and written once.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.vec4 import load_vec4, read_half, store_half, store_vec4

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})

TILE = 4
"""A thread works on TILE x TILE weights at a time."""

STRIP = 8
"""So many times, one tile below the other."""

ROWS = 4
"""Rows of a product that a thread works on side by side."""


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    // exact ones would be most of the kernel's instructions
    float root, out;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(root) : "f"(square));
    asm("div.approx.ftz.f32 %0, %1, %2;" : "=f"(out) : "f"(slope), "f"(root + tiny));
    return out;
#else
    return slope / (__builtin_sqrtf(square) + tiny);
#endif
"""
)
def over_root(slope: float, square: float, tiny: float) -> float:
    """Return slope / (root of square + tiny), on a GPU to within its last digits."""
    ...


def _outer_products(*, each: int, on_gpu: str, on_cpu: str) -> str:
    """Return the C++ that sums up outer products.

    Args:
        each: Numbers per word of a right row.
        on_gpu: What sets `b` to four of them.
        on_cpu: Bits of the n-th of them.
    """
    return f"""
    float sum[4][4] = {{}};
    const float* p = &wp::index(left, begin, j);
    const int* q = &wp::index(right, begin, k / {each});
    const size_t next_p = left.strides[0] / sizeof(float), next_q = right.strides[0] / sizeof(int);
    #pragma unroll 2
    for (int r = begin; r < end; ++r, p += next_p, q += next_q) {{
        float a[4], b[4];
#ifdef __CUDA_ARCH__
        const float4 four = __ldg(reinterpret_cast<const float4*>(p));
        a[0] = four.x, a[1] = four.y, a[2] = four.z, a[3] = four.w;
        {on_gpu}
#else
        for (int n = 0; n < 4; ++n) a[n] = p[n];
        for (int n = 0; n < 4; ++n) b[n] = __builtin_bit_cast(float, {on_cpu});
#endif
        for (int n = 0; n < 4; ++n)
            for (int m = 0; m < 4; ++m) sum[n][m] += a[n] * b[m];
    }}
    wp::mat_t<4, 4, wp::float32> out;
    for (int n = 0; n < 4; ++n)
        for (int m = 0; m < 4; ++m) out.data[n][m] = sum[n][m];
    return out;
"""


@wp.func_native(
    _outer_products(
        each=2,
        on_gpu="""const uint2 w = __ldg(reinterpret_cast<const uint2*>(q));
        b[0] = __uint_as_float(w.x << 16), b[1] = __uint_as_float(w.x & 0xffff0000u);
        b[2] = __uint_as_float(w.y << 16), b[3] = __uint_as_float(w.y & 0xffff0000u);""",
        on_cpu="n % 2 ? (unsigned int)q[n / 2] & 0xffff0000u : (unsigned int)q[n / 2] << 16",
    )
)
def outer_half(
    left: wp.array2d[float], right: wp.array2d[int], begin: int, end: int, j: int, k: int
) -> wp.mat44:
    """Return a sum of outer products at [j : j + 4, k : k + 4]; right rows hold pairs of bfloat16."""
    ...


@wp.func_native(
    _outer_products(
        each=1,
        on_gpu="""const int4 w = __ldg(reinterpret_cast<const int4*>(q));
        b[0] = __int_as_float(w.x), b[1] = __int_as_float(w.y);
        b[2] = __int_as_float(w.z), b[3] = __int_as_float(w.w);""",
        on_cpu="q[n]",
    )
)
def outer_full(
    left: wp.array2d[float], right: wp.array2d[int], begin: int, end: int, j: int, k: int
) -> wp.mat44:
    """Return the same of right rows that hold float32: left (R, J), right (R, K) as words."""
    ...


def _make_step_kernel(half: bool, belief: bool) -> wp.Kernel:
    """Return the kernel for right rows in bfloat16 or float32, and for AdaBelief or Adam without momentum."""
    outer = outer_half if half else outer_full

    @wp.kernel(enable_backward=False, module="unique")
    def step(
        first: int,
        # in
        left: wp.array2d[float],  # (R, J) rows of the outer products, critic by critic
        right: wp.array2d[int],  # (R, K) their other rows, as words
        end: wp.array[int],  # (C,) where the rows of a critic end, and the next one's begin
        rate: wp.array[float],  # (C,) learning rate, 0 leaves a critic alone
        correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
        decay: float,  # of the mean square
        momentum: float,  # decay of the mean
        tiny: float,  # added to the root
        # inout
        weight: wp.array2d[float],  # (C J, K)
        square: wp.array2d[
            float
        ],  # (C J, K) running mean of the square: of the gradient, or of what it strays by
        mean: wp.array2d[float],  # (C J, K) running mean of the gradient; not looked at by Adam
        # out
        copy: wp.array2d[int],  # (C J, K) the weights in bfloat16, as words
    ):
        """One step, a strip of tiles per thread (Kingma, Ba: Adam, 2015; Zhuang et al.: AdaBelief, 2020)."""
        c, i = wp.tid()
        speed, unbias = float(rate[c]), float(correction[c])
        if speed == 0.0:
            return
        i += first
        across = weight.shape[1] / TILE
        k = TILE * (i % across)
        strip = TILE * STRIP * (i / across)
        begin = int(0)
        if c > 0:
            begin = end[c - 1]
        stop = end[c]
        above = c * left.shape[1]
        for j in range(strip, wp.min(strip + TILE * STRIP, left.shape[1]), TILE):
            # everything is asked for before anything is worked out: no load may pass a store
            squares = wp.mat44()
            means = wp.mat44()
            weights = wp.mat44()
            for n in range(TILE):
                squares[n] = load_vec4(square, above + j + n, k)
                weights[n] = load_vec4(weight, above + j + n, k)
                if wp.static(belief):
                    means[n] = load_vec4(mean, above + j + n, k)
            gradient = outer(left, right, begin, stop, j, k)
            for n in range(TILE):
                way = gradient[n]
                stray = gradient[n]
                least = float(0.0)
                if wp.static(belief):
                    way = momentum * means[n] + (1.0 - momentum) * gradient[n]
                    stray = gradient[n] - way
                    least = tiny
                    store_vec4(mean, above + j + n, k, way)
                spread = decay * squares[n] + (1.0 - decay) * wp.cw_mul(stray, stray)
                w = weights[n]
                for m in range(TILE):
                    spread[m] = spread[m] + least
                    w[m] = w[m] - speed * over_root(way[m], spread[m] * unbias, tiny)
                store_vec4(square, above + j + n, k, spread)
                store_vec4(weight, above + j + n, k, w)
                store_half(copy, above + j + n, k, w)

    return step


def _make_sum_kernel(belief: bool) -> wp.Kernel:
    """Return the kernel of the same step where the gradient is known."""

    @wp.kernel(enable_backward=False, module="unique")
    def step(
        first: int,
        # in
        gradient: wp.array2d[float],  # (C, J)
        rate: wp.array[float],  # (C,) learning rate, 0 leaves a critic alone
        correction: wp.array[float],  # (C,) 1 / (1 - decay^steps)
        decay: float,  # of the mean square
        momentum: float,  # decay of the mean
        tiny: float,  # added to the root
        # inout
        weight: wp.array2d[float],  # (C, J)
        square: wp.array2d[float],  # (C, J) running mean of the square
        mean: wp.array2d[float],  # (C, J) running mean of the gradient; not looked at by Adam
    ):
        """One step of each weight."""
        c, i = wp.tid()
        if rate[c] == 0.0:
            return
        i += first
        way = gradient[c, i]
        stray = gradient[c, i]
        least = float(0.0)
        if wp.static(belief):
            way = momentum * mean[c, i] + (1.0 - momentum) * gradient[c, i]
            stray = gradient[c, i] - way
            least = tiny
            mean[c, i] = way
        spread = decay * square[c, i] + (1.0 - decay) * stray * stray + least
        square[c, i] = spread
        weight[c, i] = weight[c, i] - rate[c] * way / (wp.sqrt(spread * correction[c]) + tiny)

    return step


@wp.kernel(enable_backward=False)
def count_parts(
    first: int,
    # in
    end: wp.array[int],  # (C,) where the rows of a critic end, and the next one's begin
    # out
    parts: wp.array[int],  # (C,) of ROWS rows each, the last one shorter
):
    """Cut the rows of each critic into parts."""
    _, c = wp.tid()
    c += first
    begin = int(0)
    if c > 0:
        begin = end[c - 1]
    parts[c] = (end[c] - begin + ROWS - 1) / ROWS


@wp.kernel(enable_backward=False)
def multiply_parts(
    first: int,
    # in
    rows: wp.array2d[int],  # (R, K) bfloat16, as words
    weights: wp.array2d[int],  # (C K, N) bfloat16, as words
    end: wp.array[int],  # (C,) where the rows of a critic end, and the next one's begin
    part_end: wp.array[int],  # (C,) where its parts end
    # out
    out: wp.array2d[int],  # (R, N) bfloat16, as words
):
    """Multiply a part of the rows of a critic with TILE columns of its weights."""
    part, i = wp.tid()
    critics = end.shape[0]
    if part >= part_end[critics - 1]:
        return
    c = wp.lower_bound(part_end, part + 1)
    row = ROWS * part
    if c > 0:
        row = end[c - 1] + ROWS * (part - part_end[c - 1])
    last = wp.min(row + ROWS, end[c]) - 1
    k = TILE * (i + first)
    inner = 2 * rows.shape[1]
    total = wp.mat44()
    for j in range(0, inner, TILE):
        some = wp.mat44()
        for n in range(TILE):
            some[n] = read_half(weights, c * inner + j + n, k)
        mine = wp.mat44()
        for n in range(ROWS):
            mine[n] = read_half(rows, wp.min(row + n, last), j)
        total += mine * some
    for n in range(ROWS):
        if row + n <= last:
            store_half(out, row + n, k, total[n])


step_kernels = {
    (half, belief): _make_step_kernel(half, belief) for half in (True, False) for belief in (True, False)
}
"""Kernels by whether the right rows are bfloat16, and whether the optimiser is AdaBelief."""
sum_kernels = {belief: _make_sum_kernel(belief) for belief in (True, False)}
"""Those of gradients that are known, by the latter."""
