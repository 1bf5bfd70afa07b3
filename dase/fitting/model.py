"""A model under fit: a sensor, its free parameters, and where they are."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import ANY_SAMPLES, Effect
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.descent import DESCENT, DescentSettings, StopRule, descent_work, ranking_work
from dase.fitting.parameter_space import (
    ParameterSpace,
    SearchAxis,
    axes_of,
    full_axis,
    value_of,
    with_values,
)
from dase.fitting.scheduler import SimulationRequest, Work, answer_requests, run_side_by_side, run_work
from dase.fitting.subset import CalibratedSubset, PixelSubset
from dase.probes.distance import Judgement
from dase.probes.random_streams import SimulationStream
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RefitSettings:
    """How a model is fitted by its own sampling errors."""

    repeats: int = 16
    """Simulations that give a model's sampling errors while it is fitted."""

    descents: int = 3
    """Random numbers of the descents of which the best is taken, as each ends where its own happen to lead;
    by the last ones other rules are tried."""

    alike: float = 2.0
    """Most by which the loss of another phase or rule may grow where it becomes the present one."""


REFIT = RefitSettings()

PHASED = "threshold"
"""Effect that has the phase with which pixels begin."""


@dataclass(frozen=True)
class StartSettings:
    """Where searches begin."""

    thresholds: tuple[float, ...] = (0.04, 0.06, 0.09, 0.12, 0.15, 0.18, 0.22, 0.27, 0.34, 0.45, 0.65)
    """Tried for both polarities when a model is fitted from nothing [log intensity]."""

    ratio: float = 2.2
    """Most that the thresholds of a pixel differ by at the start."""

    shifts: tuple[float, ...] = (-0.7, -0.4, -0.15, 0.0, 0.35)
    """Of the logarithm of the thresholds, when an effect is tried: most effects make events more or fewer."""

    between: float = 0.125
    """Of the same, beside the best of all that were tried: half of the way from one of them to the next."""

    strengths: int = 6
    """Places along a parameter that switches its effect off."""

    margin: float = 0.1
    """Share of the plausible range that is left out at both ends when an effect is tried."""

    turns: int = 8
    """Phases at which what repeats in time is tried: no farther than a sixteenth of a turn from the right
    one."""

    fine_turns: int = 32
    """Phases at which what was fitted is tried once more: no farther than a 64th of a turn from the right
    one."""

    above: float = 0.3
    """Beside a bound that is seen in a measurement, one higher by this is tried, in the units of
    `SearchAxis.to_place`: of a bus, the most events per second are the least it can send."""

    least: float = 0.95
    """Of such a bound, below which no search goes: time stamps and counts round it."""


STARTS = StartSettings()


@dataclass(frozen=True)
class FittedModel:
    """A sensor with free parameters at a place.

    Args:
        space: Free parameters.
        place: Where they are, shape (P,).
        loss: In the fit that found it.
    """

    space: ParameterSpace
    place: Array
    loss: float = np.inf

    @property
    def sensor(self) -> Sensor:
        """The sensor at the place."""
        return self.space.at(self.place)

    def calibrate(self, subset: PixelSubset, *, repeats: int, seed: int) -> CalibratedSubset:
        """Return the pixels with this as their present model, see `PixelSubset.calibration_work`."""
        return run_work(subset.calibration_work(self.space, self.place, repeats=repeats, seed=seed))

    def judge(self, subset: PixelSubset, *, repeats: int, seed: int) -> Judgement:
        """Return the error on some pixels, seen in `repeats` simulations."""
        return run_work(self.judgement_work(subset, repeats=repeats, seed=seed))

    def judgement_work(self, subset: PixelSubset, *, repeats: int, seed: int) -> Work[Judgement]:
        """Do what `judge` does."""
        calibrated = yield from subset.calibration_work(self.space, self.place, repeats=repeats, seed=seed)
        return calibrated.judge(seed)

    def search_work(
        self,
        half: CalibratedSubset,
        *,
        seed: int,
        iterations: int = 4,
        radius: float = 0.2,
        patient: bool = False,
        over: StopRule | None = None,
        settings: DescentSettings = DESCENT,
    ) -> Work[FittedModel]:
        """Return the model with its parameters improved, see `run_side_by_side`."""
        found = yield from descent_work(
            half, self.space, self.place, seed=seed, iterations=iterations, radius=radius, patient=patient,
            over=over, settings=settings,
        )  # fmt: skip
        return replace(self, place=found.place, loss=found.loss)


def model_of(
    sensor: Sensor, free: Sequence[str] | None = None, *, before: FittedModel | None = None
) -> FittedModel:
    """Return the model of a sensor at its own parameters.

    Args:
        sensor: Its fixed parameters, and where the free ones begin.
        free: Names of those that are free, see `axes_of`.
        before: A model whose least values, where a measurement showed them, are kept.
    """
    axes = axes_of(sensor, free)
    if before is not None:
        least = {one.name: one.low for one in before.space.axes if one.fact.search_starts == "above"}
        axes = tuple(replace(one, low=max(one.low, least.get(one.name, one.low))) for one in axes)
    space = ParameterSpace(sensor, axes)
    return FittedModel(space, space.places())


def with_full_range(model: FittedModel) -> FittedModel | None:
    """Return a model whose values may go as far as a fit goes, where one ended where the search for it does.

    None if none did.
    """
    axes, ends = model.space.axes, model.space.bounds()[1]
    stopped = [
        axis.high >= axis.fact.farthest and place > end - 0.05
        for axis, place, end in zip(axes, model.place, ends, strict=True)
    ]
    if not any(stopped):
        return None
    wide = tuple(full_axis(axis) if over else axis for axis, over in zip(axes, stopped, strict=True))
    return replace(model, space=replace(model.space, axes=wide))


def free_where_measured(
    evidence: SplitMeasurement, sensor: Sensor, free: Sequence[str] | None
) -> Sequence[str] | None:
    """Return what is free in a fit to a measurement: where nothing is named, not what it cannot show.

    That is a bus that was idle, and thresholds where light never changes: they only set the unit of what
    crosses them there. Noise, drift and lamps make the same events with thresholds as much larger, and the
    rate of shot noise is in hertz.

    Args:
        evidence: The measurement.
        sensor: Its parameters.
        free: Those that are named; None for all.
    """
    idle = {e.name for e in sensor.readout_effects() if e.is_idle(evidence.highest_event_rate)}
    unseen = {"threshold.on", "threshold.off"} if evidence.light_never_changes else set()
    if free is not None or not (idle or unseen):
        return free
    return [a.name for a in axes_of(sensor) if a.effect.name not in idle and a.name not in unseen]


def with_phase(model: FittedModel, phase: float) -> FittedModel:
    """Return the model with another spread of the pixels' memories at the start."""
    sensor = with_values(model.space.sensor, {"threshold.phase": phase})
    return replace(model, space=replace(model.space, sensor=sensor))


def shift_periodic_effects(
    model: FittedModel, step: float, names: Collection[str] | None = None
) -> list[FittedModel]:
    """Return a model, and for each effect that repeats in time those with it earlier and later.

    What probes tell by steps hardly changes when all events are a step off, so a fit may end there.

    Args:
        model: Whose effects are shifted.
        step: Of the grid of time [s].
        names: Of the effects that are; None for all.
    """
    out = [model]
    for effect in model.sensor.effects:
        if names is not None and effect.name not in names:
            continue
        for seconds in (-step, step):
            place, moved = model.place.copy(), effect.shifted(seconds)
            for n, axis in enumerate(model.space.axes):
                if axis.effect is type(effect) and moved != effect:
                    value = getattr(moved, axis.fact.name)
                    if value != getattr(effect, axis.fact.name):
                        place[n] = axis.to_place(value)
            if not np.array_equal(place, model.place):
                out.append(replace(model, place=place))
    return out


def fit_present_model(
    evidence: SplitMeasurement, sensor: Sensor, free: Sequence[str] | None, *, seed: int
) -> FittedModel:
    """Fit the free parameters of a sensor: a wide look at thresholds and phase, then descents."""
    best = _look_at_thresholds(evidence, sensor, free, seed=seed)
    # each was judged by its own sampling errors; judge both by those of the better one
    half = best[0].calibrate(evidence.train, repeats=12, seed=SimulationStream.CALIBRATE_FIT.seed(seed))
    ends = run_side_by_side([m.search_work(half, seed=seed) for m in best])
    return refit_model(evidence, min(ends, key=lambda m: m.loss), seed=seed, rounds=1)


def fit_roughly(
    evidence: SplitMeasurement, sensor: Sensor, free: Sequence[str] | None, *, seed: int
) -> FittedModel:
    """Fit the free parameters of a sensor to few pixels: a wide look at thresholds and phase, one descent."""
    best = _look_at_thresholds(evidence, sensor, free, seed=seed)[0]
    half = best.calibrate(
        evidence.scout, repeats=REFIT.repeats, seed=SimulationStream.CALIBRATE_FIT.seed(seed)
    )
    return run_work(best.search_work(half, seed=seed))


def _look_at_thresholds(
    evidence: SplitMeasurement, sensor: Sensor, free: Sequence[str] | None, *, seed: int
) -> list[FittedModel]:
    """Return a model at the best of many thresholds with either phase, the better one first."""
    model = model_of(sensor, free)
    looks = [
        _threshold_scan_work(evidence.scout, with_phase(model, phase), seed=seed) for phase in (0.0, 1.0)
    ]
    return sorted(run_side_by_side(looks), key=lambda m: m.loss)


def _threshold_scan_work(subset: PixelSubset, start: FittedModel, *, seed: int) -> Work[FittedModel]:
    """Return the best of many thresholds."""
    half = yield from subset.calibration_work(
        start.space, start.place, repeats=12, seed=SimulationStream.CALIBRATE_FIT.seed(seed)
    )
    places = np.concatenate([start.place[None], _threshold_starts(start)])
    places, losses = yield from ranking_work(half, start.space, places, seed=seed)
    return replace(start, place=places[0], loss=losses[0])


def refit_model(evidence: SplitMeasurement, model: FittedModel, *, seed: int, rounds: int = 2) -> FittedModel:
    """Refit a model by its own sampling errors, which change with it.

    Each of some descents has random numbers of its own, because they end where those happen to lead, and the
    last ones begin with the other phase, or another rule of an effect; the best of them by the random numbers
    of all is taken.
    """
    seeds = [SimulationStream.DESCENT.seed(seed, n) for n in range(REFIT.descents)]
    works = [refit_work(evidence, model, seed=each, rounds=rounds) for each in seeds[:-1]]
    works += [
        _refit_otherwise_work(evidence, other, model, seed=seeds[-1], rounds=rounds)
        for other in ways_otherwise(model)
    ]
    ends = run_side_by_side(works)
    best = _best_of(evidence, ends, seeds, seed=seed)
    given = _rules_of(model)
    if all(_rules_of(end) != given for end in ends):
        # a rule that was left before anything was fitted by it has not been tried
        back = [way for way in ways_otherwise(best) if _rules_of(way) == given]
        works = [_refit_otherwise_work(evidence, way, best, seed=seeds[-1], rounds=rounds) for way in back]
        best = _best_of(evidence, [best, *run_side_by_side(works)], seeds, seed=seed)
    return best


def _best_of(
    evidence: SplitMeasurement, ends: Sequence[FittedModel], seeds: Sequence[int], *, seed: int
) -> FittedModel:
    """Return the best of some fitted models by the random numbers of all of them."""
    half = ends[0].calibrate(
        evidence.train, repeats=REFIT.repeats, seed=SimulationStream.CALIBRATE_FIT.seed(seed)
    )
    values = answer_requests(
        [SimulationRequest(half, m.space, m.place[None], each) for m in ends for each in seeds]
    )
    losses = np.reshape([float(half.scale.loss(value)[0]) for value in values], (len(ends), len(seeds)))
    return ends[int(losses.mean(1).argmin())]


def _rules_of(model: FittedModel) -> dict[str, Any]:
    """Return what of a model's effects is no number under fit, by effect and parameter."""
    free = {axis.name for axis in model.space.axes}
    names = ((effect, field.name) for effect in model.sensor.effects for field in fields(effect))
    return {
        f"{effect.name}.{name}": getattr(effect, name)
        for effect, name in names if f"{effect.name}.{name}" not in free
    }  # fmt: skip


def _refit_otherwise_work(
    evidence: SplitMeasurement, other: FittedModel, model: FittedModel, *, seed: int, rounds: int
) -> Work[FittedModel]:
    """Refit a model by another rule, such as what pixels may have seen before the start.

    Where that is wrong, all else is bent to make up for it, and the right one looks no better before all is
    fitted again.
    """
    half = yield from calibration_while_fitting(evidence, model, seed=seed)
    other = yield from other.search_work(half, seed=seed, iterations=3, patient=True)
    return (yield from refit_work(evidence, other, seed=seed, rounds=rounds))


def calibration_while_fitting(
    evidence: SplitMeasurement, model: FittedModel, *, seed: int
) -> Work[CalibratedSubset]:
    """Return the training half with a model under fit as its present one."""
    return evidence.train.calibration_work(
        model.space, model.place, repeats=REFIT.repeats, seed=SimulationStream.CALIBRATE_FIT.seed(seed)
    )


def ways_otherwise(model: FittedModel, names: Collection[str] | None = None) -> list[FittedModel]:
    """Return the model by other rules of its effects, one at a time.

    Args:
        model: At its place.
        names: Of the effects whose rules are changed; None for all of which something is free, and for the
            phase, which belongs to no camera.
    """
    acting = [effect for effect in model.sensor.effects if not effect.is_off() or effect.name == PHASED]
    free = {PHASED, *(axis.effect.name for axis in model.space.axes)} if names is None else set(names)
    return [
        _with_rule(model, other)
        for effect in acting if effect.name in free
        for other in effect.otherwise([one for one in acting if one.name != effect.name])
    ]  # fmt: skip


def _with_rule(model: FittedModel, other: Effect) -> FittedModel:
    """Return a model with one of its effects by another rule, and what is idle by it not free."""
    same = model.space.sensor.with_effect(other)
    if model.space.sensor.idle_parameters() == same.idle_parameters():
        return replace(model, space=replace(model.space, sensor=same))
    sensor = _with_its_phase(model.sensor.with_effect(other), other)
    return replace(model_of(sensor, still_free(sensor, model), before=model), loss=model.loss)


def ways_by_other_laws(model: FittedModel) -> list[FittedModel]:
    """Return the model by other laws of those of its effects of which something is free, one at a time."""
    free = {axis.effect.name for axis in model.space.axes}
    acting = [effect for effect in model.sensor.effects if effect.name in free and not effect.is_off()]
    return [_with_rule(model, other) for effect in acting for other in effect.by_other_laws()]


def refit_work(
    evidence: SplitMeasurement,
    model: FittedModel,
    *,
    seed: int,
    rounds: int = 2,
    half: CalibratedSubset | None = None,
    over: StopRule | None = None,
) -> Work[FittedModel]:
    """Do what `refit_model` does; `half` is the training half if the model is its present one."""
    for turn in range(rounds):
        if half is None or turn > 0:
            half = yield from calibration_while_fitting(evidence, model, seed=seed)
        ways = [model, *ways_otherwise(model)]
        values = yield [SimulationRequest(half, m.space, m.place[None], seed) for m in ways]
        losses = [float(half.scale.loss(value)[0]) for value in values]
        other = ways[int(np.argmin(losses))]
        if other is not model and (yield from _as_good_work(evidence, other, losses[0], seed=seed)):
            model = other
        model = yield from model.search_work(
            half,
            seed=SimulationStream.FIT.seed(seed, turn),
            radius=0.12 / (1 + turn),
            patient=True,
            over=over,
        )
    return model


def _as_good_work(evidence: SplitMeasurement, model: FittedModel, loss: float, *, seed: int) -> Work[bool]:
    """Whether a model's loss is about as small by its own sampling errors.

    By those of a model with chance in it, one without looks no worse, until it is the present one and its
    repeats are all alike.
    """
    half = yield from calibration_while_fitting(evidence, model, seed=seed)
    (values,) = yield [SimulationRequest(half, model.space, model.place[None], seed)]
    return float(half.scale.loss(values)[0]) < REFIT.alike * loss


def _threshold_starts(model: FittedModel) -> Array:
    at = [n for n, axis in enumerate(model.space.axes) if axis.is_threshold]  # ON comes before OFF
    if len(at) < 2:
        return model.place[None]
    pairs = [
        (a, b) for a, b in product(STARTS.thresholds, repeat=2) if 1 / STARTS.ratio < a / b < STARTS.ratio
    ]
    out = np.repeat(model.place[None], len(pairs), 0)
    for column, values in zip(at, np.array(pairs).T, strict=True):
        out[:, column] = model.space.axes[column].to_place(values)
    return out


def free_of(sensor: Sensor, name: str) -> list[str]:
    """Return the names of the parameters of an effect that a fit may change; there may be none."""
    return [axis.name for axis in axes_of(sensor) if axis.name.split(".")[0] == name]


def still_free(sensor: Sensor, model: FittedModel) -> list[str]:
    """Return the names of what is free in a model and is there in another sensor.

    What changes nothing there is left out, such as a second dark current. Of an effect all of which is free,
    what changes something there alone is in.
    """
    names, idle, before = {axis.name for axis in model.space.axes}, sensor.idle_parameters(), model.sensor
    out = [a.name for a in model.space.axes if a.name.split(".")[0] in sensor and a.name not in idle]
    for effect in sensor.effects:
        usual = free_of(before, effect.name) if effect.name in before else []
        if usual and names.issuperset(usual):
            out += free_of(sensor, effect.name)
    return list(dict.fromkeys(out))


def with_effect_added(present: FittedModel, effect: Effect) -> FittedModel:
    """Return the present model with an effect added, all of whose parameters are free."""
    sensor = _in_step(_with_its_phase(present.sensor.with_effect(effect), effect), effect)
    old = still_free(sensor, present)
    # read off the events of all pixels, what a fit finds only nearby is better than a fit to a few makes it
    new = [axis.name for axis in axes_of(sensor) if axis.effect is type(effect) and axis.fact.nearby is None]
    return _with_least_values(model_of(sensor, [*old, *new], before=present), effect)


def _with_least_values(model: FittedModel, effect: Effect) -> FittedModel:
    """Return a model in whose searches no value of an effect is below the least that a measurement showed."""
    axes = tuple(
        replace(axis, low=max(axis.low, STARTS.least * value_of(model.space.sensor, axis.name)))
        if axis.effect is type(effect) and axis.fact.search_starts == "above"
        else axis
        for axis in model.space.axes
    )
    return replace(model, space=replace(model.space, axes=axes))


def _with_its_phase(sensor: Sensor, effect: Effect) -> Sensor:
    """Return a sensor with the memories' begin that an effect goes with.

    A model without the effect may have them spread, to make up for it, and with that no place of the effect
    looks right.
    """
    return with_values(sensor, {"threshold.phase": 0.0}) if effect.begins_at_the_light() else sensor


def with_fixed_effect(present: FittedModel, effect: Effect) -> FittedModel:
    """Return the present model with an effect added, none of whose parameters is free."""
    return replace(
        present, space=replace(present.space, sensor=present.space.sensor.with_effect(effect)), loss=np.inf
    )


def _in_step(sensor: Sensor, effect: Effect) -> Sensor:
    """Return a sensor whose effects go on at each sample of the scene, where they can, if a new one does.

    Where one rule of another simulator is seen its others are likely, too.
    """
    if effect.longest_step() != ANY_SAMPLES:
        return sensor
    for one in sensor.effects:
        in_step = [other for other in one.otherwise([effect]) if other.longest_step() == ANY_SAMPLES]
        if in_step and one.longest_step() != ANY_SAMPLES:
            sensor = _with_its_phase(sensor.with_effect(in_step[0]), in_step[0])
    return sensor


def starting_places(
    model: FittedModel, effect: Effect, *, few: bool = False, shifts: Sequence[float] | None = None
) -> Array:
    """Return places from which an effect is tried: its strength and its character, at several thresholds.

    Args:
        model: With the effect, at its present place.
        effect: What is tried.
        few: Whether fewer places do.
        shifts: Of the logarithm of the thresholds; None for those that most effects need.

    Returns:
        M places, shape (M, P).
    """
    if shifts is None:
        shifts = STARTS.shifts
    axes = model.space.axes
    others = [e for e in model.space.sensor.effects if e.name != effect.name]
    known = {f"{effect.name}.{name}": value for name, value in effect.stood_in_for(others).items()}
    columns, choices, observed = [], [], False
    for n, axis in enumerate(axes):
        if axis.effect is type(effect):
            columns.append(n)
            observed |= axis.fact.search_starts == "above"
            tried = _starting_places_of_axis(axis, float(model.place[n]))
            tried = tried[::2] if few and axis.main and len(tried) > 2 else tried
            choices.append([*tried, float(axis.to_place(known[axis.name]))] if axis.name in known else tried)
    thresholds = [n for n, axis in enumerate(axes) if axis.is_threshold]
    out = []
    for combination in product(*choices):
        for shift in shifts[1::2] if few and not observed else shifts:
            place = model.place.copy()
            place[columns] = combination
            place[thresholds] += shift
            out.append(place)
    return np.array(out)


def places_in_uneven_light(model: FittedModel, effect: Effect, places: Array) -> Array:
    """Return places at which other effects go with the light that an effect leaves, pixel by pixel.

    Without it the model was fitted to the mean light: intensities at which effects act, as a dark current or
    a knee, have gone up by as much as light is missing, and differences between pixels by chance have taken
    what is by place. With these the effect has nothing to explain, and the way to where they are right leads
    over a ridge.

    Args:
        model: With the effect.
        effect: What is tried.
        places: From which it is tried, shape (M, P).

    Returns:
        N places, shape (N, P); none where all pixels get the same light, or no other effect is concerned.
    """
    axes = [(n, axis) for n, axis in enumerate(model.space.axes) if axis.effect is not type(effect)]
    changed = [(n, axis) for n, axis in axes if axis.fact.unit == "intensity" or axis.fact.over_pixels]
    out = []
    for way in range(len(effect.light_left()) if changed else 0):
        for place in places.copy():
            share = model.space.at(place)[effect.name].light_left()[way]
            for n, axis in changed:
                value = axis.low if axis.fact.over_pixels else share * axis.to_value(place[n])
                place[n] = float(axis.to_place(value))
            out.append(place)
    return np.reshape(out, (len(out), len(model.place)))


def places_of_as_many_events(model: FittedModel, effect: Effect, light: Array) -> Array:
    """Return places from which an effect is tried at thresholds with which as many events come as without it.

    What lowers contrasts, as a dark current does, fits along a valley: the more of it, the lower the
    thresholds. It is narrow where many events tell of them, and the steps of thresholds miss it.

    Args:
        model: With the effect, at its present place.
        effect: What is tried.
        light: Intensities, and what is added before the logarithm, of some pixels on a grid of time,
            shape (N, T).

    Returns:
        M places, shape (M, P); none where the effect leaves all of the swing.
    """
    axes = model.space.axes
    if effect.swing_left(light) == 1.0:
        return np.empty((0, len(axes)))
    thresholds = [n for n, axis in enumerate(axes) if axis.is_threshold]
    strengths = [n for n, axis in enumerate(axes) if axis.effect is type(effect) and axis.main]
    places = starting_places(model, effect, shifts=(0.0,))
    # the valley goes on to the end of what is plausible, and beyond: a descent finds its way along it
    end = places[:1].copy()
    end[:, strengths] = [float(axes[n].to_place(axes[n].fact.plausible[1])) for n in strengths]
    out = np.unique(np.concatenate([places, end]), axis=0)
    for place in out:
        place[thresholds] += math.log(model.space.at(place)[effect.name].swing_left(light))
    return out


def places_between(model: FittedModel, effect: Effect, place: Array) -> Array:
    """Return places between that from which an effect is best tried and those beside it.

    An effect that changes thresholds as well as something else, as a dark current does, fits along a narrow
    valley, which the steps of thresholds and those of its strength may miss.

    Args:
        model: With the effect.
        effect: What is tried.
        place: The best of those that `starting_places` returns, shape (P,).

    Returns:
        M places, shape (M, P); none where its strength is not searched along its range.
    """
    axes = model.space.axes
    strengths = [
        n for n, axis in enumerate(axes)
        if axis.effect is type(effect) and axis.main and axis.fact.search_starts == "spread"
    ]  # fmt: skip
    if len(strengths) != 1:
        return np.empty((0, len(axes)))
    low, high = (float(axes[strengths[0]].to_place(v)) for v in axes[strengths[0]].fact.plausible)
    half = 0.5 * (1 - 2 * STARTS.margin) * (high - low) / (STARTS.strengths - 1)
    thresholds = [n for n, axis in enumerate(axes) if axis.is_threshold]
    out = []
    for along, shift in product((-half, 0.0, half), (-STARTS.between, STARTS.between)):
        out.append(place.copy())
        out[-1][strengths] += along
        out[-1][thresholds] += shift
    return np.array(out)


def places_around(model: FittedModel, name: str) -> Array:
    """Return the places of a model with an effect that repeats in time at all phases.

    Along a phase, what events say has a valley for each step of the samples, and a descent that begins with
    other thresholds ends in any of them.

    Args:
        model: With the effect, fitted but for its phase.
        name: Of the effect.

    Returns:
        M places, shape (M, P); none of an effect that does not repeat.
    """
    out = []
    for n, axis in enumerate(model.space.axes):
        if axis.effect.name == name and axis.fact.periodic:
            for turn in np.linspace(*axis.fact.plausible, STARTS.fine_turns, endpoint=False):
                out.append(model.place.copy())
                out[-1][n] = axis.to_place(turn)
    return np.array(out) if out else np.empty((0, len(model.place)))


def _starting_places_of_axis(axis: SearchAxis, present: float) -> list[float]:
    low, high = (float(axis.to_place(v)) for v in axis.fact.plausible)
    match axis.fact.search_starts:
        case "above":
            return [present, present + STARTS.above]
        case "spread":
            return list(low + (high - low) * np.linspace(STARTS.margin, 1 - STARTS.margin, STARTS.strengths))
        case "turn":
            return [float(place) for place in np.linspace(low, high, STARTS.turns, endpoint=False)]
        case "ends":
            return [present, low + (1 - STARTS.margin) * (high - low)]
        case "value":
            return [present]
