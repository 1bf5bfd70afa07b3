"""Chances of what was seen if there were no effect, exact or nearly so."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

NINETY = 1.6448536269514722
"""Standard errors on each side of a 90 % interval."""


def sign_flip_tail(values: NDArray[np.float64]) -> float:
    """Return the chance that as large a sum comes about if every value had the other sign as well as not.

    The saddle point approximation (Lugannani and Rice, 1980) of the sum of independent signs, with the sizes
    as they are: right within some percent however far out, where permutations would have to be counted in
    millions and a normal law is wrong where few values are large.

    Args:
        values: Shape (N,).
    """
    sizes = np.abs(values[values != 0])
    total = float(values.sum())
    if not len(sizes) or total <= 0:
        return 1.0
    if total >= sizes.sum() * (1 - 1e-12):
        return 0.5 ** len(sizes)
    scale = float(np.sqrt((sizes**2).sum()))
    sizes, total = sizes / scale, total / scale
    if total < 0.05:  # the formula is 0 / 0 in the middle
        return float(stats.norm.sf(total))

    def slope(tilt: float) -> float:
        return float((sizes * np.tanh(tilt * sizes)).sum()) - total

    top = 1.0
    while slope(top) < 0 and top < 1e12:
        top *= 2
    tilt = float(optimize.brentq(slope, 0.0, top))
    # log cosh without overflow
    bent = float((np.logaddexp(tilt * sizes, -tilt * sizes) - math.log(2)).sum())
    curvature = float((sizes**2 * (1 - np.tanh(tilt * sizes) ** 2)).sum())
    root = math.sqrt(max(2 * (tilt * total - bent), 0.0))
    spread = tilt * math.sqrt(curvature)
    if root < 1e-6 or spread < 1e-12:
        return 0.5 ** len(sizes) if spread < 1e-12 else 0.5
    tail = float(stats.norm.sf(root) + stats.norm.pdf(root) * (1 / spread - 1 / root))
    return min(max(tail, 0.5 ** len(sizes)), 1.0)


def poisson_interval(count: float) -> tuple[float, float]:
    """Return the exact 90 % interval of the mean of which a count was drawn."""
    low = float(stats.chi2.ppf(0.05, 2 * count) / 2) if count > 0 else 0.0
    return low, float(stats.chi2.ppf(0.95, 2 * count + 2) / 2)


def ratio_interval(count: int, others: int, expected: float) -> tuple[float, float]:
    """Return the exact 90 % interval of how many times as many there are as expected.

    Args:
        count: Events of the kind in question.
        others: Events to compare with.
        expected: `count` / `others` without the effect.
    """
    low = float(stats.beta.ppf(0.05, count, others + 1)) if count else 0.0
    high = float(stats.beta.ppf(0.95, count + 1, others)) if others else 1.0
    most = math.inf if high >= 1 else high / (1 - high) / expected
    return (low / (1 - low) / expected if low < 1 else math.inf), most


def mean_interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return a mean and its 90 % interval, from the scatter of the values, shape (N,), N >= 2."""
    mean = float(values.mean())
    reach = float(stats.t.ppf(0.95, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values)))
    return mean, mean - reach, mean + reach
