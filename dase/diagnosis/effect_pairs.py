"""Two effects that are added at once, where each alone shows too little."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from dase.diagnosis.ranking import rank_of_pair
from dase.diagnosis.state import DiagnosisState, with_same_freedom
from dase.fitting.early_stopping import CandidateRace
from dase.fitting.model import FittedModel, refit_work, ways_otherwise
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import Judgement, reaches_floor
from dase.probes.random_streams import SimulationStream
from dase.results import Rank


def add_pair(
    state: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Where adding one after the other does not reach the floor, try two at once.

    Args:
        state: Has the candidates of the first step; gets a step for each pair that does better.
        model: The best that was found one by one.
        judgement: Its held-out error.

    Returns:
        The model with the best pair and its error, the given ones where none is better by enough.
    """
    task, path = state.task, state.path
    evidence, seed, settings = task.evidence, task.seed, task.settings
    if not path.first:
        return model, judgement
    before, start = path.history[path.first_step], path.models[path.first_step]
    singles = [one for one in path.first if one.screened_loss < settings.pair_helps_alone][: settings.paired]
    scout = start.calibrate(
        evidence.scout, repeats=settings.scout_repeats, seed=SimulationStream.CALIBRATE_SCOUT.seed(seed)
    )
    pairs = list(combinations(singles, 2))
    # a pair has to do better than what was found one by one
    present = scout.run(model.space, model.place[None], seed=seed)[0]
    goal = settings.pair_behind * float(scout.scale.loss(present))
    # only the first are fitted to all pixels
    race, works, names = CandidateRace(settings.fitted_pairs, goal=goal), [], []
    for one, two in pairs:
        both = one.model.sensor.with_effect(two.model.sensor[two.name])
        pair = with_same_freedom(both, start, (one.name, two.name))
        name = f"{one.name} + {two.name}"
        # which rule is best for an effect alone need not be best beside the other
        for way in (pair, *ways_otherwise(pair, (one.name, two.name))):
            works.append(way.search_work(scout, seed=seed, iterations=4, radius=0.3, over=race.over(name)))
            names.append(name)
    ends = run_side_by_side(works, lambda share: task.progress("trying pairs", share, judgement.error))
    best = dict[str, FittedModel]()
    for name, pair in sorted(zip(names, ends, strict=True), key=lambda named: named[1].loss):
        best.setdefault(name, pair)
    first = [(name, pair) for name, pair in best.items() if pair.loss <= goal][: settings.fitted_pairs]
    settled = run_side_by_side([refit_work(evidence, pair, seed=seed) for _, pair in first])
    ranking: list[Rank] = []
    for (name, _), pair in zip(first, settled, strict=True):
        judged = task.judge(pair)
        ranking = sorted([*ranking, rank_of_pair(name, pair, judged, before)], key=_error_of_rank)
        if judged.error < judgement.error * (1.0 if reaches_floor(judged) else settings.pair_gain):
            model, judgement = pair, judged
            state.add_step(replace(before, chosen=name, ties=(), ranking=tuple(ranking), cells=()))
    return model, judgement


def _error_of_rank(rank: Rank) -> float:
    return rank.error
