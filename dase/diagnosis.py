"""Which physical effect a model lacks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

from dase.candidates import Tried, chance_of, open_to, try_all
from dase.confidence import estimates
from dase.effects import EFFECTS, Effect
from dase.error import Judgement, announced, explained, silent, worst_families
from dase.events import Events
from dase.evidence import PIXELS, Evidence, gather
from dase.model import Model, fit_present, free_of, model_of, settle, settling
from dase.results import Cell, Diagnosis, Estimate, Rank, Step, Unexplained
from dase.scene import Scene
from dase.sensor import Sensor
from dase.stimulus import Trust
from dase.together import together
from dase.words import worst_cells

REPEATS = 60
"""Simulations with other seeds that tell what chance does."""

SIGNIFICANT = 0.02
"""Largest p-value of an effect that is added; 1 / (REPEATS + 1) is the smallest there is."""

MATERIAL = 0.3
"""Least fall of the held-out error, in units of the floor."""

HALF = 0.5
"""Where the model counts as right without it, an effect is added only if it leaves no more than chance, and
at most this share of the error."""

SHARE = 0.1
"""Least share of the way to the floor."""

TIE = 0.35
"""Candidates at the floor whose held-out error is within this of the best's are not told apart from it."""

MOST = 4
"""Effects that are added at most."""

PAIRED = 6
"""Candidates that are tried two at a time where one after the other is not enough."""

SWAPPED = 2
"""Alternatives to an effect that are tried in its place once all others are found."""

NEARBY = 1.6
"""Only alternatives whose held-out error was about below this, relative to the chosen one's."""

DROPPED = 4.0
"""An effect is tried to be dropped where the error on the scout without it, quickly fitted, is below this, in
units of the gate."""

QUICK = 2.0
"""Only alternatives whose error on the scout, quickly fitted, is below this, relative to the model's own."""

Progress = Callable[[str, float, float], None]
"""Told what is being done, the share of the step done, and the present error."""


@dataclass
class _Search:
    """What a diagnosis works on."""

    evidence: Evidence
    effects: Mapping[str, type[Effect]]
    seed: int
    progress: Progress
    given: frozenset[str]
    history: list[Step] = field(default_factory=list)
    alternatives: dict[str, list[Tried]] = field(default_factory=dict)
    error_of: dict[str, float] = field(default_factory=dict)
    ties: dict[str, set[str]] = field(default_factory=dict)
    first: list[Tried] = field(default_factory=list)
    error: float = float("nan")

    def judge(self, model: Model) -> Judgement:
        """Return the held-out error of a model; makes it the present one of all halves."""
        judgement = model.judge(self.evidence.held, repeats=REPEATS, seed=self.seed + 500)
        self.error = judgement.error
        self.progress("judging", 0.0, self.error)
        return judgement

    def added(self, model: Model) -> tuple[str, ...]:
        """Return the effects that were added to the given sensor."""
        return tuple(e.name for e in model.space.sensor.effects if e.name not in self.given)


def diagnose(
    events: Events,
    scene: Scene,
    sensor: Sensor | None = None,
    *,
    effects: Mapping[str, type[Effect]] = EFFECTS,
    free: Sequence[str] | None = None,
    trust: Trust | None = None,
    most: int = MOST,
    pixels: int = PIXELS,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the effects that a model of a camera lacks.

    Args:
        events: What was measured.
        scene: What the camera saw, on the clock of the events.
        sensor: The model; None for thresholds alone.
        effects: Candidates, name to class; those of the sensor are left out.
        free: Parameters of the sensor that may be refitted; None for all.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        most: Effects that are added at most.
        pixels: In each half of the measurement.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.

    Raises:
        InputError: Measurement and scene do not fit, or there is too little to say anything.
    """
    begin = time.perf_counter()
    sensor = sensor or Sensor()
    sensor = sensor.bound_to(scene)
    evidence = gather(
        events, scene, log_eps=sensor.log_eps, trust=trust, pixels=pixels, seed=seed, device=device
    )
    tell = progress or (lambda text, share, error: None)
    tell("fitting the present model", 0.0, float("nan"))
    search = _Search(evidence, effects, seed, tell, frozenset(e.name for e in sensor.effects))
    before = model_of(sensor, free).judge(evidence.held, repeats=REPEATS // 2, seed=seed + 500).error
    start = fit_present(evidence, sensor, free, seed=seed)
    model, judgement, errors = _greedy(search, start, most)
    if not explained(judgement) and most > 0:
        model, judgement = _pairs(search, start, model, judgement)
    if len(search.added(model)) > 1:
        model, judgement = _review(search, model, judgement)
    return _verdict(search, start, model, errors, before, begin)


def _greedy(search: _Search, model: Model, most: int) -> tuple[Model, Judgement, list[float]]:
    """Add the best effect as long as one is missing."""
    errors = []
    for _ in range(most + 1):
        judgement = search.judge(model)
        errors.append(judgement.error)
        step, better = _step(search, model, judgement, len(errors) <= most)
        search.history.append(step)
        if better is None:
            break
        model = better
    return model, judgement, errors


def _step(search: _Search, model: Model, judgement: Judgement, more: bool) -> tuple[Step, Model | None]:
    """Try all effects; return what was found and the model with the best of them, None if there is none."""
    evidence, seed = search.evidence, search.seed
    names = tuple(e.name for e in model.space.sensor.effects)
    cells = worst_cells(evidence, judgement)
    step = Step(names, judgement.error, judgement.gate, judgement.families, (), None, (), cells)
    if silent(judgement) or not more:
        return step, None
    repeats = model.rebase(evidence.train, repeats=REPEATS, seed=seed + 300)
    model.rebase(evidence.scout, repeats=16, seed=seed + 200)
    open_names = open_to(search.effects, model)
    if not open_names:
        return step, None
    present = evidence.train.run(model.space, model.place[None], seed=seed)[0]
    scale, base = evidence.train.scale, float(evidence.train.scale.loss(present))
    tried = try_all(
        evidence, model, search.effects, open_names, worst=worst_families(judgement), seed=seed,
        report=lambda text, share: search.progress(text, share, search.error),
    )  # fmt: skip
    p_value = chance_of(scale, tried, repeats, present)
    best, ties = _choose([t for t in tried if t.judged])
    ranking = tuple(_rank(t, judgement, p_value(base - t.fit) if t.judged else 1.0) for t in tried)
    mine = next(rank for rank in ranking if rank.effect == best.name)
    certain = mine.p_value <= max(SIGNIFICANT, 1.01 / (1 + len(repeats)))
    enough = mine.fall >= MATERIAL and mine.share >= SHARE and certain
    if explained(judgement):
        enough = certain and best.judged is not None and _accounts(best.judged, judgement)
    if not search.history:
        search.first = sorted(tried, key=lambda t: t.scouted)
    if enough:
        search.alternatives[best.name] = [t for t in tried if t.judged and t.name != best.name]
        search.error_of[best.name] = best.error
        search.ties[best.name] = set(ties)
    step = replace(step, ranking=ranking, chosen=best.name if enough else None, ties=ties if enough else ())
    return step, settle(evidence, best.model, seed=seed, rounds=1) if enough else None


def _choose(finalists: Sequence[Tried]) -> tuple[Tried, tuple[str, ...]]:
    """Return the best candidate, the simplest of those that are not told apart, and the others of those."""
    first = finalists[0]
    reach = max(TIE, 0.1 * first.error)
    good = first.judged is not None and explained(first.judged)
    like = [
        t for t in finalists
        if t.error <= first.error + reach and t.judged and (explained(t.judged) or not good)
    ]  # fmt: skip
    best = min(like, key=lambda t: (len(t.model.place), t.error))
    return best, tuple(t.name for t in like if t.name != best.name)


def _accounts(judgement: Judgement, without: Judgement) -> bool:
    """Whether an effect explains what a model that counts as right leaves without it.

    That may be the scene's fault, or another simulator's habit, so it must explain most of it.
    """
    return silent(judgement) and judgement.error <= HALF * without.error


def _rank(tried: Tried, judgement: Judgement, p_value: float) -> Rank:
    """Return a candidate as the user sees it."""
    fall = judgement.error - tried.error
    share = fall / max(judgement.error - 1.0, 1e-9)
    mine = {
        axis.name: Estimate(*(3 * (float(axis.to_value(place)),)))
        for axis, place in zip(tried.model.space.axes, tried.model.place, strict=True)
        if axis.name.split(".")[0] in tried.name.split(" + ")
    }
    return Rank(tried.name, tried.error, fall, min(share, 1.0), p_value, mine, tried.judged is not None)


def _pairs(search: _Search, start: Model, model: Model, judgement: Judgement) -> tuple[Model, Judgement]:
    """Where adding one after the other does not reach the floor, try two at once."""
    evidence, seed = search.evidence, search.seed
    singles = [t for t in search.first if t.scouted < 0.98][:PAIRED]
    start.rebase(evidence.scout, repeats=16, seed=seed + 200)
    pairs = list(combinations(singles, 2))
    works = []
    for one, two in pairs:
        both = one.model.sensor.with_effect(two.model.sensor[two.name])
        pair = _like(both, start, (one.name, two.name))
        works.append(pair.searching(evidence.scout, seed=seed, iterations=4, radius=0.3))
    ends = together(works, lambda share: search.progress("trying pairs", share, search.error))
    tried = [
        (pair.loss, f"{one.name} + {two.name}", pair) for (one, two), pair in zip(pairs, ends, strict=True)
    ]
    first = sorted(tried, key=lambda t: t[0])[:2]
    settled = together([settling(evidence, pair, seed=seed) for _, _, pair in first])
    for (_, name, _), pair in zip(first, settled, strict=True):
        judged = search.judge(pair)
        if judged.error < judgement.error * (1.0 if explained(judged) else 0.8):
            model, judgement = pair, judged
            search.history.append(_pair_step(search.history[0], name))
    return model, judgement


def _pair_step(first: Step, name: str) -> Step:
    return replace(first, chosen=name, ties=(), ranking=(), cells=())


def _like(sensor: Sensor, model: Model, more: Sequence[str]) -> Model:
    """Return the model of a sensor with what is free in another model, and in some effects more."""
    names = [a.name for a in model.space.axes if a.name.split(".")[0] in sensor]
    mine = [name for effect in more for name in free_of(sensor, effect)]
    return model_of(sensor, list(dict.fromkeys([*names, *mine])))


def _review(search: _Search, model: Model, judgement: Judgement) -> tuple[Model, Judgement]:
    """Drop effects that are not needed any more, put simpler ones in place of others, and drop again."""
    model, judgement = _drop(search, model, judgement)
    before = model
    for name in search.added(model):
        for other, swap in _rivals(search, model, name).items():
            swapped = settle(search.evidence, swap, seed=search.seed)
            judged = search.judge(swapped)
            if not explained(judged):
                continue
            simpler = len(swapped.place) < len(model.place)
            if simpler or not explained(judgement):
                model, judgement = swapped, judged
                search.ties[other] = {*search.ties.pop(name, set()), name} - {other}
                break
            search.ties.setdefault(name, set()).add(other)
    return _drop(search, model, judgement) if model is not before else (model, judgement)


def _drop(search: _Search, model: Model, judgement: Judgement) -> tuple[Model, Judgement]:
    """Drop effects that are not needed any more."""
    whole = model
    for name, less in _droppable(search, model).items():
        if name not in model.sensor or len(search.added(model)) == 1:
            continue
        less = less if model is whole else _like(model.sensor.without(name), model, ())
        fitted = settle(search.evidence, less, seed=search.seed)
        without = search.judge(fitted)
        # what would not be added now is not kept
        needless = announced(without) and without.error < judgement.error + MATERIAL
        if explained(without):
            needless = silent(without) or not _accounts(judgement, without)
        if needless or without.error <= judgement.error:
            model, judgement = fitted, without
    return model, judgement


def _droppable(search: _Search, model: Model) -> dict[str, Model]:
    """Return the models without one effect that may do: not far off on the scout, quickly fitted.

    Fitting one in full takes as long as trying a dozen; most are far off.
    """
    scout, seed = search.evidence.scout.view(), search.seed
    model.rebase(scout, repeats=16, seed=seed + 200)
    ways = {name: _like(model.sensor.without(name), model, ()) for name in search.added(model)}
    quick = together([way.searching(scout, seed=seed, iterations=2) for way in ways.values()])
    judged = together([way.judging(scout.view(), repeats=16, seed=seed + 500) for way in quick])
    return {
        name: way for name, way, judgement in zip(ways, quick, judged, strict=True)
        if judgement.error < DROPPED * judgement.gate
    }  # fmt: skip


def _promising(search: _Search, model: Model, ways: Mapping[str, Model]) -> dict[str, Model]:
    """Return those models that may do as well as the present one: not far off on the scout."""
    if not ways:
        return {}
    scout = search.evidence.scout.view()
    repeats = model.rebase(scout, repeats=16, seed=search.seed + 200)
    enough = QUICK * float(scout.scale.loss(repeats).mean())
    quick = together([way.searching(scout, seed=search.seed, iterations=2) for way in ways.values()])
    return {name: way for (name, way), q in zip(ways.items(), quick, strict=True) if q.loss < enough}


def _rivals(search: _Search, model: Model, name: str) -> dict[str, Model]:
    """Return the models with an alternative in the place of an effect that may do as well."""
    limit, ways = NEARBY * search.error_of.get(name, 0.0) + TIE, {}
    for other in search.alternatives.get(name, [])[:SWAPPED]:
        if other.name not in model.space.sensor and other.error <= limit:
            sensor = model.sensor.without(name).with_effect(other.model.sensor[other.name])
            ways[other.name] = _like(sensor, model, [other.name])
    return _promising(search, model, ways)


def _verdict(
    search: _Search, start: Model, model: Model, errors: list[float], before: float, begin: float
) -> Diagnosis:
    """Return what was found; names are announced only where they bring the error to the floor."""
    found = search.added(model)
    chosen = [n for s in search.history if s.chosen for n in s.chosen.split(" + ")]
    order = tuple(dict.fromkeys([*(n for n in chosen if n in found), *found]))
    model, values = estimates(search.evidence, model, seed=search.seed)
    last = search.judge(model)
    unexplained: Unexplained | None = None
    if not announced(last):
        cells = worst_cells(search.evidence, last)
        unexplained = _unexplained(search, order, errors[0], last, cells)
    kept = unexplained is None
    path = _staircase(search, order, errors, last.error) if kept else [errors[0]]
    ties = {n: tuple(sorted(search.ties.get(n, set()) - set(found))) for n in order if kept}
    return Diagnosis(
        sensor=model.sensor if kept else start.sensor,
        selected=order if kept else (),
        errors=tuple(path),
        before=before,
        floor=1.0,
        gate=last.gate,
        parameters=values,
        ties={name: others for name, others in ties.items() if others},
        unexplained=unexplained,
        history=tuple(search.history),
        notes=search.evidence.notes,
        evaluations=search.evidence.evaluations,
        seconds=time.perf_counter() - begin,
    )


def _staircase(search: _Search, order: tuple[str, ...], errors: list[float], last: float) -> list[float]:
    """Return the error at the start and after each effect that was kept.

    Effects that came in at once, or in place of another, have no error of their own on the way: it is taken
    to fall to the last error with the first of them.
    """
    after = {step.chosen: e for step, e in zip(search.history, errors[1:], strict=False)}
    path = [errors[0], *(after.get(name, last) for name in order)]
    path[-1] = last
    return path


def _unexplained(
    search: _Search, nearest: tuple[str, ...], first: float, last: Judgement, cells: tuple[Cell, ...]
) -> Unexplained:
    share = (last.error - 1.0) / max(first - 1.0, 1e-9)
    stand_in = " and ".join(nearest) if nearest else "no effect"
    where = cells[0].sentence if cells else "no single cell stands out"
    sentence = (
        f"unexplained: with {stand_in} an error of {last.error:.2g} is left ({100 * share:.0f} % of the "
        f"error above the floor), which none of the effects known takes to the floor; worst: {where}"
    )
    return Unexplained(last.error, share, nearest, cells, sentence)


def summary(found: Diagnosis) -> str:
    """Return the finding in one line."""
    if found.unexplained is not None:
        return found.unexplained.sentence
    if not found.selected:
        return f"nothing is missing: error {found.errors[0]:.2f}, repeats stay below {found.gate:.2f}"
    return f"missing: {', '.join(found.selected)}"
