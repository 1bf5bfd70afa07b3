"""Surrogate gradients of event counts by the thresholds.

Counting takes a floor (`dase.kernels.threshold_counts`), which passes no gradient. Three surrogates stand in
for it; `docs/surrogates.md` measures them:

- `interval`: the floor of Equation 7 passed straight through in every interval in which an event falls,
  -|s_k - s_{k-1}| / threshold²;
- `events`: -N / threshold, the derivative of N = |change| / threshold;
- `expected`: the central difference of the counts at threshold e^h and threshold e^-h.

Pixels are the last axis, so that neighbouring threads read neighbouring addresses.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.vector_math import whole_quotient

# the adjoints are written by hand; fused multiply-adds would move events between intervals
wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False, "fuse_fp": False})


@wp.func
def signed_crossings(change: float, on: float, off: float, per_on: float, per_off: float) -> float:
    """Return the events of a change of log intensity, ON positive, OFF negative; `per_` are inverses."""
    up = change >= 0.0
    events = whole_quotient(wp.abs(change), wp.where(up, on, off), wp.where(up, per_on, per_off))
    return wp.where(up, events, -events)


@wp.func
def height_of_events(events: float, on: float, off: float) -> float:
    """Return what signed `events` stand for [log intensity]."""
    return events * wp.where(events >= 0.0, on, off)


@wp.func
def weighted_events(events: float, gradient_on: float, gradient_off: float) -> float:
    """Return the objective that signed `events` add: their number times the gradient of their polarity."""
    return wp.where(events >= 0.0, events * gradient_on, -events * gradient_off)


@wp.kernel
def interval_gradient(
    first: int,
    # in
    log: wp.array3d[float],  # (B, K, N) [log intensity]
    threshold: wp.array3d[float],  # (B, P, N) [log intensity]
    phase: wp.array2d[float],  # (B, N) [log intensity]
    window: wp.array[int],  # (K - 1,)
    gradient: wp.array4d[float],  # (B, W, 2, N) of the objective by the counts [1/events]
    # out
    threshold_gradient_out: wp.array3d[float],  # (B, P, N) [1/log intensity]; zero on entry
):
    """Differentiate by `interval`: -|s_k - s_{k-1}| / threshold² where an event falls, else nothing.

    Both polarities have this sign: N_on = max(D, 0) with D falling in the threshold where D > 0, and
    N_off = max(-D, 0) with -D falling in it where D < 0.
    """
    b, i = wp.tid()
    n = first + i
    last = threshold.shape[1] - 1
    off = threshold[b, 0, n]
    on = threshold[b, last, n]
    reference = log[b, 0, n] - phase[b, n]
    for k in range(1, log.shape[1]):
        events = signed_crossings(log[b, k, n] - reference, on, off, 1.0 / on, 1.0 / off)
        if events != 0.0:
            reference += height_of_events(events, on, off)
            p = wp.where(events > 0.0, 1, 0)
            c = wp.where(events > 0.0, last, 0)
            slope = -wp.abs(log[b, k, n] - log[b, k - 1, n]) / (threshold[b, c, n] * threshold[b, c, n])
            share = gradient[b, window[k - 1], p, n] * slope
            threshold_gradient_out[b, c, n] = threshold_gradient_out[b, c, n] + share


@wp.kernel
def events_gradient(
    first: int,
    # in
    threshold: wp.array3d[float],  # (B, P, N) [log intensity]
    counts: wp.array4d[float],  # (B, W, 2, N) [events], as `count` returned them
    gradient: wp.array4d[float],  # (B, W, 2, N) of the objective by the counts [1/events]
    # out
    threshold_gradient_out: wp.array3d[float],  # (B, P, N) [1/log intensity]
):
    """Differentiate by `events`: -N / threshold, every polarity by its own threshold."""
    b, i = wp.tid()
    n = first + i
    off_sum = float(0.0)
    on_sum = float(0.0)
    for w in range(counts.shape[1]):
        off_sum += counts[b, w, 0, n] * gradient[b, w, 0, n]
        on_sum += counts[b, w, 1, n] * gradient[b, w, 1, n]
    if threshold.shape[1] == 1:
        threshold_gradient_out[b, 0, n] = -(off_sum + on_sum) / threshold[b, 0, n]
    else:
        threshold_gradient_out[b, 0, n] = -off_sum / threshold[b, 0, n]
        threshold_gradient_out[b, 1, n] = -on_sum / threshold[b, 1, n]


@wp.func
def scaled_thresholds(on: float, off: float, phase: float, on_scale: float, off_scale: float) -> wp.vec3f:
    """Return scaled thresholds and the phase at the same fraction of the threshold of its sign."""
    return wp.vec3f(on_scale * on, off_scale * off, phase * wp.where(phase >= 0.0, on_scale, off_scale))


@wp.func
def objective_difference(
    b: int,
    n: int,
    log: wp.array3d[float],
    window: wp.array[int],
    gradient: wp.array4d[float],
    high: wp.vec3f,  # ON, OFF, phase [log intensity]
    low: wp.vec3f,  # ON, OFF, phase [log intensity]
) -> float:
    """Return the objective at `high` minus that at `low`, linear in the counts by `gradient`."""
    high_inverse = wp.vec2(1.0 / high[0], 1.0 / high[1])
    low_inverse = wp.vec2(1.0 / low[0], 1.0 / low[1])
    high_reference = log[b, 0, n] - high[2]
    low_reference = log[b, 0, n] - low[2]
    change = float(0.0)
    for k in range(1, log.shape[1]):
        sample = log[b, k, n]
        high_events = signed_crossings(
            sample - high_reference, high[0], high[1], high_inverse[0], high_inverse[1]
        )
        low_events = signed_crossings(sample - low_reference, low[0], low[1], low_inverse[0], low_inverse[1])
        if high_events != 0.0 or low_events != 0.0:
            high_reference += height_of_events(high_events, high[0], high[1])
            low_reference += height_of_events(low_events, low[0], low[1])
            w = window[k - 1]
            g_off = gradient[b, w, 0, n]
            g_on = gradient[b, w, 1, n]
            change += weighted_events(high_events, g_on, g_off) - weighted_events(low_events, g_on, g_off)
    return change


@wp.kernel
def expected_gradient(
    first: int,
    # in
    log: wp.array3d[float],  # (B, K, N) [log intensity]
    threshold: wp.array3d[float],  # (B, P, N) [log intensity]
    phase: wp.array2d[float],  # (B, N) [log intensity]
    window: wp.array[int],  # (K - 1,)
    gradient: wp.array4d[float],  # (B, W, 2, N) of the objective by the counts [1/events]
    step: float,  # half width h of the difference, in the logarithm of the threshold
    # out
    threshold_gradient_out: wp.array3d[float],  # (B, P, N) [1/log intensity]
):
    """Differentiate by `expected`: (N(threshold e^h) - N(threshold e^-h)) / (2 threshold sinh h).

    The denominator makes N ∝ 1/threshold exact. Both polarities answer to either threshold.
    """
    b, i = wp.tid()
    n = first + i
    last = threshold.shape[1] - 1
    off = threshold[b, 0, n]
    on = threshold[b, last, n]
    up = wp.exp(step)
    down = wp.exp(-step)
    for c in range(last + 1):
        # a shared threshold moves both polarities
        moves_on = c == last
        moves_off = c == 0
        high = scaled_thresholds(
            on, off, phase[b, n], wp.where(moves_on, up, 1.0), wp.where(moves_off, up, 1.0)
        )
        low = scaled_thresholds(
            on, off, phase[b, n], wp.where(moves_on, down, 1.0), wp.where(moves_off, down, 1.0)
        )
        change = objective_difference(b, n, log, window, gradient, high, low)
        threshold_gradient_out[b, c, n] = change / ((up - down) * threshold[b, c, n])
