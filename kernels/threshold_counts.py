"""Exact event counts of pixels that are nothing but a change detector.

A pixel remembers a reference r [log intensity] and compares every sample s with it (Equations 2 to 4 of "How
to Learn a Domain-Adaptive Event Simulator?", 2021):

    d = s - r
    d >= 0:  N_on = floor(d / on),     r += N_on on
    d < 0:   N_off = floor(-d / off),  r -= N_off off

all in float32, the floor being the greatest n whose product with the threshold fits into the change, without
contraction to fused multiply-adds, so that CPU, CUDA and NumPy agree to the last bit.

Training counts stored log intensities; sensors without effects on single samples count any source. The kernel
is the composed one of `dase.kernels.pixel_stages` without all that such pixels do not need, several pixels
per thread, and returns the same counts.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from dase.kernels.random import stream_key, uniform
from dase.kernels.scene_layers import (
    BackgroundGeometry,
    Frames,
    Layers,
    background_geometry,
    layers_near,
)
from dase.kernels.stored_levels import Levels
from dase.kernels.vector_math import lane_functions, lane_options, native_function

SOURCES = {"frames": Frames, "levels": Levels, "log": Frames, "layers": Layers, "background": Layers}
"""What pixels see, by name: stored intensities, stored levels (on a CPU alone), stored log intensities,
moving layers, one layer."""

STORED = ("frames", "levels", "log")
"""Sources that hold a sample for every pixel."""


@lru_cache(maxsize=8)
def _load_levels(lanes: int) -> Any:
    """Return the function that looks up the light of stored levels of `lanes` neighbouring pixels."""
    text = f"""
const unsigned char* from = values.data + (size_t)k * (size_t)values.strides[0] + n;
// samples of a pixel lie a picture apart, which no CPU foresees: this is the line of the blocks to come
__builtin_prefetch(from + 64);
wp::vec_t<{lanes}, float> result;
for (int lane = 0; lane < {lanes}; ++lane) result[lane] = light.data[from[lane]];
return result;
"""
    arguments = "values: wp.array2d[wp.uint8], light: wp.array[float], k: int, n: int"
    scope = {"Lanes": lane_functions(lanes).Lanes}
    return native_function(f"load_levels_{lanes}", text, scope, arguments, "Lanes")


@lru_cache(maxsize=32)
def light_of(lanes: int, source: str, *, aligned: bool = False) -> Any:
    """Return the Warp function from a source to the intensity of `lanes` neighbouring pixels."""
    f = lane_functions(lanes)
    Source, Lanes = SOURCES[source], f.Lanes
    load, background, layered = f.load_aligned if aligned else f.load, f.background, f.layered

    if source in ("frames", "log"):

        @wp.func
        def light(seen: Source, ground: BackgroundGeometry, k: int, n: int, x: Lanes, y: Lanes, near: int):
            return load(seen.values, k, n)

    elif source == "levels":
        look_up = _load_levels(lanes)

        @wp.func
        def light(seen: Source, ground: BackgroundGeometry, k: int, n: int, x: Lanes, y: Lanes, near: int):
            return look_up(seen.values, seen.light, k, n)

    else:

        @wp.func
        def light(seen: Source, ground: BackgroundGeometry, k: int, n: int, x: Lanes, y: Lanes, near: int):
            if wp.static(source == "layers"):
                return layered(
                    x, y, seen.grey, ground.last, ground.corner, ground.step, ground.inverse, ground.width,
                    seen.texels, seen.start, seen.size, seen.place, k, near,
                )  # fmt: skip
            else:
                return background(
                    x, y, seen.grey, ground.last, ground.corner, ground.step, ground.inverse, ground.width,
                    seen.place, k,
                )  # fmt: skip

    return light


@lru_cache(maxsize=32)
def log_light_of(lanes: int, source: str, *, aligned: bool = False) -> Any:
    """Return the Warp function from a source to the log intensity of `lanes` neighbouring pixels."""
    f = lane_functions(lanes)
    Source, Lanes = SOURCES[source], f.Lanes
    light, logarithm = light_of(lanes, source, aligned=aligned), f.logarithm

    @wp.func
    def look(
        seen: Source, ground: BackgroundGeometry, k: int, n: int, x: Lanes, y: Lanes, near: int, eps: float
    ):
        value = light(seen, ground, k, n, x, y, near)
        if wp.static(source == "log"):
            return value
        else:
            return logarithm(value, eps)

    return look


@lru_cache(maxsize=8)
def block_functions(lanes: int) -> SimpleNamespace:
    """Return Warp functions for what `lanes` neighbouring pixels know before their first sample."""
    f = lane_functions(lanes)
    Lanes, load, near_any = f.Lanes, f.load, f.layers_of

    @wp.func
    def thresholds(threshold: wp.array3d[float], b: int, p: int, n: int):
        if threshold.shape[2] == 1:
            return Lanes(threshold[b, p, 0])
        return load(threshold[b], p, n)

    @wp.func
    def columns(pixels: wp.array[int], n: int, width: int):
        x = Lanes()
        for lane in range(wp.static(lanes)):
            x[lane] = float(pixels[n + lane] % width)
        return x

    @wp.func
    def rows(pixels: wp.array[int], n: int, width: int):
        y = Lanes()
        for lane in range(wp.static(lanes)):
            y[lane] = float(pixels[n + lane] / width)
        return y

    @wp.func
    def layers_of(seen: Layers, x: Lanes, y: Lanes):
        return near_any(seen.box, seen.count, x, y)

    return SimpleNamespace(thresholds=thresholds, columns=columns, rows=rows, layers_of=layers_of)


@lru_cache(maxsize=64)
def counting_kernel(
    lanes: int, source: str, *, shared: bool, states: bool, aligned: bool = False
) -> wp.Kernel:
    """Return the counting kernel, over (B, blocks of `lanes` pixels) threads.

    It has no branches, so that several samples are on their way from memory at once. Both polarities are
    counted by the sum and by the difference of their events; with a shared threshold nothing else has to be
    chosen by polarity. The last block ends with the last pixel and may overlap the one before.

    Args:
        lanes: Neighbouring pixels per thread.
        source: One of `SOURCES`.
        shared: Whether ON and OFF have one threshold.
        states: Whether counts are integers and the last sample is kept, as sensors need it, or floats.
        aligned: Whether stored samples are, see `samples_are_aligned`.
    """
    f = lane_functions(lanes)
    Source, Lanes = SOURCES[source], f.Lanes
    look = log_light_of(lanes, source, aligned=aligned)
    load, store, store_whole = f.load, f.store, f.store_whole
    minus, plus, plus_abs, advanced = f.minus, f.plus, f.plus_abs, f.advanced
    chosen, inverse, signed_events = f.chosen, f.inverse, f.signed_events
    half_sum, half_difference = f.half_sum, f.half_difference
    start_of = block_functions(lanes)
    thresholds, columns, rows_of = start_of.thresholds, start_of.columns, start_of.rows
    layers_of = start_of.layers_of
    Number = wp.int32 if states else wp.float32
    stored, layered = source in STORED, source == "layers"

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def count_events(
        first: int,
        # in
        seen: Source,
        rows: int,  # samples between one row of the batch and the next; 0 where all see the same
        pixels: wp.array[int],  # (N,) row-major indices
        size: int,  # N
        width: int,  # of the sensor
        begin: int,  # first sample to compare
        threshold: wp.array3d[float],  # (B, P, N or 1) [log intensity], OFF then ON; P = 1 shares one
        eps: wp.array[float],  # (B,) added to intensities
        run: wp.array[int],  # (R + 1,) samples at which runs of one window begin, and K
        window: wp.array[int],  # (R,) window that a run counts for; -1 for none
        reference_in: wp.array2d[float],  # (B, N) [log intensity]
        # out
        reference_out: wp.array2d[float],  # (B, N) [log intensity]
        signal_out: wp.array2d[float],  # (B, N) last sample [log intensity]
        counts_out: wp.array4d[Number],  # (B, W, 2, N) [events], OFF then ON
    ):
        """Count the events of every pixel in every window."""
        b, i = wp.tid()
        n = wp.min((first + i) * wp.static(lanes), size - wp.static(lanes))
        off = thresholds(threshold, b, 0, n)
        on = thresholds(threshold, b, threshold.shape[1] - 1, n)
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
        sample = Lanes()
        for r in range(run.shape[0] - 1):
            both = Lanes()
            net = Lanes()
            for k in range(wp.max(run[r], begin), run[r + 1]):
                sample = look(seen, ground, k + b * rows, n, x, y, near, eps[b])
                change = minus(sample, reference)
                theta = on
                per = per_on
                if wp.static(not shared):
                    theta = chosen(change, on, off)
                    per = chosen(change, per_on, per_off)
                events = signed_events(change, theta, per)
                both = plus_abs(both, events)
                net = plus(net, events)
                reference = advanced(reference, events, theta)
            w = window[r]
            if w >= 0:
                if wp.static(states):
                    store_whole(counts_out[b, w, 0], n, half_difference(both, net))
                    store_whole(counts_out[b, w, 1], n, half_sum(both, net))
                else:
                    store(counts_out[b, w, 0], n, half_difference(both, net))
                    store(counts_out[b, w, 1], n, half_sum(both, net))
        if wp.static(states):
            store(reference_out[b], n, reference)
            store(signal_out[b], n, sample)

    return count_events


@lru_cache(maxsize=32)
def starting_kernel(source: str) -> wp.Kernel:
    """Return the kernel that sets memories at the first samples, over (B, N) threads.

    The memories are spread as if the first change had been going on before.
    """
    f = lane_functions(1)
    Source = SOURCES[source]
    look, Lane = log_light_of(1, source), f.Lanes
    stored, layered = source in STORED, source == "layers"

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def start_counting(
        first: int,
        # in
        seen: Source,
        pixels: wp.array[int],  # (N,) row-major indices
        width: int,  # of the sensor
        begin: int,  # samples seen before, 0 or 1
        samples: int,  # in this chunk
        seed: int,
        initial_phase: int,  # stream of random numbers
        threshold: wp.array3d[float],  # (B, P, N or 1) [log intensity], OFF then ON
        eps: wp.array[float],  # (B,) added to intensities
        phase: wp.array[float],  # (B,) spread of the memories
        signal_in: wp.array2d[float],  # (B, N) [log intensity]
        # out
        reference_out: wp.array2d[float],  # (B, N) [log intensity]
        signal_out: wp.array2d[float],  # (B, N) first sample [log intensity]
    ):
        """Take the first sample as reference, led by a random share of the first change's threshold."""
        b, i = wp.tid()
        i += first
        pixel = pixels[i]
        x = Lane(float(pixel % width))
        y = Lane(float(pixel / width))
        near = int(0)
        ground = BackgroundGeometry()
        if wp.static(not stored):
            ground = background_geometry(seen)
            if wp.static(layered):
                near = layers_near(seen, x[0], y[0])
        signal = signal_in[b, i]
        if begin == 0:
            signal = look(seen, ground, 0, i, x, y, near, eps[b])[0]
        reference = signal
        if begin + samples > 1:
            change = look(seen, ground, 1 - begin, i, x, y, near, eps[b])[0] - signal
            column = wp.where(threshold.shape[2] == 1, 0, i)
            stream = stream_key(seed, initial_phase, pixel)
            lead = phase[b] * uniform(stream, 0)
            if phase[b] != 0.0:
                if change < 0.0 or (change == 0.0 and uniform(stream, 1) < 0.5):
                    reference += lead * threshold[b, 0, column]
                else:
                    reference -= lead * threshold[b, threshold.shape[1] - 1, column]
        signal_out[b, i] = signal
        reference_out[b, i] = reference

    return start_counting


def widest_block(size: int, device: wp.Device, source: str) -> int:
    """Return how many neighbouring pixels a thread works on."""
    lanes = 4 if device.is_cuda else 16
    if device.is_cuda and source == "layers":
        lanes = 1
    return lanes if size >= lanes else 1


def samples_are_aligned(source: str, seen: Any, size: int) -> bool:
    """Return whether stored samples of any block of 4 of `size` pixels begin at a multiple of 16 bytes."""
    stored = source in ("frames", "log")
    return stored and not (size % 4 or seen.values.ptr % 16 or seen.values.strides[0] % 16)


def block_count(size: int, lanes: int) -> int:
    """Return how many blocks of `lanes` pixels there are."""
    return -(-size // lanes)
