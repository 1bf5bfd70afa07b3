"""How far a model of a camera is from a recording, and where."""

from __future__ import annotations

import time
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.cell_descriptions import band_in_words, worst_cells
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.effects.optics_blur import OpticsBlur
from dase.fitting.data_split import SPLIT, ModelPremises, SplitMeasurement, split_measurement
from dase.fitting.measurement import Measured, SceneChoice, as_measurement, lens_of, with_lens
from dase.fitting.model import model_of
from dase.fitting.plain_numbers import family_counts, octave_ends, plain_numbers, rate_counts
from dase.fitting.subset import CalibratedSubset
from dase.kernels.event_probes import BANDS, INTERVALS, KINDS, LAGS, RESTING
from dase.probes.accumulators import PROBE_TIMES
from dase.probes.distance import Judgement
from dase.probes.random_streams import SimulationStream
from dase.probes.statistics import LAYOUT
from dase.probes.stimulus import Trust
from dase.results import Comparison, Curve, Progress
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor

Array = NDArray[np.float64]


def compare(
    measured: Measured,
    sensor: Sensor | str | PathLike[str],
    *,
    scene: SceneChoice | None = None,
    trust: Trust | None = None,
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
    settings: DiagnosisSettings = DEFAULTS,
) -> Comparison:
    """Compare a model with a measurement, as it is: nothing is fitted.

    Args:
        measured: A recording or its path, a `Measurement`, or events; see `as_measurement`.
        sensor: The model, a preset's name, or the path of a sensor file.
        scene: What the camera saw, on the clock of the events: a scene, a clip's path, or `static` for light
            that does not change. None for the frames of the recording; events alone need one.
        trust: Where and when the scene is to be trusted; None for everywhere, and for what a
            `CameraScene` trusts of itself.
        pixels: In each part of the measurement; up to ten times as many where these have too few events.
        seed: Of every random number.
        device: Where kernels run.
        progress: Told how far it is.
        settings: Of which the number of repeats is taken.

    Raises:
        InputError: Measurement and scene do not fit, or there is too little to say anything.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text, share, error: None)
    tell("reading the measurement", 0.0, float("nan"))
    model = as_sensor(sensor)
    measurement = as_measurement(measured, scene, trust).through_lens_of(model)
    lens = lens_of(model)
    model = model.without(OpticsBlur.name).bound_to(measurement.scene)
    premises = ModelPremises(model.log_eps, unbroken=model.unbroken)
    evidence = split_measurement(measurement, models=premises, pixels=pixels, seed=seed, device=device)
    tell("simulating", 0.3, float("nan"))
    stream = SimulationStream.JUDGE.seed(seed)
    # nothing is free: a value beyond all that a search would try is compared as it is
    held = model_of(model, []).calibrate(evidence.held, repeats=settings.repeats, seed=stream)
    judgement = held.judge(stream)
    tell("comparing", 1.0, judgement.error)
    found = comparison_of(
        evidence, held, judgement, with_lens(model, lens), seconds=time.perf_counter() - begin
    )
    return measurement.noted(found)


def comparison_of(
    evidence: SplitMeasurement,
    held: CalibratedSubset,
    judgement: Judgement,
    sensor: Sensor,
    *,
    seconds: float,
) -> Comparison:
    """Return the comparison with the present model of the held-out half.

    Args:
        evidence: The measurement.
        held: Its held-out half, calibrated by the model.
        judgement: Of that half.
        sensor: The model.
        seconds: Time it took [s].
    """
    return Comparison(
        sensor=sensor,
        error=judgement.error,
        floor=1.0,
        gate=judgement.gate,
        families=judgement.families,
        cells=worst_cells(evidence, judgement),
        plain=plain_numbers(held),
        curves=family_curves(evidence, held),
        notes=evidence.notes,
        seconds=seconds,
    )


def family_curves(evidence: SplitMeasurement, half: CalibratedSubset) -> dict[str, tuple[Curve, ...]]:
    """Return what figures are drawn from, by family; the present model of `half` is compared."""
    return {
        "rate": _rate_curves(evidence, half),
        "intervals": _interval_curves(half),
        "lag": _lag_curves(evidence, half),
    }


def _rate_curves(evidence: SplitMeasurement, half: CalibratedSubset) -> tuple[Curve, ...]:
    exposure = np.maximum(half.trials.stimulus.exposure().reshape(KINDS, BANDS), 1e-9)
    middle = np.array([-0.4, -0.12, 0.0, 0.12, 0.4])
    out = []
    both = [rate_counts(v) for v in (half.seen.target, half.repeats.mean(0))]
    sigma = half.seen.sigma[LAYOUT["rate"]].reshape(2, KINDS, BANDS)
    for n in range(BANDS):
        for p, polarity in enumerate(("OFF", "ON")):
            measured, simulated = (c[p, RESTING:, n] / exposure[RESTING:, n] for c in both)
            error = sigma[p, RESTING:, n] * (both[0][p, RESTING:, n] + 3) / exposure[RESTING:, n]
            out.append(
                Curve(f"{polarity} events, {band_in_words(evidence, n)}", middle, "change of light in 16 ms",
                      "events per pixel and second", measured, simulated, error)
            )  # fmt: skip
    return tuple(out)


def _interval_curves(half: CalibratedSubset) -> tuple[Curve, ...]:
    step = half.trials.stimulus.grid.step * 1e3
    ends = octave_ends(step)
    middle = np.concatenate([[0.35 * step], np.sqrt(ends[:-1] * ends[1:])])
    names = [f"{kin}, {state}" for state in ("moving", "at rest") for kin in ("OFF-OFF", "ON-ON", "opposite")]
    both = [
        family_counts(v, "intervals").reshape(6, INTERVALS) for v in (half.seen.target, half.repeats.mean(0))
    ]
    sigma = half.seen.sigma[LAYOUT["intervals"]].reshape(6, INTERVALS)
    return tuple(
        Curve(f"Intervals {name}", middle, "interval [ms]", "events", both[0][n], both[1][n],
              sigma[n] * (both[0][n] + 3), log_x=True, log_y=True)
        for n, name in enumerate(names)
    )  # fmt: skip


def _lag_curves(evidence: SplitMeasurement, half: CalibratedSubset) -> tuple[Curve, ...]:
    times = np.array(PROBE_TIMES.lags)
    width = 1e3 * np.diff(times)
    middle = 1e3 * 0.5 * (times[1:] + times[:-1])
    both = [v[LAYOUT["lag"]].reshape(LAGS, BANDS) for v in (half.seen.target, half.repeats.mean(0))]
    sigma = half.seen.sigma[LAYOUT["lag"]].reshape(LAGS, BANDS)
    return tuple(
        Curve(f"Light before an event, {band_in_words(evidence, n)}", middle, "time before the event [ms]",
              "change of log intensity per ms", both[0][:, n] / width, both[1][:, n] / width,
              sigma[:, n] / width)
        for n in range(BANDS)
    )  # fmt: skip
