"""Events of pixels that are nothing but a change detector, several pixels per thread, for the CPU.

The same events as the composed kernel's, to the last bit: counted by lanes as in
`dase.kernels.threshold_counts`, and only where a lane has any, one by one.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels.pixel_stages import EventKeys, SampleClock
from dase.kernels.scene_layers import BackgroundGeometry, background_geometry
from dase.kernels.threshold_counts import SOURCES, STORED, block_functions, log_light_of
from dase.kernels.vector_math import lane_functions, lane_options, lane_type, native_function

DEPOSIT_EVENTS = """
auto deposit = [&](float events, float change, float before, float on, float off, long long begin,
                   float length, int i) {
    const int crossed = (int)__builtin_fabsf(events);
    const bool rises = events > 0.0f;
    const float theta = rises ? on : -off;
    const float way = change - before;
    const long long code = (long long)(rises ? 1 : 0) << (sink.low - 1);
    const long long place = (((long long)row * size + i) << sink.low) | code;
    const int slab = i >> sink.slab;
    int* met = sink.used.data + row * sink.used.shape[1] + slab;
    long long* slots = sink.keys.data + ((size_t)row * sink.keys.shape[1] + slab) * sink.keys.shape[2];
    for (int m = 1; m <= crossed; ++m) {
        float share = way != 0.0f ? ((float)m * theta - before) / way : 0.0f;
        share = share < 0.0f ? 0.0f : (share > 1.0f ? 1.0f : share);
        const float at = share * length;
        const long long time = begin + (long long)(at < length ? at : length);
        const int slot = (*met)++;
        if (slot < sink.keys.shape[2]) slots[slot] = (time << (sink.bits + sink.low)) | place;
    }
};
"""
"""C++ that keeps the events of pixel `i` in a step; asks for `sink`, `row` and `size` around it."""


@lru_cache(maxsize=8)
def _append_function(lanes: int) -> Any:
    """Return the function that appends the events of one step of `lanes` pixels."""
    arguments = (
        "events: Lanes, change: Lanes, signal: Lanes, reference: Lanes, on: Lanes, off: Lanes, "
        "begin: wp.int64, length: float, sink: EventKeys, row: int, n: int, size: int, first_lane: int"
    )
    text = """
typedef float V __attribute__((ext_vector_type(@lanes@)));
V all;
__builtin_memcpy(&all, &events, sizeof(V));
typedef bool B __attribute__((ext_vector_type(@lanes@)));
unsigned busy = __builtin_bit_cast(@mask@, __builtin_convertvector(all != 0.0f, B)) & ((1u << @lanes@) - 1);
// lanes before belong to the block before
busy &= ~0u << first_lane;
while (busy) {
    const int lane = __builtin_ctz(busy);
    busy &= busy - 1;
    deposit(events[lane], change[lane], signal[lane] - reference[lane], on[lane], off[lane], begin, length,
            n + lane);
}
"""
    mask = "unsigned short" if lanes == 16 else "unsigned char"
    snippet = DEPOSIT_EVENTS + text.replace("@lanes@", str(lanes)).replace("@mask@", mask)
    scope = {"Lanes": lane_type(lanes), "EventKeys": EventKeys}
    return native_function(f"append_{lanes}", snippet, scope, arguments, "None")


@lru_cache(maxsize=32)
def emitting_kernel(lanes: int, source: str) -> wp.Kernel:
    """Return the emitting kernel, over (B, blocks of `lanes` pixels) threads; see `counts.count`."""
    f, start_of = lane_functions(lanes), block_functions(lanes)
    Source, Lanes = SOURCES[source], f.Lanes
    look, append = log_light_of(lanes, source), _append_function(lanes)
    load, store, minus, advanced = f.load, f.store, f.minus, f.advanced
    chosen, inverse, signed_events = f.chosen, f.inverse, f.signed_events
    thresholds, columns, rows_of = start_of.thresholds, start_of.columns, start_of.rows
    layers_of = start_of.layers_of
    stored, layered = source in STORED, source == "layers"

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def emit_events(
        first: int,
        # in
        seen: Source,
        clock: SampleClock,
        pixels: wp.array[int],  # (N,) row-major indices
        size: int,  # N
        width: int,  # of the sensor
        begin: int,  # first sample to compare
        threshold: wp.array3d[float],  # (B, 2, N or 1) [log intensity], OFF then ON
        eps: wp.array[float],  # (B,) added to intensities
        reference_in: wp.array2d[float],  # (B, N) [log intensity]
        signal_in: wp.array2d[float],  # (B, N) last sample [log intensity]
        # out
        reference_out: wp.array2d[float],  # (B, N) [log intensity]
        signal_out: wp.array2d[float],  # (B, N) last sample [log intensity]
        sink: EventKeys,
    ):
        """Emit the events of every pixel."""
        b, i = wp.tid()
        n = wp.min((first + i) * wp.static(lanes), size - wp.static(lanes))
        new = (first + i) * wp.static(lanes) - n
        off = thresholds(threshold, b, 0, n)
        on = thresholds(threshold, b, 1, n)
        per_off = inverse(off)
        per_on = inverse(on)
        x = Lanes()
        y = Lanes()
        near = int(0)
        ground = BackgroundGeometry()
        if wp.static(not stored):
            ground = background_geometry(seen)
            x = columns(pixels, n, width)
            y = rows_of(pixels, n, width)
            if wp.static(layered):
                near = layers_of(seen, x, y)
        reference = load(reference_in, b, n)
        signal = load(signal_in, b, n)
        for k in range(begin, clock.length.shape[0]):
            sample = look(seen, ground, k, n, x, y, near, eps[b])
            change = minus(sample, reference)
            theta = chosen(change, on, off)
            events = signed_events(change, theta, chosen(change, per_on, per_off))
            append(
                events, change, signal, reference, on, off, clock.begin[k], clock.length[k], sink, b, n,
                size, new,
            )  # fmt: skip
            reference = advanced(reference, events, theta)
            signal = sample
        store(reference_out[b], n, reference)
        store(signal_out[b], n, signal)

    return emit_events
