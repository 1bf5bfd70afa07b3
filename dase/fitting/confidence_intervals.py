"""How well the data know the parameters of a model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.fitting.data_split import SplitMeasurement
from dase.fitting.descent import DESCENT, denoised_normal_matrix, fit_slopes
from dase.fitting.model import FittedModel
from dase.fitting.subset import CalibratedSubset
from dase.probes.random_streams import Draw, SimulationStream
from dase.results import Estimate

Array = NDArray[np.float64]

REPEATS = 60
"""Simulations that give the covariance of the statistics, and tell a fit what chance does."""


@dataclass(frozen=True)
class ConfidenceSettings:
    """How last steps are taken and how wide intervals are, in the units of `SearchAxis.to_place`."""

    steps: int = 2
    """Last steps: the first leaves a part of the chance of a single simulation."""

    farthest: float = 0.3
    """Longest last step: a model that is farther off was not fitted, and lines would not be straight."""

    narrowest: float = 0.03
    """Least reach of the simulations that slopes are taken from: below it, chance hides the slopes."""

    widest: float = 0.3
    """Largest reach of these: beyond it, lines are not straight."""

    side: float = 1.645 * 1.25
    """Standard deviations on either side of a 90 % interval; a quarter more for the uncertainty of the
    slopes."""


CONFIDENCE = ConfidenceSettings()


def estimate_parameters(
    evidence: SplitMeasurement, model: FittedModel, *, seed: int
) -> tuple[FittedModel, dict[str, Estimate]]:
    """Return the model, its parameters improved by a last step, and their 90 % intervals.

    The fit is linearised: statistics run along straight lines in the parameters. The last steps go from the
    mean of many repeats of the model, so that the chance of a single simulation does not stay in the
    parameters. What sampling errors of the statistics make of the parameters is seen in the repeats,
    correlations between statistics included, and in the measurement with one group of pixels left out after
    the other; the larger counts.
    """
    if not model.space.axes:
        return model, {}
    low, high = model.space.bounds()
    places, errors = [model.place], []
    for turn in range(CONFIDENCE.steps):
        half = model.calibrate(
            evidence.train, repeats=REPEATS, seed=SimulationStream.CONFIDENCE.seed(seed, turn)
        )
        errors.append(half.judge(seed).error)
        repeats = half.repeats
        mean = repeats.mean(0)
        gain = _parameters_per_statistic(half, model, repeats, seed=seed + turn)
        # what the pixels of the measurement make of it, also where the model is not quite right
        seen = (half.left_out @ gain.T).var(0) * (half.groups - 1)
        step = -gain @ np.where(half.scale.used, mean - half.scale.target, 0.0)
        place = np.clip(model.place + np.clip(step, -CONFIDENCE.farthest, CONFIDENCE.farthest), low, high)
        model = replace(model, place=place)
        places.append(place)
    last = SimulationStream.CONFIDENCE.seed(seed, CONFIDENCE.steps)
    errors.append(model.judge(evidence.train, repeats=REPEATS, seed=last).error)
    place = places[int(np.argmin(errors))]  # where lines are not straight, a step may lead astray
    chance = ((repeats - mean) @ gain.T).var(0, ddof=1) * (1 + 1 / len(repeats))
    deviation = np.sqrt(np.maximum(chance, seen))
    out = {}
    for n, axis in enumerate(model.space.axes):
        ends = (
            np.clip(place[n] + side * CONFIDENCE.side * deviation[n], low[n], high[n]) for side in (-1, 1)
        )
        out[axis.name] = Estimate(
            float(axis.to_value(place[n])), *(float(axis.to_value(end)) for end in ends)
        )
    return replace(model, place=place), out


def _parameters_per_statistic(
    half: CalibratedSubset, model: FittedModel, repeats: Array, *, seed: int
) -> Array:
    """Return what a change of the statistics does to the fitted places, shape (P, J)."""
    mean = repeats.mean(0)
    tight = [axis.of_threshold for axis in model.space.axes]
    reach = np.where(tight, DESCENT.tight, 1.0) * CONFIDENCE.widest
    for turn in range(2):
        gain = _parameters_per_statistic_within(half, model, repeats, reach, seed=seed + 10 * turn)
        # as wide as the parameters are uncertain: wide enough to see a slope, narrow enough to be straight
        uncertain = ((repeats - mean) @ gain.T).std(0)
        reach = np.clip(4.0 * uncertain, CONFIDENCE.narrowest, CONFIDENCE.widest)
    return gain


def _parameters_per_statistic_within(
    half: CalibratedSubset, model: FittedModel, repeats: Array, reach: Array, *, seed: int
) -> Array:
    scale, size = half.scale, len(model.place)
    rng = Draw.SLOPES.generator(seed)
    low, high = model.space.bounds()
    steps = (
        rng.choice([-1.0, 1.0], (2 * size + 4, size)) * rng.uniform(0.3, 1.0, (2 * size + 4, size)) * reach
    )
    places = np.clip(model.place + np.concatenate([steps, -steps]), low, high)
    values = half.run(model.space, places, seed=seed + 1) / scale.sigma
    places, values = places - places.mean(0), values - values.mean(0)
    values = np.where(scale.used, values, 0.0)
    lines = fit_slopes(places, values)
    z = scale.z(repeats.mean(0))
    weights = scale.weights() / np.sqrt(1.0 + z * z)
    noise = repeats.var(0) / scale.sigma**2
    normal = denoised_normal_matrix(places, values, lines, weights, noise) + DESCENT.prior * np.eye(size)
    out: Array = np.linalg.solve(normal, lines.T * weights) / scale.sigma
    return out
