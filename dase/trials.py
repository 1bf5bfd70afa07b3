"""Many models over one stimulus: from parameter vectors to sums of statistics; the same of a measurement."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects import EFFECTS
from dase.effects.optics import SceneEffect
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.stream import StreamEffect
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.events import Events
from dase.kernels import launch, pixel, trials
from dase.kernels import probes as kernels
from dase.pixels import Pixels
from dase.probes import Sums
from dase.scene import Scene
from dase.sensor import Sensor
from dase.stimulus import Stimulus
from dase.structure import Structure

LAG_TIMES = (-0.003, -0.001, 0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.028, 0.044, 0.063)
"""Before an event [s] at which its light is looked at; the differences of neighbours are averaged."""

CLASS_TIMES = (0.012, 0.05)
"""Intervals between two events are short, middle or long, divided by these [s]."""

HALF = 0.064
"""The halves of the time take turns after this [s]."""

SLACK = 2e-6
"""Files give whole microseconds: an event up to this after a point of the grid belongs to it [s]."""

GROUP = 64
"""Pixels whose events are summed up together on a CPU; on a GPU every pixel has a thread."""

FELT = 0.25
"""Delays below this share of a step of the grid are not felt."""

FINEST = 2
"""Samples per step of the grid at most: models that ask for more are simulated a little too coarsely."""

ALONE = 1
"""Effects up to which a sensor has a kernel of its own, up to twice as fast. Those with more share one that
has all effects: it is compiled once, and not for each of hundreds of combinations."""

ROOM = 1 << 28
"""Memory for the sums of one launch [bytes]."""


def finer_steps(sensor: Sensor, step: float) -> int:
    """Return how many samples per step the model needs, 0 where those at changes of the light do."""
    longest = sensor.longest_step()
    return 0 if longest == np.inf else int(np.clip(np.ceil(step / longest - 1e-6), 1, FINEST))


@dataclass(eq=False)
class Trials:
    """Runs models over a stimulus.

    Args:
        stimulus: What the pixels see.
        middle: Typical change of the light between two events, shape (4 CLASSES,).
        structure: Regularities of the measured time stamps.
        evaluations: Models run so far.
        work: Pixels times seconds run so far.
    """

    stimulus: Stimulus
    middle: NDArray[np.float32] = field(default_factory=lambda: np.zeros(4 * kernels.CLASSES, np.float32))
    structure: Structure = field(default_factory=Structure)
    evaluations: int = 0
    work: float = 0.0
    _kernels: dict[Any, tuple[wp.Kernel, NDArray[np.float32], list[int]]] = field(
        default_factory=dict, repr=False
    )

    def __post_init__(self) -> None:
        self.device = self.stimulus.device
        self._pixels = wp.array(self.stimulus.pixels, dtype=int, device=self.device)

    def run(
        self,
        sensor: Sensor,
        vectors: NDArray[Any],
        *,
        seed: int = 0,
        reseed: bool = False,
        finer: int | None = None,
    ) -> Sums:
        """Simulate parameter vectors of a sensor.

        Args:
            sensor: Names the effects; its own parameters do not matter but for the sampling.
            vectors: Shape (B, P).
            seed: Of the random numbers.
            reseed: Whether each vector gets random numbers of its own.
            finer: Samples per step; None chooses by the sensor.
        """
        finer = finer_steps(sensor, self.stimulus.grid.step) if finer is None else finer
        history = self.stimulus.history(finer)
        kernel, base, at = self._kernel(sensor)
        at_once = max(1, ROOM // (4 * len(self.stimulus.pixels) * (kernels.SIZE // self._group() + 80)))
        parts = []
        for first in range(0, len(vectors), at_once):
            part = vectors[first : first + at_once]
            rows = np.repeat(base[None], len(part), 0)
            rows[:, at] = part
            sink = self.sink(len(rows), reseed=reseed)
            inputs = [
                history, self._pixels, self.stimulus.width, self.stimulus.height, (seed + first) & 0x3FFFFFFF,
                wp.array(rows, dtype=float, device=self.device),
                *sensor.maps(self.stimulus.pixels, self.device), sink,
            ]  # fmt: skip
            count = len(self.stimulus.pixels)
            launch.run(kernel, count, inputs, self.device, batch=len(rows), align=GROUP)
            parts.append(self._totals(sink, len(rows)))
        self.evaluations += len(vectors)
        grid = self.stimulus.grid
        self.work += len(vectors) * len(self.stimulus.pixels) * grid.step * (grid.steps - 1)
        return Sums.join(parts)

    def _kernel(self, sensor: Sensor) -> tuple[wp.Kernel, NDArray[np.float32], list[int]]:
        """Return the kernel of a sensor, a parameter vector for it, and the places of the sensor's own."""
        key = tuple((e.name, *(getattr(e, name) for name in e.choices())) for e in sensor.effects)
        if key not in self._kernels:
            stages = sensor.stages()
            wide = whole(sensor) if len(stages) > ALONE else sensor
            names = wide.parameter_names()
            at = [names.index(name) for name in sensor.parameter_names()]
            self._kernels[key] = trials.compose(wide.stages()), wide.parameters(), at
        return self._kernels[key]

    def look(self, events: Events) -> Sums:
        """Sum up stored events; those of other pixels are left out."""
        time, polarity, start = self._by_pixel(events)
        sink = self.sink(1)
        arrays = [
            wp.array(start[None].astype(np.int32), device=self.device),
            wp.array(time, dtype=wp.int64, device=self.device),
            wp.array(polarity, dtype=wp.uint8, device=self.device),
        ]
        launch.run(
            kernels.walk, len(self.stimulus.pixels), [*arrays, sink], self.device, batch=1, align=GROUP
        )
        found = self._totals(sink, 1)
        return replace(found, stamps=self.structure.shares(self._mine(events))[None])

    def felt(self, sensor: Sensor) -> tuple[StreamEffect, ...]:
        """Return the effects behind the pixels that the probes can feel.

        Small errors of the time stamps are far below the steps of the grid; they matter only where their
        regularities are compared.
        """
        fine = FELT * self.stimulus.grid.step
        lines = max(self.stimulus.width, self.stimulus.height)
        compared = self.structure.step > 0 or self.structure.line > 0
        return tuple(e for e in sensor.streams() if compared or delay_of(e, lines) > fine)

    def stream(
        self, sensor: Sensor, vector: NDArray[Any], effects: Iterable[StreamEffect], *, seed: int
    ) -> Sums:
        """Simulate one parameter vector with effects behind the pixels, and sum up what leaves.

        The pixels are some of a sensor's. A bus that all pixels share is given as much of its bandwidth and
        of its queue as they are of all pixels: right for streams, not for single collisions.
        """
        stimulus = self.stimulus
        width, height = stimulus.width, stimulus.height
        bare = replace(sensor, effects=tuple(e for e in sensor.effects if not isinstance(e, StreamEffect)))
        array = Pixels(
            bare, width, height, pixels=stimulus.pixels, parameters=np.atleast_2d(vector), seed=seed,
            device=str(self.device),
        )  # fmt: skip
        scene = _Light(stimulus)
        parts = [array.emit(scene, scene.times)[0], array.flush()[0]]
        share = len(stimulus.pixels) / (width * height)
        readers = [scaled(effect, share).reader(width, height, seed) for effect in effects]
        events = Events.concatenate(parts)
        until = math.inf
        for reader in readers:
            events, until = reader.push(events, until)
        self.evaluations += 1
        return self.look(replace(events, t=events.t + stimulus.grid.begin))

    def _mine(self, events: Events) -> Events:
        """Return the events of the pixels, within the time that is compared."""
        stimulus = self.stimulus
        own = np.zeros(stimulus.width * stimulus.height, np.bool_)
        own[stimulus.pixels] = True
        return events.select(own[events.y.astype(np.int64) * stimulus.width + events.x])

    def _by_pixel(self, events: Events) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.int64]]:
        stimulus = self.stimulus
        place = np.full(stimulus.width * stimulus.height, -1, np.int64)
        place[stimulus.pixels] = np.arange(len(stimulus.pixels))
        at = place[events.y.astype(np.int64) * stimulus.width + events.x]
        inside = at >= 0
        at = at[inside]
        order = np.argsort(at, kind="stable")
        time = np.rint((events.t[inside][order] - stimulus.grid.begin) * 1e9).astype(np.int64)
        start = np.concatenate([[0], np.cumsum(np.bincount(at, minlength=len(stimulus.pixels)))])
        return time, events.p[inside][order].astype(np.uint8), start

    def _group(self) -> int:
        return 1 if self.device.is_cuda else GROUP

    def sink(self, rows: int, *, reseed: bool = False) -> Any:
        """Return an empty sink."""
        stimulus, step = self.stimulus, self.stimulus.grid.step
        out = kernels.Probes()
        out.cell = stimulus.array("cell", lambda: stimulus.cell)
        out.level = stimulus.array("level", lambda: stimulus.level)
        lags = np.rint(np.array(LAG_TIMES) / step).astype(np.int32)
        out.lags = wp.array(lags, device=self.device)
        out.middle = wp.array(self.middle, dtype=float, device=self.device)
        out.classes = wp.array(np.rint(np.array(CLASS_TIMES) / step).astype(np.int32), device=self.device)
        out.half = max(1, round(HALF / step))
        out.step, out.slack = wp.float64(step * 1e9), wp.float64(SLACK * 1e9)
        out.reseed, out.holes = int(reseed), int(stimulus.holes)
        out.group = self._group()
        count = len(stimulus.pixels)
        groups = -(-count // out.group)
        zeros = (
            ("memory", count, kernels.MEMORY),
            ("sums", groups, kernels.SIZE),
            ("halves", count, kernels.HALVES),
        )
        for name, size, numbers in zeros:
            setattr(out, name, wp.zeros((rows, size, numbers), dtype=float, device=self.device))
        out.team, teams = GROUP, -(-count // GROUP)
        out.clock = wp.zeros((rows, teams, 2 * stimulus.grid.steps), dtype=int, device=self.device)
        return out

    def _totals(self, sink: Any, rows: int) -> Sums:
        sums = sink.sums
        if self.device.is_cuda:
            parts = -(-sums.shape[1] // GROUP)
            less = wp.empty((rows, parts, kernels.SIZE), dtype=float, device=self.device)
            inputs = [sums, GROUP, less]
            launch.run(trials.total, parts * kernels.SIZE, inputs, self.device, batch=rows)
            sums = less
        groups = sums.numpy()
        clock = sink.clock.numpy()
        return Sums(
            groups.sum(1, dtype=np.float64), sink.halves.numpy(), groups, clock.sum(1), clock,
            np.zeros((rows, len(Structure.NAMES))),
        )  # fmt: skip


class _Light(Scene):
    """The light of a stimulus as a scene, from time 0."""

    def __init__(self, stimulus: Stimulus):
        self._stimulus = stimulus
        self.width, self.height = stimulus.width, stimulus.height
        self.times: NDArray[np.float64] = np.float64(stimulus.grid.step) * np.arange(stimulus.grid.steps)
        self.duration = float(self.times[-1])

    def sample_times(self) -> NDArray[np.float64]:
        return self.times

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        out = pixel.Frames()
        out.values = self._stimulus.array("light", lambda: self._stimulus.intensity.T)
        return "frames", out

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        raise NotImplementedError("some pixels are no picture")


def whole(sensor: Sensor) -> Sensor:
    """Return a sensor with every effect of a pixel that dase has, switched off where the sensor lacks it."""
    for name, effect in EFFECTS.items():
        inside = not issubclass(effect, StreamEffect | SceneEffect | Threshold) and not effect.maps
        if inside and name not in sensor:
            sensor = sensor.with_effect(effect.identity())
    return sensor


def delay_of(effect: StreamEffect, lines: int) -> float:
    """Return about how late an effect behind the pixels makes events [s]; infinite where it may lose some."""
    if isinstance(effect, Timestamp):
        return max(effect.step, effect.jitter)
    return lines * effect.line if isinstance(effect, RowScan) else math.inf


def scaled(effect: StreamEffect, share: float) -> StreamEffect:
    """Return an effect behind the pixels for a share of them."""
    if isinstance(effect, Readout):
        return replace(effect, rate=effect.rate * share, depth=max(1.0, effect.depth * share))
    return effect
