"""Parameters from statistics: populations of models, straight lines through what they give, robust steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.fitting.parameter_space import ParameterSpace
from dase.fitting.scheduler import SimulationRequest, Work
from dase.fitting.subset import CalibratedSubset
from dase.fitting.trial_sampling import SAMPLES, samples_per_step
from dase.kernels.event_probes import LANES
from dase.probes.distance import ErrorScale
from dase.probes.random_streams import Draw

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DescentSettings:
    """How populations of models are laid and steps are taken, in the units of `SearchAxis.to_place`."""

    longest: int = 12
    """Populations at most."""

    tight: float = 0.3
    """Reach along the thresholds relative to other parameters, at first: every event depends on them."""

    smallest: float = 0.01
    """Least reach of a population along an axis: below it the noise of single events hides the slope."""

    widest: float = 0.8
    """Largest reach: beyond it, statistics do not run along straight lines."""

    narrow: float = 0.35
    """Least by which the reach changes from one population to the next: one slope may be steep by chance."""

    widen: float = 1.6
    """Most by which it does."""

    farthest: float = 2.0
    """Longest step, in units of the reach of the population it was seen from."""

    near: float = 2.5
    """Places within so many reaches of the best one tell the slopes, those of former populations included."""

    part: float = 0.25
    """Part of the loss by which a population should see it change."""

    little: float = 0.3
    """Loss that chance alone gives: for less than a part of that nobody has to look."""

    much: float = 0.9
    """A loss below this, relative to that before, tells that a descent is still on its way."""

    prior: float = 2e-3
    """Weight by which parameters that the data say nothing about are held at their start."""

    left: float = 0.25
    """Least share of the product of slopes that is taken to be no noise."""


DESCENT = DescentSettings()
"""How all searches descend unless they are told otherwise."""


StopRule = Callable[[float, float], bool]
"""Whether a search may stop, from its loss and that before the last population."""


@dataclass(frozen=True)
class DescentEnd:
    """Where a search ended.

    Args:
        place: Best place, shape (P,).
        loss: Of the best place.
        values: Its statistics, shape (J,).
        slope: Statistics per unit of place, shape (J, P).
        places: All places tried, shape (M, P).
        tried: Their statistics, shape (M, J).
    """

    place: Array
    loss: float
    values: Array
    slope: Array
    places: Array
    tried: Array


def descent_work(
    half: CalibratedSubset,
    space: ParameterSpace,
    start: Array,
    *,
    seed: int,
    iterations: int = 5,
    radius: float = 0.25,
    patient: bool = False,
    over: StopRule | None = None,
    most: int = SAMPLES[-1],
    settings: DescentSettings = DESCENT,
) -> Work[DescentEnd]:
    """Descend from one start, see `run_side_by_side`.

    Each iteration simulates a population about the present place, with the random numbers in common, fits a
    straight line to each statistic, and goes where the robust loss of those lines is least. The slopes come
    from differences as wide as the population, so the noise of single events does not matter.

    Args:
        half: What is fitted.
        space: Free parameters.
        start: Where to begin, shape (P,).
        seed: Of the models' random numbers, and of the populations.
        iterations: Populations, not counting those that are still on the way.
        radius: Reach of the first, in the units of `SearchAxis.to_place`.
        patient: Whether populations that still bring the loss down much do not count either.
        over: Asked after each population, with the loss and that before, whether to stop.
        most: Samples per step that no model exceeds.
        settings: How populations are laid.
    """
    rng = Draw.POPULATION.generator(seed)
    low, high = space.bounds()
    centre = np.clip(start, low, high)
    places, tried = np.empty((0, len(centre))), np.empty((0, len(half.scale.target)))
    slope = np.zeros((len(half.scale.target), len(centre)))
    tight = np.array([axis.of_threshold for axis in space.axes])
    reach = np.where(tight, settings.tight * radius, radius)
    best_loss, left = np.inf, iterations
    for _ in range(settings.longest if len(centre) else 0):
        # the middle comes first: what a step promised is seen, and it is a place of the next lines as well
        population = np.concatenate([centre[None], centre + reach * _cross_population(rng, len(centre))])
        population = np.clip(population, low, high)
        # all with the samples of the middle: their random numbers are the same, and they fill a CPU's lanes
        needed = min(samples_per_step(space.at(centre), half.frame.step), most)
        asked = SimulationRequest(half, space, population, seed, most=most, finer=needed or None)
        (values,) = yield [asked]
        # random numbers are common to all populations, so places of former ones stay comparable
        places, tried = np.concatenate([places, population]), np.concatenate([tried, values])
        losses = half.scale.loss(tried) + distance_penalty(places, start, settings.prior)
        leader = int(np.argmin(losses))
        # a thousandth of the loss is no improvement worth going on for
        improved = losses[leader] < best_loss - 1e-3 * abs(losses[leader])
        much = patient and losses[leader] < settings.much * best_loss < np.inf
        # asked now, for the loss before is overwritten below; obeyed only after the next centre is known
        behind = over is not None and over(float(losses[leader]), best_loss)
        best, best_loss = places[leader], float(losses[leader])
        near = np.all(np.abs(places - best) <= settings.near * reach, axis=1)
        # in units of the reach, along which the ridge of `fit_slopes` is the same for all parameters
        slope = fit_slopes((places[near] - best) / reach, tried[near] - tried[leader]) / reach
        step, steepness = robust_step(half.scale, tried[leader], slope, best - start, settings)
        beyond = float(np.max(np.abs(step) / reach))
        centre = np.clip(best + step * min(1.0, settings.farthest / max(beyond, 1e-12)), low, high)
        # as far as the loss changes by a good part of itself, along each axis
        change = settings.part * max(best_loss, settings.little)
        ideal = np.sqrt(change / np.maximum(steepness, 1e-12))
        ideal = np.clip(ideal, settings.narrow * reach, settings.widen * reach)
        reach = np.clip(ideal, settings.smallest, settings.widest)
        if behind:
            break
        if (improved and beyond > settings.farthest) or much:
            continue  # still on the way: does not count
        left -= 1
        if left <= 0:
            break
    # the last step has not been tried yet; it counts only if it is better than all before
    (final,) = yield [SimulationRequest(half, space, centre[None], seed, most=most)]
    places, tried = np.concatenate([places, centre[None]]), np.concatenate([tried, final])
    losses = half.scale.loss(tried) + distance_penalty(places, start, settings.prior)
    leader = int(np.argmin(losses))
    return DescentEnd(
        places[leader], float(half.scale.loss(tried[leader])), tried[leader], slope, places, tried
    )


def distance_penalty(places: Array, start: Array, prior: float = DESCENT.prior) -> Array:
    """Return what it costs to leave the start, shape (...).

    Args:
        places: Shape (..., P).
        start: Shape (P,).
        prior: Loss of a unit along one axis.
    """
    out: Array = prior * ((places - start) ** 2).sum(-1)
    return out


def _cross_population(rng: np.random.Generator, size: int) -> Array:
    """Return both ways along the axes of a random frame, and one direction more, shape (2 P + 2, P).

    Where that and the middle fill one block of a CPU's lanes but for the last direction, it is left out.
    """
    # along the axes themselves, two parameters that make up for each other would look like none
    frame, _ = np.linalg.qr(rng.standard_normal((size, size)))
    # each direction goes as far as the reach along the axis on which it goes farthest
    frame *= np.sqrt(size) / np.maximum(np.abs(frame).max(1, keepdims=True) * np.sqrt(size), 1e-9)
    if -(-(2 * size + 1) // LANES) < -(-(2 * size + 3) // LANES):
        return np.concatenate([frame, -frame])
    more = rng.standard_normal((1, size))
    more /= np.abs(more).max()
    return np.concatenate([frame, -frame, more, -more])


def fit_slopes(places: Array, values: Array) -> Array:
    """Return the slopes of straight lines through the origin, shape (J, P).

    Args:
        places: Relative to the origin, shape (M, P).
        values: Statistics there less those of the origin, shape (M, J).
    """
    size = places.shape[1]
    # a ridge, for places may lie in fewer directions than there are: at the ends of ranges they are clipped
    ridge = 1e-3 * np.trace(places.T @ places) / size + 1e-12
    fit = np.linalg.solve(places.T @ places + ridge * np.eye(size), places.T @ values)
    out: Array = fit.T
    return out


def denoised_normal_matrix(
    places: Array, values: Array, lines: Array, weights: Array, noise: Array, *, left: float = DESCENT.left
) -> Array:
    """Return the weighted product of slopes with themselves, less what noise in them adds to it, (P, P).

    Slopes come from simulations whose chance differs. Left in, it would make parameters that the data hardly
    know look well known.

    Args:
        places: Relative to the middle, shape (M, P).
        values: Statistics in standard errors, relative to the middle, shape (M, J).
        lines: Slopes of them, shape (J, P).
        weights: Of the statistics, shape (J,).
        noise: Variance of a statistic of one simulation, a bound of what chance does to `values`, (J,).
        left: Least share of what was seen along each direction that is taken to be no noise.
    """
    # what lines leave is chance, but for what runs along no line: the bound keeps that out
    rest = ((values - places @ lines.T) ** 2).sum(0) / max(len(places) - places.shape[1], 1)
    normal = lines.T @ (weights[:, None] * lines)
    if not normal.any():  # no parameter changes anything, as thresholds of a scene at rest
        return normal
    excess = (weights * np.minimum(rest, noise)).sum() * np.linalg.pinv(places.T @ places)
    # as `normal` sees directions, what it measures is 1 along each; a part of that stays at least, for less
    # would not be positive, and with it nothing could be solved
    root = np.linalg.cholesky(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)))
    inverse = np.linalg.inv(root)
    value, axes = np.linalg.eigh(np.eye(len(normal)) - inverse @ excess @ inverse.T)
    out: Array = root @ (axes * np.maximum(value, left)) @ axes.T @ root.T
    return out


def robust_step(
    scale: ErrorScale, values: Array, slope: Array, offset: Array, settings: DescentSettings = DESCENT
) -> tuple[Array, Array]:
    """Return the step to the least robust loss of statistics that run along straight lines.

    Args:
        scale: What differences are measured by.
        values: Statistics where the step begins, shape (J,).
        slope: Statistics per unit of place, shape (J, P).
        offset: Where that is, from the start of the search, shape (P,).
        settings: Says how strongly places are held at the start.

    Returns:
        The step, shape (P,), and what a unit along each axis, squared, adds to the loss, shape (P,).
    """
    weights = scale.weights()
    z0 = scale.z(values)
    lines = np.where(scale.used[:, None], slope / scale.sigma[:, None], 0.0)
    step, normal = np.zeros(slope.shape[1]), np.zeros((slope.shape[1],) * 2)
    # the robust loss is a sum of squares whose weights fall with the differences: weights and step take turns
    # until the step does not change any more
    for _ in range(20):
        z = z0 + lines @ step
        w = weights / np.sqrt(1.0 + z * z)
        normal = lines.T @ (w[:, None] * lines) + settings.prior * np.eye(len(step))
        right = lines.T @ (w * z0) + settings.prior * offset
        new = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(step)), right)
        done = np.abs(new - step).max() < 1e-4
        step = new
        if done:
            break
    return step, np.diag(normal).copy()


def ranking_work(
    half: CalibratedSubset,
    space: ParameterSpace,
    starts: Sequence[Array] | Array,
    *,
    seed: int,
    most: int = SAMPLES[-1],
) -> Work[tuple[Array, Array]]:
    """Return places in order of their loss, shape (M, P), and the losses, (M,); see `scheduler`."""
    places = np.atleast_2d(np.asarray(starts))
    (values,) = yield [SimulationRequest(half, space, places, seed, most=most)]
    losses = half.scale.loss(values)
    order = np.argsort(losses)
    return places[order], losses[order]
