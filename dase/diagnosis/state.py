"""What a diagnosis works on, and what it has found so far."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dase.diagnosis.candidates import Candidate
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.effects import Effect
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.model import FittedModel, free_of, model_of, still_free
from dase.probes.distance import LIMITS, Judgement, reaches_floor
from dase.probes.random_streams import SimulationStream
from dase.results import Progress, Step
from dase.simulation.sensor import Sensor


@dataclass
class DiagnosisState:
    """What a diagnosis works on, and what it has found so far.

    Args:
        evidence: The measurement, split for fitting and judging.
        effects: All effects that may be added, by name.
        seed: Of every random number.
        progress: Told how far it is.
        given: Names of the effects of the sensor as it was given.
        settings: Numbers by which effects are added and dropped.
        history: The steps so far, provisional additions included.
        alternatives: Effect that was added to the other candidates that were judged with it.
        error_of: Effect that was added to the held-out error with it.
        without: What the model left before an effect was added to it, where it counted as right already.
        first: Candidates of the first step in which all were tried, in order of their screening, from which
            pairs are made.
        first_step: Which step that was.
        certain: Effects that the events alone show; they are not dropped.
        shown: Those of them that are there however badly any model fits.
        tried_alone: Those of them that were tried before all others.
        put_off: Those that were seen beside the model before the search, and explain too little of its error
            to be put in before all others: they are asked for again at the end.
        noise: Rate of the noise that pixels at rest send and the model before the search has not [Hz].
        held: See `Measurement.held`.
        all_time: Whether all of the time is fitted, not its first part alone.
        evaluations_before: Simulations that were run before the measurement was split anew.
        samples_before: Pixels times samples of those.
        path: Models that were fitted in full on the way, the first one without any addition.
        notes: What the user should know of the search.
        after_step: Told the model and the errors so far after each step.
        error: Held-out error of the model that was judged last.
    """

    evidence: SplitMeasurement
    effects: Mapping[str, type[Effect]]
    seed: int
    progress: Progress
    given: frozenset[str]
    settings: DiagnosisSettings = DEFAULTS
    history: list[Step] = field(default_factory=list)
    alternatives: dict[str, list[Candidate]] = field(default_factory=dict)
    error_of: dict[str, float] = field(default_factory=dict)
    without: dict[str, Judgement] = field(default_factory=dict)
    first: list[Candidate] = field(default_factory=list)
    certain: frozenset[str] = frozenset()
    shown: frozenset[str] = frozenset()
    tried_alone: frozenset[str] = frozenset()
    put_off: frozenset[str] = frozenset()
    noise: float = 0.0
    held: float = 0.0
    all_time: bool = False
    evaluations_before: int = 0
    samples_before: int = 0
    first_step: int = 0
    path: list[FittedModel] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    after_step: Callable[[FittedModel, list[float]], None] = lambda model, errors: None
    error: float = float("nan")

    @property
    def samples(self) -> int:
        """Pixels times samples of all simulations so far."""
        return self.samples_before + self.evidence.samples

    def judge(self, model: FittedModel, *, repeats: int | None = None) -> Judgement:
        """Return the held-out error of a model."""
        repeats = self.settings.repeats if repeats is None else repeats
        judgement = model.judge(
            self.evidence.held, repeats=repeats, seed=SimulationStream.JUDGE.seed(self.seed)
        )
        self.error = judgement.error
        self.progress("judging", 0.0, self.error)
        return judgement

    def note_addition(self, best: Candidate, finalists: Sequence[Candidate], without: Judgement) -> None:
        """Keep what pruning needs to know of an effect that is added.

        Args:
            best: The candidate that is added.
            finalists: All candidates that were judged with it.
            without: The error of the model without it.
        """
        self.alternatives[best.name] = [one for one in finalists if one.name != best.name]
        self.error_of[best.name] = best.error
        if reaches_floor(without):
            self.without[best.name] = without

    def ways(self) -> _Ways:
        """Return how this model was come to, for `go_back`."""
        return _Ways(
            list(self.history), list(self.path), dict(self.alternatives), dict(self.error_of),
            dict(self.without), self.certain,
        )  # fmt: skip

    def go_back(self, ways: _Ways) -> None:
        """Forget what was tried since."""
        self.history, self.path, self.alternatives, self.error_of, self.without, self.certain = ways

    def has_asked(self, model: FittedModel) -> bool:
        """Whether all effects were tried beside those of a model before, wherever its values were."""
        mine = {effect.name for effect in model.space.sensor.effects}
        return any(
            set(step.model) == mine and not self.certain.issuperset(rank.effect for rank in step.ranking)
            for step in self.history
        )

    def added_to(self, model: FittedModel) -> tuple[str, ...]:
        """Return the effects of a model that the given sensor did not have."""
        return tuple(e.name for e in model.space.sensor.effects if e.name not in self.given)


class _Ways(NamedTuple):
    """What a search changes of a state."""

    history: list[Step]
    path: list[FittedModel]
    alternatives: dict[str, list[Candidate]]
    error_of: dict[str, float]
    without: dict[str, Judgement]
    certain: frozenset[str]


def explains_remainder(
    judgement: Judgement, without: Judgement, settings: DiagnosisSettings = DEFAULTS
) -> bool:
    """Whether an effect explains what a model that counts as right leaves without it.

    That may be the scene's fault, or another simulator's habit, so it must explain most of it.
    """
    level = judgement.level
    chance = judgement.error <= max(LIMITS.quiet, judgement.reach) and reaches_floor(judgement)
    return chance and judgement.error - level <= settings.remainder * (without.error - level)


def with_same_freedom(sensor: Sensor, model: FittedModel, more: Sequence[str]) -> FittedModel:
    """Return the model of a sensor in which what is free in another model is free, and all of some effects.

    Args:
        sensor: May lack effects of the other model and have further ones.
        model: The other model.
        more: Names of the effects whose parameters are free beside.
    """
    mine = [name for effect in more for name in free_of(sensor, effect)]
    return model_of(sensor, list(dict.fromkeys([*still_free(sensor, model), *mine])))
