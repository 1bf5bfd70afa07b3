"""Trying effects that a model does not have."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.settings import DEFAULTS, CandidateSettings
from dase.effects.base import Effect
from dase.effects.optics import SceneEffect
from dase.effects.threshold import Threshold
from dase.fitting.data_split import CalibratedSplit, SplitMeasurement
from dase.fitting.descent import StopRule, descent_work, ranking_work
from dase.fitting.early_stopping import CandidateRace
from dase.fitting.model import (
    FittedModel,
    calibration_while_fitting,
    places_around,
    places_between,
    places_in_uneven_light,
    places_of_as_many_events,
    refit_work,
    shift_periodic_effects,
    starting_places,
    with_effect_added,
)
from dase.fitting.scheduler import SimulationRequest, Work, run_side_by_side, run_work, side_by_side_work
from dase.fitting.subset import CalibratedSubset
from dase.fitting.trial_sampling import SAMPLES, samples_of_screening, samples_per_step
from dase.probes.distance import ErrorScale, Judgement
from dase.probes.random_streams import SimulationStream

Array = NDArray[np.float64]

LIT_PIXELS = 64
"""Whose light tells how much of its swing an effect leaves."""

Split = TypeVar("Split", bound=SplitMeasurement)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One candidate.

    Args:
        name: Of the effect, names joined by ` + ` for a pair.
        model: With the effect, fitted.
        training_loss: Its loss where it was fitted.
        screened_loss: Its loss on some of the pixels, relative to that of the present model.
        family_losses: The same by family.
        judgement: Its error on the held-out half; None where it was only screened.
        bank: Statistics of all that was tried on the training half, shape (M, J).
        p_value: Of the fall of the loss where it was fitted; 1 where it was only screened.
    """

    name: str
    model: FittedModel
    training_loss: float
    screened_loss: float = float("nan")
    family_losses: Mapping[str, float] = field(default_factory=dict)
    judgement: Judgement | None = None
    bank: Array | None = None
    p_value: float = 1.0

    @property
    def error(self) -> float:
        """The held-out error, NaN where it was only screened."""
        return self.judgement.error if self.judgement else float("nan")

    @property
    def includes(self) -> tuple[str, ...]:
        """Names of the effects that it has as special cases."""
        return self.model.space.sensor[self.name].includes


StepProgress = Callable[[str, float], None]
"""Told what is being done, and the share of the step that is done."""


def effects_to_try(effects: Mapping[str, type[Effect]], present: FittedModel) -> list[str]:
    """Return the names of the effects that can be tried."""
    sensor = present.space.sensor
    # what acts on whole pictures has no place in a parameter vector; what a network has to learn first
    # cannot be tried
    known = [n for n, e in effects.items() if not issubclass(e, SceneEffect) and not e.maps]
    return [
        n for n in known if n not in sensor or (sensor[n].is_off() and not isinstance(sensor[n], Threshold))
    ]


def variants_to_try(
    evidence: SplitMeasurement, effect: type[Effect], *, idle_bus: float = DEFAULTS.candidates.idle_bus
) -> list[Effect]:
    """Return the variants of an effect that are tried, with what can be read off the measurement set.

    No descent finds the frequency of a lamp or the ticks of a clock, but they can be seen, as can the rate of
    a bus where it is full. Where no regularity is seen in the time stamps, the effects that make one are not
    tried; nor is a bus that is known to be free when nearly all events come.

    Args:
        evidence: The measurement.
        effect: The class.
        idle_bus: Share of the events that found a bus busy at most, below which it is none without a queue.
    """
    return list(effect.candidates(evidence.observe(idle_bus=idle_bus)))


def acts_on_few_pixels(effect: Effect) -> bool:
    """Whether an effect acts on so few pixels that some hundred of them do not show it."""
    return effect.rare


@dataclass(frozen=True, eq=False)
class Screening:
    """An effect at many places of its parameters, before any descent.

    Args:
        effect: What was tried.
        model: The present one with it.
        half: Pixels and time on which it was tried.
        before: Statistics of the present model there, shape (J,).
        places: In order of their loss, shape (M, P).
        losses: Shape (M,).
        most: Samples per step that no model exceeded.
        uneven: The best place with other effects put right for light that differs from pixel to pixel, shape
            (1, P); shape (0, P) where there is none.
    """

    effect: Effect
    model: FittedModel
    half: CalibratedSubset
    before: Array
    places: Array
    losses: Array
    most: int
    uneven: Array

    @property
    def relative_loss(self) -> float:
        """The least loss, in units of that of the present model."""
        return float(self.losses[0]) / self.present_loss

    @property
    def present_loss(self) -> float:
        """Loss of the present model."""
        return float(self.half.scale.loss(self.before))

    def candidate_at(self, place: Array, loss: float) -> Candidate:
        """Return the candidate at a place, shape (P,), of which the loss is known."""
        model = replace(self.model, place=place, loss=loss)
        return Candidate(self.effect.name, model, loss, loss / self.present_loss)


def calibrate_split(
    evidence: SplitMeasurement, present: FittedModel, *, repeats: int, scout_repeats: int, seed: int
) -> CalibratedSplit:
    """Return a measurement with a model as the present one of its training half and its scout.

    Args:
        evidence: The measurement.
        present: The model.
        repeats: Simulations of it on the training half.
        scout_repeats: The same on the scout.
        seed: Of every random number.
    """
    train = present.calibrate(
        evidence.train, repeats=repeats, seed=SimulationStream.CALIBRATE_PRESENT.seed(seed)
    )
    scout = present.calibrate(
        evidence.scout, repeats=scout_repeats, seed=SimulationStream.CALIBRATE_SCOUT.seed(seed)
    )
    rest = {f.name: getattr(evidence, f.name) for f in fields(evidence) if f.name not in ("train", "scout")}
    return CalibratedSplit(train=train, scout=scout, **rest)


def screen_effect(
    evidence: CalibratedSplit, present: FittedModel, effect: Effect, *, seed: int
) -> Work[Screening]:
    """Run an effect at many places of its parameters, on some pixels, see `run_side_by_side`."""
    half = evidence.train if acts_on_few_pixels(effect) else evidence.scout
    model = with_effect_added(present, effect)
    (before,) = yield [SimulationRequest(half, present.space, present.place[None], seed)]
    few = half.slow(model.space)
    # most candidates are nothing: the finalists alone are sampled as finely as they need
    most = samples_of_screening(present.sensor, half.frame.step)
    lit = half.trials.stimulus
    light = lit.intensity[:: max(1, len(lit.pixels) // LIT_PIXELS)] + np.float64(lit.log_eps)
    along = places_of_as_many_events(model, effect, light)
    starts = np.concatenate([starting_places(model, effect, few=few), along])
    places, losses = yield from ranking_work(half, model.space, starts, seed=seed, most=most)
    between = places_between(model, effect, places[0])
    if len(between) and not few:
        more, their_losses = yield from ranking_work(half, model.space, between, seed=seed, most=most)
        places, losses = np.concatenate([places, more]), np.concatenate([losses, their_losses])
        order = np.argsort(losses, kind="stable")
        places, losses = places[order], losses[order]
    uneven = places_in_uneven_light(model, effect, starts)
    if len(uneven):
        uneven, their_losses = yield from ranking_work(half, model.space, uneven, seed=seed, most=most)
        places, losses = np.concatenate([places, uneven]), np.concatenate([losses, their_losses])
        order = np.argsort(losses, kind="stable")
        places, losses = places[order], losses[order]
    return Screening(effect, model, half, before[0], places, losses, most, uneven[:1])


def screen_and_descend(
    evidence: CalibratedSplit, present: FittedModel, effect: Effect, *, seed: int
) -> Candidate:
    """Try one effect on some pixels: many places, then a short descent from the best two."""
    screening = run_work(screen_effect(evidence, present, effect, seed=seed))
    return run_work(descend_from_screening(screening, CandidateRace(1), seed=seed))


def worth_descending(
    screenings: Sequence[Screening], settings: CandidateSettings = DEFAULTS.candidates
) -> list[Screening]:
    """Return those screenings from which a descent is worth its time."""
    best: dict[str, float] = {}
    for one in screenings:
        name = one.effect.name
        best[name] = min(one.relative_loss, best.get(name, np.inf))
    first = sorted(best.values())[: settings.followed]
    clear = first[0] < settings.clear_lead

    def near_what_is_followed(one: Screening) -> bool:
        """Return whether a variant comes near the best of its effect, which is followed."""
        leader = best[one.effect.name]
        return leader <= first[-1] and one.relative_loss <= settings.second_start * leader

    return [
        one for one in screenings
        if one.relative_loss <= first[-1] or near_what_is_followed(one)
        or not (clear or one.half.streams(one.model.space))
    ]  # fmt: skip


def descend_from_screening(
    screening: Screening, race: CandidateRace, *, seed: int, settings: CandidateSettings = DEFAULTS.candidates
) -> Work[Candidate]:
    """Descend from the best two places of a screening, see `run_side_by_side`."""
    half, places, losses = screening.half, screening.places, screening.losses
    name, unit, space = screening.effect.name, screening.present_loss, screening.model.space
    # one start is enough where a second takes too long
    slow = half.slow(space) or acts_on_few_pixels(screening.effect)
    elsewhere = np.abs(places - places[0]).max(1, initial=0.0) > settings.apart  # none may be free
    others = np.flatnonzero(elsewhere & (losses < settings.second_start * losses[0]))
    begins = places[[0, *others[: 0 if slow else 1]]]
    # on the other side of a ridge, however slow
    further = [one for one in screening.uneven if not (begins == one).all(1).any()]
    begins = np.concatenate([begins, *(one[None] for one in further)])
    ends = yield from side_by_side_work(
        [
            descent_work(
                half, space, begin, seed=seed, iterations=3, over=race.over(name, unit), most=screening.most
            )
            for begin in begins
        ]
    )
    best = min(ends, key=lambda found: found.loss)
    around = places_around(replace(screening.model, place=best.place), name)
    if len(around):
        # the phase was found beside other thresholds and another strength
        around, _ = yield from ranking_work(half, space, around, seed=seed, most=screening.most)
        turned = yield from descent_work(
            half, space, around[0], seed=seed, iterations=3, over=race.over(name, unit), most=screening.most
        )
        best = min(best, turned, key=lambda found: found.loss)
    was, now = half.scale.families(screening.before), half.scale.families(best.values)
    return replace(
        screening.candidate_at(best.place, best.loss),
        family_losses={name: value / max(was[name], 1e-9) for name, value in now.items()},
    )


def refine_candidate(
    evidence: CalibratedSplit, tried: Candidate, race: CandidateRace, *, seed: int, most: int
) -> Work[Candidate]:
    """Fit a candidate to all pixels of the training half, by the sampling errors of the present model.

    Args:
        evidence: The measurement.
        tried: The candidate.
        race: By which it is stopped where it is far behind.
        seed: Of the random numbers.
        most: Samples per step that no model exceeds.
    """
    # a finalist that is still on its way would be judged by where it happens to be
    half = evidence.train.loaded(tried.model.space, tried.model.place)
    # those of the present model were shifted when they were tried
    ways = shift_periodic_effects(tried.model, half.frame.step, [tried.name])
    works = []
    for way in ways:
        over = race.over(tried.name)
        works.append(
            descent_work(
                half,
                way.space,
                way.place,
                seed=seed,
                iterations=3,
                radius=0.2,
                patient=True,
                over=over,
                most=most,
            )
        )
    ends = yield from side_by_side_work(works)
    found = min(ends, key=lambda end: end.loss)
    model = replace(tried.model, place=found.place, loss=found.loss)
    bank = np.concatenate([end.tried for end in ends])
    return replace(tried, model=model, training_loss=found.loss, bank=bank)


def refit_and_judge(
    evidence: SplitMeasurement,
    candidates: Sequence[Candidate],
    *,
    seed: int,
    settings: CandidateSettings = DEFAULTS.candidates,
) -> list[Candidate]:
    """Fit candidates by their own sampling errors and judge them on the held-out half.

    Effects that make pixels differ have sampling errors far above those of the model without them, by which
    they would look worse than they are. The repeats that give those of a candidate also tell its error where
    it was fitted so far; candidates far behind the best by that measure go no further.
    """
    if not candidates:
        return []
    found = run_side_by_side([_error_where_fitted(evidence, one, seed=seed) for one in candidates])
    limit = settings.behind * min(error for error, _ in found) + settings.close
    race = CandidateRace(1, settings.loses)
    works = []
    for one, (error, half) in zip(candidates, found, strict=True):
        if error <= limit:
            repeats = settings.few_repeats if error > settings.far else settings.repeats
            works.append(_settle_and_judge(evidence, one, half, repeats, race.over(one.name), seed=seed))
    done = {one.name: one for one in run_side_by_side(works)}
    for _ in range(settings.refits):
        first = min(done.values(), key=_held_out_error)
        least = min(done.values(), key=lambda one: one.model.loss)
        if least is first or least.model.loss > settings.surely * first.model.loss:
            break
        # better where it was fitted, worse where it is judged: it is still on its way
        half = run_work(_error_where_fitted(evidence, least, seed=seed))[1]
        again = _settle_and_judge(evidence, least, half, settings.repeats, None, seed=seed)
        done[least.name] = run_work(again)
    return [done.get(one.name, one) for one in candidates]


def refit_and_judge_far_off(
    evidence: SplitMeasurement,
    candidates: Sequence[Candidate],
    *,
    seed: int,
    settings: CandidateSettings = DEFAULTS.candidates,
) -> list[Candidate]:
    """Do what `refit_and_judge` does beside a present model that is far off, by fits to the scout.

    What more pixels would tell is less than what most candidates leave. Where one comes near the floor, it
    and those that are not clearly behind it are fitted to all pixels of the training half before they are
    judged. So is an effect of few pixels, of which the scout knows nothing.
    """
    many = [one for one in candidates if not is_rare(one)]
    few = [one for one in candidates if is_rare(one)]
    done = refit_and_judge(scout_of(evidence), many, seed=seed, settings=settings)
    least = min((one.error for one in done if one.judgement), default=np.inf)
    limit = max(settings.far, settings.behind * least + settings.close) if least <= settings.far else 0.0
    again = [one for one in done if one.judgement and one.error <= limit]
    known = [one for one in done if one not in again]
    return known + refit_and_judge(evidence, [*again, *few], seed=seed, settings=settings)


def scout_of(evidence: Split) -> Split:
    """Return a measurement of which only the pixels of the scout are fitted."""
    return replace(evidence, train=evidence.scout)


def is_rare(tried: Candidate) -> bool:
    """Whether a candidate acts on so few pixels that the scout does not show it."""
    return acts_on_few_pixels(tried.model.sensor[tried.name])


def _held_out_error(tried: Candidate) -> float:
    return tried.error


def _error_where_fitted(
    evidence: SplitMeasurement, tried: Candidate, *, seed: int
) -> Work[tuple[float, CalibratedSubset]]:
    """Return the error on the training half, and that half with the candidate as its present model."""
    half = yield from calibration_while_fitting(evidence, tried.model, seed=seed)
    return half.judge(seed).error, half


def _settle_and_judge(
    evidence: SplitMeasurement,
    tried: Candidate,
    half: CalibratedSubset,
    repeats: int,
    over: StopRule | None,
    *,
    seed: int,
) -> Work[Candidate]:
    model = yield from refit_work(evidence, tried.model, seed=seed, rounds=1, half=half, over=over)
    judgement = yield from model.judgement_work(
        evidence.held, repeats=repeats, seed=SimulationStream.JUDGE.seed(seed)
    )
    return replace(tried, model=model, judgement=judgement)


def try_effects(
    evidence: CalibratedSplit,
    present: FittedModel,
    effects: Mapping[str, type[Effect]],
    names: Sequence[str],
    *,
    worst: Sequence[str],
    seed: int,
    report: StepProgress,
    far: bool = False,
    settings: CandidateSettings = DEFAULTS.candidates,
) -> list[Candidate]:
    """Try each effect: screen all, fit the best, judge those that chance does not explain.

    Args:
        evidence: The measurement, calibrated by the present model.
        present: The model so far.
        effects: All effects known, by name.
        names: Those that are tried.
        worst: Families in which the present model fails: who helps there is looked at more closely.
        seed: Of every random number.
        report: Told how far it is.
        far: Whether the present model is so far off that candidates are fitted to the scout.
        settings: Numbers by which candidates are chosen.

    Returns:
        Those that were judged in order of their held-out error, then the others.
    """
    variants = [
        v for name in names for v in variants_to_try(evidence, effects[name], idle_bus=settings.idle_bus)
    ]
    order, left = screen_variants(evidence, present, variants, seed=seed, report=report, settings=settings)
    first = finalists_of(order, settings)
    chosen = [*first, *family_specialists(order, first, worst)]
    report(f"fitting {', '.join(one.name for one in chosen)}", 0.5)
    parts = [(evidence, chosen)]
    if far:
        few = [one for one in chosen if is_rare(one)]
        parts = [(scout_of(evidence), [one for one in chosen if one not in few]), (evidence, few)]
    finalists, behind, certain = list[Candidate](), list[Candidate](), list[Candidate]()
    for fitted, some in (part for part in parts if part[1]):
        refined, left_behind = _refine_candidates(fitted, present, some, seed=seed, settings=settings)
        refined = _best_of_each_effect(refined)
        fitted_names = {one.name for one in refined}
        behind += [one for one in _best_of_each_effect(left_behind) if one.name not in fitted_names]
        tested = with_p_values(fitted, present, refined, seed=seed)
        # what chance does as well is not added, whatever its error; few repeats cannot give a small p-value
        significant = max(settings.significant, 1.01 / (1 + len(fitted.train.repeats)))
        certain += [one for one in tested if one.p_value <= significant]
        finalists += tested
    report(f"judging {', '.join(one.name for one in certain)}", 0.75)
    judge = refit_and_judge_far_off if far else refit_and_judge
    done = judge(evidence, certain, seed=seed, settings=settings)
    done += [one for one in finalists if one not in certain]
    done.sort(key=lambda one: (one.error if one.judgement else np.inf, one.p_value))
    names_of_chosen = {one.name for one in chosen}
    return [*done, *behind, *(one for one in order if one.name not in names_of_chosen), *left]


def _refine_candidates(
    evidence: CalibratedSplit,
    present: FittedModel,
    chosen: Sequence[Candidate],
    *,
    seed: int,
    settings: CandidateSettings,
) -> tuple[list[Candidate], list[Candidate]]:
    """Fit candidates, sampled as finely as each needs; return them and those that are far behind.

    A candidate that needs many samples, fast voltage noise above all, takes longer than all others together.
    It is fitted with few of them first, and goes on where that takes it near the best.
    """
    step = evidence.train.frame.step
    most = samples_of_screening(present.sensor, step)

    def refined(candidates: Sequence[Candidate], samples: int) -> list[Candidate]:
        race = CandidateRace(1, settings.gives_up)
        works = [refine_candidate(evidence, one, race, seed=seed, most=samples) for one in candidates]
        return run_side_by_side(works)

    first = refined(chosen, most)
    rough = [one for one in first if samples_per_step(one.model.sensor, step) > most]
    limit = settings.gives_up * min((one.training_loss for one in first), default=np.inf)
    behind = [one for one in rough if one.training_loss > limit]
    # from where screening left them: a coarse fit has made up for events that it had lost between samples
    again = [was for was, one in zip(chosen, first, strict=True) if one in rough and one not in behind]
    return [one for one in first if one not in rough] + refined(again, SAMPLES[-1]), behind


def screen_variants(
    evidence: CalibratedSplit,
    present: FittedModel,
    variants: Sequence[Effect],
    *,
    seed: int,
    report: StepProgress,
    settings: CandidateSettings,
    goal: float = float("inf"),
) -> tuple[list[Candidate], list[Candidate]]:
    """Return candidates in order of their loss on some pixels, and those from which nothing descended.

    Args:
        evidence: The measurement, calibrated.
        present: The model so far.
        variants: Effects at any strength.
        seed: Of every random number.
        report: Told how far it is.
        settings: Numbers by which candidates are chosen.
        goal: Loss above which a descent need not go on.
    """
    screenings = run_side_by_side(
        [screen_effect(evidence, present, effect, seed=seed) for effect in variants],
        lambda share: report("looking at all effects", 0.2 * share),
    )
    unit = max((one.present_loss for one in screenings), default=1.0)
    race = CandidateRace(settings.finalists, goal=goal / unit)
    found = dict[tuple[str, int], Candidate]()
    step = evidence.train.frame.step
    most = samples_of_screening(present.sensor, step)
    works = [
        descend_from_screening(one, race, seed=seed, settings=settings)
        for one in worth_descending(screenings, settings)
    ]
    for tried in run_side_by_side(works, lambda share: report("trying all effects", 0.2 + 0.3 * share)):
        # of the variants of an effect the best stands for it, but one that lost events between the samples of
        # screening is not to be measured by one that lost fewer
        wanted = samples_per_step(tried.model.sensor, step)
        kind = tried.name, wanted if wanted > most else 0
        if kind not in found or tried.screened_loss < found[kind].screened_loss:
            found[kind] = tried
    left = {one.effect.name: one.candidate_at(one.places[0], float(one.losses[0])) for one in screenings}
    first = sorted(found.values(), key=lambda one: one.screened_loss)
    names = {one.name for one in first}
    return first, [tried for name, tried in left.items() if name not in names]


def _best_of_each_effect(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates without those that another variant of the same effect fits better than."""
    best = dict[str, Candidate]()
    for one in sorted(candidates, key=lambda one: one.training_loss):
        best.setdefault(one.name, one)
    return [one for one in candidates if best[one.name] is one]


def finalists_of(
    order: Sequence[Candidate], settings: CandidateSettings = DEFAULTS.candidates
) -> list[Candidate]:
    """Return the candidates that are fitted to all pixels of the training half.

    Where the best explains most of what is wrong, some pixels do not tell it from those near it.

    Args:
        order: Candidates in order of their loss on some pixels.
        settings: How many are fitted.
    """
    # two variants of an effect take the place of one
    names = list(dict.fromkeys(one.name for one in order))[: settings.finalists]
    least = order[0].screened_loss if order else math.inf
    limit = settings.near_best * least if least < settings.explains else 0.0
    return [one for one in order if one.name in names or one.screened_loss <= limit]


def family_specialists(
    order: Sequence[Candidate], first: Sequence[Candidate], worst: Sequence[str]
) -> list[Candidate]:
    """Return those beside the first ones that help most in the families where the present model is worst."""
    out: list[Candidate] = []
    for family in worst:
        best = min(order, key=lambda one: one.family_losses.get(family, float("inf")))
        if best not in first and best not in out:
            out.append(best)
    return out


def with_p_values(
    evidence: CalibratedSplit,
    present: FittedModel,
    candidates: Sequence[Candidate],
    *,
    seed: int,
) -> list[Candidate]:
    """Return candidates with the p-values of what they make of the training loss."""
    scale = evidence.train.scale
    standing = evidence.train.run(present.space, present.place[None], seed=seed)[0]
    p_value = p_value_function(scale, candidates, evidence.train.repeats, standing)
    return [
        replace(one, p_value=p_value(float(scale.loss(standing)) - one.training_loss)) for one in candidates
    ]


def p_value_function(
    scale: ErrorScale, candidates: Sequence[Candidate], repeats: Array, present: Array
) -> Callable[[float], float]:
    """Return the function from a fall of the training loss to its p-value, corrected over all candidates.

    Repeats of the present model stand in for the measurement; each takes the best of everything that was
    tried for any candidate.

    Args:
        scale: Of the training half, by which candidates were fitted.
        candidates: With their banks.
        repeats: Statistics of repeats of the present model on the training half, shape (R, J).
        present: Statistics of the present model as it was compared with the candidates, shape (J,).
    """
    banks = [one.bank for one in candidates if one.bank is not None]
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
