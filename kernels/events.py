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
    bits: int,
    size: int,  # pixels per row of the batch
    pixels: wp.array[int],  # (N,)
    width: int,
    begin: wp.int64,  # of the chunk [ns]
    # out
    t_out: wp.array[wp.float64],  # [s]
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    p_out: wp.array[wp.uint8],
    row_out: wp.array[int],  # of the batch; of length 0 when nobody asks
):
    """Unpack keys: time, pixel and polarity of each event."""
    _, i = wp.tid()
    i += first
    key = keys[i]
    place = int((key >> wp.int64(1)) & ((wp.int64(1) << wp.int64(bits)) - wp.int64(1)))
    pixel = pixels[place % size]
    # from whole nanoseconds, so that times never go back from chunk to chunk
    t_out[i] = wp.float64(1.0e-9) * wp.float64(begin + (key >> wp.int64(bits + 1)))
    x_out[i] = wp.uint16(pixel % width)
    y_out[i] = wp.uint16(pixel / width)
    p_out[i] = wp.uint8(key & wp.int64(1))
    if row_out.shape[0] > 0:
        row_out[i] = place / size


def ordered(keys: wp.array, used: np.ndarray, bits: int, device: wp.Device) -> wp.array:
    """Return all keys in order of time, then place, then polarity.

    Args:
        keys: Shape (B, slabs, capacity), int64: time [ns] << (bits + 1) | place << 1 | polarity.
        used: Shape (B, slabs), not above the capacity.
        bits: Of the place.
        device: Where `keys` live.
    """
    rows, slabs, capacity = keys.shape
    counts = used.reshape(-1)
    total = int(counts.sum())
    out = wp.empty(2 * total, dtype=wp.int64, device=device)  # the second half is room for the sort
    if total == 0:
        return out
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    flat = keys.reshape((rows * slabs, capacity))
    if device.is_cpu:
        source, target = flat.numpy(), out.numpy()
        for slab, (at, n) in enumerate(zip(start, counts, strict=True)):
            target[at : at + n] = source[slab, :n]
    else:
        arguments = [flat, *(wp.array(a, dtype=int, device=device) for a in (counts, start)), out]
        launch.run(gather, rows * slabs, arguments, device, batch=int(counts.max()))
    # a CPU slab emits its pixels one after the other, so a stable sort by time alone gives the full order
    low = bits + 1 if device.is_cpu else 0
    high = 63
    if device.is_cpu:
        high = max(int(out.numpy()[:total].max()).bit_length(), low + 1)
    idle = wp.empty(2 * total, dtype=wp.int32, device=device)
    wp.utils.radix_sort_pairs(out, idle, total, begin_bit=low, end_bit=high)
    return out[:total]
