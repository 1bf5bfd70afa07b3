"""Whether a pole and a delay explain more than two poles, which are the nearest single effect to both.

A search that adds one effect after the other takes two poles first: alone they are as late and as slow. With
them in the model neither a pole nor a delay shows any more, and alone neither does as well in their place.
"""

from __future__ import annotations

import math
from dataclasses import replace

from dase.diagnosis.cell_descriptions import worst_cells
from dase.diagnosis.ranking import rank_of_pair
from dase.diagnosis.state import DiagnosisState, with_same_freedom
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.second_order import SecondOrder
from dase.fitting.model import FittedModel, refit_model, refit_work
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import Judgement, reaches_floor
from dase.results import Step

DELAYS = (0.4, 0.8)
"""Shares of the time by which two poles are late that is the delay, from which a fit begins."""


def put_pole_and_delay(
    state: DiagnosisState, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Return a model with a pole and a delay in the place of two poles, where these leave far more.

    Args:
        state: Gets a step if they take the place of these.
        model: The last one.
        judgement: Its held-out error.

    Returns:
        The model, or the given one, and its held-out error.
    """
    task, poles, pair = state.task, SecondOrder.name, (Bandwidth.name, Latency.name)
    if poles not in task.added_to(model) or poles in state.path.certain:
        return model, judgement
    if any(name in model.sensor or name not in task.effects for name in pair):
        return model, judgement
    two = model.sensor[poles]
    assert isinstance(two, SecondOrder)
    bare = model.sensor.without(poles)
    late = two.damping / (math.pi * two.cutoff)  # of a slow ramp
    ways = []
    for share in DELAYS:
        pole = Bandwidth(cutoff=1 / (2 * math.pi * (1 - share) * late), dark=two.dark)
        sensor = bare.with_effect(pole).with_effect(Latency(delay=share * late, light=0.0))
        ways.append(with_same_freedom(sensor, model, pair))
    fits = run_side_by_side([refit_work(task.evidence, way, seed=task.seed, rounds=1) for way in ways])
    best = refit_model(task.evidence, min(fits, key=lambda one: one.loss), seed=task.seed, rounds=1)
    judged = task.judge(best)
    limit = task.settings.exchange.pole_and_delay * judgement.error
    if judged.error > limit or reaches_floor(judged) < reaches_floor(judgement):
        return model, judgement
    rest = with_same_freedom(bare, model, ())
    without, name = task.judge(rest), " + ".join(pair)
    step = Step(
        model=tuple(effect.name for effect in bare.effects), error=without.error, gate=without.gate,
        families=without.families, ranking=(), chosen=name, ties=(),
        cells=worst_cells(task.evidence, without),
    )  # fmt: skip
    state.add_step(replace(step, ranking=(rank_of_pair(name, best, judged, step),)))
    return best, judged
