"""What a diagnosis works on, what it knows before its search, and the path of the search.

The parts of a `DiagnosisState` are frozen: a function that takes one of them only reads it. One that takes
the state itself may change it, and changes those parts by its methods alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from dase.diagnosis.candidates import Candidate
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.effects import Effect
from dase.effects.optics_blur import OpticsBlur
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, free_of, model_of, still_free
from dase.probes.distance import LIMITS, Judgement, reaches_floor
from dase.probes.random_streams import SimulationStream
from dase.results import Progress, Step
from dase.simulation.sensor import Sensor


@dataclass(frozen=True, eq=False)
class DiagnosisTask:
    """What a diagnosis is asked.

    Args:
        evidence: The measurement, split for fitting and judging.
        effects: All effects that may be added, by name.
        seed: Of every random number.
        progress: Told how far it is.
        given: Names of the effects that a model has before the search.
        settings: Numbers by which effects are added and dropped.
        frame_held: Time for which each frame of a clip is held [s], see `Measurement.held`.
        grey_step: Between two greys of a clip of 8 bits [intensity]; 0 of other scenes.
        all_time: Whether all of the time is fitted, not its first part alone.
        lens: Through which a clip is seen, where the search before has told it; None without one.
    """

    evidence: SplitMeasurement
    effects: Mapping[str, type[Effect]]
    seed: int
    progress: Progress
    given: frozenset[str]
    settings: DiagnosisSettings = DEFAULTS
    frame_held: float = 0.0
    grey_step: float = 0.0
    all_time: bool = False
    lens: OpticsBlur | None = None

    def judge(self, model: FittedModel, *, repeats: int | None = None) -> Judgement:
        """Return the held-out error of a model."""
        repeats = self.settings.repeats if repeats is None else repeats
        judgement = model.judge(
            self.evidence.held, repeats=repeats, seed=SimulationStream.JUDGE.seed(self.seed)
        )
        self.progress("judging", 0.0, judgement.error)
        return judgement

    def added_to(self, model: FittedModel) -> tuple[str, ...]:
        """Return the effects of a model that it did not have before the search."""
        return tuple(e.name for e in model.space.sensor.effects if e.name not in self.given)


@dataclass(frozen=True)
class EventsAlone:
    """What the events alone show, which `look_beside_model` settles before the search.

    Only the last two grow later, in `effect_search`. A search that goes back to an earlier path keeps them.

    Args:
        shown: Effects that are there however badly any model fits.
        noise: Rate of the noise that pixels at rest send and the model before the search has not [Hz].
        tried_alone: Certain effects that were tried before all others.
        put_off: Those that explain too little of the error of the model before the search to be put in before
            all others: they are asked for again at the end.
    """

    shown: frozenset[str] = frozenset()
    noise: float = 0.0
    tried_alone: frozenset[str] = frozenset()
    put_off: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class SearchPath:
    """How a search came to its last model.

    Args:
        history: The steps so far, provisional additions included.
        models: Models that were fitted in full on the way, the first one without any addition.
        certain: Effects that are not dropped, for the events alone show them, before the search or beside a
            model on its path.
        alternatives: Effect that was added to the other candidates that were judged with it.
        error_of: Effect that was added to the held-out error with it.
        without: What the model left before an effect was added to it, where it counted as right already.
        first: Candidates of the first step in which all were tried, in order of their screening, from which
            pairs are made, and another way begins.
        first_step: Which step that was.
    """

    history: tuple[Step, ...] = ()
    models: tuple[FittedModel, ...] = ()
    certain: frozenset[str] = frozenset()
    alternatives: Mapping[str, Sequence[Candidate]] = field(default_factory=dict)
    error_of: Mapping[str, float] = field(default_factory=dict)
    without: Mapping[str, Judgement] = field(default_factory=dict)
    first: tuple[Candidate, ...] = ()
    first_step: int = 0

    def has_asked(self, model: FittedModel) -> bool:
        """Whether all effects were tried beside those of a model before, wherever its values were."""
        mine = {effect.name for effect in model.space.sensor.effects}
        return any(
            set(step.model) == mine and not self.certain.issuperset(rank.effect for rank in step.ranking)
            for step in self.history
        )


@dataclass
class DiagnosisState:
    """What a diagnosis works on, and what it has found so far.

    Args:
        task: What it is asked.
        events_alone: What the events alone show.
        path: How the search came to its last model; the one to go back to where another is tried.
        notes: What the user should know of the search.
        after_step: Told the model and the errors so far after each step.
        other_scene: The measurement with its clip known at its frames alone, or behind a lens, which explains
            it better: what was searched before says nothing then.
        asked_at_frames: The model of which it was asked last whether its clip is known at its frames alone.
        evaluations_before: Simulations that were run before the measurement was split anew.
        samples_before: Pixels times samples of those.
        double_gap: Mean time from an event to its double [s], which are tried where it is not 0.
        double_spread: How far these times are apart, evenly [s]; 0 where they hardly differ.
        double_opposite: Whether the double has the other polarity.
        unlike_poles: Two that events are seen to be behind, see `Observations`; empty where they are not.
    """

    task: DiagnosisTask
    events_alone: EventsAlone = EventsAlone()
    path: SearchPath = field(default_factory=SearchPath)
    notes: list[str] = field(default_factory=list)
    after_step: Callable[[FittedModel, list[float]], None] = lambda model, errors: None
    other_scene: Measurement | None = None
    asked_at_frames: FittedModel | None = None
    evaluations_before: int = 0
    samples_before: int = 0
    double_gap: float = 0.0
    double_spread: float = 0.0
    double_opposite: bool = False
    unlike_poles: tuple[float, ...] = ()

    @property
    def evaluations(self) -> int:
        """All simulations so far."""
        return self.evaluations_before + self.task.evidence.evaluations

    @property
    def samples(self) -> int:
        """Pixels times samples of all simulations so far."""
        return self.samples_before + self.task.evidence.samples

    def doubt_scene(self, evidence: SplitMeasurement) -> None:
        """Go on with the same parts of the measurement, with what their scene is not known to."""
        self.task = replace(self.task, evidence=evidence)

    def try_doubles(self, gap: float, *, spread: float = 0.0, opposite: bool = False) -> None:
        """Let double events be tried, that are so much later [s]: they are seen, and not of the scene.

        Args:
            gap: From an event to its double, in the mean [s].
            spread: How far these times are apart, evenly [s].
            opposite: Whether the double has the other polarity.
        """
        self.double_gap, self.double_spread, self.double_opposite = gap, spread, opposite
        evidence = replace(self.task.evidence, double_gap=gap, double_spread=spread, double_opposite=opposite)
        self.task = replace(self.task, evidence=evidence)

    def try_unlike_poles(self, poles: tuple[float, ...]) -> None:
        """Let two poles be tried of which one goes with the light, see `Observations`: they are seen."""
        self.unlike_poles = poles
        self.task = replace(self.task, evidence=replace(self.task.evidence, unlike_poles=poles))

    def split_anew(self, evidence: SplitMeasurement) -> None:
        """Go on with a split of which all of the time is fitted; what was run before counts on."""
        self.evaluations_before, self.samples_before = self.evaluations, self.samples
        self.task = replace(self.task, evidence=evidence, all_time=True)
        if self.double_gap:
            self.try_doubles(self.double_gap, spread=self.double_spread, opposite=self.double_opposite)
        if self.unlike_poles:
            self.try_unlike_poles(self.unlike_poles)

    def count_as_given(self, name: str) -> None:
        """Count an effect as one that a model has before the search."""
        self.task = replace(self.task, given=self.task.given | {name})

    def begin_path(self, *, certain: frozenset[str], shown: frozenset[str], noise: float) -> None:
        """Begin the path of the search with what the events alone show, see there."""
        self.events_alone = EventsAlone(shown, noise)
        self.path = SearchPath(certain=certain)

    def try_alone(self, names: Sequence[str]) -> None:
        """Keep that certain effects are tried before all others, which they are once."""
        tried = self.events_alone.tried_alone.union(names)
        self.events_alone = replace(self.events_alone, tried_alone=tried)

    def put_off(self, name: str) -> None:
        """Take an effect as certain no more, and ask for it again at the end."""
        self.path = replace(self.path, certain=self.path.certain - {name})
        self.events_alone = replace(self.events_alone, put_off=self.events_alone.put_off | {name})

    def make_certain(self, name: str) -> None:
        """Take an effect as certain, so that it is not dropped."""
        self.path = replace(self.path, certain=self.path.certain | {name})

    def add_model(self, model: FittedModel) -> None:
        """Add a model that is fitted in full to the path."""
        self.path = replace(self.path, models=(*self.path.models, model))

    def add_step(self, step: Step) -> None:
        """Add a step to the path."""
        self.path = replace(self.path, history=(*self.path.history, step))

    def keep_first_candidates(self, tried: Sequence[Candidate]) -> None:
        """Keep the candidates of the next step if they are the first of one in which all were tried."""
        if not self.path.first:
            first = tuple(sorted(tried, key=lambda one: one.screened_loss))
            self.path = replace(self.path, first=first, first_step=len(self.path.history))

    def note_addition(self, best: Candidate, finalists: Sequence[Candidate], without: Judgement) -> None:
        """Keep what pruning and grading need to know of an effect that is added.

        Args:
            best: The candidate that is added.
            finalists: All candidates that were judged with it.
            without: The error of the model without it.
        """
        self.note_rivals(best.name, [one for one in finalists if one.name != best.name], best.error)
        if reaches_floor(without):
            self.path = replace(self.path, without={**self.path.without, best.name: without})

    def note_rivals(self, name: str, others: Sequence[Candidate], error: float) -> None:
        """Keep what was judged in the place of an effect, beside the same others.

        Args:
            name: Of the effect.
            others: Candidates in its place.
            error: The held-out error with the effect.
        """
        path = self.path
        self.path = replace(
            path,
            alternatives={**path.alternatives, name: others},
            error_of={**path.error_of, name: error},
        )

    def leave_at_first_step(self) -> None:
        """Leave the path at the first step in which all effects were tried, before it added any.

        What is known of the effects that were added stays.
        """
        path, at = self.path, self.path.first_step
        self.path = replace(path, history=path.history[:at], models=path.models[: at + 1])

    def go_back(self, path: SearchPath) -> None:
        """Go back to an earlier path: forget what was tried since."""
        self.path = path


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
    return model_of(sensor, list(dict.fromkeys([*still_free(sensor, model), *mine])), before=model)
