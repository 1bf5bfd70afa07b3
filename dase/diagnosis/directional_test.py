"""A closer look at a model whose own chance may hide an effect.

The error of a model is a mean over all statistics, and where pixels differ or noise is strong, chance makes
most of it: an effect that changes a few statistics a little vanishes in it. But how an effect changes all of
them together is known, and along that way a measurement can be far from all repeats of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.candidates import Candidate, effects_to_try, variants_to_try
from dase.diagnosis.state import REPEATS, DiagnosisState
from dase.fitting.model import FittedModel, refit_model, with_effect_added
from dase.fitting.scheduler import SimulationRequest, answer_requests, run_work
from dase.fitting.subset import PixelSubset
from dase.probes.distance import Judgement, reaches_floor
from dase.probes.statistics import compute_statistics

Array = NDArray[np.float64]

HIDES = 0.3
"""Error that chance makes of a model in the mean, from which on it may hide an effect."""

STRENGTHS = (0.2, 0.5, 0.8)
"""At which an effect is looked at, as shares of the plausible range."""

MEANS = 8
"""Simulations whose mean is looked at."""

AWAY = 4.0
"""Standard deviations by which a measurement must be away from repeats of a model, on the way to an effect.

Of 40 models that lacked nothing all but one had at most 3.0; those that lacked jitter beside mismatch
had 4.9 to 10."""

AGAIN = 3.0
"""The same on the held-out half, on the way to that effect once it is fitted."""

PLAIN = 3.0
"""Differences beyond this many standard errors count as this: no single statistic decides."""

FARTHEST = 0.2
"""Most by which what is free otherwise gives way, in the units of `Axis.to_place`."""


@dataclass(frozen=True)
class RepeatCloud:
    """From repeats of a model to where other models are.

    Args:
        repeats: Of the model, in standard errors from their mean, shape (R, J).
        seen: The same of the measurement, shape (J,).
    """

    repeats: Array
    seen: Array

    def deviations_along(self, ways: Array) -> Array:
        """Return how far the measurement is from the repeats along some ways (M, J), in deviations, (M,).

        The repeats and the measurement may be off by the tolerance, which their standard errors know: without
        it, a model without chance in it would have no deviation.
        """
        along = np.clip(self.repeats, -PLAIN, PLAIN) @ ways.T
        rest = np.maximum(1.0 - self.repeats.var(0), 0.0)
        spread = np.sqrt(along.var(0) + (rest * ways**2).sum(1))
        out: Array = (np.clip(self.seen, -PLAIN, PLAIN) @ ways.T - along.mean(0)) / np.maximum(spread, 1e-12)
        return out


def find_hidden_effect(
    search: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[Candidate, float] | None:
    """Return the effect that chance hid, fitted and judged, and its p-value; None if there is none."""
    # also above what chance does: there no candidate may be certain by the fall of its loss
    if judgement.level < HIDES or not reaches_floor(judgement):
        return None
    search.progress("looking closer", 0.0, search.error)
    start = _most_deviating_effect(search, model)
    if start is None:
        return None
    name, begin, p_value = start
    fitted = refit_model(search.evidence, begin, seed=search.seed, rounds=1)
    judged = run_work(fitted.judging(search.evidence.held.view(), repeats=REPEATS, seed=search.seed + 500))
    if (
        not reaches_floor(judged)
        or deviation_towards(search.evidence.held, model, fitted, seed=search.seed) < AGAIN
    ):
        return None
    return Candidate(name, fitted, fitted.loss, judged=judged), p_value


def may_hide_effect(judgement: Judgement) -> bool:
    """Whether the chance of a model may hide an effect: it makes much of the error, and may make all."""
    return judgement.level >= HIDES and judgement.error <= judgement.reach and reaches_floor(judgement)


def lacks_effect_of(
    search: DiagnosisState, model: FittedModel, judgement: Judgement, other: FittedModel
) -> bool:
    """Whether a closer look shows that a model, which leaves what is judged, lacks what another one has."""
    if not may_hide_effect(judgement):
        return False
    ways = ((search.evidence.train, AWAY), (search.evidence.held, AGAIN))
    return all(deviation_towards(half, model, other, seed=search.seed) >= least for half, least in ways)


def deviation_towards(half: PixelSubset, model: FittedModel, other: FittedModel, *, seed: int) -> float:
    """Return how far a measurement is from repeats of a model, on the way to another, in their deviations."""
    half, way = _repeat_cloud(half, model, seed=seed)
    one, two = _mean_statistics(half, [(model, model.place[None]), (other, other.place[None])], seed=seed)
    return float(way.deviations_along(_in_standard_errors(half, two - one))[0])


def _most_deviating_effect(
    search: DiagnosisState, model: FittedModel
) -> tuple[str, FittedModel, float] | None:
    """Return the effect on whose way the measurement is farthest from the model, where to begin, a p-value.

    For that, repeats stand in for the measurement, each on the way on which it is farthest.
    """
    half, way = _repeat_cloud(search.evidence.train, model, seed=search.seed)
    reach = np.where([a.name.startswith("threshold.") for a in model.space.axes], 0.05, 0.2)
    sides = np.concatenate([model.place[None], model.place + np.diag(reach), model.place - np.diag(reach)])
    tried = _models_to_probe(search, model, half)
    if not tried:
        return None
    here, *there = _mean_statistics(
        half, [(model, sides), *((m, places) for _, m, places in tried)], seed=search.seed
    )
    plus, minus = np.split(here[1:], 2)
    slopes = _in_standard_errors(half, 0.5 * (plus - minus)).T
    ways = np.clip(_in_standard_errors(half, np.concatenate(there) - here[0]), -PLAIN, PLAIN)
    frame, _ = np.linalg.qr(slopes)
    # what the free parameters can do as well tells nothing
    bare = ways - (ways @ frame) @ frame.T
    far = way.deviations_along(bare)
    chance = np.array([RepeatCloud(way.repeats, one).deviations_along(bare).max() for one in way.repeats])
    first = int(far.argmax())
    if far[first] < AWAY:
        return None
    name, other, place = [(n, m, place) for n, m, places in tried for place in places][first]
    step = (way.seen - ways[first]) @ np.linalg.pinv(slopes).T * reach
    p_value = (1 + np.count_nonzero(chance >= far[first])) / (1 + len(chance))
    return name, _starting_model(model, other, place, step), float(p_value)


def _starting_model(model: FittedModel, other: FittedModel, place: Array, step: Array) -> FittedModel:
    """Return the model with an effect more where the rest has given way to it."""
    names = [axis.name for axis in other.space.axes]
    place = place.copy()
    for axis, change in zip(model.space.axes, np.clip(step, -FARTHEST, FARTHEST), strict=True):
        place[names.index(axis.name)] += change
    return FittedModel(other.space, place)


def _models_to_probe(
    search: DiagnosisState, model: FittedModel, half: PixelSubset
) -> list[tuple[str, FittedModel, Array]]:
    """Return effects, the models with them, and the places where those are looked at; none that are slow."""
    out = []
    effects = search.effects
    for effect in (
        e for n in effects_to_try(effects, model) for e in variants_to_try(search.evidence, effects[n])
    ):
        other = with_effect_added(model, effect)
        columns = [
            n for n, a in enumerate(other.space.axes) if a.name.split(".")[0] == effect.name and a.main
        ]
        if half.slow(other.space) or not columns:
            continue
        places = np.repeat(other.place[None], len(STRENGTHS), 0)
        for n in columns:
            low, high = (float(other.space.axes[n].to_place(v)) for v in other.space.axes[n].fact.plausible)
            places[:, n] = low + (high - low) * np.array(STRENGTHS)
        out.append((effect.name, other, places))
    return out


def _repeat_cloud(half: PixelSubset, model: FittedModel, *, seed: int) -> tuple[PixelSubset, RepeatCloud]:
    half = half.view()
    repeats = model.rebase(half, repeats=REPEATS, seed=seed + 700)
    middle = repeats.mean(0)
    return half, RepeatCloud(
        _in_standard_errors(half, repeats - middle), _in_standard_errors(half, half.chance.target - middle)
    )


def _in_standard_errors(half: PixelSubset, apart: Array) -> Array:
    """Return differences in standard errors, those that are compared."""
    used = half.chance.used
    out: Array = apart[..., used] / half.chance.sigma[used]
    return out


def _mean_statistics(
    half: PixelSubset, models: Sequence[tuple[FittedModel, Array]], *, seed: int
) -> list[Array]:
    """Return the mean statistics of models at some places, their random numbers in common."""
    sums = answer_requests(
        [
            SimulationRequest(half, m.space, np.repeat(places, MEANS, 0), seed + 900, repeats=True)
            for m, places in models
        ]
    )
    return [compute_statistics(one, half.frame)[0].reshape(-1, MEANS, len(half.off)).mean(1) for one in sums]
