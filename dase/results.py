"""What comparing, fitting and diagnosing return: frozen, with plain fields.

What Python prints of a result is a table that fits on a screen and says what was found; `to_json` has all of
it.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.formatting import align_columns, fit_to_screen
from dase.simulation.sensor import Sensor

Progress = Callable[[str, float, float], None]
"""Told what is being done, the share of the step done, and the present error."""


@dataclass(frozen=True)
class Estimate:
    """A fitted number and its 90 % confidence interval, in the unit of its parameter."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, repr=False)
class Cell:
    """One place at which model and measurement are compared.

    Args:
        probe: Family of summary statistics, a key of `dase.probes.statistics.FAMILIES`.
        where: The cell in words, such as `dark pixels (below 20 DN), at rest for 200 ms`.
        what: What is compared, such as `OFF events`.
        measured: The statistic of the measurement.
        simulated: That of the model.
        unit: Of both.
        z: Difference in units of its sampling error, a tolerance included; positive where the model has more.
        sentence: The finding as one sentence.
    """

    probe: str
    where: str
    what: str
    measured: float
    simulated: float
    unit: str
    z: float
    sentence: str

    def __repr__(self) -> str:
        return fit_to_screen([f"Cell({self.sentence}; {self.z:+.1f} standard errors)"])


@dataclass(frozen=True, repr=False)
class Curve:
    """A statistic over an axis, measured and simulated, for a figure.

    Args:
        title: What is drawn.
        x: Middles of the bins, shape (N,).
        x_label: With unit.
        y_label: With unit.
        measured: Shape (N,).
        simulated: Shape (N,).
        error: Standard error of the difference, shape (N,).
        log_x: Whether the axis is logarithmic.
        log_y: Whether the values are.
    """

    title: str
    x: NDArray[np.float64]
    x_label: str
    y_label: str
    measured: NDArray[np.float64]
    simulated: NDArray[np.float64]
    error: NDArray[np.float64]
    log_x: bool = False
    log_y: bool = False

    def __repr__(self) -> str:
        rows = [(self.x_label, "measured", "simulated", "error"), *self._rows()]
        lines = align_columns(rows, right=(0, 1, 2, 3))
        return fit_to_screen([f"{self.title} ({self.y_label})", *(f"  {line}" for line in lines)])

    def _rows(self) -> Iterator[tuple[str, ...]]:
        for row in zip(self.x, self.measured, self.simulated, self.error, strict=True):
            yield tuple(f"{value:.3g}" for value in row)


@dataclass(frozen=True, repr=False)
class Comparison:
    """How far a model is from a measurement, and where.

    Args:
        sensor: The model, as it was compared.
        error: Mean error over the families on held-out pixels and time; 1 is what two repeats of one
            measurement give.
        floor: The error of repeats, 1 by construction.
        gate: Error that 99 of 100 repeats stay below; above it the model is wrong beyond chance.
        families: Error per family of probes, in the same unit.
        cells: Where the model fails, worst first.
        plain: Name with unit to (measured, simulated), such as `ON events [1/(px s)]`.
        curves: Figures by family: one or more curves each.
        notes: What the user should know, such as what the data cannot show.
        seconds: Time it took.
    """

    sensor: Sensor
    error: float
    floor: float
    gate: float
    families: Mapping[str, float]
    cells: tuple[Cell, ...]
    plain: Mapping[str, tuple[float, float]]
    curves: Mapping[str, tuple[Curve, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: float = 0.0

    def __repr__(self) -> str:
        ranked = sorted(self.families.items(), key=lambda item: -item[1])
        families = align_columns([(name, f"{error:.2f}") for name, error in ranked], right=(1,))
        return fit_to_screen(
            [
                f"Comparison of '{self.sensor.name}': {_error_words(self.error, self.gate)}",
                *_indented("error per family of statistics", families),
                *_indented("where the model fails most", [cell.sentence for cell in self.cells[:4]]),
                *_plain_lines(self.plain),
                *_noted(self.notes),
            ]
        )

    def to_json(self) -> dict[str, Any]:
        """Return the numbers as JSON objects; figures are left out."""
        return {
            "sensor": self.sensor.to_table(),
            "error": self.error,
            "floor": self.floor,
            "gate": self.gate,
            "families": dict(self.families),
            "cells": [asdict(cell) for cell in self.cells],
            "plain": _plain_json(self.plain),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


@dataclass(frozen=True, repr=False)
class Fit:
    """A sensor fitted to a measurement.

    Args:
        sensor: With the fitted parameters.
        parameters: `effect.parameter` to its estimate.
        error: On held-out pixels and time; 1 is what two repeats of one measurement give.
        before: The error of the sensor before the fit.
        floor: The error of repeats, 1 by construction.
        gate: Error that 99 of 100 repeats stay below.
        agree: Whether the starts of the optimiser came to the same parameters.
        poor: Whether only one start came to this error, so that it may be a poor minimum.
        notes: Parameters that left their plausible range, starts that disagree, what the data cannot show.
        evaluations: Simulations that were run.
        seconds: Time it took.
        plain: Name with unit to (measured, simulated), such as `ON events [1/(px s)]`.
        contradiction: Why the events cannot be of the scene, in a sentence; empty where they may.
    """

    sensor: Sensor
    parameters: Mapping[str, Estimate]
    error: float
    before: float
    floor: float
    gate: float
    agree: bool = True
    poor: bool = False
    notes: tuple[str, ...] = ()
    evaluations: int = 0
    seconds: float = 0.0
    plain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    contradiction: str = ""

    def refusal(self) -> str:
        """Return why the fit is not to be kept unless the user insists, in words; empty where it is."""
        if self.contradiction:
            return self.contradiction
        if self.worse:
            return (
                "the fit is worse than the sensor as it was given on held-out data "
                f"(error {self.error:.2f}, before {self.before:.2f})"
            )
        return ""

    @property
    def worse(self) -> bool:
        """Whether pixels and time that no fit has seen speak for the sensor as it was before the fit."""
        return is_worse(self.error, self.before, self.gate)

    def __repr__(self) -> str:
        return fit_to_screen(
            [
                f"Fit of '{self.sensor.name}': error {self.before:.2f} before",
                f"  after: {_error_words(self.error, self.gate)}",
                *_parameter_lines(self.parameters, most=15),
                *_plain_lines(self.plain),
                *_noted(self.notes),
            ]
        )

    def to_json(self) -> dict[str, Any]:
        """Return the numbers as JSON objects."""
        out = {name: getattr(self, name) for name in ("error", "before", "floor", "gate", "agree", "poor")}
        out |= {"sensor": self.sensor.to_table(), "notes": list(self.notes)}
        out |= {"parameters": {name: asdict(e) for name, e in self.parameters.items()}}
        out |= {"worse": self.worse, "contradiction": self.contradiction, "plain": _plain_json(self.plain)}
        return out | {"evaluations": self.evaluations, "seconds": self.seconds}


@dataclass(frozen=True, repr=False)
class Rank:
    """One candidate of one step of a diagnosis.

    Args:
        effect: Name, or names joined by ` + ` for a pair.
        error: Held-out error with the effect added and everything refitted.
        fall: By how much the held-out error falls.
        share: The fall as a share of the way from the present error to the floor.
        p_value: Chance of such a fall when the present model is true, for the best of all candidates; not a
            number for pairs.
        parameters: `effect.parameter` of what was added to its estimate.
        refined: Whether it was fitted in full; weak candidates are only screened.
    """

    effect: str
    error: float
    fall: float
    share: float
    p_value: float
    parameters: Mapping[str, Estimate]
    refined: bool = True

    def __repr__(self) -> str:
        return f"Rank({', '.join(word for word in _rank_words(self) if word)})"


@dataclass(frozen=True, repr=False)
class Step:
    """One step of a diagnosis: what was missing in the model so far.

    Args:
        model: Effects of the present model.
        error: Its held-out error after it was refitted.
        gate: Error that 99 of 100 repeats of the present model stay below.
        families: Its error per family of probes.
        ranking: Candidates, best first; empty when the model is at the floor.
        chosen: Effect that was added, names joined by ` + ` for a pair; None when nothing was.
        ties: Candidates that the data cannot tell apart from the chosen one.
        cells: Where the present model fails, worst first.
    """

    model: tuple[str, ...]
    error: float
    gate: float
    families: Mapping[str, float]
    ranking: tuple[Rank, ...]
    chosen: str | None
    ties: tuple[str, ...]
    cells: tuple[Cell, ...]

    def __repr__(self) -> str:
        ranked = [rank for rank in self.ranking if not math.isnan(rank.error)]
        ranking = align_columns([_rank_words(rank) for rank in ranked]) if ranked else []
        chosen = f"added: {self.chosen}" if self.chosen else "nothing was added"
        ties = f", which cannot be told apart from {', '.join(self.ties)}" if self.ties else ""
        return fit_to_screen(
            [
                f"Step from {' + '.join(self.model)}: {_error_words(self.error, self.gate)}",
                f"  {chosen}{ties}",
                *_indented("candidates that were judged", ranking[:12]),
                *_indented("where the model fails most", [cell.sentence for cell in self.cells[:4]]),
            ]
        )


class Grade(StrEnum):
    """How sure a diagnosis is of an effect."""

    CERTAIN = "certain"
    """Seen in the events alone: it holds whatever is known of the scene and whatever else the camera does."""

    SUPPORTED = "supported"
    """Given the scene: the effect's own test holds on pixels by which nothing was chosen, nothing else does
    as well in its place, and with it next to nothing of the error is left."""

    EITHER = "either"
    """As much speaks for another effect, or so little for any that something unknown may look like it."""

    STAND_IN = "stand-in"
    """It takes some of the error away and is not found: something else may be behind that."""


@dataclass(frozen=True, repr=False)
class Finding:
    """What a diagnosis says of one effect.

    Args:
        effect: Its name.
        grade: How sure that is.
        alternatives: Effects that do nearly as well in its place.
        unknown: Whether something that is not in the library may look like it at this strength.
        error_without: Error of the model without it, all else fitted again; not a number where that was not
            seen.
        error_with: Error of the model with it.
        deviation: Standard deviations by which the measurement is away from the model without it, along its
            way; not a number where that was not seen.
        parameters: `effect.parameter` to its estimate.
        seen: What the events show of it without a scene, in a sentence; empty where that is nothing.
    """

    effect: str
    grade: Grade
    alternatives: tuple[str, ...] = ()
    unknown: bool = False
    error_without: float = math.nan
    error_with: float = math.nan
    deviation: float = math.nan
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    seen: str = ""

    def __repr__(self) -> str:
        return fit_to_screen([f"Finding({self.sentence()})"])

    def words(self) -> str:
        """Return the effect, and what it cannot be told from."""
        others = [*self.alternatives, *(["something that is not in the library"] if self.unknown else [])]
        if self.grade is not Grade.EITHER:
            return self.effect
        return f"either {self.effect} or {' or '.join(others)}"

    def sentence(self) -> str:
        """Return what is said of the effect, and why."""
        why = [self.seen] if self.seen else []
        if not math.isnan(self.error_without):
            why.append(f"without it the error is {self.error_without:.3g}, with it {self.error_with:.3g}")
            if not math.isnan(self.deviation):
                why[-1] += (
                    f", and the measurement is {self.deviation:.1f} standard deviations off along its way"
                )
        grade = "" if self.grade is Grade.EITHER else f"{self.grade}: "
        return f"{grade}{self.words()}" + (f" ({'; '.join(why)})" if why else "")

    def to_json(self) -> dict[str, Any]:
        """Return the finding as a JSON object: None where a number is not known."""
        out = asdict(self) | {"grade": str(self.grade), "sentence": self.sentence()}
        plain = ("error_without", "error_with", "deviation")
        return out | {name: None if math.isnan(out[name]) else out[name] for name in plain}


@dataclass(frozen=True, repr=False)
class DetectionLimit:
    """What a measurement would have shown of an effect that was not found.

    Args:
        effect: Its name.
        parameter: `effect.parameter` that makes it strong; empty where the events alone tell.
        strength: Least value of it that nine of ten such recordings would have shown; None for none in the
            range of real cameras.
        unit: Of the value.
        rises: Whether the effect is stronger where the value is higher.
        sentence: The same as a sentence.
    """

    effect: str
    parameter: str
    strength: float | None
    unit: str
    rises: bool
    sentence: str

    def __repr__(self) -> str:
        return fit_to_screen([f"DetectionLimit({self.sentence})"])


@dataclass(frozen=True, repr=False)
class Unexplained:
    """An error that no effect of the library takes to the floor.

    Args:
        error: What is left with the best that was found, stand-ins included.
        share: What is left as a share of the error of the model before the search, both above the level of
            chance.
        nearest: Effects that come nearest to an explanation of what the findings leave; stand-ins, not
            findings.
        cells: Where what is left sits, worst first.
        sentence: The finding as one sentence.
        of_scene: Share of what the model is off by that the scene may be blamed for, as it is only guessed
            between frames.
        places: Share of what is left by the pixels in which it sits: `moving`, `resting`, or `all` at once.
    """

    error: float
    share: float
    nearest: tuple[str, ...]
    cells: tuple[Cell, ...]
    sentence: str
    of_scene: float = 0.0
    places: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        lines = textwrap.wrap(f"Unexplained({self.sentence})", 100, subsequent_indent="  ")
        cells = (f"  {cell.sentence}" for cell in self.cells[1:5])
        return fit_to_screen([*lines, *(f"  {text}" for text in self.whereabouts()), *cells])

    def whereabouts(self) -> tuple[str, ...]:
        """Return in which pixels it sits and what of it the scene may be blamed for, in sentences."""
        words = {
            "moving": "pixels whose light changes",
            "resting": "pixels at rest",
            "all": "all pixels at once",
        }
        sits = [
            f"{100 * share:.0f} % in {words[kind]}" for kind, share in self.places.items() if share >= 0.05
        ]
        out = [f"what is left sits to {', '.join(sits)}"] if sits else []
        if self.of_scene >= 0.05:
            out.append(
                f"the scene between frames may be blamed for {100 * self.of_scene:.0f} % of what the model "
                "is off by; that much is left out of the error above"
            )
        return tuple(out)


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Which effects a model lacks.

    Args:
        sensor: The model with all that was found, fitted; the refitted model where nothing was found.
        selected: Names of the effects that are certain or supported and in `sensor`, in the order added.
        errors: Error of the refitted model at the start and after each addition to `selected`, like `before`
            on pixels by which nothing was chosen.
        before: Error of the model as it was given, before any fit.
        floor: The error of repeats, 1 by construction.
        gate: Error that 99 of 100 repeats of the last model stay below.
        parameters: `effect.parameter` to its estimate, of all fitted parameters of `sensor`.
        unexplained: What is left, or None; there may be findings beside it.
        history: One entry per step of the search, provisional additions included.
        notes: What the user should know.
        evaluations: Simulations that were run.
        seconds: Time it took.
        plain: Name with unit to (measured, simulated) of the last model, such as `ON events [1/(px s)]`.
        finished: Whether the search came to its end; before, nothing is announced.
        findings: What is said of each effect, with its grade: those of `selected`, those that cannot be told
            from others, and those that the events alone show but that no model was fitted with.
        stand_ins: The same of effects that came nearest and are not found.
        record: What to record next so that more can be said, most useful first.
        not_seen: What the measurement would have shown of each effect that is neither found nor a stand-in.
        level: Error of a repeat of the last model, in the mean.
        reach: Error that 99 of 100 repeats of it stay below, however little that is.
    """

    sensor: Sensor
    selected: tuple[str, ...]
    errors: tuple[float, ...]
    before: float
    floor: float
    gate: float
    parameters: Mapping[str, Estimate]
    unexplained: Unexplained | None
    history: tuple[Step, ...]
    notes: tuple[str, ...] = ()
    evaluations: int = 0
    seconds: float = 0.0
    plain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    finished: bool = True
    findings: tuple[Finding, ...] = ()
    stand_ins: tuple[Finding, ...] = ()
    not_seen: tuple[DetectionLimit, ...] = ()
    record: tuple[str, ...] = ()
    level: float = 0.0
    reach: float = 0.0

    @property
    def ties(self) -> dict[str, tuple[str, ...]]:
        """Effect found to those that do nearly as well in its place."""
        return {one.effect: one.alternatives for one in self.findings if one.alternatives}

    @property
    def parameters_hold(self) -> bool:
        """Whether the sensor explains so much of the measurement that its parameters may be the camera's.

        Else they are only what makes a wrong model least wrong.
        """
        return self.errors[-1] <= max(self.gate, 0.1 * self.errors[0])

    def of_grade(self, grade: Grade) -> tuple[Finding, ...]:
        """Return the findings of a grade."""
        return tuple(one for one in self.findings if one.grade is grade)

    def __repr__(self) -> str:
        steps = [("as given", self.before), *zip(("fitted", *self.selected), self.errors, strict=False)]
        return fit_to_screen(
            [
                *textwrap.wrap(f"Diagnosis: {self.finding()}", 100, subsequent_indent="  "),
                *_indented(
                    f"error after each step; repeats stay below {self.gate:.2f}",
                    align_columns([(name, f"{error:.2f}") for name, error in steps], right=(1,)),
                ),
                *_indented("findings", [one.sentence() for one in self.findings[:6]]),
                *_indented("record next", self.record),
                *_indented("not seen", [one.sentence for one in self.not_seen[:6]]),
                *_parameter_lines(self.parameters, most=12, hold=self.parameters_hold),
                *_plain_lines(self.plain),
                *_noted(self.notes),
            ]
        )

    def finding(self) -> str:
        """Return what was found, in one line."""
        if not self.finished:
            added = [step.chosen for step in self.history if step.chosen]
            tried = f"; nearest so far: {', '.join(added)}, not yet checked" if added else ""
            return f"not finished: error {self.history[-1].error:.2f} after {len(self.history)} steps{tried}"
        said = []
        for grade in (Grade.CERTAIN, Grade.SUPPORTED, Grade.EITHER):
            names = [one.words() for one in self.of_grade(grade)]
            if names:
                said.append(", ".join(names) + ("" if grade is Grade.EITHER else f" ({grade})"))
        if self.unexplained is not None:
            return "; ".join([*([f"missing: {'; '.join(said)}"] if said else []), self.unexplained.sentence])
        if not said:
            return f"nothing is missing: error {self.errors[0]:.2f}, repeats stay below {self.gate:.2f}"
        return f"missing: {'; '.join(said)}"

    def to_json(self) -> dict[str, Any]:
        """Return the findings as JSON objects."""
        return {
            "selected": list(self.selected),
            "findings": [one.to_json() for one in self.findings],
            "stand_ins": [one.to_json() for one in self.stand_ins],
            "parameters_hold": self.parameters_hold,
            "record": list(self.record),
            "not_seen": [asdict(one) for one in self.not_seen],
            "level": self.level,
            "reach": self.reach,
            "errors": list(self.errors),
            "before": self.before,
            "floor": self.floor,
            "gate": self.gate,
            "parameters": {name: asdict(e) for name, e in self.parameters.items()},
            "ties": {name: list(others) for name, others in self.ties.items()},
            "unexplained": None if self.unexplained is None else asdict(self.unexplained),
            "history": [asdict(step) for step in self.history],
            "finished": self.finished,
            "plain": _plain_json(self.plain),
            "sensor": self.sensor.to_table(),
            "notes": list(self.notes),
            "evaluations": self.evaluations,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, repr=False)
class Answer:
    """What one standard recording does for telling two models apart.

    Args:
        stimulus: Name of the recording.
        how: To make it.
        seconds: Shortest duration that tells them apart; None if none up to `longest` does.
        power: Share of recordings of B that are known, at that or the longest duration.
        differs: Family of statistics that differs most, in words; empty where nothing clearly differs.
        rates: OFF and ON events of A, then of B [1/(px s)].
        tried: Durations [s] and the power of each.
    """

    stimulus: str
    how: str
    seconds: float | None
    power: float
    differs: str
    rates: tuple[float, float, float, float]
    tried: tuple[tuple[float, float], ...] = ()

    def __repr__(self) -> str:
        return f"Answer({', '.join(_answer_words(self))})"


@dataclass(frozen=True, repr=False)
class Distinction:
    """Which recording tells two models apart.

    Args:
        answers: One per standard recording, in the order of `STANDARDS`.
        best: The answer of the shortest recording, None where none tells them apart.
        sentence: Advice.
        pixels: Of a recording that were looked at.
        longest: Longest duration that was tried [s].
    """

    answers: tuple[Answer, ...]
    best: Answer | None
    sentence: str
    pixels: int
    longest: float

    def __repr__(self) -> str:
        rows = [("recording", "tells apart in", "power", "they differ in"), *map(_answer_words, self.answers)]
        lines = textwrap.wrap(self.sentence, 98)
        return fit_to_screen(["Distinction", *(f"  {line}" for line in [*align_columns(rows), *lines])])


NO_CLAIM = "parameters of the nearest model, which leaves too much: no claim about the camera"
"""Above parameters of a model that does not explain the measurement."""


def is_worse(error: float, before: float, gate: float) -> bool:
    """Whether held-out data speak against a model in place of another, beyond what repeats differ by.

    Args:
        error: Of the model.
        before: Of the other.
        gate: Error up to which a model counts as right; which of two right ones has less does not matter.
    """
    return error > gate and error > max(1.1 * before, before + 0.1)


def _error_words(error: float, gate: float) -> str:
    """Return an error with what it is to be compared with."""
    return f"error {error:.2f} noise floors, where repeats stay below {gate:.2f}"


def _rank_words(rank: Rank) -> tuple[str, ...]:
    """Return a candidate as cells of a table."""
    if math.isnan(rank.error):
        return rank.effect, "not judged"
    way = f"{100 * rank.share:.0f} % of the way to the floor"
    return rank.effect, f"error {rank.error:.2f}", way


def _answer_words(answer: Answer) -> tuple[str, ...]:
    """Return an answer as cells of a table."""
    shortest = "-" if answer.seconds is None else f"{answer.seconds:g} s"
    return answer.stimulus, shortest, f"{100 * answer.power:.0f} %", answer.differs or "-"


def _parameter_lines(parameters: Mapping[str, Estimate], *, most: int, hold: bool = True) -> list[str]:
    """Return parameters with their intervals as lines of a table, at most some of them.

    Args:
        parameters: By name.
        most: Of them.
        hold: Whether they may be the camera's; else they have no intervals.
    """
    rows = [
        (name, f"{e.value:.4g}", f"{e.low:.4g} to {e.high:.4g}" if hold else "")
        for name, e in list(parameters.items())[:most]
    ]
    left = [(f"and {len(parameters) - most} more", "", "")] if len(parameters) > most else []
    table = align_columns([*_pushed([*rows, *left])], right=(1,)) if rows else []
    head = "parameters, with 90 % intervals" if hold else NO_CLAIM
    return [head, *table] if table else []


def _plain_json(plain: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, float | None]]:
    """Return plain numbers as JSON objects, None where nothing can be said."""
    return {
        name: {
            key: None if math.isnan(value) else value
            for key, value in zip(("measured", "simulated"), pair, strict=True)
        }
        for name, pair in plain.items()
    }


def plain_rows(plain: Mapping[str, tuple[float, float]]) -> list[tuple[str, str, str]]:
    """Return plain numbers as rows of name, measured and simulated; `-` where nothing can be said."""
    words = [(name, *("-" if math.isnan(v) else f"{v:.4g}" for v in pair)) for name, pair in plain.items()]
    return [(name, measured, simulated) for name, measured, simulated in words]


def _plain_lines(plain: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return plain numbers as lines of a table; nothing where there are none."""
    rows = plain_rows(plain)
    head = ("in plain numbers", "measured", "simulated")
    return align_columns([head, *_pushed(rows)], right=(1, 2)) if rows else []


def _noted(notes: Sequence[str]) -> list[str]:
    """Return notes, the first of them where there are many."""
    left = [f"note: and {len(notes) - 3} more, see .notes"] if len(notes) > 3 else []
    return [*(f"note: {note}" for note in notes[:3]), *left]


def _indented(title: str, lines: Sequence[str]) -> list[str]:
    """Return lines under a title; nothing where there are none."""
    return [title, *(f"  {line}" for line in lines)] if lines else []


def _pushed(rows: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return rows of a table with the first cell indented."""
    return [(f"  {first}", *rest) for first, *rest in rows]
