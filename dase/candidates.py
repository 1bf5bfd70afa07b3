"""Trying effects that a model does not have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.descent import Found, screen
from dase.effects.base import Effect
from dase.effects.flicker import Flicker
from dase.effects.optics import SceneEffect
from dase.effects.row_scan import RowScan
from dase.effects.timestamp import Timestamp
from dase.evidence import Evidence
from dase.model import Model, added, starts
from dase.space import variants
from dase.trials import finer_steps

Array = NDArray[np.float64]

FINALISTS = 5
"""Candidates that are fitted to all pixels of the training half."""

SECOND = 1.25
"""A second start is followed where its loss is below this, relative to the first."""

SEEDS = 6
"""Simulations whose mean loss is taken where candidates are compared."""


@dataclass(frozen=True)
class Tried:
    """One candidate.

    Args:
        name: Of the effect, names joined by ` + ` for a pair.
        model: With the effect, fitted.
        fit: Its loss where it was fitted.
        scouted: Its loss on the scout.
        held: Its loss on the held-out half, by what is seen of the model without it; NaN where it was only
            screened.
        bank: Statistics of all that was tried on the training half, shape (M, J).
    """

    name: str
    model: Model
    fit: float
    scouted: float = float("nan")
    held: float = float("nan")
    bank: Array | None = None


Report = Callable[[str, float], None]
"""Told what is being done, and the share of the step that is done."""


def open_to(effects: Mapping[str, type[Effect]], present: Model) -> list[str]:
    """Return the names of the effects that can be tried."""
    sensor = present.space.sensor
    # what acts on whole pictures has no place in a parameter vector; what a network has to learn first
    # cannot be tried
    known = [n for n, e in effects.items() if not issubclass(e, SceneEffect) and not e.maps]
    return [n for n in known if n not in sensor or (sensor[n].is_off() and n != "threshold")]


def prepared(evidence: Evidence, effect: type[Effect]) -> list[Effect]:
    """Return the variants of an effect that are tried, with what can be read off the measurement set.

    No descent finds the frequency of a lamp or the ticks of a clock, but they can be seen. Where no
    regularity is seen in the time stamps, the effects that make one are not tried.
    """
    structure = evidence.structure
    if effect is Flicker:
        return [Flicker(frequency=evidence.peak)]
    if effect is Timestamp:
        return [Timestamp(step=structure.step, jitter=0.0)] if structure.step else []
    if effect is RowScan:
        return [RowScan(line=structure.line, direction=structure.direction)] if structure.line else []
    return variants(effect)


def scout(evidence: Evidence, present: Model, effect: Effect, *, seed: int) -> Tried:
    """Try one effect on the scout: a look at many places, then a short descent from the best two."""
    model = added(present, effect)
    sensor = model.space.sensor
    slow = model.space.streams or finer_steps(sensor, evidence.scout.trials.stimulus.grid.step) > 0
    places, losses = screen(evidence.scout, model.space, starts(model, effect, few=slow), seed=seed)
    apart = np.flatnonzero((np.abs(places - places[0]).max(1) > 0.8) & (losses < SECOND * losses[0]))
    picks = [0, *apart[: 0 if slow else 1]]
    ends = [
        replace(model, place=places[n], loss=losses[n]).search(
            evidence.scout, seed=seed, iterations=3, radius=0.25
        )
        for n in picks
    ]
    best = min(ends, key=lambda m: m.loss)
    return Tried(effect.name, best, best.loss, best.loss)


def refine(evidence: Evidence, tried: Tried, *, seed: int) -> Tried:
    """Fit a candidate to all pixels of the training half and look at the held-out one."""
    found: Found = tried.model.explore(evidence.train, seed=seed, iterations=4, radius=0.2)
    model = replace(tried.model, place=found.place, loss=found.loss)
    held = held_loss(evidence, model, seed=seed)
    return replace(tried, model=model, fit=found.loss, held=held, bank=found.tried)


def held_loss(evidence: Evidence, model: Model, *, seed: int) -> float:
    """Return the held-out loss of a model as that of the present one is judged: the mean of a few repeats."""
    half = evidence.held
    places = np.repeat(model.place[None], SEEDS, 0)
    values = half.run(model.space, places, seed=seed + 700, reseed=True)
    return float(half.seen.loss(values.mean(0)))


def try_all(
    evidence: Evidence,
    present: Model,
    effects: Mapping[str, type[Effect]],
    names: Sequence[str],
    *,
    seed: int,
    report: Report,
) -> list[Tried]:
    """Try each effect; return the finalists in order of their held-out loss, then the others.

    All halves must have been rebased to the present model.
    """
    all_variants = [v for name in names for v in prepared(evidence, effects[name])]
    found: dict[str, Tried] = {}
    for n, effect in enumerate(all_variants):
        tried = scout(evidence, present, effect, seed=seed)
        if effect.name not in found or tried.fit < found[effect.name].fit:
            found[effect.name] = tried
        report(f"trying {effect.name}", 0.7 * (n + 1) / len(all_variants))
    order = sorted(found.values(), key=lambda t: t.fit)
    finalists = []
    for n, tried in enumerate(order[:FINALISTS]):
        finalists.append(refine(evidence, tried, seed=seed))
        report(f"fitting {tried.name}", 0.7 + 0.3 * (n + 1) / min(FINALISTS, len(order)))
    finalists.sort(key=lambda t: t.held)
    return [*finalists, *order[FINALISTS:]]


def chance_of(
    evidence: Evidence, tried: Sequence[Tried], repeats: Array, present: Array
) -> Callable[[float], float]:
    """Return the function from a fall of the training loss to its p-value, corrected over all candidates.

    Repeats of the present model stand in for the measurement; each takes the best of everything that was
    tried for any candidate.

    Args:
        evidence: Rebased to the present model.
        tried: Candidates with their banks.
        repeats: Statistics of repeats of the present model on the training half, shape (R, J).
        present: Statistics of the present model as it was compared with the candidates, shape (J,).
    """
    banks = [t.bank for t in tried if t.bank is not None]
    if not banks:
        return lambda fall: 1.0
    bank = np.concatenate(banks)
    scale = evidence.train.scale
    gains = []
    for repeat in repeats:
        stand_in = replace(scale, target=repeat)
        gains.append(float(stand_in.loss(present)) - float(stand_in.loss(bank).min()))
    ordered = np.sort(gains)

    def p_value(fall: float) -> float:
        return float((1 + np.count_nonzero(ordered >= fall)) / (1 + len(ordered)))

    return p_value


def apart(evidence: Evidence, one: Model, other: Model, *, seed: int) -> tuple[float, float]:
    """Return by how much the held-out loss of `other` is above that of `one`, and its standard error.

    The error comes from leaving out one group of pixels after the other.
    """
    half = evidence.held
    differences = half.leave_out([half.simulate(m.space, m.place, seed=seed) for m in (one, other)])
    count = differences.shape[1]
    gap = differences[1] - differences[0]
    return float(gap.mean()), float(np.sqrt((count - 1) * gap.var()))
