"""Four numbers at a time: loads and stores of 16 bytes, or of 8 where the numbers are bfloat16.

Rows that may be either are handed over as words: one float32 or two bfloat16 in each.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const float4 q = *reinterpret_cast<const float4*>(&wp::index(a, r, k));
    return wp::vec_t<4, wp::float32>(q.x, q.y, q.z, q.w);
#else
    const float* q = &wp::index(a, r, k);
    return wp::vec_t<4, wp::float32>(q[0], q[1], q[2], q[3]);
#endif
"""
)
def load_vec4(a: wp.array2d[float], r: int, k: int) -> wp.vec4:
    """Return a[r, k : k + 4], which the kernel may change."""
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
def read_vec4(a: wp.array2d[float], r: int, k: int) -> wp.vec4:
    """Return a[r, k : k + 4], which the kernel does not change."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    *reinterpret_cast<float4*>(&wp::index(a, r, k)) = make_float4(q[0], q[1], q[2], q[3]);
#else
    for (int n = 0; n < 4; ++n) (&wp::index(a, r, k))[n] = q[n];
#endif
"""
)
def store_vec4(a: wp.array2d[float], r: int, k: int, q: wp.vec4):
    """Set a[r, k : k + 4]."""
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
def read_half(a: wp.array2d[int], r: int, k: int) -> wp.vec4:
    """Return the four bfloat16 at [r, k : k + 4], which the kernel does not change."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const int4 q = *reinterpret_cast<const int4*>(&wp::index(a, r, k));
    return wp::vec_t<4, wp::float32>(
        __int_as_float(q.x), __int_as_float(q.y), __int_as_float(q.z), __int_as_float(q.w));
#else
    wp::vec_t<4, wp::float32> q;
    __builtin_memcpy(&q, &wp::index(a, r, k), sizeof(q));
    return q;
#endif
"""
)
def read_full(a: wp.array2d[int], r: int, k: int) -> wp.vec4:
    """Return the four float32 at [r, k : k + 4]."""
    ...


@wp.func_native(
    """
    // nearest, ties to even; no NaN
#ifdef __CUDA_ARCH__
    int low, high;
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(low) : "f"(q[1]), "f"(q[0]));
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(high) : "f"(q[3]), "f"(q[2]));
    *reinterpret_cast<int2*>(&wp::index(a, r, k / 2)) = make_int2(low, high);
#else
    unsigned int half[4];
    for (int n = 0; n < 4; ++n) {
        const unsigned int bits = __builtin_bit_cast(unsigned int, q[n]);
        half[n] = (bits + 32767u + ((bits >> 16) & 1u)) >> 16;
    }
    for (int n = 0; n < 2; ++n) (&wp::index(a, r, k / 2))[n] = (int)(half[2 * n] | (half[2 * n + 1] << 16));
#endif
"""
)
def store_half(a: wp.array2d[int], r: int, k: int, q: wp.vec4):
    """Set the four bfloat16 at [r, k : k + 4]."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    *reinterpret_cast<float4*>(&wp::index(a, r, k)) = make_float4(q[0], q[1], q[2], q[3]);
#else
    __builtin_memcpy(&wp::index(a, r, k), &q, sizeof(q));
#endif
"""
)
def store_full(a: wp.array2d[int], r: int, k: int, q: wp.vec4):
    """Set the four float32 at [r, k : k + 4]."""
    ...


word_functions = {True: (read_half, store_half), False: (read_full, store_full)}
"""How rows of words are read and set, by whether they hold bfloat16."""
