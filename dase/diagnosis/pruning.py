"""Whether a diagnosis needs all that it added, and whether something simpler does."""

from __future__ import annotations

from collections.abc import Mapping

from dase.diagnosis.directional_test import lacks_effect_of
from dase.diagnosis.state import MATERIAL, TIE, DiagnosisState, explains_remainder, with_same_freedom
from dase.fitting.early_stopping import stop_unless_below
from dase.fitting.model import FittedModel, refit_model, refit_work
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import Judgement, leaves_nothing, may_be_announced, reaches_floor

SWAPPED = 2
"""Alternatives to an effect that are tried in its place once all others are found."""

NEARBY = 1.6
"""Only alternatives whose held-out error was about below this, relative to the chosen one's."""

DROPPED = 8.0
"""An effect is tried to be dropped where the error on the scout without it, quickly fitted, is below this, in
units of the gate."""

NEAR = 1.5
"""A model is fitted in full where one descent takes its held-out error below this, in units of the gate or of
the present model's error."""

LOST = 4.0
"""A model that is farther off than this, in units of the gate, is not reviewed. In the blind benchmark one
was taken from 2.9 to the floor, and none of 24 that were beyond 3."""

REPEATS = 16
"""Simulations by which that is judged."""

QUICK = 2.0
"""Only alternatives whose error on the scout, quickly fitted, is below this, relative to the model's own."""


def prune_model(
    search: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Drop effects that are not needed any more, put simpler ones in place of others, and drop again."""
    if judgement.error > LOST * judgement.gate:
        return model, judgement
    model, judgement = _drop_needless(search, model, judgement)
    before = model
    for name in search.added(model):
        for other, swap in _keep_near_models(search, _rival_models(search, model, name), judgement).items():
            swapped = refit_model(search.evidence, swap, seed=search.seed)
            judged = search.judge(swapped)
            without = search.without.get(name)
            if not reaches_floor(judged) or (without is not None and not explains_remainder(judged, without)):
                continue
            if lacks_effect_of(search, swapped, judged, model):
                continue
            simpler = len(swapped.place) < len(model.place)
            if simpler or not reaches_floor(judgement):
                model, judgement = swapped, judged
                search.ties[other] = {*search.ties.pop(name, set()), name} - {other}
                break
            search.ties.setdefault(name, set()).add(other)
    return _drop_needless(search, model, judgement) if model is not before else (model, judgement)


def _drop_needless(
    search: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Drop effects that are not needed any more."""
    whole = model
    for name, less in _keep_near_models(search, _droppable_models(search, model), judgement).items():
        if name not in model.sensor or len(search.added(model)) == 1:
            continue
        less = less if model is whole else with_same_freedom(model.sensor.without(name), model, ())
        fitted = refit_model(search.evidence, less, seed=search.seed)
        without = search.judge(fitted)
        # what would not be added now is not kept
        needless = may_be_announced(without) and without.error < judgement.error + MATERIAL
        if reaches_floor(without):
            needless = leaves_nothing(without) or not explains_remainder(judgement, without)
        needless = needless or without.error <= judgement.error
        if needless and not lacks_effect_of(search, fitted, without, model):
            model, judgement = fitted, without
    return model, judgement


def _keep_near_models(
    search: DiagnosisState, ways: Mapping[str, FittedModel], judgement: Judgement
) -> dict[str, FittedModel]:
    """Return those models that one descent takes near enough to be fitted in full, fitted by it."""
    evidence, seed = search.evidence, search.seed
    ends = run_side_by_side([refit_work(evidence, way, seed=seed, rounds=1) for way in ways.values()])
    judged = run_side_by_side(
        [m.judging(evidence.held.view(), repeats=REPEATS, seed=seed + 500) for m in ends]
    )
    limit = NEAR * max(judgement.gate, judgement.error)
    return {name: m for name, m, j in zip(ways, ends, judged, strict=True) if j.error < limit}


def _droppable_models(search: DiagnosisState, model: FittedModel) -> dict[str, FittedModel]:
    """Return the models without one effect that may do: not far off on the scout, quickly fitted.

    Fitting one in full takes as long as trying a dozen; most are far off.
    """
    scout, seed = search.evidence.scout.view(), search.seed
    model.rebase(scout, repeats=16, seed=seed + 200)
    ways = {name: with_same_freedom(model.sensor.without(name), model, ()) for name in search.added(model)}
    quick = run_side_by_side([way.searching(scout, seed=seed, iterations=2) for way in ways.values()])
    judged = run_side_by_side([way.judging(scout.view(), repeats=16, seed=seed + 500) for way in quick])
    return {
        name: way for name, way, judgement in zip(ways, quick, judged, strict=True)
        if judgement.error < DROPPED * judgement.gate
    }  # fmt: skip


def _keep_promising_models(
    search: DiagnosisState, model: FittedModel, ways: Mapping[str, FittedModel]
) -> dict[str, FittedModel]:
    """Return those models that may do as well as the present one: simpler, or not far off on the scout.

    A simpler model may be long on its way: bandwidth after an overdamped second order had been fitted.
    """
    if not ways:
        return {}
    scout = search.evidence.scout.view()
    repeats = model.rebase(scout, repeats=16, seed=search.seed + 200)
    enough = QUICK * float(scout.scale.loss(repeats).mean())
    simpler = {name: len(way.place) < len(model.place) for name, way in ways.items()}
    works = [
        way.searching(
            scout, seed=search.seed, iterations=2, over=None if simpler[name] else stop_unless_below(enough)
        )
        for name, way in ways.items()
    ]
    quick = zip(ways, run_side_by_side(works), strict=True)
    return {name: ways[name] for name, found in quick if found.loss < enough or simpler[name]}


def _rival_models(search: DiagnosisState, model: FittedModel, name: str) -> dict[str, FittedModel]:
    """Return the models with an alternative in the place of an effect that may do as well."""
    limit, ways = NEARBY * search.error_of.get(name, 0.0) + TIE, {}
    for other in search.alternatives.get(name, [])[:SWAPPED]:
        if other.name not in model.space.sensor and other.error <= limit:
            sensor = model.sensor.without(name).with_effect(other.model.sensor[other.name])
            ways[other.name] = with_same_freedom(sensor, model, [other.name])
    return _keep_promising_models(search, model, ways)
