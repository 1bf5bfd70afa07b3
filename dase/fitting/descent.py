"""Parameters from statistics: populations of models, straight lines through what they give, robust steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.fitting.parameter_space import ParameterSpace
from dase.fitting.scheduler import SimulationRequest, Work
from dase.fitting.subset import PixelSubset
from dase.probes.distance import ErrorScale

Array = NDArray[np.float64]

RADIUS = 0.25
"""Of the first population, in the units of `Axis.to_place`."""

LEFT = 0.25
"""Least share of the product of slopes that is taken to be no noise."""

WIDEST = 0.8
"""Reach of any."""

FARTHEST = 2.0
"""Longest step, in units of the reach of the population it was seen from."""

WIDEN = 1.6
"""Most by which the reach grows from one population to the next."""

LONGEST = 12
"""Populations at most."""

SMALLEST = 0.01
"""Reach of a population along an axis: below it the noise of single events hides the slope."""

TIGHT = 0.3
"""Reach along the thresholds relative to other parameters, at first: every event depends on them."""

PART = 0.25
"""Of the loss, by which a population should see it change."""

LITTLE = 0.3
"""Loss that chance alone gives."""

MUCH = 0.9
"""A loss below this, relative to that before, tells that a descent is still on its way."""

PRIOR = 2e-3
"""Weight by which parameters that the data say nothing about are held at their start."""


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
    half: PixelSubset,
    space: ParameterSpace,
    start: Array,
    *,
    seed: int,
    iterations: int = 5,
    radius: float = RADIUS,
    patient: bool = False,
    over: StopRule | None = None,
) -> Work[DescentEnd]:
    """Descend from one start, see `together`.

    Each iteration simulates a population about the present place, with the random numbers in common, fits a
    straight line to each statistic, and goes where the robust loss of those lines is least. The slopes come
    from differences as wide as the population, so the noise of single events does not matter.

    Args:
        half: What is fitted.
        space: Free parameters.
        start: Where to begin, shape (P,).
        seed: Of the models' random numbers, and of the populations.
        iterations: Populations, not counting those that are still on the way.
        radius: Of the first.
        patient: Whether populations that still bring the loss down much do not count either.
        over: Asked after each population, with the loss and that before, whether to stop.
    """
    rng = np.random.default_rng([seed, 7])
    low, high = space.bounds()
    centre = np.clip(start, low, high)
    places, tried = np.empty((0, len(centre))), np.empty((0, len(half.scale.target)))
    slope = np.zeros((len(half.scale.target), len(centre)))
    tight = np.array([axis.name.startswith("threshold.") for axis in space.axes])
    reach = np.where(tight, TIGHT * radius, radius)
    best_loss, left = np.inf, iterations
    for _ in range(LONGEST if len(centre) else 0):
        population = np.concatenate([centre[None], centre + reach * _cross_population(rng, len(centre))])
        population = np.clip(population, low, high)
        (values,) = yield [SimulationRequest(half, space, population, seed)]
        places, tried = np.concatenate([places, population]), np.concatenate([tried, values])
        losses = half.scale.loss(tried) + distance_penalty(places, start)
        leader = int(np.argmin(losses))
        improved = losses[leader] < best_loss - 1e-3 * abs(losses[leader])
        much = patient and losses[leader] < MUCH * best_loss < np.inf
        behind = over is not None and over(float(losses[leader]), best_loss)
        best, best_loss = places[leader], float(losses[leader])
        near = np.all(np.abs(places - best) <= 2.5 * reach, axis=1)
        slope = fit_slopes((places[near] - best) / reach, tried[near] - tried[leader]) / reach
        step, steepness = robust_step(half.scale, tried[leader], slope, best - start)
        beyond = float(np.max(np.abs(step) / reach))
        centre = np.clip(best + step * min(1.0, FARTHEST / max(beyond, 1e-12)), low, high)
        # as far as the loss changes by a good part of itself, along each axis
        ideal = np.sqrt(PART * max(best_loss, LITTLE) / np.maximum(steepness, 1e-12))
        reach = np.clip(np.clip(ideal, 0.35 * reach, WIDEN * reach), SMALLEST, WIDEST)
        if behind:
            break
        if (improved and beyond > FARTHEST) or much:
            continue  # still on the way: does not count
        left -= 1
        if left <= 0:
            break
    (final,) = yield [SimulationRequest(half, space, centre[None], seed)]
    places, tried = np.concatenate([places, centre[None]]), np.concatenate([tried, final])
    losses = half.scale.loss(tried) + distance_penalty(places, start)
    leader = int(np.argmin(losses))
    return DescentEnd(
        places[leader], float(half.scale.loss(tried[leader])), tried[leader], slope, places, tried
    )


def distance_penalty(places: Array, start: Array) -> Array:
    """Return what it costs to leave the start, shape (...)."""
    out: Array = PRIOR * ((places - start) ** 2).sum(-1)
    return out


def _cross_population(rng: np.random.Generator, size: int) -> Array:
    """Return both ways along the axes of a random frame, and some directions more, shape (2 P + 2, P)."""
    frame, _ = np.linalg.qr(rng.standard_normal((size, size)))
    frame *= np.sqrt(size) / np.maximum(np.abs(frame).max(1, keepdims=True) * np.sqrt(size), 1e-9)
    more = rng.standard_normal((1, size))
    more /= np.abs(more).max()
    return np.concatenate([frame, -frame, more, -more])


def fit_slopes(places: Array, values: Array) -> Array:
    """Return the slopes of straight lines through the origin, shape (J, P)."""
    size = places.shape[1]
    ridge = 1e-3 * np.trace(places.T @ places) / size + 1e-12
    fit = np.linalg.solve(places.T @ places + ridge * np.eye(size), places.T @ values)
    out: Array = fit.T
    return out


def denoised_normal_matrix(places: Array, values: Array, lines: Array, weights: Array, noise: Array) -> Array:
    """Return the weighted product of slopes with themselves, less what noise in them adds to it, (P, P).

    Slopes come from simulations whose chance differs. Left in, it would make parameters that the data hardly
    know look well known.

    Args:
        places: Relative to the middle, shape (M, P).
        values: Statistics in standard errors, relative to the middle, shape (M, J).
        lines: Slopes of them, shape (J, P).
        weights: Of the statistics, shape (J,).
        noise: Variance of a statistic of one simulation, a bound of what chance does to `values`, (J,).
    """
    rest = ((values - places @ lines.T) ** 2).sum(0) / max(len(places) - places.shape[1], 1)
    normal = lines.T @ (weights[:, None] * lines)
    if not normal.any():  # no parameter changes anything, as thresholds of a scene at rest
        return normal
    excess = (weights * np.minimum(rest, noise)).sum() * np.linalg.pinv(places.T @ places)
    # along each direction at least LEFT of what was seen stays
    root = np.linalg.cholesky(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)))
    inverse = np.linalg.inv(root)
    value, axes = np.linalg.eigh(np.eye(len(normal)) - inverse @ excess @ inverse.T)
    out: Array = root @ (axes * np.maximum(value, LEFT)) @ axes.T @ root.T
    return out


def robust_step(scale: ErrorScale, values: Array, slope: Array, offset: Array) -> tuple[Array, Array]:
    """Return the step to the least robust loss of statistics that run along straight lines, (P,).

    Also what a unit along each axis, squared, adds to the loss, (P,).
    """
    weights = scale.weights()
    z0 = scale.z(values)
    lines = np.where(scale.used[:, None], slope / scale.sigma[:, None], 0.0)
    step, normal = np.zeros(slope.shape[1]), np.zeros((slope.shape[1],) * 2)
    for _ in range(20):
        z = z0 + lines @ step
        w = weights / np.sqrt(1.0 + z * z)
        normal = lines.T @ (w[:, None] * lines) + PRIOR * np.eye(len(step))
        right = lines.T @ (w * z0) + PRIOR * offset
        new = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(step)), right)
        done = np.abs(new - step).max() < 1e-4
        step = new
        if done:
            break
    return step, np.diag(normal).copy()


def ranking_work(
    half: PixelSubset, space: ParameterSpace, starts: Sequence[Array] | Array, *, seed: int
) -> Work[tuple[Array, Array]]:
    """Return places in order of their loss, and the losses, see `scheduler`."""
    places = np.atleast_2d(np.asarray(starts))
    (values,) = yield [SimulationRequest(half, space, places, seed)]
    losses = half.scale.loss(values)
    order = np.argsort(losses)
    return places[order], losses[order]
