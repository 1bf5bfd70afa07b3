"""Summary statistics of events, accumulated per pixel, event by event.

The stimulus of a pixel is known on a grid of equal steps: a cell (what the light does there: at rest, or by
how much it has changed, in which band of intensity) and the log intensity. `observe_event` looks at one
event; a pixel kernel calls it as its events happen, `observe_stored_events` for events that are stored. Both
write the same numbers, so that model and measurement are compared like with like. Sums over pixels, and their
sampling errors, are worked out in `dase.probes.statistics`.
"""

from __future__ import annotations

from enum import IntEnum

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

KINDS = 7
"""At rest for long, at rest for a short time, and five bins of the change."""

RESTING = 2
"""Kinds that are at rest."""

BANDS = 4
"""Of intensity."""

CELLS = KINDS * BANDS

MASKED = 255
"""Cell of a step that is not compared."""

INTERVALS = 11
"""Bins of the interval between two events of a pixel: 0 steps, 1, 2, 3-4, 5-8 and so on by octaves."""

LAGS = 10
"""Differences of log intensity about an event."""

CLASSES = 3
"""Of intervals, for the change between two events."""

ZONES = 4
"""Rings about the middle of the sensor, of equal numbers of pixels."""


class SumPlace(IntEnum):
    """Where the families of statistics begin among the sums of a group of pixels, and how many there are."""

    RATE = 0  # events by polarity and cell
    ISI = RATE + 2 * CELLS  # by at rest or not, kinship of polarities (OFF OFF, ON ON, mixed) and interval
    LAG = ISI + 6 * INTERVALS  # change of log intensity, times the sign of the event, by lag and band
    LAG_COUNT = LAG + LAGS * BANDS  # events that those are summed over, by band
    CHANGE = LAG_COUNT + BANDS  # number, sum, sum of deviations of the change, by polarities and class
    REPEAT = CHANGE + 3 * 4 * CLASSES  # events, second ones and third ones of a step, by band
    SERIAL = REPEAT + 3 * BANDS  # number and sum of products of successive deviations, by class
    SIZE = SERIAL + 2 * CLASSES


class FoldPlace(IntEnum):
    """Where things are in what the counts of pixels are folded into, and how many numbers there are."""

    PRODUCTS = 0  # of what is not expected in the two halves, moving and at rest
    ODD = 12  # pixels that count oddly: busy at rest, hot, busy at all, silent
    RINGS = 16  # events by moving or at rest, polarity and zone
    SIZE = RINGS + 4 * ZONES


HALVES = 8
"""Counts kept for every pixel: moving and at rest, even and odd halves of the time, OFF and ON."""

MEMORY = 4
"""Numbers a pixel remembers from event to event: the step of the last one plus 1 (0: there was none), its
polarity, how far the change before it was from what is typical (below -1e5: unknown), events of its step."""

LANES = 16
"""Models of a pixel that a CPU thread works on side by side; an event that waits has 4 bits for which."""

QUEUE = 512
"""Their events that wait until they are looked at, a multiple of 8."""


@wp.struct
class ProbeSums:
    """Sink that keeps sums over events instead of events."""

    cell: wp.array2d[wp.uint8]  # (N, T) of each step; step k ends at grid point k
    level: wp.array2d[float]  # (N, T) log intensity at the grid points; (N, 1) where it never changes
    lags: wp.array[int]  # (LAGS + 1,) steps before an event at which its light is looked at
    middle: wp.array[float]  # (4 CLASSES,) typical change between two events
    classes: wp.array[int]  # (CLASSES - 1,) steps that end a class of intervals
    half: int  # steps after which the halves take turns
    step: wp.float64  # of the grid [ns]
    slack: wp.float64  # times up to this past a grid point belong to it [ns]
    holes: int  # 1 where parts of the time are not compared: then no pair of events reaches across them
    ticks: wp.array[wp.int64]  # (B,) from tick to tick of the clock that stamps the events [ps]; 0 for none
    group: int  # pixels that share a row of `sums`; one thread works on all of them
    team: int  # pixels that share a row of `clock`
    memory: wp.array3d[float]  # (B, N, MEMORY)
    queue: wp.array2d[wp.int64]  # (G, QUEUE) events of a pixel that wait, on a CPU: time [ns], ON, lane
    sums: wp.array3d[float]  # (B, G, SumPlace.SIZE)
    halves: wp.array3d[float]  # (B, N, HALVES)
    clock: wp.array3d[int]  # (B, G, 2 T) OFF, ON events of each step


_names_in_cpp = {
    "BANDS": BANDS, "RESTING": RESTING, "MASKED": MASKED, "INTERVALS": INTERVALS, "LAGS": LAGS,
    "CLASSES": CLASSES, "CELLS": CELLS, "HALVES": HALVES, "MEMORY": MEMORY, "LANES": LANES, "QUEUE": QUEUE,
    **SumPlace.__members__,
}  # fmt: skip

_observation = (
    f"enum {{ {', '.join(f'{name} = {at:d}' for name, at in _names_in_cpp.items())} }};"
    """
const int steps = sink.cell.shape[1];
const unsigned char* cell = sink.cell.data + (size_t)i * steps;
const int end = sink.level.shape[1] - 1;
const float* level = sink.level.data + (size_t)i * sink.level.shape[1];
const int* lags = sink.lags.data;
const int group = i / sink.group;
const int team = i / sink.team;
// before and after the time that is looked at the light stands still; light at rest is one column
auto INSIDE = [=](int k) { return k < 0 ? 0 : k > end ? end : k; };
auto OCTAVE = [](int size, int last) {
    // bin of an interval
#ifdef __CUDA_ARCH__
    const int zeros = __clz(size - 1);
#else
    const int zeros = size > 1 ? __builtin_clz((unsigned)(size - 1)) : 32;
#endif
    const int at = size > 0 ? 33 - zeros : 0;
    return at < last ? at : last;
};
auto JOINED = [&](int before, int k) {
    // whether all that lies between two events is compared
    while (before < k && cell[before] != MASKED) ++before;
    return before == k;
};
auto LOOK_AT = [&](int row, int k, int now, float* memory) {
    if (k < 0 || k >= steps) return;
    const int before = (int)memory[0] - 1;
    const int last = (int)memory[1];
    // events of one step follow each other more closely than anything that the light does
    const float run = before == k ? memory[3] + 1.0f : 1.0f;
    float apart = -1.0e6f;
    if (cell[k] != MASKED) {
        const int band = cell[k] % BANDS;
        const int rest = cell[k] / BANDS < RESTING;
        // the group's sums, which one thread owns
        float* sums = sink.sums.data + ((size_t)row * sink.sums.shape[1] + group) * SIZE;
        sums[now * CELLS + cell[k]] += 1.0f;
        if (!rest) {
            // how the light went before the event: bandwidth and latency
            const float sign = now ? 1.0f : -1.0f;
            float* to = sums + LAG + band;
            float newer = level[INSIDE(k - lags[0])];
            for (int n = 0; n < LAGS; ++n) {
                const float older = level[INSIDE(k - lags[n + 1])];
                to[n * BANDS] += sign * (newer - older);
                newer = older;
            }
            sums[LAG_COUNT + band] += 1.0f;
        }
        if (before >= 0 && (sink.holes == 0 || JOINED(before, k))) {
            const int kinship = now == last ? now : 2;
            const int size = k - before;
            sums[ISI + (3 * rest + kinship) * INTERVALS + OCTAVE(size, INTERVALS - 1)] += 1.0f;
            // how the light changed since the last event, and how far from what is typical
            // longer intervals see larger changes: they are compared class by class
            const int of = (size > sink.classes.data[0]) + (size > sink.classes.data[1]);
            const int pair = (2 * now + last) * CLASSES + of;
            const float change = (now ? 1.0f : -1.0f) * (level[INSIDE(k)] - level[INSIDE(before)]);
            const float off = change - sink.middle.data[pair];
            // clipped, so that a few leaps of the light do not outweigh everything else
            apart = off < -1.0f ? -1.0f : off > 1.0f ? 1.0f : off;
            float* changes = sums + CHANGE + 3 * pair;
            changes[0] += 1.0f;
            changes[1] += change;
            changes[2] += off < 0.0f ? -off : off;
            if (memory[2] > -1.0e5f) {
                sums[SERIAL + 2 * of] += 1.0f;
                sums[SERIAL + 2 * of + 1] += apart * memory[2];
            }
        }
        float* repeats = sums + REPEAT + 3 * band;
        repeats[0] += 1.0f;
        if (run >= 2.0f) repeats[1] += 1.0f;
        if (run >= 3.0f) repeats[2] += 1.0f;
        const int half = 4 * rest + 2 * (k / sink.half % 2) + now;
        sink.halves.data[((size_t)row * sink.halves.shape[1] + i) * HALVES + half] += 1.0f;
        int* clock = sink.clock.data + ((size_t)row * sink.clock.shape[1] + team) * sink.clock.shape[2];
        // a team is several groups, whose threads count side by side on a GPU; a CPU thread has whole teams
#ifdef __CUDA_ARCH__
        atomicAdd(clock + now * steps + k, 1);
#else
        clock[now * steps + k] += 1;
#endif
    }
    memory[0] = (float)(k + 1);
    memory[1] = (float)now;
    memory[2] = apart;
    memory[3] = run;
};
auto STAMPED = [&](int row, long long time) {
    // models differ in their clocks, so times are stamped as they are looked at
    const long long tick = sink.ticks.data[row];
    return tick > 0 ? 1000 * time / tick * tick / 1000 : time;
};
auto MEMORY_OF = [&](int row) {
    return sink.memory.data + ((size_t)row * sink.memory.shape[1] + i) * MEMORY;
};
"""
)
"""What one event of pixel `i` adds to the sums: C++ that observing and observing queued events share."""


@wp.func_native(
    _observation
    + """
// a step ends at its grid point, which belongs to it: hence rounded up
const double at = ((double)STAMPED(row, time) - sink.slack) / sink.step;
LOOK_AT(row, (int)ceil(at), now, MEMORY_OF(row));
"""
)
def observe_event(sink: ProbeSums, row: int, i: int, time: wp.int64, now: int):
    """Look at one event of pixel `i`, `time` [ns] after the begin of the grid, `now` 1 for ON."""
    ...


@wp.func_native(
    """
// 4 bits of the lane, 1 of the polarity, 59 of the time
sink.queue.data[(size_t)slot * sink.queue.shape[1] + waiting] = (time << 1 | now) << 4 | lane;
return waiting + 1;
"""
)
def queue_event(sink: ProbeSums, slot: int, waiting: int, lane: int, time: wp.int64, now: int) -> int:
    """Keep an event of a lane until `observe_queued_events`; returns how many wait."""
    ...


@wp.func_native(
    _observation
    + """
// all times first, in the CPU's vectors, and then one event after the other
typedef double Times __attribute__((ext_vector_type(8)));
typedef long long Longs __attribute__((ext_vector_type(8)));
typedef int Ints __attribute__((ext_vector_type(8)));
long long* queue = sink.queue.data + (size_t)group * sink.queue.shape[1];
// most models have no clock: one question for all of them
long long ticking = 0;
const int rows = sink.ticks.shape[0] - start;
for (int lane = 0; lane < LANES && lane < rows; ++lane) ticking |= sink.ticks.data[start + lane];
if (ticking > 0) {
    for (int n = 0; n < waiting; ++n)
        queue[n] = STAMPED(start + (int)(queue[n] & (LANES - 1)), queue[n] >> 5) << 5 | (queue[n] & 31);
}
int grid[QUEUE];
for (int n = 0; n < waiting; n += 8) {
    Longs time;
    __builtin_memcpy(&time, queue + n, sizeof(time));
    const Times at = (__builtin_convertvector(time >> 5, Times) - sink.slack) / sink.step;
    const Ints k = __builtin_convertvector(__builtin_elementwise_ceil(at), Ints);
    __builtin_memcpy(grid + n, &k, sizeof(k));
}
for (int n = 0; n < waiting; ++n) {
    const int row = start + (int)(queue[n] & (LANES - 1));
    LOOK_AT(row, grid[n], (int)(queue[n] >> 4 & 1), MEMORY_OF(row));
}
return 0;
"""
)
def observe_queued_events(sink: ProbeSums, start: int, i: int, waiting: int) -> int:
    """Look at the events of pixel `i` that wait, of models `start` and after, on a CPU; none wait then."""
    ...


@wp.kernel(enable_backward=False)
def observe_stored_events(
    # in
    first: int,
    start: wp.array2d[int],  # (B, N + 1) first event of each pixel, and the end
    time: wp.array[wp.int64],  # [ns], in order of row, pixel, time
    polarity: wp.array[wp.uint8],
    # out
    sink: ProbeSums,
):
    """Look at stored events, one pixel per thread."""
    row, i = wp.tid()
    i += first
    for n in range(start[row, i], start[row, i + 1]):
        observe_event(sink, row, i, time[n], int(polarity[n]))


@wp.kernel(enable_backward=False)
def fold_pixel_counts(
    # in
    first: int,
    halves: wp.array3d[float],  # (B, N, HALVES)
    expected: wp.array3d[float],  # (K, N, HALVES) what the present model expects
    frame: wp.array[int],  # (B,) which of those a row is compared with
    zone: wp.array[int],  # (N,)
    often: float,  # events at rest of a pixel that is called hot
    seen: float,  # events that are expected of a pixel which is called silent if it sends none
    team: int,  # pixels that one thread adds up
    # out
    out: wp.array3d[float],  # (B, G, FoldPlace.SIZE)
):
    """Fold the counts of the pixels of each group into a few sums."""
    row, g = wp.tid()
    g += first
    of = frame[row]
    sums = wp.vector(length=wp.static(int(FoldPlace.SIZE)), dtype=float)
    for i in range(g * team, wp.min((g + 1) * team, halves.shape[1])):
        rest = float(0.0)
        usual = float(0.0)
        every = float(0.0)
        all_usual = float(0.0)
        for state in range(2):
            for n in range(4):
                count = halves[row, i, 4 * state + n]
                mean = expected[of, i, 4 * state + n]
                every += count
                all_usual += mean
                if state == 1:
                    rest += count
                    usual += mean
            # products of the two halves: chance has no part in both, what is wrong with a pixel has
            a_off = halves[row, i, 4 * state] - expected[of, i, 4 * state]
            a_on = halves[row, i, 4 * state + 1] - expected[of, i, 4 * state + 1]
            b_off = halves[row, i, 4 * state + 2] - expected[of, i, 4 * state + 2]
            b_on = halves[row, i, 4 * state + 3] - expected[of, i, 4 * state + 3]
            sums[6 * state] += a_off * b_off
            sums[6 * state + 1] += a_off * b_on
            sums[6 * state + 2] += a_on * b_off
            sums[6 * state + 3] += a_on * b_on
            sums[6 * state + 4] += a_off * a_off + b_off * b_off
            sums[6 * state + 5] += a_on * a_on + b_on * b_on
            for p in range(2):
                ring = FoldPlace.RINGS + (2 * state + p) * ZONES + zone[i]
                sums[ring] += halves[row, i, 4 * state + p] + halves[row, i, 4 * state + 2 + p]
        # four standard deviations of a Poisson count, that of no event taken as of one
        bound = usual + 4.0 * wp.sqrt(usual + 1.0)
        if rest > bound + 2.0:
            sums[FoldPlace.ODD] += 1.0
        if rest > bound + often:
            sums[FoldPlace.ODD + 1] += 1.0
        if every > 3.0 * all_usual + 20.0:
            sums[FoldPlace.ODD + 2] += 1.0
        if every == 0.0 and all_usual >= seen:
            sums[FoldPlace.ODD + 3] += 1.0
    for n in range(wp.static(int(FoldPlace.SIZE))):
        out[row, g, n] = sums[n]


@wp.kernel(enable_backward=False)
def sum_groups(
    # in
    first: int,
    parts: wp.array3d[float],  # (B, G, K)
    # out
    out: wp.array2d[wp.float64],  # (B, K)
):
    """Add up what groups of pixels have."""
    row, k = wp.tid()
    k += first
    value = wp.float64(0.0)
    for g in range(parts.shape[1]):
        value += wp.float64(parts[row, g, k])
    out[row, k] = value


@wp.kernel(enable_backward=False)
def sum_group_counts(
    # in
    first: int,
    parts: wp.array3d[int],  # (B, G, K)
    # out
    out: wp.array2d[int],  # (B, K)
):
    """Add up what groups of pixels have counted."""
    row, k = wp.tid()
    k += first
    value = int(0)
    for g in range(parts.shape[1]):
        value += parts[row, g, k]
    out[row, k] = value
