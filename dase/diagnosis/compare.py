"""How far a model of a camera is from a recording, and where."""

from __future__ import annotations

import time
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.cell_descriptions import band_in_words, worst_cells
from dase.diagnosis.settings import DEFAULTS, DiagnosisSettings
from dase.fitting.data_split import SPLIT, SplitMeasurement, split_measurement
from dase.fitting.measurement import Measured, SceneChoice, as_measurement
from dase.fitting.model import model_of
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
        pixels: In each half of the measurement.
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
    measurement = as_measurement(measured, scene, trust)
    model = model.bound_to(measurement.scene)
    evidence = split_measurement(
        measurement.events, measurement.scene, log_eps=model.log_eps, trust=measurement.trust,
        pixels=pixels, seed=seed, device=device,
    )  # fmt: skip
    tell("simulating", 0.3, float("nan"))
    stream = SimulationStream.JUDGE.seed(seed)
    held = model_of(model).calibrate(evidence.held, repeats=settings.repeats, seed=stream)
    judgement = held.judge(stream)
    tell("comparing", 1.0, judgement.error)
    found = comparison_of(evidence, held, judgement, model, seconds=time.perf_counter() - begin)
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


def plain_numbers(half: CalibratedSubset) -> dict[str, tuple[float, float]]:
    """Return measured and simulated values in units that need no explanation."""
    values = half.seen.target, half.repeats.mean(0)
    real, made = (_rate_counts(v) for v in values)
    exposure = half.trials.stimulus.exposure().reshape(KINDS, BANDS)
    time_ = max(float(exposure.sum()), 1e-9)
    rest = max(float(exposure[:RESTING].sum()), 1e-9)
    names = ("OFF", "ON")
    out = {
        f"{names[n]} events [1/(px s)]": (float(real[n].sum() / time_), float(made[n].sum() / time_))
        for n in range(2)
    }
    for n in range(2):
        slow = real[n, :RESTING].sum() / rest, made[n, :RESTING].sum() / rest
        out[f"{names[n]} events at rest [1/(px s)]"] = float(slow[0]), float(slow[1])
    step = 1e3 * half.trials.stimulus.grid.step
    a, b = (_median_interval(_family_counts(v, "intervals"), step) for v in values)
    out["median interval of a pixel [ms]"] = a, b
    a, b = (_mean_lag(v) for v in values)
    out["mean lag behind the light [ms]"] = a, b
    return out


def _family_counts(values: Array, family: str) -> Array:
    return np.maximum(np.exp(values[LAYOUT[family]]) - 3.0, 0.0)


def _rate_counts(values: Array) -> Array:
    return _family_counts(values, "rate").reshape(2, KINDS, BANDS)


def _octave_ends(step: float) -> Array:
    """Return the upper ends of the bins of intervals, in units of `step`."""
    return step * np.concatenate([[0.5], 2.0 ** np.arange(INTERVALS - 1)])


def _median_interval(counts: Array, step: float) -> float:
    """Return the median interval, on a logarithmic scale within its bin."""
    total = counts.reshape(-1, INTERVALS).sum(0)
    if total.sum() == 0:
        return float("nan")
    share = np.concatenate([[0.0], np.cumsum(total) / total.sum()])
    ends = np.log(np.concatenate([[0.25 * step], _octave_ends(step)]))
    return float(np.exp(np.interp(0.5, share, ends)))


def _mean_lag(values: Array) -> float:
    change = values[LAYOUT["lag"]].reshape(LAGS, BANDS).mean(1)
    middle = 0.5 * (np.array(PROBE_TIMES.lags[1:]) + np.array(PROBE_TIMES.lags[:-1]))
    weight = np.maximum(change, 0.0)
    return float(1e3 * (weight * middle).sum() / max(weight.sum(), 1e-12))


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
    both = [_rate_counts(v) for v in (half.seen.target, half.repeats.mean(0))]
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
    ends = _octave_ends(step)
    middle = np.concatenate([[0.35 * step], np.sqrt(ends[:-1] * ends[1:])])
    names = [f"{kin}, {state}" for state in ("moving", "at rest") for kin in ("OFF-OFF", "ON-ON", "opposite")]
    both = [
        _family_counts(v, "intervals").reshape(6, INTERVALS) for v in (half.seen.target, half.repeats.mean(0))
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
