"""Trying effects that a model does not have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dase.descent import screening
from dase.effects.base import Effect
from dase.effects.flicker import Flicker
from dase.effects.optics import SceneEffect
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.timestamp import Timestamp
from dase.error import Judgement, Scale
from dase.evidence import Evidence, Half
from dase.model import SETTLED, Model, added, settling, starts
from dase.space import variants
from dase.together import Ask, Work, alone, beside, together

Array = NDArray[np.float64]

FINALISTS = 4
"""Candidates that are fitted to all pixels of the training half."""

SECOND = 1.25
"""A second start is followed where its loss is below this, relative to the first."""

BEHIND = 2.0
"""A finalist goes on where its error before the last fit is at most this times the best's, and `CLOSE`."""

CLOSE = 1.0
"""Such an error that is added to the limit, for errors near the floor say little."""

AGAIN = 2
"""Times at most that a finalist is fitted further whose training loss is least but not its held-out error."""

SURELY = 0.8
"""Its training loss, relative to that of the finalist with the least held-out error."""

IDLE = 0.01
"""Share of what a bus can send below which it is no candidate: it would lose less than that."""

REPEATS = 30
"""Simulations with other seeds by which a finalist is judged."""


@dataclass(frozen=True, eq=False)
class Tried:
    """One candidate.

    Args:
        name: Of the effect, names joined by ` + ` for a pair.
        model: With the effect, fitted.
        fit: Its loss where it was fitted.
        scouted: Its loss on some of the pixels, relative to that of the present model.
        families: The same by family.
        judged: Its error on the held-out half; None where it was only screened.
        bank: Statistics of all that was tried on the training half, shape (M, J).
    """

    name: str
    model: Model
    fit: float
    scouted: float = float("nan")
    families: Mapping[str, float] = field(default_factory=dict)
    judged: Judgement | None = None
    bank: Array | None = None

    @property
    def error(self) -> float:
        """The held-out error, NaN where it was only screened."""
        return self.judged.error if self.judged else float("nan")


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
        if evidence.busiest < IDLE * evidence.fastest:
            return []
        # events come as fast as the bus can send them, if it ever was full
        return [replace(e, rate=evidence.busiest) for e in variants(effect) if isinstance(e, Readout)]
    return variants(effect)


def rare(effect: Effect) -> bool:
    """Whether an effect acts on a share of the pixels: a few hundred of them do not show it."""
    return any(p.name == "share" for p in effect.parameters())


def scout(evidence: Evidence, present: Model, effect: Effect, *, seed: int) -> Tried:
    """Try one effect on some pixels: a look at many places, then a short descent from the best two."""
    return alone(scouting(evidence, present, effect, seed=seed))


def scouting(evidence: Evidence, present: Model, effect: Effect, *, seed: int) -> Work[Tried]:
    """Do what `scout` does, see `together`."""
    half = evidence.train if rare(effect) else evidence.scout
    model = added(present, effect)
    slow = half.slow(model.space)
    (before,) = yield [Ask(half, present.space, present.place[None], seed)]
    places, losses = yield from screening(half, model.space, starts(model, effect, few=slow), seed=seed)
    apart = np.flatnonzero((np.abs(places - places[0]).max(1) > 0.8) & (losses < SECOND * losses[0]))
    picks = [0, *apart[: 0 if slow or rare(effect) else 1]]
    ends = yield from beside(
        [
            replace(model, place=places[n], loss=losses[n]).exploring(
                half, seed=seed, iterations=3, radius=0.25
            )
            for n in picks
        ]
    )
    best = min(ends, key=lambda found: found.loss)
    share = best.loss / float(half.scale.loss(before[0]))
    was, now = half.scale.families(before[0]), half.scale.families(best.values)
    families = {name: value / max(was[name], 1e-9) for name, value in now.items()}
    return Tried(effect.name, replace(model, place=best.place, loss=best.loss), best.loss, share, families)


def refining(evidence: Evidence, tried: Tried, *, seed: int) -> Work[Tried]:
    """Fit a candidate to all pixels of the training half, by the sampling errors of the present model."""
    # a finalist that is still on its way would be judged by where it happens to be
    half = evidence.train.loaded(tried.model.space, tried.model.place)
    ways = turned(tried.model, half.frame.step)
    ends = yield from beside(
        [way.exploring(half, seed=seed, iterations=3, radius=0.2, patient=True) for way in ways]
    )
    found = min(ends, key=lambda end: end.loss)
    model = replace(tried.model, place=found.place, loss=found.loss)
    bank = np.concatenate([end.tried for end in ends])
    return replace(tried, model=model, fit=found.loss, bank=bank)


def turned(model: Model, step: float) -> list[Model]:
    """Return a model, and where it has a lamp, also those with the lamp a step of the grid earlier and later.

    What probes tell by steps hardly changes when all events are a step off, so a fit may end there.
    """
    names = [axis.name for axis in model.space.axes]
    if "flicker.phase" not in names:
        return [model]
    at = names.index("flicker.phase")
    turn = step * model.sensor["flicker"].frequency  # type: ignore[attr-defined]
    out = [model]
    for phase in (-turn, turn):
        place = model.place.copy()
        value = float(model.space.axes[at].to_value(place[at])) + phase
        place[at] = model.space.axes[at].to_place((value + 1.0) % 2.0 - 1.0)
        out.append(replace(model, place=place))
    return out


def judge_alone(evidence: Evidence, tried: Sequence[Tried], *, seed: int) -> list[Tried]:
    """Fit candidates by their own sampling errors and judge them on the held-out half.

    Effects that make pixels differ have sampling errors far above those of the model without them, by which
    they would look worse than they are. The repeats that give those of a candidate also tell its error where
    it was fitted so far; candidates far behind the best by that measure go no further.
    """
    looks = [_looking(evidence, t, seed=seed) for t in tried]
    found = together(looks)
    limit = BEHIND * min(error for error, _ in found) + CLOSE
    works = [
        _judging(evidence, t, half, seed=seed)
        for t, (error, half) in zip(tried, found, strict=True) if error <= limit
    ]  # fmt: skip
    done = {t.name: t for t in together(works)}
    for _ in range(AGAIN):
        first, least = (min(done.values(), key=key) for key in (_error, lambda t: t.model.loss))
        if least is first or least.model.loss > SURELY * first.model.loss:
            break
        # better where it was fitted, worse where it is judged: it is still on its way
        half = alone(_looking(evidence, least, seed=seed))[1]
        done[least.name] = alone(_judging(evidence, least, half, seed=seed))
    return [done.get(t.name, t) for t in tried]


def _error(tried: Tried) -> float:
    return tried.error


def _looking(evidence: Evidence, tried: Tried, *, seed: int) -> Work[tuple[float, Half]]:
    """Return the error on the training half, and that half with the candidate as its present model."""
    half = evidence.train.view()
    values = yield from half.rebasing(tried.model.space, tried.model.place, repeats=SETTLED, seed=seed + 100)
    return half.judge(values, seed=seed).error, half


def _judging(evidence: Evidence, tried: Tried, half: Half, *, seed: int) -> Work[Tried]:
    model = yield from settling(evidence, tried.model, seed=seed, rounds=1, half=half)
    judged = yield from model.judging(evidence.held.view(), repeats=REPEATS, seed=seed + 500)
    return replace(tried, model=model, judged=judged)


def try_all(
    evidence: Evidence,
    present: Model,
    effects: Mapping[str, type[Effect]],
    names: Sequence[str],
    *,
    worst: Sequence[str],
    seed: int,
    report: Report,
) -> list[Tried]:
    """Try each effect; return the finalists in order of their held-out error, then the others.

    `worst` are the families in which the present model fails; who helps there is looked at more closely. The
    training half and the scout must have been rebased to the present model; finalists take their place.
    """
    all_variants = [v for name in names for v in prepared(evidence, effects[name])]
    found: dict[str, Tried] = {}
    looks = [scouting(evidence, present, effect, seed=seed) for effect in all_variants]
    for tried in together(looks, lambda share: report("trying all effects", 0.5 * share)):
        if tried.name not in found or tried.scouted < found[tried.name].scouted:
            found[tried.name] = tried
    order = sorted(found.values(), key=lambda t: t.scouted)
    chosen = [*order[:FINALISTS], *specialists(order, worst)]
    report(f"fitting {', '.join(t.name for t in chosen)}", 0.5)
    finalists = together([refining(evidence, tried, seed=seed) for tried in chosen])
    report(f"judging {', '.join(t.name for t in chosen)}", 0.75)
    done = judge_alone(evidence, finalists, seed=seed)
    done.sort(key=lambda t: t.error if t.judged else np.inf)
    return [*done, *(t for t in order if t not in chosen)]


def specialists(order: Sequence[Tried], worst: Sequence[str]) -> list[Tried]:
    """Return those beside the first ones that help most in the families where the present model is worst."""
    out: list[Tried] = []
    for family in worst:
        best = min(order, key=lambda t: t.families.get(family, float("inf")))
        if best not in order[:FINALISTS] and best not in out:
            out.append(best)
    return out


def chance_of(
    scale: Scale, tried: Sequence[Tried], repeats: Array, present: Array
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
