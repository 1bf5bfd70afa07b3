"""How many events a sensor sends as one of its parameters varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.effects import EFFECTS
from dase.errors import InputError, nearest
from dase.formatting import fit_to_screen
from dase.scenes.scene import Scene
from dase.scenes.video import as_scene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor
from dase.simulation.sensor_run import SensorRun, sample_times


@dataclass(frozen=True, repr=False)
class Sweep:
    """Rates of events for each value of a parameter.

    Args:
        name: The parameter, as `effect.parameter`.
        unit: Of the values; "1" is a ratio.
        values: What it was set to, shape (V,).
        on: ON events [1/pixel/s], shape (V,).
        off: OFF events [1/pixel/s], shape (V,).
        counts: Events of each pixel, OFF in channel 0 and ON in channel 1, int32, shape (V, 2, N).
    """

    name: str
    unit: str
    values: NDArray[np.float64]
    on: NDArray[np.float64]
    off: NDArray[np.float64]
    counts: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        """Return a table with a line for each value."""
        head = (f"{self.name} [{self.unit}]", "ON [1/pixel/s]", "OFF [1/pixel/s]")
        rows = [
            tuple(f"{number:.4g}" for number in row)
            for row in zip(self.values, self.on, self.off, strict=True)
        ]
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        return fit_to_screen(
            "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))
            for row in (head, *rows)
        )


def sweep(
    scene: Scene | ArrayLike,
    sensor: Sensor | str | PathLike[str],
    name: str,
    values: ArrayLike,
    *,
    fps: float | None = None,
    times: ArrayLike | None = None,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
) -> Sweep:
    """Simulate a scene with one parameter of the sensor set to one value after the other.

        print(dase.sweep(frames, "davis346", "threshold.on", [0.1, 0.2, 0.4], fps=1000))

    All values share their random numbers, so that differences are the parameter's. They run in one launch
    where they can be sampled at the same times and act in the pixels; readout, optics, and whatever asks for
    finer sampling run one value after the other, with the same result. What all pixels share (`dase.count`
    says what) is left out, unless its own parameters are swept.

    Args:
        scene: What the sensor sees: a scene, or frames; see `dase.stream`.
        sensor: What it does: a `Sensor`, the name of a preset, or the path of a sensor file.
        name: `effect.parameter` of an effect that the sensor has, or `sensor.log_eps`.
        values: In the parameter's unit and within its bounds, shape (V,).
        fps: Frames per second, for frames.
        times: Times of the frames [s], shape (F,), instead of `fps`.
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate, shape (N,); None for all.

    Raises:
        InputError: The sensor has no such effect or parameter, or a value is out of its bounds.
    """
    seen, model = as_scene(scene, fps=fps, times=times), as_sensor(sensor)
    levels = np.atleast_1d(np.asarray(values, np.float64))
    if levels.ndim != 1 or len(levels) == 0:
        raise InputError(f"sweep: values must have shape (V,), V >= 1, got {np.shape(values)}")
    unit = _unit_of(model, name)
    variants = [_with_value(model, name, float(level)) for level in levels]
    span = seen.sample_times()[[0, -1]]
    if not span[1] > span[0]:
        raise InputError("sweep: the scene must last longer than 0 s")

    effect = name.partition(".")[0]
    is_left_out = effect in model and not all(effect in one.by_single_pixels() for one in variants)

    def count(given: Sensor, parameters: NDArray[np.float32] | None) -> NDArray[np.int32]:
        run = SensorRun(seen, given, pixels=pixels, parameters=parameters, seed=seed, device=device)
        return (run.count_leaving if is_left_out else run.count)(span)[:, 0]

    if _can_run_at_once(seen, variants, name):
        counts = count(variants[0], np.stack([variant.parameters() for variant in variants]))
    else:
        counts = np.concatenate([count(variant, None) for variant in variants])
    off, on = counts.sum(2, dtype=np.int64).T / (counts.shape[2] * float(span[1] - span[0]))
    return Sweep(name, unit, levels, on, off, counts)


def _can_run_at_once(scene: Scene, variants: Sequence[Sensor], name: str) -> bool:
    """Whether sensors differ only in what a launch takes as parameter vectors.

    Sample times and the way out of the camera belong to a whole launch: a value that changes them (a lamp's
    frequency asks for finer sampling, a latency of zero for no queue) needs a launch of its own.
    """
    first = variants[0]
    if name not in first.parameter_names():
        return False
    step = sample_times(scene, first)
    return all(
        np.array_equal(sample_times(scene, variant), step)
        and variant.changes_event_stream() == first.changes_event_stream()
        for variant in variants[1:]
    )


def _unit_of(sensor: Sensor, name: str) -> str:
    """Return the unit of a parameter of the sensor; raises InputError unless it has it."""
    effect, dot, parameter = name.partition(".")
    if not dot or not parameter:
        raise InputError(f"sweep: name must be effect.parameter, such as threshold.on, got '{name}'")
    if name == "sensor.log_eps":
        return "1"
    if effect not in sensor:
        own = [e.name for e in sensor.effects]
        if effect in EFFECTS:
            raise InputError(
                f"sweep: sensor '{sensor.name}' has no effect '{effect}'; add it before, as in "
                f"sensor.with_effect(dase.EFFECTS['{effect}']()), or choose one that it has: {', '.join(own)}"
            )
        raise InputError(f"sweep: sensor '{sensor.name}' has no effect '{effect}': {nearest(effect, own)}")
    units = {p.name: p.unit for p in sensor[effect].parameters()}
    if parameter not in units:
        raise InputError(
            f"sweep: effect '{effect}' has no parameter '{parameter}': {nearest(parameter, units)}"
        )
    return units[parameter]


def _with_value(sensor: Sensor, name: str, value: float) -> Sensor:
    """Return the sensor with one parameter set; raises InputError for a value out of its bounds."""
    effect, _, parameter = name.partition(".")
    if effect == "sensor":
        return replace(sensor, log_eps=value)
    return sensor.with_effect(replace(sensor[effect], **{parameter: value}))
