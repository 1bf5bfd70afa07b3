"""The parameters of a sensor from a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from statistics import NormalDist

import numpy as np

from dase.effects.optics_blur import OpticsBlur
from dase.fitting.burst_strength import find_frame_times, follows_frames, put_in_step
from dase.fitting.confidence_intervals import REPEATS, estimate_parameters
from dase.fitting.data_split import SPLIT, ModelPremises, SplitMeasurement, split_measurement
from dase.fitting.measurement import Measured, SceneChoice, as_measurement, lens_of, with_lens
from dase.fitting.model import (
    PHASED,
    REFIT,
    FittedModel,
    fit_present_model,
    free_where_measured,
    model_of,
    refit_model,
    ways_by_other_laws,
    with_full_range,
    with_phase,
)
from dase.fitting.parameter_space import SearchAxis, refuse_idle
from dase.fitting.plain_numbers import plain_numbers
from dase.fitting.scheduler import SimulationRequest, answer_requests
from dase.fitting.screen_limits import notes_on_screen
from dase.fitting.search_ends import is_where_it_began, parameters_at_bounds
from dase.probes.distance import Judgement
from dase.probes.random_streams import Draw, SimulationStream
from dase.probes.stimulus import Trust
from dase.results import Estimate, Fit, Progress, is_worse
from dase.scenes.screen_scene import ScreenScene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor


@dataclass(frozen=True)
class FitSettings:
    """How many starts a fit has, and when they agree."""

    other_starts: int = 2
    """Starts beside the wide look at thresholds."""

    most_starts: int = 5
    """The same where no two starts come to the same error."""

    agree: float = 3.0
    """Starts agree where their ends lie within so many half-widths of the confidence interval."""

    near: float = 0.08
    """They agree as well where they lie within this of each other, in the units of `SearchAxis.to_place`."""

    phase_told: float = 1.05
    """A measurement tells the phase where the other makes the error or the loss so many times as large."""


FIT = FitSettings()


def fit(
    measured: Measured,
    sensor: Sensor | str | PathLike[str],
    *,
    scene: SceneChoice | None = None,
    free: Sequence[str] | None = None,
    trust: Trust | None = None,
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Fit:
    """Fit the parameters of a sensor to a measurement.

    Args:
        measured: A recording or its path, a `Measurement`, or events; see `as_measurement`.
        sensor: Its effects are fitted, nothing is added: a sensor, a preset's name, or a sensor file's path.
        scene: What the camera saw, on the clock of the events: a scene, a clip's path, `static` for light
            that does not change, or the JSON of a stimulus that was shown. None for the frames of the
            recording; events alone need one.
        free: Effects or `effect.parameter` that are fitted; None for all.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        pixels: In each part of the measurement.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.

    Raises:
        InputError: Measurement and scene do not fit, or there is too little to say anything.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text, share, error: None)
    start = as_sensor(sensor)
    model_of(start, free)  # refuses names that are not there before anything takes time
    refuse_idle(start, free)
    measurement = as_measurement(measured, scene, trust).through_lens_of(start)
    scene, lens = measurement.scene, lens_of(start)
    start = start.without(OpticsBlur.name).bound_to(scene)
    follows = follows_frames(start)
    frames = find_frame_times(measurement) if follows else None
    untold = follows and frames is None
    premises = ModelPremises(start.log_eps, frames=frames, unbroken=start.unbroken)
    evidence = split_measurement(measurement, models=premises, pixels=pixels, seed=seed, device=device)
    start = put_in_step(start, evidence)
    free = free_where_measured(evidence, start, free)
    given = model_of(start, free)
    # by the part that nothing is chosen by: the starts that are compared below are chosen by another
    before = given.judge(evidence.report, repeats=REPEATS // 2, seed=SimulationStream.JUDGE.seed(seed)).error
    ends = _descend_from_starts(evidence, start, free, seed, lambda text, share: tell(text, share, before))
    if (wide := with_full_range(_best_end(ends)[1])) is not None:
        # where a search stops for the time it takes, a fit goes on
        wide = refit_model(evidence, wide, seed=seed)
        judged = wide.judge(evidence.held, repeats=REPEATS, seed=SimulationStream.JUDGE.seed(seed))
        ends.append((judged, wide))
    judgement, model = _best_end(ends)
    model = with_phase_given(evidence, model, start, seed=seed)
    tell("confidence intervals", 0.9, judgement.error)
    good = [one for one in _equally_good_models(ends) if one.space.names == model.space.names]
    model, values = estimate_parameters(evidence, model, seed=seed)
    stream = SimulationStream.JUDGE.seed(seed)
    report = model.calibrate(evidence.report, repeats=REPEATS, seed=stream)
    judgement = report.judge(stream)
    stuck = is_where_it_began(model, given) and judgement.error > judgement.gate
    plain = plain_numbers(report)
    apart = notes_on_disagreement(model, good, values)
    values = widen_intervals(model, good, values)
    if isinstance(scene, ScreenScene):
        values = widen_by_gamma(values, scene)
    notes = [
        *_notes_on_held_out_error(judgement, before),
        *evidence.notes,
        *(["no bursts come in step with frames: the times of `exposure` stay as given"] if untold else []),
        *_notes_on_rules(start, model.sensor),
        *_notes_on_phase(start, model.sensor),
        *apart,
        *(["no descent left the start: the values are those that were given"] if stuck else []),
        *parameters_at_bounds(model, values),
        *notes_on_implausible_values(model),
        *_notes_on_minimum(judgement, len(ends), len(good)),
        *(notes_on_screen(model.sensor, scene.stimulus) if isinstance(scene, ScreenScene) else []),
    ]
    found = Fit(
        sensor=with_lens(model.sensor, lens),
        parameters=values,
        error=judgement.error,
        before=before,
        floor=1.0,
        gate=judgement.gate,
        agree=not apart and len(good) > 1,
        poor=len(good) < 2,
        notes=tuple(notes),
        evaluations=evidence.evaluations,
        seconds=time.perf_counter() - begin,
        plain=plain,
        contradiction=evidence.contradiction,
    )
    return measurement.noted(found)


Ends = list[tuple[Judgement, FittedModel]]


def _descend_from_starts(
    evidence: SplitMeasurement,
    sensor: Sensor,
    free: Sequence[str] | None,
    seed: int,
    tell: Callable[[str, float], None],
) -> Ends:
    """Return where several starts end, each with its held-out error."""
    tell("a wide look", 0.1)
    model = refit_model(evidence, fit_present_model(evidence, sensor, free, seed=seed), seed=seed)
    ways = [model, *(refit_model(evidence, way, seed=seed) for way in ways_by_other_laws(model))]
    # starts that end alike are starts by one law: the others are given up here
    stream = SimulationStream.JUDGE.seed(seed)
    ends = [_best_end([(way.judge(evidence.held, repeats=REPEATS, seed=stream), way) for way in ways])]
    for n in range(FIT.most_starts):
        if n >= FIT.other_starts and len(_equally_good_models(ends)) > 1:
            break
        tell(f"start {n + 2}", 0.3 + 0.6 * n / FIT.most_starts)
        own = SimulationStream.FIT.seed(seed, n)
        model = refit_model(evidence, _move_away(_best_end(ends)[1], own), seed=own)
        ends.append(
            (model.judge(evidence.held, repeats=REPEATS, seed=SimulationStream.JUDGE.seed(seed)), model)
        )
    return ends


def _best_end(ends: Ends) -> tuple[Judgement, FittedModel]:
    return min(ends, key=lambda pair: pair[0].error)


def _equally_good_models(ends: Ends) -> list[FittedModel]:
    """Return the ends whose error is about that of the best."""
    least = _best_end(ends)[0].error
    return [model for judged, model in ends if judged.error < max(1.25 * least, least + 0.25)]


def _notes_on_rules(before: Sensor, after: Sensor) -> list[str]:
    """Return a sentence for each word of an effect that the fit has changed."""
    return [
        f"{effect.name}.{name} is {getattr(after[effect.name], name)} instead of {getattr(effect, name)}, "
        "which fits better"
        for effect in before.effects for name in effect.choices()
        if getattr(after[effect.name], name) != getattr(effect, name)
    ]  # fmt: skip


def with_phase_given(
    evidence: SplitMeasurement, model: FittedModel, given: Sensor, *, seed: int
) -> FittedModel:
    """Return a model with the phase of the sensor that was given, unless the measurement tells another.

    The phase acts at the start alone. Of a long recording that is so little that chance leads a search to
    either, while other scenes, which may be short, are simulated with the sensor that is found. It is judged
    by the sampling errors of both: those of pixels that begin alike are small, and where memories are spread
    a model without looks no worse.
    """
    phase = _phase_of(given)
    if _phase_of(model.sensor) == phase:
        return model
    ways = model, with_phase(model, phase)
    stream = SimulationStream.JUDGE.seed(seed)
    halves = [one.calibrate(evidence.held, repeats=REPEATS, seed=stream) for one in ways]
    here, there = (half.judge(stream).error for half in halves)
    seeds = [SimulationStream.DESCENT.seed(seed, n) for n in range(REFIT.descents)]
    values = answer_requests(
        [SimulationRequest(halves[0], one.space, one.place[None], each) for one in ways for each in seeds]
    )
    losses = np.reshape([float(halves[0].scale.loss(value)[0]) for value in values], (2, -1)).mean(1)
    told = there > FIT.phase_told * here or losses[1] > FIT.phase_told * losses[0]
    return ways[0] if told else ways[1]


def _phase_of(sensor: Sensor) -> float:
    phase: float = sensor[PHASED].phase  # type: ignore[attr-defined]
    return phase


def _notes_on_phase(before: Sensor, after: Sensor) -> list[str]:
    """Return what is to be said of a phase that the fit has changed."""
    phase, given = _phase_of(after), _phase_of(before)
    if phase == given:
        return []
    return [
        f"threshold.phase is {phase:g} instead of {given:g}: so the recording began, which is no property of "
        "the camera; set it to 1 for scenes that are cut out of time"
    ]


def _notes_on_minimum(judgement: Judgement, starts: int, good: int) -> list[str]:
    """Return what is to be said of a minimum that may be a poor one, and of an error that stays."""
    out = []
    if good < 2:
        out.append(
            f"a poor minimum is possible: of {starts} starts only one came to this error; "
            "record more motion, or free fewer parameters"
        )
    if judgement.error > judgement.gate:
        out.append(
            f"the error stays at {judgement.error:.2g}, above {judgement.gate:.2g}: "
            "the model lacks something, which dase diagnose looks for"
        )
    return out


def _move_away(model: FittedModel, seed: int) -> FittedModel:
    """Return the model well away from where it is."""
    rng = Draw.FAR_START.generator(seed)
    low, high = model.space.bounds()
    place = np.clip(model.place + rng.choice([-0.5, 0.5], len(model.place)), low, high)
    return replace(model, place=place)


def notes_on_disagreement(
    best: FittedModel, ends: Sequence[FittedModel], values: dict[str, Estimate]
) -> list[str]:
    """Return a sentence for each parameter in which equally good ends differ."""
    out = []
    for n in _disagreeing_axes(best, ends, values):
        axis = best.space.axes[n]
        found = ", ".join(f"{float(axis.to_value(p)):.3g}" for p in sorted(m.place[n] for m in ends))
        out.append(f"{axis.name}: starts end at {found}; the data do not say which")
    return out


def _disagreeing_axes(
    best: FittedModel, ends: Sequence[FittedModel], values: dict[str, Estimate]
) -> list[int]:
    """Return the indices of the axes on which equally good ends are apart."""
    out = []
    for n, axis in enumerate(best.space.axes):
        low, high = (float(axis.to_place(v)) for v in (values[axis.name].low, values[axis.name].high))
        if np.ptp([m.place[n] for m in ends]) > max(FIT.agree * 0.5 * (high - low), FIT.near):
            out.append(n)
    return out


def widen_intervals(
    best: FittedModel, ends: Sequence[FittedModel], values: dict[str, Estimate]
) -> dict[str, Estimate]:
    """Return estimates whose intervals reach all ends where equally good ends differ.

    An interval beside one end says what the data tell near that end; where others are as good, it is not all
    that the data leave open.
    """
    out = dict(values)
    for n in _disagreeing_axes(best, ends, values):
        axis, estimate = best.space.axes[n], values[best.space.axes[n].name]
        found = [float(axis.to_value(m.place[n])) for m in ends]
        low, high = min(estimate.low, *found), max(estimate.high, *found)
        out[axis.name] = replace(estimate, low=low, high=high)
    return out


def widen_by_gamma(values: dict[str, Estimate], scene: ScreenScene) -> dict[str, Estimate]:
    """Return estimates whose thresholds are as uncertain as the gamma of the screen makes them.

    All changes of log light go in proportion to the gamma, and so do thresholds.
    """
    # an interval of 90 % goes that many standard errors to either side
    out, share = dict(values), NormalDist().inv_cdf(0.95) * scene.gamma_error / scene.gamma
    for name in ("threshold.on", "threshold.off"):
        if name in out and share > 0:
            e = out[name]
            low, high = (math.hypot(end - e.value, share * e.value) for end in (e.low, e.high))
            out[name] = replace(e, low=e.value - low, high=e.value + high)
    return out


def _notes_on_held_out_error(judgement: Judgement, before: float) -> list[str]:
    if not is_worse(judgement.error, before, judgement.gate):
        return []
    return [
        f"the fit does not generalise: on pixels and time that it has not seen its error is "
        f"{judgement.error:.2f}, that of the sensor as it was given {before:.2f}; keep that one"
    ]


def notes_on_implausible_values(model: FittedModel) -> list[str]:
    """Return a sentence for each parameter beyond its plausible range; a phase goes round, and has none."""
    return [
        f"{axis.name} = {value:.3g} {axis.fact.unit} lies outside its plausible range, "
        f"{axis.fact.plausible[0]:g} to {axis.fact.plausible[1]:g}"
        for axis, value in _values_of_axes(model)
        if not axis.fact.periodic
        and not axis.fact.plausible[0] * 0.999 <= value <= axis.fact.plausible[1] * 1.001
    ]


def _values_of_axes(model: FittedModel) -> list[tuple[SearchAxis, float]]:
    return [(a, float(a.to_value(p))) for a, p in zip(model.space.axes, model.place, strict=True)]
