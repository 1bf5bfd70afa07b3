"""An effect added to a sensor and fitted: what the error was without it, and what it is with it."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike

from dase.diagnosis.blurred_lens import behind_lens, best_width, error_of_choice
from dase.diagnosis.candidates import calibrate_split, screen_and_descend
from dase.diagnosis.settings import DEFAULTS
from dase.effects import Effect
from dase.effects.optics import SceneEffect
from dase.effects.optics_blur import OpticsBlur
from dase.errors import InputError
from dase.fitting.data_split import SPLIT, ModelPremises, split_measurement
from dase.fitting.fit import fit
from dase.fitting.measurement import (
    Measured,
    Measurement,
    SceneChoice,
    as_measurement,
    lens_of,
    with_lens,
)
from dase.fitting.model import fit_present_model
from dase.probes.random_streams import SimulationStream
from dase.probes.stimulus import Trust
from dase.results import Fit
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor


def fit_added(
    measured: Measured,
    sensor: Sensor | str | PathLike[str],
    effect: Effect,
    *,
    scene: SceneChoice | None = None,
    trust: Trust | None = None,
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[str, float, float], None] | None = None,
) -> tuple[float, Fit]:
    """Add an effect to a sensor and fit all its parameters to a measurement.

    Args:
        measured: A recording or its path, a `Measurement`, or events; see `as_measurement`.
        sensor: Without the effect; a sensor, a preset's name, or the path of a sensor file.
        effect: Its values are where the search begins, among others.
        scene: What the camera saw, on the clock of the events: a scene, a clip's path, or `static` for light
            that does not change. None for the frames of the recording; events alone need one.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        pixels: In each part of the measurement; up to ten times as many where these have too few events.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.

    Returns:
        Held-out error of the sensor without the effect, fitted as well as it can be, and the fit with it.

    Raises:
        InputError: Measurement and scene do not fit, or what acts on pictures is no lens before a clip.
    """
    tell = progress or (lambda text, share, error: None)
    without = as_sensor(sensor)
    measurement = as_measurement(measured, scene, trust).through_lens_of(without)
    lens = lens_of(without)
    without = without.without(OpticsBlur.name).bound_to(measurement.scene)
    effect = effect.bound_to(measurement.scene)
    if isinstance(effect, SceneEffect):
        effect = _as_lens_before_clip(effect, measurement)
    premises = ModelPremises(without.log_eps, unbroken=without.unbroken or effect.unbroken)
    evidence = split_measurement(measurement, models=premises, pixels=pixels, seed=seed, device=device)
    tell("fitting without the effect", 0.0, float("nan"))
    present = fit_present_model(evidence, without, None, seed=seed)
    before = present.judge(
        evidence.report, repeats=DEFAULTS.repeats // 2, seed=SimulationStream.JUDGE.seed(seed)
    ).error
    tell(f"where to begin with {effect.name}", 0.1, before)
    if isinstance(effect, OpticsBlur):

        def left(width: float) -> float:
            seen = behind_lens(measurement, width)
            behind = split_measurement(seen, models=premises, pixels=pixels, seed=seed, device=device)
            return error_of_choice(behind, fit_present_model(behind, without, None, seed=seed), seed=seed)

        found = with_lens(without, OpticsBlur(sigma=best_width(left) or effect.sigma))
        return before, fit(measurement, found, pixels=pixels, seed=seed, device=device, progress=progress)
    # far from where it is, a descent could end in the wrong place
    calibrated = calibrate_split(
        evidence, present, repeats=DEFAULTS.repeats, scout_repeats=DEFAULTS.scout_repeats, seed=seed
    )
    start = with_lens(screen_and_descend(calibrated, present, effect, seed=seed).model.sensor, lens)
    fitted = fit(measurement, start, pixels=pixels, seed=seed, device=device, progress=progress)
    return before, fitted


def _as_lens_before_clip(effect: SceneEffect, measurement: Measurement) -> OpticsBlur:
    """Return what acts on pictures as the lens before a clip that it has to be to be fitted.

    Raises:
        InputError: It is another effect, or the scene is no clip, or one behind a lens already.
    """
    if not isinstance(effect, OpticsBlur):
        raise InputError(f"{effect.name} acts on pictures, and cannot be fitted: add it without a recording")
    if not isinstance(measurement.scene, VideoScene) or measurement.scene.sharp is not None:
        raise InputError(
            f"{effect.name} can be fitted where the scene is a clip, which knows no lens: what else is known "
            "of a scene, such as a camera's own frames, is as blurred as the events"
        )
    return effect
