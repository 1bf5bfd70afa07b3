"""Trying effects that a model does not have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Effect
from dase.effects.flicker import Flicker
from dase.effects.optics import SceneEffect
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.timestamp import Timestamp
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.descent import StopRule, descent_work, ranking_work
from dase.fitting.early_stopping import CandidateRace
from dase.fitting.model import (
    SETTLED,
    FittedModel,
    refit_work,
    starting_places,
    with_effect_added,
    with_lamp_shifted,
)
from dase.fitting.parameter_space import effect_variants
from dase.fitting.scheduler import SimulationRequest, Work, run_side_by_side, run_work, side_by_side_work
from dase.fitting.subset import PixelSubset
from dase.probes.distance import ErrorScale, Judgement

Array = NDArray[np.float64]

FINALISTS = 4
"""Candidates that are fitted to all pixels of the training half."""

FOLLOWED = 8
"""Candidates that are followed where a look shows one clearly ahead: the turn of the others comes. Of those
whose events go through a readout, which takes ten times as long, no more are ever followed."""

CLEAR = 0.6
"""Loss of such a one, relative to that of the present model."""

SECOND = 1.25
"""A second start is followed where its loss is below this, relative to the first."""

BEHIND = 1.5
"""A finalist goes on where its error before the last fit is at most this times the best's, and `CLOSE`."""

CLOSE = 1.0
"""Such an error that is added to the limit, for errors near the floor say little."""

LOSES = 1.6
"""A finalist is fitted no further where its loss will not come below this, relative to that of the best."""

GIVES_UP = 2.0
"""The same before each finalist has sampling errors of its own, by which it may look better."""

AGAIN = 2
"""Times at most that a finalist is fitted further whose training loss is least but not its held-out error."""

FAR = 3.0
"""A finalist whose error before the last fit is above this is judged by `FEW` simulations."""

FEW = 12
"""Simulations by which models are judged that are far from the floor."""

SURELY = 0.8
"""Its training loss, relative to that of the finalist with the least held-out error."""

IDLE = 0.01
"""Share of what a bus can send below which it is no candidate: it would lose less than that."""

REPEATS = 30
"""Simulations with other seeds by which a finalist is judged."""

SIGNIFICANT = 0.05
"""Largest p-value of an effect that is added; 1 / (repeats + 1) is the smallest there is."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One candidate.

    Args:
        name: Of the effect, names joined by ` + ` for a pair.
        model: With the effect, fitted.
        fit: Its loss where it was fitted.
        scouted: Its loss on some of the pixels, relative to that of the present model.
        families: The same by family.
        judged: Its error on the held-out half; None where it was not looked at.
        bank: Statistics of all that was tried on the training half, shape (M, J).
        p_value: Of the fall of the loss where it was fitted; 1 where it was only screened.
    """

    name: str
    model: FittedModel
    fit: float
    screened_loss: float = float("nan")
    families: Mapping[str, float] = field(default_factory=dict)
    judged: Judgement | None = None
    bank: Array | None = None
    p_value: float = 1.0

    @property
    def error(self) -> float:
        """The held-out error, NaN where it was only screened."""
        return self.judged.error if self.judged else float("nan")


StepProgress = Callable[[str, float], None]
"""Told what is being done, and the share of the step that is done."""


def effects_to_try(effects: Mapping[str, type[Effect]], present: FittedModel) -> list[str]:
    """Return the names of the effects that can be tried."""
    sensor = present.space.sensor
    # what acts on whole pictures has no place in a parameter vector; what a network has to learn first
    # cannot be tried
    known = [n for n, e in effects.items() if not issubclass(e, SceneEffect) and not e.maps]
    return [n for n in known if n not in sensor or (sensor[n].is_off() and n != "threshold")]


def variants_to_try(evidence: SplitMeasurement, effect: type[Effect]) -> list[Effect]:
    """Return the variants of an effect that are tried, with what can be read off the measurement set.

    No descent finds the frequency of a lamp or the ticks of a clock, but they can be seen, as can the rate of
    a bus where it is full. Where no regularity is seen in the time stamps, the effects that make one are not
    tried; nor is a bus that is known to be free nearly always.
    """
    structure = evidence.structure
    if effect is Flicker:
        return [Flicker(frequency=evidence.peak)]
    if effect is Timestamp:
        return [Timestamp(step=structure.step, jitter=0.0)] if structure.step else []
    if effect is RowScan:
        return [RowScan(line=structure.line, direction=structure.direction)] if structure.line else []
    if effect is Readout:
        if evidence.highest_event_rate < IDLE * evidence.least_bus_rate:
            return []
        # events come as fast as the bus can send them, if it ever was full
        return [
            replace(e, rate=evidence.highest_event_rate)
            for e in effect_variants(effect)
            if isinstance(e, Readout)
        ]
    return effect_variants(effect)


def acts_on_few_pixels(effect: Effect) -> bool:
    """Whether an effect acts on a share of the pixels: a few hundred of them do not show it."""
    return any(p.name == "share" for p in effect.parameters())


@dataclass(frozen=True, eq=False)
class Screening:
    """Many places at which an effect was tried.

    Args:
        effect: What was tried.
        model: The present one with it.
        half: Where.
        before: Statistics of the present model there, shape (J,).
        places: In order of their loss, shape (M, P).
        losses: Shape (M,).
    """

    effect: Effect
    model: FittedModel
    half: PixelSubset
    before: Array
    places: Array
    losses: Array

    @property
    def share(self) -> float:
        """The least loss relative to that of the present model."""
        return float(self.losses[0]) / self.present

    @property
    def present(self) -> float:
        """Loss of the present model."""
        return float(self.half.scale.loss(self.before))

    def found(self, place: Array, loss: float) -> Candidate:
        """Return the candidate at a place."""
        model = replace(self.model, place=place, loss=loss)
        return Candidate(self.effect.name, model, loss, loss / self.present)


def screen_effect(
    evidence: SplitMeasurement, present: FittedModel, effect: Effect, *, seed: int
) -> Work[Screening]:
    """Look at an effect at many places, on some pixels, see `run_side_by_side`."""
    half = evidence.train if acts_on_few_pixels(effect) else evidence.scout
    model = with_effect_added(present, effect)
    (before,) = yield [SimulationRequest(half, present.space, present.place[None], seed)]
    few = half.slow(model.space)
    places, losses = yield from ranking_work(
        half, model.space, starting_places(model, effect, few=few), seed=seed
    )
    return Screening(effect, model, half, before[0], places, losses)


def screen_and_descend(
    evidence: SplitMeasurement, present: FittedModel, effect: Effect, *, seed: int
) -> Candidate:
    """Try one effect on some pixels: a look at many places, then a short descent from the best two."""
    look = run_work(screen_effect(evidence, present, effect, seed=seed))
    return run_work(descend_from_screening(look, CandidateRace(1), seed=seed))


def worth_descending(looks: Sequence[Screening]) -> list[Screening]:
    """Return those looks from which a descent is worth its time."""
    best: dict[str, float] = {}
    for look in looks:
        best[look.effect.name] = min(look.share, best.get(look.effect.name, np.inf))
    first = sorted(best.values())[:FOLLOWED]
    clear = first[0] < CLEAR
    return [
        look for look in looks
        if look.share <= first[-1] or not (clear or look.half.streams(look.model.space))
    ]  # fmt: skip


def descend_from_screening(look: Screening, race: CandidateRace, *, seed: int) -> Work[Candidate]:
    """Descend from the best two places of a look, see `run_side_by_side`."""
    half, places, losses = look.half, look.places, look.losses
    slow = half.slow(look.model.space) or acts_on_few_pixels(look.effect)
    apart = np.flatnonzero((np.abs(places - places[0]).max(1) > 0.8) & (losses < SECOND * losses[0]))
    name, unit, space = look.effect.name, look.present, look.model.space
    begins = places[[0, *apart[: 0 if slow else 1]]]
    ends = yield from side_by_side_work(
        [
            descent_work(half, space, begin, seed=seed, iterations=3, over=race.over(name, unit))
            for begin in begins
        ]
    )
    best = min(ends, key=lambda found: found.loss)
    was, now = half.scale.families(look.before), half.scale.families(best.values)
    return replace(
        look.found(best.place, best.loss),
        families={name: value / max(was[name], 1e-9) for name, value in now.items()},
    )


def refine_candidate(
    evidence: SplitMeasurement, tried: Candidate, race: CandidateRace, *, seed: int
) -> Work[Candidate]:
    """Fit a candidate to all pixels of the training half, by the sampling errors of the present model."""
    # a finalist that is still on its way would be judged by where it happens to be
    half = evidence.train.loaded(tried.model.space, tried.model.place)
    ways = with_lamp_shifted(tried.model, half.frame.step)
    works = []
    for way in ways:
        over = race.over(tried.name)
        works.append(
            descent_work(
                half, way.space, way.place, seed=seed, iterations=3, radius=0.2, patient=True, over=over
            )
        )
    ends = yield from side_by_side_work(works)
    found = min(ends, key=lambda end: end.loss)
    model = replace(tried.model, place=found.place, loss=found.loss)
    bank = np.concatenate([end.tried for end in ends])
    return replace(tried, model=model, fit=found.loss, bank=bank)


def refit_and_judge(evidence: SplitMeasurement, tried: Sequence[Candidate], *, seed: int) -> list[Candidate]:
    """Fit candidates by their own sampling errors and judge them on the held-out half.

    Effects that make pixels differ have sampling errors far above those of the model without them, by which
    they would look worse than they are. The repeats that give those of a candidate also tell its error where
    it was fitted so far; candidates far behind the best by that measure go no further.
    """
    looks = [_error_where_fitted(evidence, t, seed=seed) for t in tried]
    found = run_side_by_side(looks)
    limit = BEHIND * min(error for error, _ in found) + CLOSE
    race = CandidateRace(1, LOSES)
    works = [
        _settle_and_judge(evidence, t, half, FEW if error > FAR else REPEATS, race.over(t.name), seed=seed)
        for t, (error, half) in zip(tried, found, strict=True) if error <= limit
    ]  # fmt: skip
    done = {t.name: t for t in run_side_by_side(works)}
    for _ in range(AGAIN):
        first, least = (min(done.values(), key=key) for key in (_held_out_error, lambda t: t.model.loss))
        if least is first or least.model.loss > SURELY * first.model.loss:
            break
        # better where it was fitted, worse where it is judged: it is still on its way
        half = run_work(_error_where_fitted(evidence, least, seed=seed))[1]
        done[least.name] = run_work(_settle_and_judge(evidence, least, half, REPEATS, None, seed=seed))
    return [done.get(t.name, t) for t in tried]


def _held_out_error(tried: Candidate) -> float:
    return tried.error


def _error_where_fitted(
    evidence: SplitMeasurement, tried: Candidate, *, seed: int
) -> Work[tuple[float, PixelSubset]]:
    """Return the error on the training half, and that half with the candidate as its present model."""
    half = evidence.train.view()
    values = yield from half.rebasing(tried.model.space, tried.model.place, repeats=SETTLED, seed=seed + 100)
    return half.judge(values, seed=seed).error, half


def _settle_and_judge(
    evidence: SplitMeasurement,
    tried: Candidate,
    half: PixelSubset,
    repeats: int,
    over: StopRule | None,
    *,
    seed: int,
) -> Work[Candidate]:
    model = yield from refit_work(evidence, tried.model, seed=seed, rounds=1, half=half, over=over)
    judged = yield from model.judging(evidence.held.view(), repeats=repeats, seed=seed + 500)
    return replace(tried, model=model, judged=judged)


def try_effects(
    evidence: SplitMeasurement,
    present: FittedModel,
    effects: Mapping[str, type[Effect]],
    names: Sequence[str],
    *,
    repeats: Array,
    worst: Sequence[str],
    seed: int,
    report: StepProgress,
) -> list[Candidate]:
    """Try each effect; return those that were judged in order of their held-out error, then the others.

    `repeats` are those of the present model on the training half, to which that and the scout must have been
    rebased; `worst` are the families in which it fails: who helps there is looked at more closely.
    """
    all_variants = [v for name in names for v in variants_to_try(evidence, effects[name])]
    order, left = _screen_variants(evidence, present, all_variants, seed=seed, report=report)
    chosen = [*order[:FINALISTS], *family_specialists(order, worst)]
    report(f"fitting {', '.join(t.name for t in chosen)}", 0.5)
    last = CandidateRace(1, GIVES_UP)
    refined = run_side_by_side([refine_candidate(evidence, tried, last, seed=seed) for tried in chosen])
    finalists = with_p_values(evidence, present, refined, repeats, seed=seed)
    # what chance does as well is not added, whatever its error
    certain = [t for t in finalists if t.p_value <= max(SIGNIFICANT, 1.01 / (1 + len(repeats)))]
    report(f"judging {', '.join(t.name for t in certain)}", 0.75)
    done = refit_and_judge(evidence, certain, seed=seed) if certain else []
    done += [t for t in finalists if t not in certain]
    done.sort(key=lambda t: (t.error if t.judged else np.inf, t.p_value))
    return [*done, *(t for t in order if t not in chosen), *left]


def _screen_variants(
    evidence: SplitMeasurement,
    present: FittedModel,
    variants: Sequence[Effect],
    *,
    seed: int,
    report: StepProgress,
) -> tuple[list[Candidate], list[Candidate]]:
    """Return candidates in order of their loss on some pixels, and those that were only looked at."""
    looks = run_side_by_side(
        [screen_effect(evidence, present, effect, seed=seed) for effect in variants],
        lambda share: report("looking at all effects", 0.2 * share),
    )
    race, found = CandidateRace(FINALISTS), dict[str, Candidate]()
    works = [descend_from_screening(look, race, seed=seed) for look in worth_descending(looks)]
    for tried in run_side_by_side(works, lambda share: report("trying all effects", 0.2 + 0.3 * share)):
        if tried.name not in found or tried.screened_loss < found[tried.name].screened_loss:
            found[tried.name] = tried
    left = {look.effect.name: look.found(look.places[0], float(look.losses[0])) for look in looks}
    first = sorted(found.values(), key=lambda t: t.screened_loss)
    return first, [tried for name, tried in left.items() if name not in found]


def with_p_values(
    evidence: SplitMeasurement, present: FittedModel, tried: Sequence[Candidate], repeats: Array, *, seed: int
) -> list[Candidate]:
    """Return candidates with the p-values of what they make of the training loss."""
    scale = evidence.train.scale
    standing = evidence.train.run(present.space, present.place[None], seed=seed)[0]
    p_value = p_value_function(scale, tried, repeats, standing)
    return [replace(t, p_value=p_value(float(scale.loss(standing)) - t.fit)) for t in tried]


def family_specialists(order: Sequence[Candidate], worst: Sequence[str]) -> list[Candidate]:
    """Return those beside the first ones that help most in the families where the present model is worst."""
    out: list[Candidate] = []
    for family in worst:
        best = min(order, key=lambda t: t.families.get(family, float("inf")))
        if best not in order[:FINALISTS] and best not in out:
            out.append(best)
    return out


def p_value_function(
    scale: ErrorScale, tried: Sequence[Candidate], repeats: Array, present: Array
) -> Callable[[float], float]:
    """Return the function from a fall of the training loss to its p-value, corrected over all candidates.

    Repeats of the present model stand in for the measurement; each takes the best of everything that was
    tried for any candidate.

    Args:
        scale: Of the training half, by which candidates were fitted.
        tried: Candidates with their banks.
        repeats: Statistics of repeats of the present model on the training half, shape (R, J).
        present: Statistics of the present model as it was compared with the candidates, shape (J,).
    """
    banks = [t.bank for t in tried if t.bank is not None]
    if not banks:
        return lambda fall: 1.0
    bank = np.concatenate(banks)
    gains = []
    for repeat in repeats:
        stand_in = replace(scale, target=repeat)
        gains.append(float(stand_in.loss(present)) - float(stand_in.loss(bank).min()))
    ordered = np.sort(gains)

    def p_value(fall: float) -> float:
        return float((1 + np.count_nonzero(ordered >= fall)) / (1 + len(ordered)))

    return p_value
