"""What is behind the pixels of a model under trial: what the probes feel of it, events that go through."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects.stream import SharedReader, StreamEffect
from dase.events import Events
from dase.fitting.bus_load import BusLoad
from dase.fitting.trial_sampling import samples_per_step_of_rows
from dase.kernels import launch, pixel_stages
from dase.probes.stimulus import Stimulus
from dase.probes.timestamp_patterns import TimestampStructure
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_run import SensorRun


def noticeable_effects(
    stimulus: Stimulus,
    structure: TimestampStructure,
    sensor: Sensor,
    *,
    highest_rate: float = math.inf,
    least_delay: float = 0.25,
) -> tuple[StreamEffect, ...]:
    """Return the effects behind the pixels that the probes can feel.

    Small errors of the time stamps are far below the steps of the grid; they matter only where their
    regularities are compared.

    Args:
        stimulus: What the pixels see.
        structure: Regularities of the measured time stamps.
        sensor: Whose effects.
        highest_rate: Most events per second that were measured, of the whole sensor [Hz].
        least_delay: Delays up to this are not felt, in steps of the grid.
    """
    fine = least_delay * stimulus.grid.step
    lines = max(stimulus.width, stimulus.height)
    compared = structure.step > 0 or structure.line > 0
    return tuple(
        e
        for e in sensor.readout_effects()
        if not e.is_idle(highest_rate) and (compared or e.longest_delay(lines) > fine)
    )


def clock_of(effects: tuple[StreamEffect, ...], structure: TimestampStructure) -> float | None:
    """Return the ticks of a clock that is all the probes feel behind the pixels [s], 0 for nothing.

    The kernel stamps events by such a clock itself. None where events have to be stored and go through what
    is behind the pixels.
    """
    if not effects:
        return 0.0
    period = effects[0].clock_period() if len(effects) == 1 else None
    # where the measurement has another regularity, the shares of events that follow it have to be counted
    same = structure.line == 0 and structure.step in (0.0, period)
    return period if same else None


def simulate_pixels(
    stimulus: Stimulus,
    sensor: Sensor,
    vectors: NDArray[Any],
    seeds: NDArray[np.int64],
    finer: NDArray[np.int64] | None = None,
) -> list[Events]:
    """Return the events that leave the pixels, of each model.

    Args:
        stimulus: What the pixels see.
        sensor: Its effects; those behind the pixels are left out.
        vectors: Parameters of the models, shape (B, P).
        seeds: Of the models, shape (B,).
        finer: Samples that each takes per step, shape (B,); None for as many as it needs.
    """
    if finer is None:
        finer = np.maximum(samples_per_step_of_rows(sensor, vectors, stimulus.grid.step), 1)
    # what is behind the pixels goes over all of them, see `pass_readout`
    bare = replace(sensor, effects=tuple(e for e in sensor.effects if not isinstance(e, StreamEffect)))
    kind = "cuda" if stimulus.device.is_cuda else "cpu"
    # a model that sends more is run again; on a CPU room costs nothing before it is used
    room = 64 if kind == "cuda" else 2048  # events per pixel

    def out(rows: slice) -> list[Events]:
        scene = scenes[int(finer[rows.start])]
        return SensorRun(
            scene, bare, pixels=stimulus.pixels, parameters=vectors[rows],
            seed=int(seeds[rows.start]), device=str(stimulus.device), events_per_pixel=room,
            chunk=len(scene.times) if scene.light is not None else stimulus.grid.steps,
        ).events()  # fmt: skip

    # the light between the steps is worked out once for all models that take as many samples
    scenes = {each: _StimulusScene(stimulus, each) for each in np.unique(finer).tolist()}

    # a GPU takes all models in one launch, if they have one clock and one seed
    if kind == "cuda" and np.all(seeds == seeds[0]) and np.all(finer == finer[0]):
        return out(slice(0, len(seeds)))
    if kind == "cuda":
        return [events for n in range(len(seeds)) for events in out(slice(n, n + 1))]
    works = [partial(out, rows) for rows in _rows_at_a_time(stimulus, seeds, finer)]
    return [events for some in launch.run_concurrently(works) for events in some]


def _rows_at_a_time(stimulus: Stimulus, seeds: NDArray[np.int64], finer: NDArray[np.int64]) -> list[slice]:
    """Return the models of each run on a CPU, which are B by their seeds and samples per step, shape (B,).

    Those of one seed and as many samples share what it takes to begin a run, which is as long as simulating a
    small one. All threads get as many, after the first, which `run_concurrently` does before the others.
    """
    samples = len(stimulus.pixels) * stimulus.grid.steps * finer
    most = max(1, -(-(len(seeds) - 1) // launch.thread_count()))
    # rows of a run have one seed, and one scene with as many samples as the first of them takes
    out, first = [slice(0, 1)], 1
    for n in range(2, len(seeds) + 1):
        alike = n < len(seeds) and seeds[n] == seeds[first] and finer[n] == finer[first]
        if not alike or n - first == most or (n - first + 1) * samples[first] > SAMPLES_OF_A_RUN:
            out.append(slice(first, n))
            first = n
    return out


SAMPLES_OF_A_RUN = 1 << 22
"""Samples of pixels of models that are simulated together: events of more are not sorted in the caches."""


def pass_readout(
    stimulus: Stimulus,
    events: Events,
    effects: Iterable[StreamEffect],
    seed: int,
    load: BusLoad | None = None,
) -> Events:
    """Return what leaves the sensor.

    The pixels are some of a sensor's. What the others send over a bus that all share is `load`. Where that is
    not known, for lack of a scene that all pixels see, the bus is given as much of its bandwidth and of its
    queue as these pixels are of all: right while it is full or free, not between.
    """
    until, weight = math.inf, None if load is None else load.weight(events)
    share = len(stimulus.pixels) / (stimulus.width * stimulus.height)
    before: list[StreamEffect] = []
    for effect in effects:
        reader = effect.reader(stimulus.width, stimulus.height, seed)
        # what others send holds these up, in the order of time; else a part of the bus is theirs alone
        if load is not None and weight is not None and isinstance(reader, SharedReader):
            events = reader.beside(events, load.others(before, seed), weight)
        else:
            reader = effect.for_share(share).reader(stimulus.width, stimulus.height, seed)
            events, until = reader.push(events, until)
        before.append(effect)
    return replace(events, t=events.t + stimulus.grid.begin)


class _StimulusScene(Scene):
    """The light of a stimulus as a scene, from time 0, some samples per step."""

    def __init__(self, stimulus: Stimulus, finer: int):
        self._stimulus, self._finer = stimulus, finer
        self.width, self.height = stimulus.width, stimulus.height
        points = (stimulus.grid.steps - 1) * finer + 1
        self.times: NDArray[np.float64] = np.float64(stimulus.grid.step / finer) * np.arange(points)
        self.duration = float(self.times[-1])
        self.light = stimulus.finer_light(finer)

    def sample_times(self) -> NDArray[np.float64]:
        return self.times

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        out = pixel_stages.Frames()
        # a run that is not cut into chunks takes the light as it lies on the device
        if self.light is not None and len(times) == len(self.times):
            out.values = self.light
        else:
            points = np.searchsorted(self.times, times)
            light = np.ascontiguousarray(self._stimulus.light_at(points, self._finer).T)
            out.values = wp.array(light, dtype=float, device=device)
        return "frames", out

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        raise NotImplementedError("some pixels are no picture")
