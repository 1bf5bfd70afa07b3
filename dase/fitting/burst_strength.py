"""How strongly frames couple into the events: fitted to the bursts alone.

Bursts last some milliseconds, so what the scene does meanwhile matters little, and a scene that is known
badly does not hide them. Everything else is better fitted without them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Effect
from dase.errors import InputError
from dase.fitting.confidence_intervals import REPEATS, estimate_parameters
from dase.fitting.data_split import (
    SPLIT,
    LeftOut,
    ModelPremises,
    SplitMeasurement,
    split_measurement,
)
from dase.fitting.descent import ranking_work
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, model_of, refit_model, starting_places
from dase.fitting.parameter_space import axes_of
from dase.fitting.scheduler import run_work
from dase.probes.random_streams import SimulationStream
from dase.results import Estimate
from dase.scenes.between_frames import CameraScene
from dase.signatures.burst_times import BurstTimes, find_burst_times
from dase.signatures.find import find_signatures
from dase.signatures.kinds import FRAME_COUPLING
from dase.signatures.result import Signature
from dase.simulation.sensor import Sensor


@dataclass(frozen=True)
class BurstFitSettings:
    """What of a recording a burst is fitted to, and when its strength means something."""

    reach: float = 5e-3
    """Compared before and after an edge [s]: recorded bursts last 1 to 3 ms, and what pixels do without one
    has to be seen, too."""

    left: float = 0.9
    """Share of the bursts' error that may be left: where it hardly falls, the model is too far off all else
    for the strength to mean anything."""


BURST_FIT = BurstFitSettings()


@dataclass(frozen=True)
class BurstStrength:
    """What the bursts say of the effect that makes them.

    Args:
        effect: With the values fitted.
        parameters: `effect.parameter` to its estimate; how uncertain the thresholds are is not in it.
        error_without: Of the bursts, with the sensor as it was, on pixels by which nothing was chosen.
        error_with: The same with the effect.
    """

    effect: Effect
    parameters: Mapping[str, Estimate]
    error_without: float
    error_with: float


def burst_times_of(measurement: Measurement, coupling: Signature) -> BurstTimes | None:
    """Return when the bursts of a measurement come; None where that is not at even times.

    Args:
        measurement: Its events have them; where one edge alone shows, its frames tell the exposure.
        coupling: The signature that was found.
    """
    scene, exposure = measurement.scene, None
    if isinstance(scene, CameraScene):
        lasts = float(np.median(scene.end - scene.begin))
        exposure = lasts if lasts > 0 else None
    return find_burst_times(measurement.events, coupling.details, exposure)


def find_frame_times(measurement: Measurement) -> BurstTimes | None:
    """Return when bursts in step with frames come in a measurement; None where there are none."""
    scene = measurement.scene
    begins = scene.begin if isinstance(scene, CameraScene) else None
    try:
        found = find_signatures(measurement.events, begins=begins).found
    except InputError:
        return None
    for entry in found:
        if entry.name == FRAME_COUPLING:
            return burst_times_of(measurement, entry)
    return None


def follows_frames(sensor: Sensor) -> bool:
    """Whether an effect of a sensor follows a clock that the measurement tells."""
    return any(type(effect).in_step is not Effect.in_step for effect in sensor.effects)


def put_in_step(sensor: Sensor, evidence: SplitMeasurement, *, idle_bus: float = 0.0) -> Sensor:
    """Return the sensor with what follows the frames at the times of a measurement's."""
    observed = evidence.observe(idle_bus=idle_bus)
    for effect in sensor.effects:
        sensor = sensor.with_effect(effect.in_step(observed))
    return sensor


def fit_bursts(
    measurement: Measurement,
    sensor: Sensor,
    kind: type[Effect],
    times: BurstTimes,
    begin: Effect | None = None,
    *,
    pixels: int = SPLIT.pixels,
    plenty: float = math.inf,
    seed: int = 0,
    device: str = "cpu",
) -> BurstStrength | None:
    """Fit the effect that makes the bursts to them; None where they have too few events.

    Args:
        measurement: Events and scene.
        sensor: All else, which is not fitted.
        kind: The effect.
        times: When the bursts come; little else is compared.
        begin: The effect as it was fitted beside another model; None looks for where to begin.
        pixels: In each part of the measurement.
        plenty: Events about the bursts, of one part, from which on a longer time is not looked at.
        seed: Of every random number.
        device: Where kernels run.
    """
    events = measurement.events
    if isinstance(measurement.scene, CameraScene):
        # what is wrong between frames is little beside a burst, and where it is trusted are few of these
        measurement = replace(measurement, trust=everywhere)
    bursts = times.around(float(events.t[0]), float(events.t[-1]), BURST_FIT.reach)

    # of a longer time, so many lie about the bursts
    settings = replace(SPLIT, plenty=plenty / max(float(bursts.contains(events.t).mean()), 1e-6))

    def between_bursts(t: NDArray[np.float64]) -> NDArray[np.bool_]:
        return ~bursts.contains(t)

    try:
        evidence = split_measurement(
            measurement, left_out=LeftOut(between_bursts), models=ModelPremises(sensor.log_eps, frames=times),
            pixels=pixels, seed=seed, device=device, settings=settings,
        )  # fmt: skip
    except InputError:
        return None
    if begin is None:
        tried = kind.candidates(evidence.observe(idle_bus=0.0))
        if not tried:
            return None
        models = [_fitted_to_bursts(evidence, sensor, effect, seed=seed) for effect in tried]
        near = min(models, key=lambda m: m.loss)
    else:  # beside other effects its values change by little, and last steps find them
        near = _effect_alone_free(sensor, begin)
    model, values = estimate_parameters(evidence, near, seed=seed)
    without, with_it = (
        one.judge(evidence.report, repeats=REPEATS // 2, seed=SimulationStream.JUDGE.seed(seed)).error
        for one in (model_of(sensor, ()), model)
    )
    if not with_it < BURST_FIT.left * without:
        return None
    return BurstStrength(model.sensor[kind.name], values, without, with_it)


def everywhere(times: NDArray[np.float64], pixels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Trust in a scene at all times (T,) and pixels (N,), shape (T, N)."""
    return np.ones((len(times), len(pixels)), np.bool_)


def _fitted_to_bursts(
    evidence: SplitMeasurement, sensor: Sensor, effect: Effect, *, seed: int
) -> FittedModel:
    """Return the sensor with the effect, whose parameters alone are fitted."""
    model = _effect_alone_free(sensor, effect)
    stream = SimulationStream.CALIBRATE_FIT.seed(seed)
    half = model.calibrate(evidence.scout, repeats=12, seed=stream)
    places, losses = run_work(ranking_work(half, model.space, starting_places(model, effect), seed=seed))
    found = FittedModel(model.space, places[0], losses[0])
    return refit_model(evidence, found, seed=seed, rounds=1)


def _effect_alone_free(sensor: Sensor, effect: Effect) -> FittedModel:
    """Return the sensor with the effect, at its values, whose parameters alone are free."""
    together = sensor.with_effect(effect)
    free: Sequence[str] = [axis.name for axis in axes_of(together) if axis.effect is type(effect)]
    return model_of(together, free)
