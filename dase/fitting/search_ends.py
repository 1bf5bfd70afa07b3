"""Fits that did not find the least error: stopped at the end of the search, or never moved."""

from __future__ import annotations

from collections.abc import Mapping

from dase.fitting.model import FittedModel
from dase.fitting.parameter_space import SearchAxis
from dase.results import Estimate


def parameters_at_bounds(model: FittedModel, values: Mapping[str, Estimate]) -> list[str]:
    """Return the thresholds and strengths of effects that ended where their search does, each in words.

    There a fit did not find the least error but was stopped. What the data hardly know, as thresholds of a
    scene at rest, may end anywhere.

    Args:
        model: Where the fit ended.
        values: Its parameters with their intervals.
    """
    out = []
    for axis, place in zip(model.space.axes, model.place, strict=True):
        decides = axis.main or axis.name in ("threshold.on", "threshold.off")
        low, high = axis.bounds()
        estimate = values[axis.name]
        wide = float(axis.to_place(estimate.high)) - float(axis.to_place(estimate.low)) > 0.3 * (high - low)
        if decides and not wide and axis.fact.search_starts != "above" and _is_at_bound(axis, float(place)):
            value = float(axis.to_value(place))
            out.append(f"{axis.name} = {value:.3g} {axis.fact.unit}, the end of its search")
    return out


def _is_at_bound(axis: SearchAxis, place: float, *, near: float = 2e-3) -> bool:
    low, high = axis.bounds()
    return min(place - low, high - place) < near * (high - low)


def is_where_it_began(model: FittedModel, given: FittedModel) -> bool:
    """Whether no descent moved anything that is free in a model as it was given."""
    before = dict(zip((axis.name for axis in given.space.axes), given.place, strict=True))
    moved = [
        abs(float(place) - float(before[axis.name])) > 1e-9
        for axis, place in zip(model.space.axes, model.place, strict=True)
        if axis.name in before
    ]
    return bool(moved) and not any(moved)
