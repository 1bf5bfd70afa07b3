"""A closer look at a model whose own chance may hide an effect.

The error of a model is a mean over all statistics, and where pixels differ or noise is strong, chance makes
most of it: an effect that changes a few statistics a little vanishes in it. But how an effect changes all of
them together is known, and along that way a measurement can be far from all repeats of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.candidates import Candidate, effects_to_try, variants_to_try
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.state import DiagnosisTask
from dase.fitting.model import FittedModel, refit_model, with_effect_added
from dase.fitting.scheduler import SimulationRequest, answer_requests
from dase.fitting.subset import CalibratedSubset, PixelSubset
from dase.probes.distance import Judgement, compared_in_standard_errors, leaves_nothing, reaches_floor
from dase.probes.random_streams import SimulationStream

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RepeatCloud:
    """Repeats of a model, in standard errors from their mean, beside which measurements are looked at.

    Args:
        repeats: Of the model, shape (R, J).
        most_of_one: Differences beyond this many standard errors count as this.
        doubt: Standard errors by which each statistic may be off for other reasons than chance, shape (J,).
        drift: The same as one way that all of them may go together, with signs, shape (J,).
    """

    repeats: Array
    most_of_one: float = DEFAULTS.hidden.most_of_one
    doubt: Array | None = None
    drift: Array | None = None

    def clipped(self, differences: Array) -> Array:
        """Return differences (..., J), none larger than a single statistic may count."""
        return np.clip(differences, -self.most_of_one, self.most_of_one)

    def deviations_along(self, ways: Array, seen: Array) -> Array:
        """Return how far a measurement is from the repeats along some ways, in deviations, shape (M,).

        The repeats and the measurement may be off by the tolerance, which their standard errors know: without
        it, a model without chance in it would have no deviation.

        Args:
            ways: In standard errors, shape (M, J).
            seen: The measurement, in standard errors from the repeats' mean, shape (J,); or one for each way,
                shape (M, J).
        """
        along = self._clipped_repeats @ ways.T
        square = along.var(0) + (self._rest * ways**2).sum(1)
        if self.drift is not None:
            square = square + (self.clipped(self.drift) @ ways.T) ** 2
        spread = np.sqrt(square)
        clipped = self.clipped(seen)
        here = clipped @ ways.T if clipped.ndim == 1 else np.einsum("mj,mj->m", clipped, ways)
        out: Array = (here - along.mean(0)) / np.maximum(spread, 1e-12)
        return out

    @cached_property
    def _clipped_repeats(self) -> Array:
        return self.clipped(self.repeats)

    @cached_property
    def _rest(self) -> Array:
        """Variance of each statistic that the repeats do not show, in standard errors, shape (J,)."""
        rest: Array = np.maximum(1.0 - self.repeats.var(0), 0.0)
        if self.doubt is not None:
            rest = rest + np.minimum(self.doubt, self.most_of_one) ** 2
        return rest


def find_hidden_effect(
    task: DiagnosisTask, model: FittedModel, judgement: Judgement
) -> tuple[Candidate, float] | None:
    """Return the effect that chance hid, fitted and judged, and its p-value; None if there is none."""
    hidden = task.settings.hidden
    # also above what chance does: there no candidate may be certain by the fall of its loss
    # what the scene is not known to hides effects as chance does
    hides = judgement.level >= hidden.hides or task.evidence.train.doubt is not None
    # nor does chance explain what is left, though it is little
    hides = hides or (judgement.level >= hidden.some and judgement.error > judgement.reach)
    # and right models leave less than this
    hides = hides or not leaves_nothing(judgement)
    if not hides or not reaches_floor(judgement):
        return None
    task.progress("looking closer", 0.0, judgement.error)
    start = _most_deviating_effect(task, model)
    if start is None:
        return None
    name, begin, p_value = start
    fitted = refit_model(task.evidence, begin, seed=task.seed, rounds=1)
    repeats = task.settings.repeats
    judged = fitted.judge(task.evidence.held, repeats=repeats, seed=SimulationStream.JUDGE.seed(task.seed))
    if not reaches_floor(judged):
        return None
    if deviation_towards(task, task.evidence.held, model, fitted) < hidden.away_held_out:
        return None
    return Candidate(name, fitted, fitted.loss, judgement=judged), p_value


def may_hide_effect(judgement: Judgement, hides: float = DEFAULTS.hidden.hides) -> bool:
    """Whether the chance of a model may hide an effect: it makes much of the error, and may make all."""
    return judgement.level >= hides and judgement.error <= judgement.reach and reaches_floor(judgement)


def lacks_effect_of(
    task: DiagnosisTask, model: FittedModel, judgement: Judgement, other: FittedModel
) -> bool:
    """Whether a closer look shows that a model, which leaves what is judged, lacks what another one has."""
    hidden = task.settings.hidden
    if not may_hide_effect(judgement, hidden.hides):
        return False
    ways = ((task.evidence.train, hidden.away), (task.evidence.held, hidden.away_held_out))
    return all(deviation_towards(task, half, model, other) >= least for half, least in ways)


def deviation_towards(
    task: DiagnosisTask,
    subset: PixelSubset,
    model: FittedModel,
    other: FittedModel,
    *,
    doubt: Array | None = None,
) -> float:
    """Return how far a measurement is from repeats of a model, on the way to another, in their deviations.

    Args:
        task: Seeds and settings.
        subset: Where both are run.
        model: Whose repeats the measurement is compared with.
        other: Towards which.
        doubt: What each statistic may be off by for other reasons than chance, shape (J,).
    """
    half, cloud, seen = _repeat_cloud(task, subset, model)
    if doubt is not None:
        cloud = replace(cloud, doubt=compared_in_standard_errors(doubt, half.chance))
    one, two = _mean_statistics(task, half, [(model, model.place[None]), (other, other.place[None])])
    # a way far along few statistics would count only these, of which none may decide
    way = cloud.clipped(compared_in_standard_errors(two - one, half.chance))
    return float(cloud.deviations_along(way, seen)[0])


def _most_deviating_effect(task: DiagnosisTask, model: FittedModel) -> tuple[str, FittedModel, float] | None:
    """Return the effect on whose way the measurement is farthest from the model, where to begin, a p-value.

    For that, repeats stand in for the measurement, each on the way on which it is farthest.
    """
    hidden = task.settings.hidden
    half, cloud, seen = _repeat_cloud(task, task.evidence.train, model)
    threshold = [axis.of_threshold for axis in model.space.axes]
    reach = np.where(threshold, hidden.threshold_reach, hidden.reach)
    sides = np.concatenate([model.place[None], model.place + np.diag(reach), model.place - np.diag(reach)])
    probed = _models_to_probe(task, model, half)
    if not probed:
        return None
    here, *there = _mean_statistics(task, half, [(model, sides), *((m, places) for _, m, places in probed)])
    plus, minus = np.split(here[1:], 2)
    slopes = compared_in_standard_errors(0.5 * (plus - minus), half.chance).T
    ways = cloud.clipped(compared_in_standard_errors(np.concatenate(there) - here[0], half.chance))
    frame, _ = np.linalg.qr(slopes)
    # what the free parameters can do as well tells nothing
    bare = ways - (ways @ frame) @ frame.T
    far = cloud.deviations_along(bare, seen)
    chance = np.array([cloud.deviations_along(bare, one).max() for one in cloud.repeats])
    first = int(far.argmax())
    if far[first] < hidden.away:
        return None
    name, other, place = [(n, m, place) for n, m, places in probed for place in places][first]
    step = (seen - ways[first]) @ np.linalg.pinv(slopes).T * reach
    p_value = (1 + np.count_nonzero(chance >= far[first])) / (1 + len(chance))
    return (
        name,
        _starting_model(model, other, place, np.clip(step, -hidden.reach, hidden.reach)),
        float(p_value),
    )


def _starting_model(model: FittedModel, other: FittedModel, place: Array, step: Array) -> FittedModel:
    """Return the model with an effect more where the rest has given way to it.

    What the effect takes the place of, as a second pole does of a bandwidth, has gone.

    Args:
        model: Without the effect, P free parameters.
        other: With the effect.
        place: Of `other`.
        step: By which the free parameters of `model` give way, shape (P,).
    """
    names = [axis.name for axis in other.space.axes]
    place = place.copy()
    for axis, change in zip(model.space.axes, step, strict=True):
        if axis.name in names:
            place[names.index(axis.name)] += change
    return FittedModel(other.space, place)


def _models_to_probe(
    task: DiagnosisTask, model: FittedModel, half: PixelSubset
) -> list[tuple[str, FittedModel, Array]]:
    """Return effects, the models with them, and the places where those are looked at; none that are slow."""
    out = []
    effects, idle_bus = task.effects, task.settings.candidates.idle_bus
    strengths = np.array(task.settings.hidden.strengths)
    names = effects_to_try(effects, model)
    for effect in (e for n in names for e in variants_to_try(task.evidence, effects[n], idle_bus=idle_bus)):
        other = with_effect_added(model, effect)
        columns = [
            n for n, a in enumerate(other.space.axes) if a.name.split(".")[0] == effect.name and a.main
        ]
        if half.slow(other.space) or not columns:
            continue
        places = np.repeat(other.place[None], len(strengths), 0)
        for n in columns:
            low, high = (float(other.space.axes[n].to_place(v)) for v in other.space.axes[n].fact.plausible)
            places[:, n] = low + (high - low) * strengths
        out.append((effect.name, other, places))
    return out


def _repeat_cloud(
    task: DiagnosisTask, subset: PixelSubset, model: FittedModel
) -> tuple[CalibratedSubset, RepeatCloud, Array]:
    """Return a half with a model as its present one, the repeats of it, and the measurement beside these.

    That is in standard errors from the repeats' mean, shape (J,).
    """
    half = model.calibrate(subset, repeats=task.settings.repeats, seed=SimulationStream.CLOUD.seed(task.seed))
    repeats = half.repeats
    middle = repeats.mean(0)
    seen = compared_in_standard_errors(half.chance.target - middle, half.chance)
    drift = None if half.drift is None else compared_in_standard_errors(half.drift, half.chance)
    cloud = RepeatCloud(
        compared_in_standard_errors(repeats - middle, half.chance),
        task.settings.hidden.most_of_one,
        drift=drift,
    )
    return half, cloud, seen


def _mean_statistics(
    task: DiagnosisTask, half: CalibratedSubset, models: Sequence[tuple[FittedModel, Array]]
) -> list[Array]:
    """Return the mean statistics of models at some places, (M, J) each, their random numbers in common."""
    count = task.settings.hidden.repeats_of_mean
    seeds = [SimulationStream.DIRECTIONS.seed(task.seed, n) for n in range(count)]
    values = answer_requests([SimulationRequest(half, m.space, p, seed) for m, p in models for seed in seeds])
    return [np.mean(values[n : n + count], 0) for n in range(0, len(values), count)]
