"""What a diagnosis works on, and what it has found so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dase.diagnosis.candidates import Candidate
from dase.effects import Effect
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.model import FittedModel, free_of, model_of
from dase.probes.distance import QUIET, Judgement, reaches_floor
from dase.results import Progress, Step
from dase.simulation.sensor import Sensor

REPEATS = 60
"""Simulations with other seeds that tell what chance does."""

MATERIAL = 0.3
"""Least fall of the held-out error, in units of the floor."""

TIE = 0.35
"""Candidates at the floor whose held-out error is within this of the best's are not told apart from it."""

HALF = 0.5
"""Where the model counts as right without it, an effect is added only if it leaves no more than chance
may, and at most this share of what was left above the level of chance."""


@dataclass
class DiagnosisState:
    """What a diagnosis works on.

    Args:
        without: What the model left before an effect was added to it, where it counted as right already.
    """

    evidence: SplitMeasurement
    effects: Mapping[str, type[Effect]]
    seed: int
    progress: Progress
    given: frozenset[str]
    history: list[Step] = field(default_factory=list)
    alternatives: dict[str, list[Candidate]] = field(default_factory=dict)
    error_of: dict[str, float] = field(default_factory=dict)
    ties: dict[str, set[str]] = field(default_factory=dict)
    without: dict[str, Judgement] = field(default_factory=dict)
    first: list[Candidate] = field(default_factory=list)
    error: float = float("nan")

    def judge(self, model: FittedModel, *, repeats: int = REPEATS) -> Judgement:
        """Return the held-out error of a model; makes it the present one of that half."""
        judgement = model.judge(self.evidence.held, repeats=repeats, seed=self.seed + 500)
        self.error = judgement.error
        self.progress("judging", 0.0, self.error)
        return judgement

    def note(
        self, best: Candidate, finalists: Sequence[Candidate], ties: Sequence[str], without: Judgement
    ) -> None:
        """Note what a review needs to know of an effect that is added."""
        self.alternatives[best.name] = [t for t in finalists if t.name != best.name]
        self.error_of[best.name] = best.error
        self.ties[best.name] = set(ties)
        if reaches_floor(without):
            self.without[best.name] = without

    def added(self, model: FittedModel) -> tuple[str, ...]:
        """Return the effects that were added to the given sensor."""
        return tuple(e.name for e in model.space.sensor.effects if e.name not in self.given)


def explains_remainder(judgement: Judgement, without: Judgement) -> bool:
    """Whether an effect explains what a model that counts as right leaves without it.

    That may be the scene's fault, or another simulator's habit, so it must explain most of it.
    """
    level = judgement.level
    chance = judgement.error <= max(QUIET, judgement.reach) and reaches_floor(judgement)
    return chance and judgement.error - level <= HALF * (without.error - level)


def with_same_freedom(sensor: Sensor, model: FittedModel, more: Sequence[str]) -> FittedModel:
    """Return the model of a sensor with what is free in another model, and in some effects more."""
    names = [a.name for a in model.space.axes if a.name.split(".")[0] in sensor]
    mine = [name for effect in more for name in free_of(sensor, effect)]
    return model_of(sensor, list(dict.fromkeys([*names, *mine])))
