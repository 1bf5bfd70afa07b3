"""A kink and darker corners that events show, in the model before the search and in what a diagnosis says.

The kink is a simulator's own, known to the last digit, and hides what else steps in the dark would tell. How
much light is lost at the corners no error tells as well: a change of log intensity is the same in less light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from dase.diagnosis.alike_steps import find_alike_steps
from dase.diagnosis.compared_measurement import ComparedMeasurement
from dase.diagnosis.grading import judge_on_report
from dase.diagnosis.kinked_response import find_kinked_response
from dase.diagnosis.state import DiagnosisState, DiagnosisTask
from dase.diagnosis.steps_in_the_dark import find_current_at_corners
from dase.effects.linlog import Linlog
from dase.effects.vignetting import Vignetting
from dase.fitting.model import FittedModel, refit_model, with_fixed_effect
from dase.results import Diagnosis, Estimate
from dase.signatures.kinds import CURRENT_AT_CORNERS, KINK_AT_CORNERS, KINKED_RESPONSE
from dase.signatures.result import Signature


@dataclass(frozen=True, eq=False)
class KinkInModel:
    """A kink or darker corners, and what makes them.

    Args:
        seen: What shows it.
        effects: Names of what makes it, in the order in which models got them.
        parameters: `effect.parameter` to what is told of it.
        without: The fitted model before each of them came in.
    """

    seen: tuple[Signature, ...]
    effects: tuple[str, ...]
    parameters: dict[str, Estimate]
    without: tuple[FittedModel, ...]

    def added_to(self, found: Diagnosis, task: DiagnosisTask) -> Diagnosis:
        """Return a diagnosis, made with these in its model, with what they are and the error before each.

        Args:
            found: By the search.
            task: What it was asked.
        """
        judged = judge_on_report(task, self.without, repeats=task.settings.repeats)
        errors = (*(one.judgement.error for one in judged), *found.errors)
        falls = {name: errors[n : n + 2] for n, name in enumerate(self.effects)}
        findings = tuple(
            replace(
                one, error_without=falls[one.effect][0], error_with=falls[one.effect][1],
                parameters={k: v for k, v in self.parameters.items() if k.startswith(f"{one.effect}.")},
            )
            if one.effect in falls
            else one
            for one in found.findings
        )  # fmt: skip
        return replace(
            found,
            selected=(*self.effects, *found.selected),
            errors=errors,
            findings=findings,
            parameters={**found.parameters, **self.parameters},
        )


def put_kink_in_model(
    state: DiagnosisState, compared: ComparedMeasurement, model: FittedModel
) -> tuple[FittedModel, KinkInModel | None]:
    """Return a model with what events show of response and corners, fitted, and that; None without any.

    Args:
        state: Counts what makes it among what the model has before the search.
        compared: The measurement, and what its events show.
        model: The one before the search.
    """
    task = state.task
    if task.evidence.contradiction or compared.seen.lamp or Linlog.name in task.given:
        return model, None
    found = find_kinked_response(compared.measurement, model.sensor, seed=task.seed)
    if not found and not compared.seen.stamped_late and Vignetting.name not in task.given:
        alike = find_alike_steps(compared.measurement, model.sensor, seed=task.seed)
        found = () if alike is None else alike.at_corners()
        if not found:
            darker = find_current_at_corners(compared.measurement, model.sensor, seed=task.seed)
            found = () if darker is None else (darker,)
    makers = [(effect, told) for effect, told in _makers(found) if effect.name in task.effects]
    if not makers:
        return model, None
    without, parameters = [], dict[str, Estimate]()
    for effect, told in makers:
        without.append(model)
        state.count_as_given(effect.name)
        model = refit_model(task.evidence, with_fixed_effect(model, effect), seed=task.seed)
        parameters |= told
    return model, KinkInModel(found, tuple(one.name for one, _ in makers), parameters, tuple(without))


def _makers(found: Sequence[Signature]) -> list[tuple[Linlog | Vignetting, dict[str, Estimate]]]:
    """Return the effects that make what was found, each with its parameters."""
    out = list[tuple[Linlog | Vignetting, dict[str, Estimate]]]()
    for one in found:
        told = Estimate(one.size, one.low, one.high)
        if one.name == KINKED_RESPONSE:
            slope = math.log(255 * one.size)
            known = {f"{Linlog.name}.knee": told, f"{Linlog.name}.slope": Estimate(slope, slope, slope)}
            out.append((Linlog(knee=one.size, slope=slope), known))
        elif one.name in (KINK_AT_CORNERS, CURRENT_AT_CORNERS):
            out.append((Vignetting(loss=one.size), {f"{Vignetting.name}.loss": told}))
    return out
