"""Many models over one stimulus: from parameter vectors to sums of statistics; the same of a measurement."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects import EFFECTS
from dase.effects.optics import SceneEffect
from dase.effects.stream import StreamEffect
from dase.effects.threshold import Threshold
from dase.events import Events
from dase.fitting.bus_load import BusLoad
from dase.fitting.parameter_space import SearchAxis
from dase.fitting.readout_simulator import clock_of, noticeable_effects, pass_readout, simulate_pixels
from dase.fitting.trial_kernels import CHOICE, KERNELS, KernelChoice, KernelSettings
from dase.fitting.trial_sampling import SAMPLES, samples_per_step_of_rows
from dase.kernels import event_probes as kernels
from dase.kernels import launch, pixel_codegen_trials
from dase.probes.accumulators import (
    GROUP,
    PROBE_TIMES,
    ProbeSums,
    StatisticsFrame,
    fold_counts,
    sum_over_groups,
)
from dase.probes.events_by_pixel import sort_by_pixel
from dase.probes.stimulus import Stimulus
from dase.probes.timestamp_patterns import TimestampStructure
from dase.simulation.sensor import Sensor


@dataclass(frozen=True)
class SimulatorSettings:
    """How launches are made up; speed and memory depend on it, results do not."""

    sums_bytes: int
    """Memory for the sums of one launch [bytes]."""

    kernels: KernelSettings
    """When a sensor's own kernel is taken."""

    streamed: int = 32
    """Models whose events are stored at a time: some hundred megabytes where each sends millions."""


LAUNCHES = {
    # the sums should stay in the caches
    "cpu": SimulatorSettings(sums_bytes=1 << 26, kernels=KERNELS["cpu"]),
    "cuda": SimulatorSettings(sums_bytes=1 << 31, kernels=KERNELS["cuda"]),
}


@dataclass(frozen=True, eq=False)
class SimulationOrder:
    """Models to run: one sensor at several parameter vectors.

    Args:
        sensor: Names the effects; its own parameters do not matter.
        vectors: Shape (B, P).
        seed: Of the random numbers.
        reseed: Whether each vector gets random numbers of its own.
        finer: Samples per step; None chooses by each model, and by the one that needs most for repeats.
        frame: What the counts of pixels are folded for; None where that is not known yet.
        ticks: From tick to tick of the clock that stamps the events [s], 0 for none.
        most: Samples per step that no model exceeds, whatever it needs.
    """

    sensor: Sensor
    vectors: NDArray[Any]
    seed: int = 0
    reseed: bool = False
    finer: int | None = None
    frame: StatisticsFrame | None = None
    ticks: float = 0.0
    most: int = SAMPLES[-1]

    def samples_per_step(self, step: float) -> NDArray[np.int64]:
        """Return how many samples each vector takes per step of the grid, shape (B,)."""
        rows = len(self.vectors)
        if self.finer is not None:
            return np.full(rows, self.finer)
        found = np.minimum(samples_per_step_of_rows(self.sensor, self.vectors, step), self.most)
        return np.full(rows, found.max(initial=0)) if self.reseed else found

    def seeds(self) -> NDArray[np.int64]:
        """Return the seed of each vector, shape (B,)."""
        # kernels take seeds as 32-bit integers, and these must not be negative
        return (self.seed + int(self.reseed) * np.arange(len(self.vectors))) & 0x3FFFFFFF


@dataclass(eq=False)
class BatchSimulator:
    """Runs models over a stimulus.

    Args:
        stimulus: What the pixels see.
        middle: Typical change of the light between two events, shape (4 CLASSES,) [log intensity]; 0 until a
            first look has told it, see `with_middle`.
        structure: Regularities of the measured time stamps.
        highest_rate: Most events per second that were measured, of the whole sensor [Hz].
        evaluations: Models run so far.
        samples: Pixels times samples run so far.
        settings: How launches are made up; None for what suits the device.
        choice: Which sensors have kernels of their own.
    """

    stimulus: Stimulus
    middle: NDArray[np.float32] = field(default_factory=lambda: np.zeros(4 * kernels.CLASSES, np.float32))
    structure: TimestampStructure = field(default_factory=TimestampStructure)
    highest_rate: float = math.inf
    evaluations: int = 0
    samples: int = 0
    settings: SimulatorSettings | None = None
    choice: KernelChoice = CHOICE
    _kernels: dict[Any, tuple[wp.Kernel, NDArray[np.float32], list[int]]] = field(
        default_factory=dict, repr=False
    )

    def __post_init__(self) -> None:
        self.device = self.stimulus.device
        self._launches = self.settings or LAUNCHES["cuda" if self.device.is_cuda else "cpu"]
        # a CPU works on several models of one pixel in a vector, a GPU has a thread for each
        self._lanes = 1 if self.device.is_cuda else kernels.LANES
        # moved once, for no launch changes them
        self._pixels = wp.array(self.stimulus.pixels, dtype=int, device=self.device)
        self._middle = wp.array(self.middle, dtype=float, device=self.device)

    def with_middle(self, middle: NDArray[np.float32]) -> BatchSimulator:
        """Return a simulator of another typical change (4 CLASSES,) [log intensity]; kernels are shared."""
        return replace(self, middle=middle)

    def run(
        self,
        sensor: Sensor,
        vectors: NDArray[Any],
        *,
        seed: int = 0,
        reseed: bool = False,
        finer: int | None = None,
    ) -> ProbeSums:
        """Simulate parameter vectors of one sensor, shape (B, P); see `SimulationOrder`."""
        return self.run_all([SimulationOrder(sensor, vectors, seed, reseed, finer)])[0]

    def run_all(self, orders: Sequence[SimulationOrder]) -> list[ProbeSums]:
        """Simulate many models; those that have a kernel in common run together, whatever their effects."""
        parts: list[list[tuple[NDArray[np.int64], ProbeSums]]] = [[] for _ in orders]
        for finer, share, members in self._launches_of(orders):
            cut = [replace(orders[n], vectors=orders[n].vectors[rows], finer=finer) for n, rows in members]
            done = self._run(cut, self.stimulus.history(finer), share=share)
            for (n, rows), sums in zip(members, done, strict=True):
                parts[n].append((rows, sums))
            for order in cut:
                samples = len(order.vectors) * self._samples_of_a_model(finer)
                self.samples += samples
                self.choice.work[_kernel_key(order.sensor)] += samples
        out = []
        for found in parts:
            joined = ProbeSums.join([sums for _, sums in found])
            order_of_rows = np.argsort(np.concatenate([rows for rows, _ in found]))
            out.append(joined if len(found) == 1 else joined.select(order_of_rows))
        return out

    def _samples_of_a_model(self, finer: int) -> int:
        """Return pixels times samples of one model that takes so many samples per step of the grid."""
        return len(self.stimulus.pixels) * self.stimulus.grid.steps * max(finer, 1)

    def _launches_of(
        self, orders: Sequence[SimulationOrder]
    ) -> list[tuple[int, bool, list[tuple[int, NDArray[np.int64]]]]]:
        """Return what runs in one launch: samples per step, whether in the kernel of all effects, orders.

        Of each order the rows that take part.
        """
        # of one number of samples and one combination of effects
        pieces: dict[tuple[int, Any, int], list[tuple[int, NDArray[np.int64]]]] = {}
        for n, order in enumerate(orders):
            each = order.samples_per_step(self.stimulus.grid.step)
            # maps are of one sensor, so a launch has either none or those of a single order
            maps = n if any(effect.maps for effect in order.sensor.effects) else -1
            for finer in np.unique(each).tolist():
                key = finer, _kernel_key(order.sensor), maps
                pieces.setdefault(key, []).append((n, np.flatnonzero(each == finer)))
        beside = Counter((finer, maps) for finer, _, maps in pieces)
        out: dict[Any, tuple[int, bool, list[tuple[int, NDArray[np.int64]]]]] = {}
        for (finer, key, maps), members in pieces.items():
            stages, settings = orders[members[0][0]].sensor.stages(), self._launches.kernels
            share = not self.choice.has_own(key, stages, settings, lanes=self._lanes)
            rows = sum(len(of) for _, of in members)
            # few models fill the lanes only beside others, with which they have the kernel of all effects in
            # common
            filled = rows / (self._lanes * -(-rows // self._lanes))
            share |= len(stages) > settings.effects and beside[finer, maps] > 1 and filled < settings.filled
            # kernels of all effects differ by the words of a sensor's own, and by effects that are a user's
            kernel = id(self._kernel(orders[members[0][0]].sensor, share)[0])
            out.setdefault((finer, maps, kernel), (finer, share, []))[2].extend(members)
        return list(out.values())

    def _run(self, orders: Sequence[SimulationOrder], history: Any, *, share: bool) -> list[ProbeSums]:
        """Simulate models through a kernel that they have in common: that of all effects, or their own."""
        kernel, maps = (
            self._kernel(orders[0].sensor, share)[0],
            orders[0].sensor.maps(self.stimulus.pixels, self.device),
        )
        count, seeds = len(self.stimulus.pixels), np.concatenate([order.seeds() for order in orders])
        rows = np.concatenate([self._kernel_vectors(order, share) for order in orders])
        ends = np.cumsum([len(order.vectors) for order in orders])
        begins = np.concatenate([[0], ends[:-1]])
        # in whole picoseconds, as the clock of a readout has them: the same stamps to the bit
        ticks = np.repeat([round(order.ticks * 1e12) for order in orders], ends - begins)
        # the first of repeats shows how groups of pixels differ; groups of all models would fill the memory
        apart = [int(begin) for begin, order in zip(begins, orders, strict=True) if order.reseed]
        # counts of pixels stay on the device, whole: what they are folded for may change later
        pixels = wp.zeros((len(rows), count, kernels.HALVES), dtype=float, device=self.device)
        sums, clock = [], []
        groups: dict[int, tuple[NDArray[np.float32], NDArray[np.int32]]] = {}
        # all else is added up part by part, for the sums of many models would not fit
        for first in range(0, len(rows), self._models_at_once()):
            part = slice(first, min(first + self._models_at_once(), len(rows)))
            sink = self.sink(pixels[part], ticks[part])
            inputs = [
                history, self._pixels, self.stimulus.width, self.stimulus.height,
                wp.array(seeds[part].astype(np.int32), dtype=int, device=self.device),
                wp.array(rows[part], dtype=float, device=self.device), *maps, sink,
            ]  # fmt: skip
            # `align`: one thread of a CPU has whole groups, so no two add to the same sum, and the order in
            # which floating-point numbers are added never changes
            blocks = -(-len(rows[part]) // self._lanes)
            launch.run_kernel(kernel, count, inputs, self.device, batch=blocks, align=GROUP)
            grouped = self._grouped(sink.sums)
            sums.append(sum_over_groups(grouped))
            clock.append(self._clock(sink.clock))
            mine = [n for n in apart if part.start <= n < part.stop]
            groups |= {n: _groups_of_row(grouped, sink.clock, n - first) for n in mine}
        self.evaluations += len(rows)
        folded, both, clocks = _fold_for_frames(orders, pixels), np.concatenate(sums), np.concatenate(clock)
        out = []
        for order, begin, end in zip(orders, begins.tolist(), ends.tolist(), strict=True):
            cut, (of_groups, teams) = slice(begin, end), groups.get(begin, (None, None))
            known = None if folded is None or order.frame is None else folded[cut]
            stamps = self._stamps(order)
            out.append(
                ProbeSums(both[cut], pixels[cut], clocks[cut], stamps, of_groups, teams, order.frame, known)
            )
        return out

    def _stamps(self, order: SimulationOrder) -> NDArray[np.float64]:
        """Return the shares of events that follow regularities: those that a clock has stamped do."""
        # a scan is no clock of the kernel's: models that have one are stored and looked at, see `_look`
        out = np.zeros((len(order.vectors), len(TimestampStructure.NAMES)))
        out[:, 0] = order.ticks > 0 and self.structure.step > 0
        return out

    def _kernel_vectors(self, order: SimulationOrder, share: bool) -> NDArray[np.float32]:
        """Return parameter vectors as the kernel takes them, shape (B, all parameters of the kernel)."""
        _, base, at = self._kernel(order.sensor, share)
        out = np.repeat(base[None], len(order.vectors), 0)
        out[:, at] = order.vectors
        return out

    def _models_at_once(self) -> int:
        """Return how many models there is room for."""
        count, group = len(self.stimulus.pixels), self._pixels_per_sum()
        # float32 and int32 of a model: sums of each group, events of each step, memory of each pixel
        numbers = (
            -(-count // group) * kernels.SumPlace.SIZE + -(-count // GROUP) * 2 * self.stimulus.grid.steps
        )
        numbers += count * (kernels.MEMORY + kernels.HALVES)
        # a thread takes as long for one model as for all its lanes
        blocks = self._launches.sums_bytes // (4 * numbers * self._lanes)
        return self._lanes * max(1, blocks)

    def _kernel(self, sensor: Sensor, share: bool) -> tuple[wp.Kernel, NDArray[np.float32], list[int]]:
        """Return the kernel of a sensor, a parameter vector for it, and the places of the sensor's own."""
        key = _kernel_key(sensor), share
        if key not in self._kernels:
            # what the sensor lacks is off in the wide one, and off changes nothing, bit for bit
            wide = with_every_effect(sensor) if share else sensor
            names = wide.parameter_names()
            at = [names.index(name) for name in sensor.parameter_names()]
            self._kernels[key] = (
                pixel_codegen_trials.compose_trials(wide.stages(), lanes=self._lanes),
                wide.parameters(),
                at,
            )
        return self._kernels[key]

    def look(self, events: Events) -> ProbeSums:
        """Sum up stored events, as one row; those of other pixels are left out."""
        return self._look([events])

    def _look(self, streams: Sequence[Events], frame: StatisticsFrame | None = None) -> ProbeSums:
        """Sum up streams of stored events, one per row."""
        count = len(self.stimulus.pixels)
        pixels = wp.zeros((len(streams), count, kernels.HALVES), dtype=float, device=self.device)
        sink = self.sink(pixels, np.zeros(len(streams), np.int64))
        inputs = [*sort_by_pixel(self.stimulus, streams), sink]
        launch.run_kernel(
            kernels.observe_stored_events, count, inputs, self.device, batch=len(streams), align=GROUP
        )
        grouped = self._grouped(sink.sums)
        folded = None
        if frame is not None:
            folded = sum_over_groups(fold_counts(pixels, [frame], np.zeros(len(streams), np.int64)))
        stamps = np.zeros((len(streams), len(TimestampStructure.NAMES)))
        # shares take a pass over all events, so only where the measurement follows a regularity
        if self.structure != TimestampStructure():
            stamps = np.stack([self.structure.shares(self._events_of_pixels(events)) for events in streams])
        return ProbeSums(
            sum_over_groups(grouped), pixels, self._clock(sink.clock), stamps,
            *_groups_of_row(grouped, sink.clock, 0), frame, folded,
        )  # fmt: skip

    def noticeable_effects(self, sensor: Sensor) -> tuple[StreamEffect, ...]:
        """Return the effects behind the pixels that the probes can feel."""
        return noticeable_effects(self.stimulus, self.structure, sensor, highest_rate=self.highest_rate)

    def has_free_readout(self, sensor: Sensor, axes: Iterable[SearchAxis]) -> bool:
        """Whether a fit along some axes changes an effect behind the pixels that the probes can feel."""
        free = {axis.effect for axis in axes}
        return any(type(effect) in free for effect in self.noticeable_effects(sensor))

    def ticks(self, sensor: Sensor) -> float | None:
        """Return what the kernel needs to know of a sensor's clock, see `clock_of`; None for a readout."""
        return clock_of(self.noticeable_effects(sensor), self.structure)

    def stream(
        self, sensor: Sensor, vector: NDArray[Any], effects: Iterable[StreamEffect], *, seed: int
    ) -> ProbeSums:
        """Simulate one parameter vector (P,) with effects behind the pixels, and sum up what leaves."""
        return self.simulate_streams(SimulationOrder(sensor, np.atleast_2d(vector), seed), [tuple(effects)])

    def simulate_streams(
        self, order: SimulationOrder, effects: Sequence[Sequence[StreamEffect]], load: BusLoad | None = None
    ) -> ProbeSums:
        """Simulate models with effects behind the pixels and sum up what leaves.

        Args:
            order: Models, B vectors.
            effects: Behind the pixels of each, B in all.
            load: What the sensor's other pixels send over a bus that all share, None where it is not known.
        """
        seeds, rows, found = order.seeds(), len(order.vectors), []
        finer = np.maximum(order.samples_per_step(self.stimulus.grid.step), 1)
        self.evaluations += rows
        self.samples += sum(self._samples_of_a_model(each) for each in finer.tolist())
        for first in range(0, rows, self._launches.streamed):
            cut = slice(first, first + self._launches.streamed)
            left = simulate_pixels(self.stimulus, order.sensor, order.vectors[cut], seeds[cut], finer[cut])
            each = zip(left, effects[cut], seeds[cut], strict=True)
            # readouts take one event after the other, so each model is a thread of its own
            works = [partial(pass_readout, self.stimulus, e, behind, int(s), load) for e, behind, s in each]
            found.append(self._look(launch.run_concurrently(works), order.frame))
        return ProbeSums.join(found)

    def _events_of_pixels(self, events: Events) -> Events:
        """Return the events of the pixels, within the time that is compared."""
        stimulus = self.stimulus
        own = np.zeros(stimulus.width * stimulus.height, np.bool_)
        own[stimulus.pixels] = True
        return events.select(own[events.y.astype(np.int64) * stimulus.width + events.x])

    def _pixels_per_sum(self) -> int:
        # on a GPU every pixel has sums of its own, or threads would wait for each other; see `_grouped`
        return 1 if self.device.is_cuda else GROUP

    def sink(self, pixels: Any, ticks: NDArray[np.int64]) -> Any:
        """Return an empty sink.

        Args:
            pixels: Counts of each pixel, a Warp array of zeros, shape (B, N, HALVES).
            ticks: From tick to tick of the clock that stamps events [ps], 0 for none, shape (B,).
        """
        stimulus, step = self.stimulus, self.stimulus.grid.step
        out = kernels.ProbeSums()
        out.cell = stimulus.array("cell", lambda: stimulus.cell)
        out.level = stimulus.array("level", lambda: stimulus.level)
        out.lags = stimulus.array("lags", lambda: np.rint(np.array(PROBE_TIMES.lags) / step).astype(np.int32))
        out.classes = stimulus.array(
            "classes", lambda: np.rint(np.array(PROBE_TIMES.classes) / step).astype(np.int32)
        )
        out.middle = self._middle
        out.half = max(1, round(PROBE_TIMES.half / step))
        out.step, out.slack = wp.float64(step * 1e9), wp.float64(PROBE_TIMES.slack * 1e9)
        out.ticks = wp.array(ticks.astype(np.int64), dtype=wp.int64, device=self.device)
        out.holes = int(stimulus.holes)
        out.group = self._pixels_per_sum()
        out.halves = pixels
        rows, count, _ = pixels.shape
        out.memory = launch.new_zeros((rows, count, kernels.MEMORY), wp.float32, self.device)
        groups = -(-count // out.group)
        # events of a pixel wait here, so that the CPU's vectors work out their times several at once
        if not self.device.is_cuda:
            out.queue = wp.empty((groups, kernels.QUEUE), dtype=wp.int64, device=self.device)
        out.sums = launch.new_zeros((rows, groups, kernels.SumPlace.SIZE), wp.float32, self.device)
        out.team, teams = GROUP, -(-count // GROUP)
        out.clock = launch.new_zeros((rows, teams, 2 * stimulus.grid.steps), wp.int32, self.device)
        return out

    def _grouped(self, sums: Any) -> Any:
        """Return the sums over groups of pixels, a Warp array of shape (B, G, SIZE)."""
        if not self.device.is_cuda:
            return sums
        # in the order of the pixels, as a CPU adds them: no atomic additions, whose order changes
        rows, count, size = sums.shape
        parts = -(-count // GROUP)
        less = wp.empty((rows, parts, size), dtype=float, device=self.device)
        launch.run_kernel(
            pixel_codegen_trials.sum_pixel_groups, parts * size, [sums, GROUP, less], self.device, batch=rows
        )
        return less

    def _clock(self, teams: Any) -> NDArray[np.int32]:
        """Return the events of each step over all groups, shape (B, 2 T)."""
        rows, _, steps = teams.shape
        out = wp.empty((rows, steps), dtype=int, device=self.device)
        launch.run_kernel(kernels.sum_group_counts, steps, [teams, out], self.device, batch=rows, slabs=1)
        found: NDArray[np.int32] = out.numpy()
        return found


def _fold_for_frames(orders: Sequence[SimulationOrder], pixels: Any) -> NDArray[np.float64] | None:
    """Return the counts of pixels folded, as far as it is known for what."""
    frames = list({id(o.frame): o.frame for o in orders if o.frame is not None}.values())
    if not frames:
        return None
    places = {id(frame): n for n, frame in enumerate(frames)}
    which = [places.get(id(order.frame), 0) for order in orders]
    return sum_over_groups(
        fold_counts(pixels, frames, np.repeat(which, [len(order.vectors) for order in orders]))
    )


def _groups_of_row(grouped: Any, clock: Any, row: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return sums and events of each step of the groups of one row."""
    return grouped[row].numpy().copy(), clock[row].numpy().copy()


def _kernel_key(sensor: Sensor) -> tuple[Any, ...]:
    """Return what chooses a sensor's kernel: words do, numbers come with the parameter vector."""
    return tuple((e.name, *(getattr(e, name) for name in e.choices())) for e in sensor.effects)


def with_every_effect(sensor: Sensor) -> Sensor:
    """Return a sensor with every effect of a pixel that dase has, switched off where the sensor lacks it."""
    for name, effect in EFFECTS.items():
        inside = not issubclass(effect, StreamEffect | SceneEffect | Threshold) and not effect.maps
        if inside and name not in sensor:
            sensor = sensor.with_effect(effect.identity())
    return sensor
