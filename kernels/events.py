"""From the keys that a pixel kernel emitted to events in order of time."""

from __future__ import annotations

import numpy as np
import warp as wp

from dase.kernels import launch


@wp.kernel(enable_backward=False)
def gather(
    # in
    first: int,
    keys: wp.array2d[wp.int64],  # (S, capacity)
    used: wp.array[int],  # (S,)
    start: wp.array[int],  # (S,) exclusive sum of used
    # out
    keys_out: wp.array[wp.int64],
):
    """Close the gaps between slabs, one slab per row."""
    n, slab = wp.tid()
    slab += first
    if n < used[slab]:
        keys_out[start[slab] + n] = keys[slab, n]


@wp.kernel(enable_backward=False)
def decode(
    # in
    first: int,
    keys: wp.array[wp.int64],
    bits: int,  # of the place
    low: int,  # bits below the place
    size: int,  # pixels per row of the batch
    x: wp.array[wp.uint16],  # (N,) column of each pixel
    y: wp.array[wp.uint16],  # (N,) row of each pixel
    begin: wp.int64,  # of the chunk [ns]
    each: int,  # events per thread
    # out
    t_out: wp.array[wp.float64],  # [s]
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    p_out: wp.array[wp.uint8],
    row_out: wp.array[int],  # of the batch; of length 0 when nobody asks
    label_out: wp.array[wp.int8],  # of length 0 when nobody asks
):
    """Unpack keys: time, pixel, polarity and label of each event."""
    _, n = wp.tid()
    n += first
    for i in range(n * each, wp.min((n + 1) * each, keys.shape[0])):
        key = keys[i]
        place = int((key >> wp.int64(low)) & ((wp.int64(1) << wp.int64(bits)) - wp.int64(1)))
        if row_out.shape[0] > 0:
            row_out[i] = place / size
            place = place % size
        # from whole nanoseconds, so that times never go back from chunk to chunk
        t_out[i] = wp.float64(1.0e-9) * wp.float64(begin + (key >> wp.int64(bits + low)))
        x_out[i] = x[place]
        y_out[i] = y[place]
        p_out[i] = wp.uint8((key >> wp.int64(low - 1)) & wp.int64(1))
        if label_out.shape[0] > 0:
            label_out[i] = wp.int8(key & wp.int64(3))


EACH = {"cpu": 256, "cuda": 1}
"""Events that a thread decodes: on the CPU it costs as much to begin a thread as to decode ten."""

RADIX = 9
"""Bits that a pass of the sort on the CPU looks at: as many write positions as stay in the nearest cache."""


@wp.func_native(
    """
    long long* from = keys.data;
    long long* to = other.data;
    int place[1 << 9];
    for (int shift = begin; shift < end; shift += 9) {
        for (int d = 0; d < 512; ++d) place[d] = 0;
        for (int i = 0; i < count; ++i) ++place[(from[i] >> shift) & 511];
        int sum = 0;
        for (int d = 0; d < 512; ++d) {
            const int here = place[d];
            place[d] = sum;
            sum += here;
        }
        for (int i = 0; i < count; ++i) to[place[(from[i] >> shift) & 511]++] = from[i];
        long long* swap = from;
        from = to;
        to = swap;
    }
"""
)
def radix_sort(keys: wp.array[wp.int64], other: wp.array[wp.int64], count: int, begin: int, end: int):
    """Sort stably by some bits; the result is in `keys` after an even number of passes, else in `other`."""
    ...


@wp.kernel(enable_backward=False)
def sort(first: int, keys: wp.array[wp.int64], other: wp.array[wp.int64], count: int, begin: int, end: int):
    """Sort on one thread of a CPU, three times as fast as Warp's sort of pairs."""
    radix_sort(keys, other, count, begin, end)


def ordered(
    keys: wp.array,
    used: np.ndarray,
    bits: int,
    low: int,
    top: int,
    device: wp.Device,
    late: np.ndarray | None = None,
) -> wp.array:
    """Return all keys in order of time, then place, then polarity.

    Where events leave late, those of one pixel at one time keep the order in which they happened.

    Args:
        keys: Shape (B, slabs, capacity), int64: time [ns], place, polarity and label.
        used: Shape (B, slabs), not above the capacity.
        bits: Of the place.
        low: Bits below the place.
        top: Bits of all.
        device: Where `keys` live.
        late: Keys that earlier chunks have left, shape (L,), or None where no event leaves late.
    """
    out = _gathered(keys, used, np.empty(0, np.int64) if late is None else late, device)
    total = len(out) // 2
    if total == 0:
        return out
    # a CPU slab emits its pixels one after the other, so a stable sort by time alone gives the full order
    begin = bits + low if device.is_cpu else 0
    if late is not None:
        begin = low
    if device.is_cpu:
        halves = out[:total], out[total:]
        launch.run(sort, 1, [*halves, total, begin, top], device)
        return halves[-(-(top - begin) // RADIX) % 2]
    idle = wp.empty(2 * total, dtype=wp.int32, device=device)
    wp.utils.radix_sort_pairs(out, idle, total, begin_bit=begin, end_bit=top)
    return out[:total]


def _gathered(keys: wp.array, used: np.ndarray, late: np.ndarray, device: wp.Device) -> wp.array:
    """Return late and new keys side by side, in the first half of an array that leaves room for the sort."""
    rows, slabs, capacity = keys.shape
    counts = used.reshape(-1)
    out = wp.empty(2 * (len(late) + int(counts.sum())), dtype=wp.int64, device=device)
    if len(late):
        out[: len(late)].assign(late)
    if not counts.any():
        return out
    start = len(late) + np.concatenate([[0], np.cumsum(counts)[:-1]])
    flat = keys.reshape((rows * slabs, capacity))
    if device.is_cpu:
        source, target = flat.numpy(), out.numpy()
        for slab, (at, n) in enumerate(zip(start, counts, strict=True)):
            target[at : at + n] = source[slab, :n]
    else:
        arguments = [flat, *(wp.array(a, dtype=int, device=device) for a in (counts, start)), out]
        launch.run(gather, rows * slabs, arguments, device, batch=int(counts.max()))
    return out
