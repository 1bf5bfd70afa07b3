"""Events of pixels that are nothing but a change detector and look at pictures of 8 bits, for the CPU.

A level that a pixel sees either brings events or does not, and between two events of a pixel that depends on
the level alone: those that bring none are an interval. So a thread compares the levels of 64 neighbouring
pixels with their intervals, byte by byte, and works out a logarithm, a change and a new interval only where
one has been left. Events and counts are those of `dase.kernels.threshold_events` and
`dase.kernels.threshold_counts`, to the last bit, wherever logarithms do not fall from level to level.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from dase.kernels import launch
from dase.kernels.pixel_stages import EventKeys, SampleClock
from dase.kernels.stored_levels import LEVELS, Levels
from dase.kernels.threshold_events import DEPOSIT_EVENTS
from dase.kernels.vector_math import lane_functions, lane_options, native_function

LANES = 64
"""Neighbouring pixels of a thread: their levels fill a line of the cache."""

_INTERVALS = """
typedef unsigned char L __attribute__((ext_vector_type(64)));
typedef bool B __attribute__((ext_vector_type(64)));
typedef float V __attribute__((ext_vector_type(16)));
typedef bool M __attribute__((ext_vector_type(16)));
const float* __restrict__ logs = logs_in.data + (size_t)row * logs_in.shape[1];
const size_t stride = values.strides[0];
const unsigned char* seen = values.data + n;
const bool same = threshold.shape[2] == 1;
const float* off_of = &wp::index(threshold, row, 0, 0);
const float* on_of = &wp::index(threshold, row, threshold.shape[1] - 1, 0);
float reference[64], on[64], off[64];
unsigned char low[64], high[64];
// the last level of every 16, by which the 16 that an interval ends in are found
V last;
for (int g = 0; g < 16; ++g) last[g] = logs[16 * g + 15];
auto COUNT = [](auto holds) {
    return __builtin_popcount(__builtin_bit_cast(unsigned short, __builtin_convertvector(holds, M)));
};
auto SIXTEEN = [&](int g) { V v; __builtin_memcpy(&v, logs + 16 * g, sizeof(V)); return v; };
auto settle = [&](int lane) {
    // how many levels, from the darkest on, change by less than the ON threshold, and by the OFF one or more
    const V at = reference[lane], up = on[lane], down = -off[lane];
    const int above = COUNT(last - at < up), below = COUNT(last - at <= down);
    const int silent = above == 16 ? 256 : 16 * above + COUNT(SIXTEEN(above) - at < up);
    const int dark = below == 16 ? 256 : 16 * below + COUNT(SIXTEEN(below) - at <= down);
    // an interval that holds no level has its ends the wrong way round
    const bool none = dark >= silent;
    low[lane] = none ? 255 : dark;
    high[lane] = none ? 0 : silent - 1;
};
for (int lane = 0; lane < 64; ++lane) {
    const int at = same ? 0 : n + lane;
    on[lane] = on_of[at];
    off[lane] = off_of[at];
    reference[lane] = reference_in.data[(size_t)row * reference_in.shape[1] + n + lane];
    settle(lane);
}
// the pixels before are another thread's
const unsigned long long mine = ~0ull << first_lane;
auto left_intervals = [&](int k) {
    const unsigned char* line = seen + k * stride;
    __builtin_prefetch(line + @AHEAD@);
    L level, bottom, top;
    __builtin_memcpy(&level, line, 64);
    __builtin_memcpy(&bottom, low, 64);
    __builtin_memcpy(&top, high, 64);
    const auto out = (level < bottom) | (level > top);
    return __builtin_bit_cast(unsigned long long, __builtin_convertvector(out, B)) & mine;
};
// events of a change, as `signed_events` of dase.kernels.vector_math has them
auto crossings = [&](int lane, float change) {
    const float theta = change >= 0.0f ? on[lane] : off[lane];
    const float near = __builtin_fmaf(change, 1.0f / theta, 12582912.0f) - 12582912.0f;
    const float step = change < 0.0f ? -1.0f : 1.0f;
    const float events = __builtin_fabsf(near * theta) > __builtin_fabsf(change) ? near - step : near;
    reference[lane] = reference[lane] + events * theta;
    return events;
};
""".replace("@AHEAD@", str(2 * LANES))  # memory is asked for the block after the next
"""What both kernels do: the interval of every pixel, and which pixels have left theirs."""

_KEEP = """
const unsigned char* final = seen + (values.shape[0] - 1) * stride;
for (int lane = first_lane; lane < 64; ++lane) {
    const size_t at = (size_t)row * reference_out.shape[1] + n + lane;
    reference_out.data[at] = reference[lane];
    signal_out.data[at] = begin < values.shape[0] ? logs[final[lane]] : signal_in.data[at];
}
"""
"""What the next chunk needs."""

_EMIT = """
for (int k = begin; k < values.shape[0]; ++k) {
    unsigned long long busy = left_intervals(k);
    while (busy) {
        const int lane = __builtin_ctzll(busy);
        busy &= busy - 1;
        const float signal = k > begin ? logs[seen[(k - 1) * stride + lane]]
                                       : signal_in.data[(size_t)row * signal_in.shape[1] + n + lane];
        const float before = signal - reference[lane];
        const float change = logs[seen[k * stride + lane]] - reference[lane];
        const float events = crossings(lane, change);
        deposit(events, change, before, on[lane], off[lane], clock.begin.data[k], clock.length.data[k],
                n + lane);
        settle(lane);
    }
}
"""

_COUNT = """
for (int r = 0; r + 1 < run.shape[0]; ++r) {
    int up[64] = {}, down[64] = {};
    for (int k = run.data[r] > begin ? run.data[r] : begin; k < run.data[r + 1]; ++k) {
        unsigned long long busy = left_intervals(k);
        while (busy) {
            const int lane = __builtin_ctzll(busy);
            busy &= busy - 1;
            const float change = logs[seen[k * stride + lane]] - reference[lane];
            const float events = crossings(lane, change);
            (change >= 0.0f ? up : down)[lane] += (int)__builtin_fabsf(events);
            settle(lane);
        }
    }
    const int w = window.data[r];
    if (w < 0) continue;
    int* offs = &wp::index(counts, row, w, 0, n);
    int* ons = &wp::index(counts, row, w, 1, n);
    for (int lane = first_lane; lane < 64; ++lane) {
        offs[lane] = down[lane];
        ons[lane] = up[lane];
    }
}
"""

_SHARED_ARGUMENTS = (
    "values: wp.array2d[wp.uint8], logs_in: wp.array2d[float], row: int, n: int, first_lane: int, "
    "begin: int, threshold: wp.array3d[float], reference_in: wp.array2d[float], "
    "signal_in: wp.array2d[float], reference_out: wp.array2d[float], signal_out: wp.array2d[float]"
)


def _function(name: str, body: str, arguments: str) -> Any:
    scope = {"EventKeys": EventKeys, "SampleClock": SampleClock}
    return native_function(name, body, scope, f"{_SHARED_ARGUMENTS}, {arguments}", "None")


_emit_block = _function(
    "emit_levels",
    _INTERVALS + DEPOSIT_EVENTS + _EMIT + _KEEP,
    "clock: SampleClock, sink: EventKeys, size: int",
)
_count_block = _function(
    "count_levels",
    _INTERVALS + _COUNT + _KEEP,
    "run: wp.array[int], window: wp.array[int], counts: wp.array4d[int]",
)


@wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
def emit_level_events(
    first: int,
    # in
    values: wp.array2d[wp.uint8],  # (K, N) levels
    logs: wp.array2d[float],  # (B, 256) [log intensity]
    clock: SampleClock,
    size: int,  # N
    begin: int,  # first sample to compare
    threshold: wp.array3d[float],  # (B, 2, N or 1) [log intensity], OFF then ON
    reference_in: wp.array2d[float],  # (B, N) [log intensity]
    signal_in: wp.array2d[float],  # (B, N) last sample [log intensity]
    # out
    reference_out: wp.array2d[float],  # (B, N) [log intensity]
    signal_out: wp.array2d[float],  # (B, N) last sample [log intensity]
    sink: EventKeys,
):
    """Emit the events of every pixel, 64 of them per thread; the last block may overlap the one before."""
    b, i = wp.tid()
    n = wp.min((first + i) * 64, size - 64)
    new = (first + i) * 64 - n
    _emit_block(
        values, logs, b, n, new, begin, threshold, reference_in, signal_in, reference_out, signal_out, clock,
        sink, size,
    )  # fmt: skip


@wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
def count_level_events(
    first: int,
    # in
    values: wp.array2d[wp.uint8],  # (K, N) levels
    logs: wp.array2d[float],  # (B, 256) [log intensity]
    size: int,  # N
    begin: int,  # first sample to compare
    threshold: wp.array3d[float],  # (B, 2, N or 1) [log intensity], OFF then ON
    run: wp.array[int],  # (R + 1,) samples at which runs of one window begin, and K
    window: wp.array[int],  # (R,) window that a run counts for; -1 for none
    reference_in: wp.array2d[float],  # (B, N) [log intensity]
    signal_in: wp.array2d[float],  # (B, N) last sample [log intensity]
    # out
    reference_out: wp.array2d[float],  # (B, N) [log intensity]
    signal_out: wp.array2d[float],  # (B, N) last sample [log intensity]
    counts: wp.array4d[int],  # (B, W, 2, N) [events], OFF then ON
):
    """Count the events of every pixel in every window, as `emit_level_events` emits them."""
    b, i = wp.tid()
    n = wp.min((first + i) * 64, size - 64)
    new = (first + i) * 64 - n
    _count_block(
        values, logs, b, n, new, begin, threshold, reference_in, signal_in, reference_out, signal_out, run,
        window, counts,
    )  # fmt: skip


@lru_cache(maxsize=1)
def _logarithm_kernel() -> wp.Kernel:
    logarithm, Lane = lane_functions(1).logarithm, lane_functions(1).Lanes

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def take_logarithms(
        first: int,
        # in
        light: wp.array[float],  # (256,)
        eps: wp.array[float],  # (B,) added to intensities
        # out
        logs: wp.array2d[float],  # (B, 256) [log intensity]
    ):
        """Take the logarithms of all levels, as kernels take those of samples."""
        b, i = wp.tid()
        i += first
        logs[b, i] = logarithm(Lane(light[i]), eps[b])[0]

    return take_logarithms


def logarithms_of_levels(levels: Levels, eps: wp.array, device: wp.Device) -> wp.array:
    """Return the log intensity of every level, shape (B, 256)."""
    out = wp.empty((len(eps), LEVELS), dtype=float, device=device)
    launch.run_kernel(_logarithm_kernel(), LEVELS, [levels.light, eps, out], device, batch=len(eps))
    return out


def have_intervals(logs: wp.array) -> bool:
    """Return whether what a level brings is decided by intervals: no logarithm below that of a darker one.

    Args:
        logs: Log intensity of every level, shape (B, 256).
    """
    return bool(np.all(np.diff(logs.numpy()) >= 0))
