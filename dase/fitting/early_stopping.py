"""Searches side by side of which a few go on: those that will not come to the front stop."""

from __future__ import annotations

from dataclasses import dataclass, field

from dase.fitting.descent import StopRule


@dataclass(frozen=True, eq=False)
class CandidateRace:
    """What candidates have reached so far.

    Args:
        places: Candidates that go on.
        lags: A search stops where its loss will stay above this, relative to that of the last of those.
        own_lags: The same relative to another search of its own candidate.
        goal: A search stops where its loss will stay above this, whatever others reach.
        best: The least loss of each candidate.
    """

    places: int
    lags: float = 1.1
    own_lags: float = 1.1
    goal: float = float("inf")
    best: dict[str, float] = field(default_factory=dict)

    def over(self, name: str, unit: float = 1.0) -> StopRule:
        """Return what one search of a candidate asks, whose loss is divided by `unit`."""

        def over(loss: float, before: float) -> bool:
            self.best[name] = min(loss / unit, self.best.get(name, float("inf")))
            first = sorted(self.best.values())[: self.places]
            last = first[-1] if len(first) == self.places else float("inf")
            soon = expected_loss(loss, before) / unit
            return soon > min(self.lags * last, self.own_lags * self.best[name], self.goal)

        return over


def stop_unless_below(goal: float) -> StopRule:
    """Return whether a search will not come below a loss."""
    return lambda loss, before: expected_loss(loss, before) > goal


def expected_loss(loss: float, before: float, *, ahead: int = 2) -> float:
    """Return the loss so many populations ahead, if it goes on to fall by factors as by the last one.

    After the first population `before` is infinite: nothing is known, and the loss expected is 0.
    """
    return float(loss * min(loss / before, 1.0) ** ahead)
