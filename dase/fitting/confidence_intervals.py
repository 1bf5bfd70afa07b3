"""How well the data know the parameters of a model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.fitting.data_split import SplitMeasurement
from dase.fitting.descent import DESCENT, denoised_normal_matrix, fit_slopes
from dase.fitting.model import FittedModel, model_of
from dase.fitting.parameter_space import SearchAxis
from dase.fitting.subset import CalibratedSubset
from dase.probes.random_streams import Draw, SimulationStream
from dase.results import Estimate

Array = NDArray[np.float64]

REPEATS = 60
"""Simulations that give the covariance of the statistics, and tell a fit what chance does."""


@dataclass(frozen=True)
class ConfidenceSettings:
    """How last steps are taken and how wide intervals are, in the units of `SearchAxis.to_place`."""

    steps: int = 3
    """Last steps, each seen from nearer: the first leaves a part of the chance of a single simulation."""

    farthest: float = 0.3
    """Longest last step: a model that is farther off was not fitted, and lines would not be straight."""

    narrowest: float = 0.004
    """Least reach of the simulations that slopes are taken from: below it, all is exact enough."""

    widest: float = 0.3
    """Largest reach of these: beyond it, lines are not straight."""

    first: float = 0.4
    """Reach of the first look, in units of the largest: a fit has ended about there."""

    wide: float = 3.5
    """Reach of the next look, in units of what the last one could not tell."""

    bent: float = 20.0
    """What an estimate misses by, in units of its chance, above which lines are not straight."""

    nearer: float = 0.3
    """Reach of the next look there, in units of the last."""

    checks: int = 12
    """Simulations with known parameters for each parameter, at which an estimate is tried."""

    least_known: float = 0.2
    """Least share of a variance of parameters that an estimate is taken to see: of less, nothing is known."""

    worse: float = 0.2
    """A step that makes the error larger by more than this share leads astray."""

    side: float = 0.9 * 1.645
    """Standard deviations on either side of a 90 % interval. What a look misses by has curvature over all of
    its reach in it, which is wider than the interval: of 579 intervals (key 2026-11-a) 95 % held the truth,
    and 91 % with a tenth less."""


CONFIDENCE = ConfidenceSettings()


@dataclass(frozen=True)
class LinearEstimator:
    """Parameters as a linear function of statistics, tried at simulations whose parameters are known.

    Args:
        gain: Change of the places per statistic, shape (P, J).
        covariance: Of what it missed by there: chance, and lines that are not straight, shape (P, P).
    """

    gain: Array
    covariance: Array


def estimate_parameters(
    evidence: SplitMeasurement, model: FittedModel, *, seed: int
) -> tuple[FittedModel, dict[str, Estimate]]:
    """Return the model, its parameters improved by last steps, and their 90 % intervals.

    Statistics are taken to run along straight lines in the parameters. The slopes of many statistics, seen in
    few simulations, are noisy, and what they say of parameters falls short along all ways on which these make
    up for each other. So the estimate that they give is tried at further simulations with known parameters:
    by how much it falls short there is undone, and by how much it misses there is its standard deviation,
    lines that are not straight included. Each step looks from as near as the last one was sure.

    The steps go from the mean of many repeats of the model, so that the chance of a single simulation does
    not stay in the parameters. What the measurement's own pixels make of them is seen with one group of
    pixels left out after the other; the larger counts. What the scene is not known to is added.
    """
    if not model.space.axes:
        return model, {}
    model = _with_observed_free(model)
    low, high = model.space.bounds()
    tight = np.array([axis.of_threshold for axis in model.space.axes])
    limit = np.where(tight, DESCENT.tight, 1.0) * CONFIDENCE.widest
    way = np.diag(CONFIDENCE.first * limit)
    best, least = model, np.inf
    for turn in range(CONFIDENCE.steps + 1):
        half = model.calibrate(
            evidence.train, repeats=REPEATS, seed=SimulationStream.CONFIDENCE.seed(seed, turn)
        )
        error = half.judge(seed).error
        if error > (1 + CONFIDENCE.worse) * least:
            model = best  # where lines are not straight, a step may lead astray
            half = model.calibrate(
                evidence.train, repeats=REPEATS, seed=SimulationStream.CONFIDENCE.seed(seed, turn)
            )
        else:
            best, least = model, min(error, least)
        estimator = _linear_estimator(half, model, way, seed=SimulationStream.FIT.seed(seed, turn))
        deviation = _standard_deviations(half, estimator)
        if turn == CONFIDENCE.steps:
            break
        apart = np.where(half.scale.used, half.scale.target - half.repeats.mean(0), 0.0)
        step = np.clip(estimator.gain @ apart, -CONFIDENCE.farthest, CONFIDENCE.farthest)
        model = replace(model, place=np.clip(model.place + step, low, high))
        way = _steps_as_wide_as(_where_lines_are_straight(estimator, half, way), limit)
    out = {}
    for n, axis in enumerate(model.space.axes):
        place, off = model.place[n], _side_of(model, axis, half) * deviation[n]
        ends = (float(axis.to_value(np.clip(place + way * off, low[n], high[n]))) for way in (-1, 1))
        out[axis.name] = Estimate(float(axis.to_value(place)), *ends)
    return model, out


def _side_of(model: FittedModel, axis: SearchAxis, half: CalibratedSubset) -> float:
    """Return how many standard deviations an interval has on either side.

    How far a few values lie apart is known no better than their mean: without this, 75 % of intervals held
    the median rate of some ten hot pixels.
    """
    effect, _, parameter = axis.name.partition(".")
    share = model.sensor[effect].share_that_tells(parameter)
    few = max(share * len(half.trials.stimulus.pixels), 2.0)
    return float(CONFIDENCE.side * stats.t.ppf(0.95, few - 1.0) / stats.norm.ppf(0.95))


def _with_observed_free(model: FittedModel) -> FittedModel:
    """Return the model with what was read off all events free beside the rest of its effect.

    Of a lamp, the phase at the begin is known no better than the frequency.
    """
    names = [axis.name for axis in model.space.axes]
    for effect in model.sensor.effects:
        mine = {f"{effect.name}.{p.name}": p for p in effect.parameters() if p.fitted}
        if {name for name, p in mine.items() if p.nearby is None} <= set(names):
            names += [name for name, p in mine.items() if p.nearby is not None and name not in names]
    return (
        model if len(names) == len(model.place) else replace(model_of(model.sensor, names), loss=model.loss)
    )


def _steps_as_wide_as(covariance: Array, limit: Array) -> Array:
    """Return steps as wide as parameters are uncertain, along the ways on which they are, shape (P, P).

    Args:
        covariance: Of the parameters, shape (P, P).
        limit: Longest step along each of them, shape (P,).
    """
    variance, axes = np.linalg.eigh(covariance / np.outer(limit, limit))
    least = CONFIDENCE.narrowest / CONFIDENCE.widest
    reach = np.clip(CONFIDENCE.wide * np.sqrt(np.maximum(variance, 0.0)), least, 1.0)
    out: Array = limit[:, None] * axes * reach
    return out


def _where_lines_are_straight(estimator: LinearEstimator, half: CalibratedSubset, way: Array) -> Array:
    """Return the covariance of an estimator, less where it comes of lines that are not straight, (P, P).

    Args:
        estimator: Of P parameters.
        half: With the model as its present one.
        way: Columns are the steps in which it was looked at, shape (P, P).
    """
    chance = ((half.repeats - half.repeats.mean(0)) @ estimator.gain.T).std(0)
    missed = np.sqrt(np.diag(estimator.covariance))
    bent = missed > CONFIDENCE.bent * chance
    # there the next look is from nearer
    nearer = CONFIDENCE.nearer * np.sqrt((way**2).sum(1)) / CONFIDENCE.wide
    less = np.where(bent, np.minimum(nearer / np.maximum(missed, 1e-12), 1.0), 1.0)
    out: Array = estimator.covariance * np.outer(less, less)
    return out


def _standard_deviations(half: CalibratedSubset, estimator: LinearEstimator) -> Array:
    """Return how well the places are known, shape (P,).

    Args:
        half: With the model as its present one.
        estimator: Of its parameters.
    """
    gain, repeats = estimator.gain, half.repeats
    # the mean of the repeats has a part of the chance, too
    chance = ((repeats - repeats.mean(0)) @ gain.T).var(0, ddof=1) * (1 + 1 / len(repeats))
    chance = np.maximum(chance, np.diag(estimator.covariance))
    # what the pixels of the measurement make of it, also where the model is not quite right
    seen = (half.left_out @ gain.T).var(0) * (half.groups - 1)
    square: Array = np.maximum(chance, seen)
    if half.doubt is not None:
        square = square + ((gain * half.doubt) ** 2)[:, half.scale.used].sum(1)
    if half.drift is not None:
        square = square + (gain @ np.where(half.scale.used, half.drift, 0.0)) ** 2
    return np.sqrt(square)


def _linear_estimator(
    half: CalibratedSubset, model: FittedModel, way: Array, *, seed: int
) -> LinearEstimator:
    """Return an estimator about a model that is right in the mean at simulations near it.

    Args:
        half: With the model as its present one.
        model: Of P free parameters.
        way: Columns are steps within which the simulations lie, shape (P, P).
        seed: Of the simulations.
    """
    size = len(model.place)
    raw = _steps_per_statistic(half, model, way, seed=SimulationStream.SLOPES.seed(seed))
    rng = Draw.SLOPES.generator(SimulationStream.SLOPES.seed(seed, 1))
    steps, places = _places_on_both_sides(model, way, CONFIDENCE.checks * size // 2, rng)
    values = half.run_repeats(model.space, places, seed=SimulationStream.SLOPE_MODELS.seed(seed, 1))
    seen = np.where(half.scale.used, values - values.mean(0), 0.0) @ raw.T
    true = steps - steps.mean(0)
    # what few simulations say is drawn towards the middle of those looked at, by as much as it is noise
    told = np.linalg.lstsq(seen, true, rcond=None)[0].T
    missed = true - seen @ told.T
    left = missed.T @ missed / max(len(missed) - size - 1, 1)
    # ... which is undone: in units of what was looked at, `known` is 0 where nothing is known
    spread = np.maximum(true.std(0), 1e-9)
    share, axes = np.linalg.eigh(left / np.outer(spread, spread))
    share = np.clip(share, 0.0, 1.0)
    known = np.maximum(1.0 - share, CONFIDENCE.least_known)
    undo = spread[:, None] * ((axes / known) @ axes.T) / spread
    covariance = np.outer(spread, spread) * ((axes * (share / known)) @ axes.T)
    return LinearEstimator(way @ undo @ told @ raw, way @ covariance @ way.T)


def _places_on_both_sides(
    model: FittedModel, way: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return steps and the places that they lead to, both ways, within bounds, shape (2 count, P) each."""
    size = len(model.place)
    steps = rng.choice([-1.0, 1.0], (count, size)) * rng.uniform(0.3, 1.0, (count, size))
    low, high = model.space.bounds()
    places = np.clip(model.place + np.concatenate([steps, -steps]) @ way.T, low, high)
    within: Array = (places - model.place) @ np.linalg.inv(way).T.astype(np.float64)
    return within, places


def _steps_per_statistic(half: CalibratedSubset, model: FittedModel, way: Array, *, seed: int) -> Array:
    """Return what a change of the statistics does to the steps, as few simulations tell, shape (P, J)."""
    scale, size = half.scale, len(model.place)
    steps, places = _places_on_both_sides(model, way, 2 * size + 4, Draw.SLOPES.generator(seed))
    values = half.run(model.space, places, seed=SimulationStream.SLOPE_MODELS.seed(seed)) / scale.sigma
    steps, values = steps - steps.mean(0), values - values.mean(0)
    values = np.where(scale.used, values, 0.0)
    lines = fit_slopes(steps, values)
    z = scale.z(half.repeats.mean(0))
    weights = scale.weights() / np.sqrt(1.0 + z * z)
    noise = half.repeats.var(0) / scale.sigma**2
    normal = denoised_normal_matrix(steps, values, lines, weights, noise)
    normal = normal + DESCENT.prior * way.T @ way
    out: Array = np.linalg.solve(normal, lines.T * weights) / scale.sigma
    return out
