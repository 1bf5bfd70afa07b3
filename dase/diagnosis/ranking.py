"""Effects that were tried, as the user sees them: by how much the error falls, and their values."""

from __future__ import annotations

from collections.abc import Collection

from dase.diagnosis.candidates import Candidate
from dase.fitting.model import FittedModel
from dase.probes.distance import Judgement
from dase.results import Estimate, Rank, Step


def rank_of(candidate: Candidate, judgement: Judgement) -> Rank:
    """Return a candidate as the user sees it.

    Args:
        candidate: Its error is from the screening where it was not judged.
        judgement: Error of the model without it.
    """
    fall = judgement.error - candidate.error
    share = fall / max(judgement.error - 1.0, 1e-9)
    # before it is the model, an effect has values without intervals
    mine = values_of(candidate.model, candidate.name.split(" + "))
    refined = candidate.judgement is not None
    return Rank(candidate.name, candidate.error, fall, min(share, 1.0), candidate.p_value, mine, refined)


def rank_of_pair(name: str, pair: FittedModel, judged: Judgement, first: Step) -> Rank:
    """Return two effects that came in at once as the user sees them; there is no null of pairs, so no p.

    Args:
        name: Of both, with a plus between them.
        pair: The model with both, fitted.
        judged: Its error.
        first: The step in which all effects were tried alone, and its error.
    """
    fall = first.error - judged.error
    share = min(fall / max(first.error - 1.0, 1e-9), 1.0)
    return Rank(name, judged.error, fall, share, float("nan"), values_of(pair, name.split(" + ")))


def values_of(model: FittedModel, effects: Collection[str]) -> dict[str, Estimate]:
    """Return the fitted values of some effects, each with an interval of no length."""
    return {
        axis.name: Estimate(*(3 * (float(axis.to_value(place)),)))
        for axis, place in zip(model.space.axes, model.place, strict=True)
        if axis.effect.name in effects
    }
