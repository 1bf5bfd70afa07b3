"""Summary statistics of events, accumulated per pixel, event by event.

The stimulus of a pixel is known on a grid of equal steps: a cell (what the light does there: at rest, or by
how much it has changed, in which band of intensity) and the log intensity. `observe` looks at one event; a
pixel kernel calls it as its events happen, `walk` for events that are stored. Both write the same numbers, so
that model and measurement are compared like with like. Sums over pixels, and their sampling errors, are
`dase.probes`'.
"""

from __future__ import annotations

import warp as wp

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

RATE = 0
ISI = RATE + 2 * CELLS
LAG = ISI + 6 * INTERVALS
LAG_COUNT = LAG + LAGS * BANDS
CHANGE = LAG_COUNT + BANDS
REPEAT = CHANGE + 3 * 4 * CLASSES
SERIAL = REPEAT + 3 * BANDS
SIZE = SERIAL + 2 * CLASSES
"""Places of the families in the sums, and how many there are."""

HALVES = 8
"""Counts kept for every pixel: moving and at rest, even and odd halves of the time, OFF and ON."""

MEMORY = 4
"""Numbers a pixel remembers from event to event."""

ZONES = 4
"""Rings about the middle of the sensor, of equal numbers of pixels."""

PRODUCTS, ODD, RINGS = 0, 12, 16
FOLD = RINGS + 4 * ZONES
"""Places in what the counts of pixels are folded into, and how many numbers there are: products of what is
not expected in the two halves, pixels that count oddly, events by zone."""

_BANDS, _RESTING, _MASKED = wp.constant(BANDS), wp.constant(RESTING), wp.constant(MASKED)
_INTERVALS, _LAGS, _CLASSES = wp.constant(INTERVALS), wp.constant(LAGS), wp.constant(CLASSES)
_CELLS, _SIZE = wp.constant(CELLS), wp.constant(SIZE)
_ISI, _LAG, _LAG_COUNT, _CHANGE = (wp.constant(n) for n in (ISI, LAG, LAG_COUNT, CHANGE))
_REPEAT, _SERIAL = wp.constant(REPEAT), wp.constant(SERIAL)
_ODD, _RINGS, _FOLD, _ZONES = (wp.constant(n) for n in (ODD, RINGS, FOLD, ZONES))


@wp.struct
class Probes:
    """Sink that keeps sums over events instead of events."""

    cell: wp.array2d[wp.uint8]  # (N, T) of each step; step k ends at grid point k
    level: wp.array2d[float]  # (N, T) log intensity at the grid points
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
    sums: wp.array3d[float]  # (B, G, SIZE)
    halves: wp.array3d[float]  # (B, N, HALVES)
    clock: wp.array3d[int]  # (B, G, 2 T) OFF, ON events of each step


@wp.func_native("a.data[place] += value;")
def plus(a: wp.array3d[float], place: int, value: float):
    """Add to what one thread owns; Warp's own look-up takes most of the time of an event."""
    ...


@wp.func_native("return a.data[(size_t)i * a.shape[1] + k];")
def entry(a: wp.array2d[float], i: int, k: int) -> float:
    """Return a[i, k] of a contiguous array."""
    ...


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    const int zeros = __clz(steps - 1);
#else
    const int zeros = steps > 1 ? __builtin_clz((unsigned)(steps - 1)) : 32;
#endif
    const int at = steps > 0 ? 33 - zeros : 0;
    return at < last ? at : last;
"""
)
def octave(steps: int, last: int) -> int:
    """Bin of an interval, at most `last`."""
    ...


@wp.func
def observe_light(sink: Probes, base: int, i: int, k: int, band: int, sign: float):
    """How the light went before the event: bandwidth and latency."""
    end = sink.level.shape[1] - 1
    newer = entry(sink.level, i, wp.clamp(k - sink.lags[0], 0, end))
    for n in range(_LAGS):
        older = entry(sink.level, i, wp.clamp(k - sink.lags[n + 1], 0, end))
        plus(sink.sums, base + _LAG + n * _BANDS + band, sign * (newer - older))
        newer = older
    plus(sink.sums, base + _LAG_COUNT + band, 1.0)


@wp.func
def observe_pair(sink: Probes, base: int, i: int, k: int, before: int, now: int, last: int, deviation: float):
    """How the light changed since the pixel's last event; returns the deviation from what is typical."""
    steps = k - before
    group = int(0)
    if steps > sink.classes[0]:
        group = 1
    if steps > sink.classes[1]:
        group = 2
    pair = (2 * now + last) * _CLASSES + group
    change = float(2 * now - 1) * (entry(sink.level, i, k) - entry(sink.level, i, before))
    apart = change - sink.middle[pair]
    plus(sink.sums, base + _CHANGE + 3 * pair, 1.0)
    plus(sink.sums, base + _CHANGE + 3 * pair + 1, change)
    plus(sink.sums, base + _CHANGE + 3 * pair + 2, wp.abs(apart))
    if deviation > -1.0e5:
        plus(sink.sums, base + _SERIAL + 2 * group, 1.0)
        plus(sink.sums, base + _SERIAL + 2 * group + 1, wp.clamp(apart, -1.0, 1.0) * deviation)
    return wp.clamp(apart, -1.0, 1.0)


@wp.func
def joined(sink: Probes, i: int, before: int, k: int):
    """Whether all that lies between two events of a pixel is compared."""
    at = before
    while at < k and int(sink.cell[i, at]) != _MASKED:
        at += 1
    return at == k


@wp.func
def observe(sink: Probes, row: int, i: int, time: wp.int64, now: int):
    """Look at one event of pixel `i`, `time` [ns] after the begin of the grid, `now` 1 for ON."""
    stamp = time
    if sink.ticks[row] > wp.int64(0):
        stamp = wp.int64(1000) * time / sink.ticks[row] * sink.ticks[row] / wp.int64(1000)
    at = (wp.float64(stamp) - sink.slack) / sink.step
    k = int(wp.ceil(at))
    if k < 0 or k >= sink.cell.shape[1]:
        return
    cell = int(sink.cell[i, k])
    before = int(sink.memory[row, i, 0]) - 1
    last = int(sink.memory[row, i, 1])
    deviation = sink.memory[row, i, 2]
    run = sink.memory[row, i, 3] + 1.0
    if before != k:
        run = 1.0
    apart = float(-1.0e6)
    # the group's sums, which one thread owns
    base = (row * sink.sums.shape[1] + i / sink.group) * _SIZE
    if cell != _MASKED:
        band = cell % _BANDS
        kind = cell / _BANDS
        plus(sink.sums, base + now * _CELLS + cell, 1.0)
        rest = int(0)
        if kind < _RESTING:
            rest = 1
        else:
            observe_light(sink, base, i, k, band, float(2 * now - 1))
        if before >= 0 and (sink.holes == 0 or joined(sink, i, before, k)):
            kinship = int(2)
            if now == last:
                kinship = now
            interval = octave(k - before, _INTERVALS - 1)
            plus(sink.sums, base + _ISI + (3 * rest + kinship) * _INTERVALS + interval, 1.0)
            apart = observe_pair(sink, base, i, k, before, now, last, deviation)
        plus(sink.sums, base + _REPEAT + 3 * band, 1.0)
        if run >= 2.0:
            plus(sink.sums, base + _REPEAT + 3 * band + 1, 1.0)
        if run >= 3.0:
            plus(sink.sums, base + _REPEAT + 3 * band + 2, 1.0)
        half = 4 * rest + 2 * ((k / sink.half) % 2) + now
        sink.halves[row, i, half] = sink.halves[row, i, half] + 1.0
        wp.atomic_add(sink.clock, row, i / sink.team, now * sink.cell.shape[1] + k, 1)
    sink.memory[row, i, 0] = float(k + 1)
    sink.memory[row, i, 1] = float(now)
    sink.memory[row, i, 2] = apart
    sink.memory[row, i, 3] = run


@wp.kernel(enable_backward=False)
def walk(
    # in
    first: int,
    start: wp.array2d[int],  # (B, N + 1) first event of each pixel, and the end
    time: wp.array[wp.int64],  # [ns], in order of row, pixel, time
    polarity: wp.array[wp.uint8],
    # out
    sink: Probes,
):
    """Look at stored events, one pixel per thread."""
    row, i = wp.tid()
    i += first
    for n in range(start[row, i], start[row, i + 1]):
        observe(sink, row, i, time[n], int(polarity[n]))


@wp.kernel(enable_backward=False)
def fold(
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
    out: wp.array3d[float],  # (B, G, FOLD)
):
    """Fold the counts of the pixels of each group into a few sums."""
    row, g = wp.tid()
    g += first
    of = frame[row]
    sums = wp.vector(length=wp.static(FOLD), dtype=float)
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
                ring = _RINGS + (2 * state + p) * _ZONES + zone[i]
                sums[ring] += halves[row, i, 4 * state + p] + halves[row, i, 4 * state + 2 + p]
        bound = usual + 4.0 * wp.sqrt(usual + 1.0)
        if rest > bound + 2.0:
            sums[_ODD] += 1.0
        if rest > bound + often:
            sums[_ODD + 1] += 1.0
        if every > 3.0 * all_usual + 20.0:
            sums[_ODD + 2] += 1.0
        if every == 0.0 and all_usual >= seen:
            sums[_ODD + 3] += 1.0
    for n in range(_FOLD):
        out[row, g, n] = sums[n]


@wp.kernel(enable_backward=False)
def together(
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
def counted(
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
