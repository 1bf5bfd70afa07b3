"""From the keys that a pixel kernel emitted to events in order of time."""

from __future__ import annotations

import numpy as np
import warp as wp

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

GAP_THREADS = 64
"""Threads that copy the keys of one slab: neighbours take neighbouring keys, as a GPU's memory wants it."""


@wp.kernel(enable_backward=False)
def close_gaps(
    # in
    first: int,
    keys: wp.array2d[wp.int64],  # (S, capacity)
    used: wp.array[int],  # (S,)
    start: wp.array[int],  # (S,) exclusive sum of used
    before: int,  # keys that lie in front of all
    # out
    keys_out: wp.array[wp.int64],
):
    """Close the gaps between slabs, with `GAP_THREADS` threads for each."""
    _, thread = wp.tid()
    thread += first
    slab = thread / wp.static(GAP_THREADS)
    for n in range(thread - slab * wp.static(GAP_THREADS), used[slab], wp.static(GAP_THREADS)):
        keys_out[before + start[slab] + n] = keys[slab, n]


@wp.func_native(
    """
    // one output after the other, so that the compiler makes vectors of the loops
    const long long* __restrict__ from = keys.data;
    const int last = last_in < keys.shape[0] ? last_in : keys.shape[0];
    const long long mask = (1ll << bits) - 1;
    double* __restrict__ t = t_out.data;
    for (int i = first; i < last; ++i) t[i] = 1.0e-9 * (double)(begin + (from[i] >> (bits + low)));
    unsigned char* __restrict__ p = p_out.data;
    for (int i = first; i < last; ++i) p[i] = (unsigned char)((from[i] >> (low - 1)) & 1);
    const unsigned* __restrict__ pixels = xy.data;
    unsigned short* __restrict__ x = x_out.data;
    unsigned short* __restrict__ y = y_out.data;
    const bool rows = row_out.shape[0] > 0;
    for (int i = first; i < last; ++i) {
        int place = (int)((from[i] >> low) & mask);
        if (rows) {
            row_out.data[i] = place / size;
            place %= size;
        }
        const unsigned at = pixels[place];
        x[i] = (unsigned short)at;
        y[i] = (unsigned short)(at >> 16);
    }
    if (label_out.shape[0] > 0)
        for (int i = first; i < last; ++i) label_out.data[i] = (signed char)(from[i] & 3);
"""
)
def unpack_keys(
    keys: wp.array[wp.int64],
    first: int,
    last_in: int,
    bits: int,
    low: int,
    size: int,
    xy: wp.array[wp.uint32],
    begin: wp.int64,
    t_out: wp.array[wp.float64],
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    p_out: wp.array[wp.uint8],
    row_out: wp.array[int],
    label_out: wp.array[wp.int8],
):
    """Decode keys `first` to `last_in`; arguments have the shape and unit that `decode_keys` says."""
    ...


@wp.kernel(enable_backward=False)
def decode_keys(
    # in
    first: int,
    keys: wp.array[wp.int64],  # (M,)
    bits: int,  # of the place
    low: int,  # bits below the place
    size: int,  # pixels per row of the batch
    xy: wp.array[wp.uint32],  # (N,) column of each pixel, and its row 16 bits higher
    begin: wp.int64,  # of the chunk [ns]
    each: int,  # events per thread
    # out
    t_out: wp.array[wp.float64],  # (M,) [s], from whole nanoseconds, so that it never goes back
    x_out: wp.array[wp.uint16],  # (M,)
    y_out: wp.array[wp.uint16],  # (M,)
    p_out: wp.array[wp.uint8],  # (M,)
    row_out: wp.array[int],  # (M,) of the batch; of length 0 when nobody asks
    label_out: wp.array[wp.int8],  # (M,) or of length 0 when nobody asks
):
    """Unpack keys: time, pixel, polarity and label of each event."""
    _, n = wp.tid()
    n = (n + first) * each
    unpack_keys(
        keys, n, n + each, bits, low, size, xy, begin, t_out, x_out, y_out, p_out, row_out, label_out
    )  # fmt: skip


def events_per_thread(device: wp.Device) -> int:
    """Return how many events a thread of `decode_keys` takes, its argument `each`."""
    # on the CPU it costs as much to begin a thread as to decode ten
    return 1 if device.is_cuda else 1024


@wp.func_native(
    """
    // 9 bits per pass: as many write positions, 512, as stay in the nearest cache
    // the first pass reads the keys where the pixels left them
    auto each = [&](auto look) {
        for (int i = 0; i < late.shape[0]; ++i) look(late.data[i]);
        for (int slab = 0; slab < used.shape[0]; ++slab) {
            const long long* from = keys.data + (size_t)slab * keys.shape[1];
            for (int i = 0; i < used.data[slab]; ++i) look(from[i]);
        }
    };
    auto sum = [](int* place) {
        int before = 0;
        for (int d = 0; d < 512; ++d) {
            const int here = place[d];
            place[d] = before;
            before += here;
        }
    };
    int place[512] = {};
    long long* to = one.data;
    long long* from = other.data;
    each([&](long long key) { ++place[(key >> begin) & 511]; });
    sum(place);
    each([&](long long key) { to[place[(key >> begin) & 511]++] = key; });
    for (int shift = begin + 9; shift < end; shift += 9) {
        long long* swap = from;
        from = to;
        to = swap;
        for (int d = 0; d < 512; ++d) place[d] = 0;
        for (int i = 0; i < count; ++i) ++place[(from[i] >> shift) & 511];
        sum(place);
        for (int i = 0; i < count; ++i) to[place[(from[i] >> shift) & 511]++] = from[i];
    }
    // events of one time in the order of their places; few, so they are put right by insertion
    for (int i = 1; i < count; ++i) {
        if ((to[i - 1] >> low) <= (to[i] >> low)) continue;
        const long long key = to[i];
        int j = i;
        for (; j > 0 && (to[j - 1] >> low) > (key >> low); --j) to[j] = to[j - 1];
        to[j] = key;
    }
"""
)
def radix_sort(
    late: wp.array[wp.int64],
    keys: wp.array2d[wp.int64],
    used: wp.array[int],
    count: int,
    begin: int,
    end: int,
    low: int,
    one: wp.array[wp.int64],
    other: wp.array[wp.int64],
):
    """Sort stably by time, then by place; after an even number of passes the result is in `other`.

    Arguments have the shape that `sort_keys` says.
    """
    ...


@wp.kernel(enable_backward=False)
def sort_keys(
    first: int,
    # in
    late: wp.array[wp.int64],  # (L,)
    keys: wp.array2d[wp.int64],  # (S, capacity)
    used: wp.array[int],  # (S,)
    count: int,  # of all keys
    begin: int,  # lowest bit of the time
    end: int,  # bits of all
    low: int,  # bits below the place
    # out
    one: wp.array[wp.int64],  # (count,)
    other: wp.array[wp.int64],  # (count,)
):
    """Sort on one thread of a CPU, three times as fast as Warp's sort of pairs."""
    radix_sort(late, keys, used, count, begin, end, low, one, other)


class KeyBuffer:
    """Memory that is kept from chunk to chunk: new memory costs as much as a sort."""

    def __init__(self) -> None:
        self._kept: dict[str, wp.array] = {}

    def take(self, what: str, size: int, device: wp.Device, dtype: type = wp.int64) -> wp.array:
        """Return an array of `size` numbers, shape (size,), which was that of `what` before, too."""
        kept = self._kept.get(what)
        if kept is None or len(kept) < size:
            kept = self._kept[what] = launch.new_array(size + size // 4, dtype, device)
        return kept[:size] if size else wp.empty(0, dtype=dtype, device=device)


def keys_in_order(
    keys: wp.array,
    counts: wp.array,
    used: np.ndarray,
    bits: int,
    low: int,
    top: int,
    device: wp.Device,
    late: np.ndarray | None = None,
    room: KeyBuffer | None = None,
) -> wp.array:
    """Return all keys in order of time, then place, then polarity.

    Where events leave late, those of one pixel at one time keep the order in which they happened.

    Args:
        keys: Shape (B, slabs, capacity), int64: time [ns], place, polarity and label.
        counts: How many of them each slab has, shape (B, slabs), int32, not above the capacity.
        used: The same on the host.
        bits: Of the place.
        low: Bits below the place.
        top: Bits of all.
        device: Where `keys` live.
        late: Keys that earlier chunks have left, shape (L,), or None where no event leaves late.
        room: Where to sort; the result lies in it. None takes new memory.
    """
    begin = low if late is not None else bits + low if device.is_cpu else 0
    late = np.empty(0, np.int64) if late is None else late
    total = len(late) + int(used.sum())
    room = room or KeyBuffer()
    out = room.take("keys", 2 * total, device)
    if total == 0:
        return out
    flat, counts = keys.reshape((keys.shape[0] * keys.shape[1], keys.shape[2])), counts.flatten()
    if device.is_cpu:
        halves = out[:total], out[total:]
        before = wp.array(late, dtype=wp.int64, device=device)
        launch.run_kernel(sort_keys, 1, [before, flat, counts, total, begin, top, low, *halves], device)
        passes = -(-(top - begin) // 9)  # of 9 bits each, from one half to the other and back
        return halves[(passes + 1) % 2]
    if len(late):
        out[: len(late)].assign(late)
    if used.any():
        start = room.take("start", len(counts), device, wp.int32)
        # not by Warp's sum on the device: memory that Warp lets go of makes all streams wait for each other,
        # and this one would wait for the pixels of the next chunk
        start.assign(np.cumsum(used, dtype=np.int32) - used.ravel())
        arguments = [flat, counts, start, len(late), out]
        launch.run_kernel(close_gaps, len(counts) * GAP_THREADS, arguments, device)
    # Warp's sort takes numbers along with the keys; nobody reads these
    idle = room.take("idle", 2 * total, device, wp.int32)
    wp.utils.radix_sort_pairs(out, idle, total, begin_bit=begin, end_bit=top)
    return out[:total]
