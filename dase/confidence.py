"""How well the data know the parameters of a model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dase.descent import PRIOR
from dase.evidence import Evidence
from dase.model import Model
from dase.results import Estimate

Array = NDArray[np.float64]

REPEATS = 60
"""Simulations that give the covariance of the statistics."""

SIDE = 1.645
"""Standard deviations on either side of a 90 % interval."""


def estimates(evidence: Evidence, model: Model, *, seed: int) -> dict[str, Estimate]:
    """Return the free parameters with their 90 % intervals.

    The fit is linearised: statistics run along straight lines in the parameters. What sampling errors of the
    statistics make of the parameters is seen in repeats of the model, correlations between statistics
    included, and in the measurement with one group of pixels left out after the other; the larger counts.
    """
    half = evidence.train
    repeats = model.rebase(half, repeats=REPEATS, seed=seed + 900)
    found = model.explore(half, seed=seed, iterations=2, radius=0.08)
    gain = gain_matrix(
        half.scale.sigma, half.scale.used, half.scale.weights(), found.slope, half.scale.z(repeats.mean(0))
    )
    apart = (repeats - repeats.mean(0)) @ gain.T
    chance = apart.var(0, ddof=1) * (1 + 1 / len(repeats))
    # what the pixels of the measurement make of it, also where the model is not quite right
    seen = (half.left() @ gain.T).var(0) * (half.groups - 1)
    deviation = np.sqrt(np.maximum(chance, seen))
    low, high = model.space.bounds()
    out = {}
    for n, axis in enumerate(model.space.axes):
        ends = [model.place[n] + side * SIDE * deviation[n] for side in (-1, 1)]
        ends = [float(axis.to_value(np.clip(end, low[n], high[n]))) for end in ends]
        out[axis.name] = Estimate(float(axis.to_value(model.place[n])), ends[0], ends[1])
    return out


def gain_matrix(sigma: Array, used: NDArray[np.bool_], weights: Array, slope: Array, z: Array) -> Array:
    """Return what a change of the statistics does to the fitted places, shape (P, J)."""
    lines = np.where(used[:, None], slope / sigma[:, None], 0.0)
    w = weights / np.sqrt(1.0 + z * z)
    normal = lines.T @ (w[:, None] * lines) + PRIOR * np.eye(slope.shape[1])
    out: Array = np.linalg.solve(normal, lines.T * w) / sigma
    return out
