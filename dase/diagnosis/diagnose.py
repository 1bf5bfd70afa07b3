"""Which physical effect a model lacks."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

from dase.diagnosis.candidates import FEW, Candidate, effects_to_try, try_effects
from dase.diagnosis.cell_descriptions import worst_cells
from dase.diagnosis.directional_test import find_hidden_effect
from dase.diagnosis.pruning import prune_model
from dase.diagnosis.state import MATERIAL, REPEATS, TIE, DiagnosisState, explains_remainder, with_same_freedom
from dase.effects import EFFECTS, Effect
from dase.events import Events
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.data_split import PIXELS, split_measurement
from dase.fitting.model import FittedModel, fit_present_model, model_of, refit_model, refit_work
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import Judgement, leaves_nothing, may_be_announced, reaches_floor, worst_families
from dase.probes.stimulus import Trust
from dase.results import Cell, Diagnosis, Estimate, Progress, Rank, Step, Unexplained
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor

SHARE = 0.1
"""Least share of the way to the floor."""

ON_ITS_WAY = 2.0
"""A model with one effect more is judged by fewer simulations where its error is above this, in units of the
gate."""

MOST = 4
"""Effects that are added at most."""

PAIRED = 6
"""Candidates that are tried two at a time where one after the other is not enough."""


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
    evidence = split_measurement(
        events, scene, log_eps=sensor.log_eps, trust=trust, pixels=pixels, seed=seed, device=device
    )
    tell = progress or (lambda text, share, error: None)
    tell("fitting the present model", 0.0, float("nan"))
    search = DiagnosisState(evidence, effects, seed, tell, frozenset(e.name for e in sensor.effects))
    before = model_of(sensor, free).judge(evidence.held, repeats=REPEATS // 2, seed=seed + 500).error
    start = fit_present_model(evidence, sensor, free, seed=seed)
    model, judgement, errors = _add_one_by_one(search, start, most)
    if not reaches_floor(judgement) and most > 0:
        model, judgement = _add_pair(search, start, model, judgement)
    if len(search.added(model)) > 1:
        model, judgement = prune_model(search, model, judgement)
    return _conclude_diagnosis(search, start, model, errors, before, begin)


def _add_one_by_one(
    search: DiagnosisState, model: FittedModel, most: int
) -> tuple[FittedModel, Judgement, list[float]]:
    """Add the best effect as long as one is missing."""
    errors, far = list[float](), False
    for _ in range(most + 1):
        judgement = search.judge(model, repeats=FEW if far else REPEATS)
        errors.append(judgement.error)
        more = len(errors) <= most
        step, better, far = _look_for_effect(search, model, judgement, more)
        if better is None and more and (hidden := find_hidden_effect(search, model, judgement)) is not None:
            step, better = _note_hidden_effect(search, *hidden, step, judgement), hidden[0].model
        search.history.append(step)
        if better is None:
            break
        model = better
    return model, judgement, errors


def _look_for_effect(
    search: DiagnosisState, model: FittedModel, judgement: Judgement, more: bool
) -> tuple[Step, FittedModel | None, bool]:
    """Try all effects.

    Returns:
        What was found, the model with the best of them, None if there is none, and whether that is still far
        from the floor.
    """
    evidence, seed = search.evidence, search.seed
    names = tuple(e.name for e in model.space.sensor.effects)
    cells = worst_cells(evidence, judgement)
    step = Step(names, judgement.error, judgement.gate, judgement.families, (), None, (), cells)
    if leaves_nothing(judgement) or not more:
        return step, None, False
    repeats = model.rebase(evidence.train, repeats=REPEATS, seed=seed + 300)
    model.rebase(evidence.scout, repeats=16, seed=seed + 200)
    open_names = effects_to_try(search.effects, model)
    if not open_names:
        return step, None, False
    tried = try_effects(
        evidence, model, search.effects, open_names, repeats=repeats, worst=worst_families(judgement),
        seed=seed, report=lambda text, share: search.progress(text, share, search.error),
    )  # fmt: skip
    finalists = [t for t in tried if t.judged]
    step = replace(step, ranking=tuple(_rank_of(t, judgement) for t in tried))
    if not search.history:
        search.first = sorted(tried, key=lambda t: t.screened_loss)
    worthy = [t for t in finalists if t.judged and explains_remainder(t.judged, judgement)]
    able = worthy if reaches_floor(judgement) else finalists
    if not able:
        return step, None, False
    best, ties = _simplest_of_the_best(able)
    mine = _rank_of(best, judgement)
    if not reaches_floor(judgement) and (mine.fall < MATERIAL or mine.share < SHARE):
        return step, None, False
    search.note(best, finalists, ties, judgement)
    step = replace(step, chosen=best.name, ties=ties)
    return (
        step,
        refit_model(evidence, best.model, seed=seed, rounds=1),
        best.error > ON_ITS_WAY * judgement.gate,
    )


def _note_hidden_effect(
    search: DiagnosisState, hidden: Candidate, p_value: float, step: Step, judgement: Judgement
) -> Step:
    """Note an effect that only a closer look shows."""
    search.note(hidden, [hidden], (), judgement)
    rank = _rank_of(replace(hidden, p_value=p_value), judgement)
    others = tuple(r for r in step.ranking if r.effect != hidden.name)
    return replace(step, ranking=(rank, *others), chosen=hidden.name)


def _simplest_of_the_best(finalists: Sequence[Candidate]) -> tuple[Candidate, tuple[str, ...]]:
    """Return the best candidate, the simplest of those that are not told apart, and the others of those."""
    first = finalists[0]
    reach = max(TIE, 0.1 * first.error)
    good = first.judged is not None and reaches_floor(first.judged)
    like = [
        t for t in finalists
        if t.error <= first.error + reach and t.judged and (reaches_floor(t.judged) or not good)
    ]  # fmt: skip
    best = min(like, key=lambda t: (len(t.model.place), t.error))
    return best, tuple(t.name for t in like if t.name != best.name)


def _rank_of(tried: Candidate, judgement: Judgement) -> Rank:
    """Return a candidate as the user sees it."""
    fall = judgement.error - tried.error
    share = fall / max(judgement.error - 1.0, 1e-9)
    mine = {
        axis.name: Estimate(*(3 * (float(axis.to_value(place)),)))
        for axis, place in zip(tried.model.space.axes, tried.model.place, strict=True)
        if axis.name.split(".")[0] in tried.name.split(" + ")
    }
    return Rank(tried.name, tried.error, fall, min(share, 1.0), tried.p_value, mine, tried.judged is not None)


def _add_pair(
    search: DiagnosisState, start: FittedModel, model: FittedModel, judgement: Judgement
) -> tuple[FittedModel, Judgement]:
    """Where adding one after the other does not reach the floor, try two at once."""
    evidence, seed = search.evidence, search.seed
    singles = [t for t in search.first if t.screened_loss < 0.98][:PAIRED]
    start.rebase(evidence.scout, repeats=16, seed=seed + 200)
    pairs = list(combinations(singles, 2))
    works = []
    for one, two in pairs:
        both = one.model.sensor.with_effect(two.model.sensor[two.name])
        pair = with_same_freedom(both, start, (one.name, two.name))
        works.append(pair.searching(evidence.scout, seed=seed, iterations=4, radius=0.3))
    ends = run_side_by_side(works, lambda share: search.progress("trying pairs", share, search.error))
    tried = [
        (pair.loss, f"{one.name} + {two.name}", pair) for (one, two), pair in zip(pairs, ends, strict=True)
    ]
    first = sorted(tried, key=lambda t: t[0])[:2]
    settled = run_side_by_side([refit_work(evidence, pair, seed=seed) for _, _, pair in first])
    for (_, name, _), pair in zip(first, settled, strict=True):
        judged = search.judge(pair)
        if judged.error < judgement.error * (1.0 if reaches_floor(judged) else 0.8):
            model, judgement = pair, judged
            search.history.append(_pair_step(search.history[0], name))
    return model, judgement


def _pair_step(first: Step, name: str) -> Step:
    return replace(first, chosen=name, ties=(), ranking=(), cells=())


def _conclude_diagnosis(
    search: DiagnosisState,
    start: FittedModel,
    model: FittedModel,
    errors: list[float],
    before: float,
    begin: float,
) -> Diagnosis:
    """Return what was found; names are announced only where they bring the error to the floor."""
    found = search.added(model)
    chosen = [n for s in search.history if s.chosen for n in s.chosen.split(" + ")]
    order = tuple(dict.fromkeys([*(n for n in chosen if n in found), *found]))
    model, values = estimate_parameters(search.evidence, model, seed=search.seed)
    last = search.judge(model)
    unexplained: Unexplained | None = None
    if not may_be_announced(last):
        cells = worst_cells(search.evidence, last)
        unexplained = _describe_unexplained(search, order, errors[0], last, cells)
    kept = unexplained is None
    path = _errors_after_additions(search, order, errors, last.error) if kept else [errors[0]]
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


def _errors_after_additions(
    search: DiagnosisState, order: tuple[str, ...], errors: list[float], last: float
) -> list[float]:
    """Return the error at the start and after each effect that was kept.

    Effects that came in at once, or in place of another, have no error of their own on the way: it is taken
    to fall to the last error with the first of them.
    """
    after = {step.chosen: e for step, e in zip(search.history, errors[1:], strict=False)}
    path = [errors[0], *(after.get(name, last) for name in order)]
    path[-1] = last
    return path


def _describe_unexplained(
    search: DiagnosisState, nearest: tuple[str, ...], first: float, last: Judgement, cells: tuple[Cell, ...]
) -> Unexplained:
    share = (last.error - 1.0) / max(first - 1.0, 1e-9)
    stand_in = " and ".join(nearest) if nearest else "no effect"
    where = cells[0].sentence if cells else "no single cell stands out"
    sentence = (
        f"unexplained: with {stand_in} an error of {last.error:.2g} is left ({100 * share:.0f} % of the "
        f"error above the floor), which none of the effects known takes to the floor; worst: {where}"
    )
    return Unexplained(last.error, share, nearest, cells, sentence)


def summary_line(found: Diagnosis) -> str:
    """Return the finding in one line."""
    if found.unexplained is not None:
        return found.unexplained.sentence
    if not found.selected:
        return f"nothing is missing: error {found.errors[0]:.2f}, repeats stay below {found.gate:.2f}"
    return f"missing: {', '.join(found.selected)}"
