"""What a recording and a model of it have in units that need no explanation."""

from __future__ import annotations

import numpy as np

from dase.fitting.subset import Array, CalibratedSubset
from dase.kernels.event_probes import BANDS, INTERVALS, KINDS, LAGS, RESTING
from dase.probes.accumulators import PROBE_TIMES
from dase.probes.statistics import LAYOUT


def plain_numbers(half: CalibratedSubset) -> dict[str, tuple[float, float]]:
    """Return measured and simulated values in units that need no explanation."""
    values = half.seen.target, half.repeats.mean(0)
    real, made = (rate_counts(v) for v in values)
    exposure = half.trials.stimulus.exposure().reshape(KINDS, BANDS)
    time_ = max(float(exposure.sum()), 1e-9)
    rest = max(float(exposure[:RESTING].sum()), 1e-9)
    names = ("OFF", "ON")
    out = {
        f"{names[n]} events [1/(px s)]": (float(real[n].sum() / time_), float(made[n].sum() / time_))
        for n in range(2)
    }
    for n in range(2):
        slow = real[n, :RESTING].sum() / rest, made[n, :RESTING].sum() / rest
        out[f"{names[n]} events at rest [1/(px s)]"] = float(slow[0]), float(slow[1])
    step = 1e3 * half.trials.stimulus.grid.step
    a, b = (_median_interval(family_counts(v, "intervals"), step) for v in values)
    out["median interval of a pixel [ms]"] = a, b
    a, b = (_mean_lag(v) for v in values)
    # the mean over events that a model does not send is drawn to the measured one
    absent = half.seen.least is not None and bool(np.any(half.seen.least[LAYOUT["lag"]] > 0))
    out["mean lag behind the light [ms]"] = a, float("nan") if absent else b
    return out


def family_counts(values: Array, family: str) -> Array:
    """Return the events that statistics (J,) of a family count, one for each statistic of the family."""
    counts = np.exp(values[LAYOUT[family]]) - 3.0
    # log(0 + 3) is rounded, so that no event may come back as 4e-16 of one
    return np.where(counts < 1e-9, 0.0, counts)


def rate_counts(values: Array) -> Array:
    """Return events by polarity, kind of cell and band, shape (2, KINDS, BANDS)."""
    return family_counts(values, "rate").reshape(2, KINDS, BANDS)


def octave_ends(step: float) -> Array:
    """Return the upper ends of the bins of intervals, shape (INTERVALS,), in units of `step`."""
    return step * np.concatenate([[0.5], 2.0 ** np.arange(INTERVALS - 1)])


def _median_interval(counts: Array, step: float) -> float:
    """Return the median interval, on a logarithmic scale within its bin."""
    total = counts.reshape(-1, INTERVALS).sum(0)
    if total.sum() == 0:
        return float("nan")
    share = np.concatenate([[0.0], np.cumsum(total) / total.sum()])
    ends = np.log(np.concatenate([[0.25 * step], octave_ends(step)]))
    return float(np.exp(np.interp(0.5, share, ends)))


def _mean_lag(values: Array) -> float:
    change = values[LAYOUT["lag"]].reshape(LAGS, BANDS).mean(1)
    middle = 0.5 * (np.array(PROBE_TIMES.lags[1:]) + np.array(PROBE_TIMES.lags[:-1]))
    weight = np.maximum(change, 0.0)
    return float(1e3 * (weight * middle).sum() / max(weight.sum(), 1e-12))
