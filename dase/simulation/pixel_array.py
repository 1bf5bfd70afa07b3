"""Pixels of a sensor while time passes: runs the kernels chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError, checked_seed
from dase.events import LARGEST_SIDE, Events
from dase.kernels import event_keys as ordering
from dase.kernels import launch, pixel_compile, pixel_stages, threshold_events, threshold_levels
from dase.kernels import threshold_counts as counting
from dase.kernels.event_columns import EventColumns
from dase.kernels.random import stream_number
from dase.scenes.scene import Scene
from dase.simulation.sample_clock import upload_clock
from dase.simulation.sensor import Sensor


def _pixel_indices(pixels: ArrayLike | None, width: int, height: int) -> NDArray[np.int32]:
    """Return row-major indices, shape (N,); raises InputError where they are none: a fraction is not cut."""
    if pixels is None:
        return np.arange(width * height, dtype=np.int32)
    given = np.asarray(pixels)
    whole = given.dtype.kind in "iu" and given.ndim == 1 and len(given)
    if not whole or int(given.min()) < 0 or int(given.max()) >= width * height:
        raise InputError(
            f"pixels must be whole numbers, indices of the {width}x{height} sensor, shape (N,), N >= 1"
        )
    return given.astype(np.int32)


@dataclass(frozen=True)
class KeyRoom:
    """Room for the events of a chunk before any is known.

    Too little costs a second run of the pixels; too much costs nothing but addresses on a CPU, where memory
    that nobody touches is none, and memory on a GPU.
    """

    most: int = 32
    """Events of a pixel; fast scenes have some 6 in 64 samples."""
    least: int = 4
    """Events of a pixel, whatever memory they take."""
    keys_cpu: int = 1 << 25
    """In all, of 8 bytes each."""
    keys_gpu: int = 1 << 27
    """In all."""

    def per_pixel(self, pixels: int, *, on_gpu: bool) -> int:
        """Return the room of a pixel of so many in the batch [events]."""
        keys = self.keys_gpu if on_gpu else self.keys_cpu
        return min(max(keys // pixels, self.least), self.most)


EventsOfChunk: TypeAlias = tuple[Events, NDArray[np.int32] | None]
"""Events in order of time, and for a batch the row of each, shape (N,)."""


@dataclass
class _Launched:
    """A chunk on which pixels are at work.

    Args:
        run: Runs the pixels once more, from where the chunk began, into a sink.
        begin: When the last chunk ended [s].
        end: When this one ends [s].
        sink: Where the keys go.
        done: On a GPU, comes when the keys are there.
    """

    run: Callable[[Any], None]
    begin: float
    end: float
    sink: Any
    done: Any = None


class PixelArray:
    """Some pixels of a sensor while time passes: runs the composed kernel chunk by chunk.

    Args:
        sensor: What the pixels do.
        width: Columns of the sensor.
        height: Rows of the sensor.
        pixels: Row-major indices of the pixels to simulate, shape (N,); None for all.
        parameters: Parameter vectors, shape (B, P), to simulate at once with common random numbers; None for
            the sensor's own.
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        labels: Whether events are marked with what they came from.
        events_per_pixel: Room for events of a chunk at first; a chunk with more runs again with more room.
            None for what `KeyRoom` says.
    """

    def __init__(
        self,
        sensor: Sensor,
        width: int,
        height: int,
        *,
        pixels: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        seed: int = 0,
        device: str = "cpu",
        labels: bool = False,
        events_per_pixel: int | None = None,
    ):
        try:
            self.device = launch.find_device(device)
        except ValueError as error:
            raise InputError(str(error)) from error
        self.sensor, self.width, self.height = sensor, width, height
        self.seed = checked_seed(seed)
        if max(width, height) > LARGEST_SIDE or width * height >= 1 << 31:
            # columns and rows of an event have 16 bits each, the index of a pixel 31
            raise InputError(f"a sensor must be at most {LARGEST_SIDE} wide and high, got {width}x{height}")
        self.stages = sensor.stages()
        self.pixels = _pixel_indices(pixels, width, height)
        vectors = sensor.parameters()[None] if parameters is None else np.asarray(parameters, np.float32)
        if vectors.ndim != 2 or vectors.shape[1] != len(sensor.parameter_names()):
            raise InputError(
                f"parameters must have shape (B, {len(sensor.parameter_names())}), got {vectors.shape}"
            )
        self.batch, self.count = len(vectors), len(self.pixels)
        self._pixels = wp.array(self.pixels, dtype=int, device=self.device)
        xy = self.pixels % width + (self.pixels // width << 16)
        self._xy = wp.array(xy.astype(np.uint32), dtype=wp.uint32, device=self.device)
        self._parameters = wp.array(vectors, dtype=float, device=self.device)
        self.sink = "labels" if labels else "keys"
        shape = (len(pixel_stages.states(self.stages, self.sink)), self.batch, self.count)
        # two copies, so that a chunk whose events overran their buffer can be run again
        self._state = wp.zeros(shape, dtype=float, device=self.device)
        self._next = wp.zeros(shape, dtype=float, device=self.device)
        # what is to be written after `_next`, where pixels run a chunk ahead of their events
        self._idle: list[Any] = []
        self.samples = 0
        self.begin = 0.0
        self.emitted_again = 0  # chunks that had more events than there was room for
        # consecutive pixels whose keys share a counter and a stretch of the buffer
        self.slab = 256 if self.device.is_cuda else 2048
        if events_per_pixel is None:
            events_per_pixel = KeyRoom().per_pixel(self.batch * self.count, on_gpu=self.device.is_cuda)
        self._capacity = events_per_pixel * self.slab
        self._buffers: list[Any] = [None, None]  # of keys, kept from chunk to chunk, in turns
        self._later: Any = None  # keys of a sample's second event and those after it, see `EventKeys`
        self._later_room = 3
        self._room = ordering.KeyBuffer()
        self._ordering: Any = None  # stream of a GPU on which events are ordered, decoded and copied
        # nothing but a change detector: counted by a kernel of its own, several pixels per thread
        self._thresholds_only = all(
            stage == "threshold" for effect in self.stages for stage, _ in effect.functions
        )
        self._vectors = vectors
        self._levels: tuple[Any, Any] | None = None
        self._logs: tuple[NDArray[np.float32], Any] | None = None  # light of levels, and its logarithms
        self._maps_of_scene: list[Any] | None = None
        self._drawn: dict[tuple[tuple[int, bool], ...], Any] = {}  # numbers of pixels, by their streams
        # a key is an integer: time since the begin of the chunk [ns], pixel of the batch, label and polarity;
        # sorted keys are events sorted by time, and of one time by pixel, whatever the device did first
        self._pixel_bits = max((self.batch * self.count - 1).bit_length(), 1)
        self._low_bits = 3 if labels else 1
        delays = any(stage == "delay" for effect in self.stages for stage, _ in effect.functions)
        # keys of events that leave after the chunk, counted from its end
        self._late = np.empty(0, np.int64) if delays else None
        asked = {"row": self.batch > 1, "label": labels}
        absent = frozenset(name for name, given in asked.items() if not given)
        self._columns = EventColumns(self.device, absent)

    def count_events(
        self, scene: Scene, times: NDArray[np.float64], windows: NDArray[np.int32], size: int
    ) -> Any:
        """Advance over `times` and count events.

        Args:
            scene: What the pixels see.
            times: Samples [s], shape (K,), following the last ones.
            windows: Window that the step ending at each sample counts for, shape (K,), not decreasing; -1 for
                none.
            size: Number of windows W.

        Returns:
            Warp array of int32, shape (B, W, 2, N): OFF counts in channel 0, ON counts in channel 1.
        """
        sink = pixel_stages.EventCounts()
        if np.any(np.diff(windows[windows >= 0]) < 0):
            raise InputError("windows must not decrease from sample to sample")
        shape = (self.batch, size, 2, self.count)
        # the kernel writes each window it meets, whole
        new = wp.empty if len(np.unique(windows[windows >= 0])) == size else wp.zeros
        sink.counts = new(shape, dtype=int, device=self.device)
        if self._thresholds_only:
            self._count_thresholds_only(sink.counts, scene, times, windows)
        else:
            self._prepare_launch("counts", scene, times, windows, align=16)(sink)
        self._advance(times)
        return sink.counts

    def _count_thresholds_only(
        self, out: Any, scene: Scene, times: NDArray[np.float64], windows: NDArray[np.int32]
    ) -> None:
        """Count into `out`, shape (B, W, 2, N), with a kernel that knows nothing but thresholds."""
        self.bind_scene(scene)
        self._step_edges(times)
        name, source = self.sensor.through_optics(scene).source(times, self.pixels, self.device)
        first, memory, signal = self._state_before(name, source, len(times))
        if first >= len(times):
            out.zero_()
            return
        logs = self._logarithms_in_order(name, source)
        if logs is not None:
            inputs = [
                source.values, logs, self.count, first, self._thresholds_of_pixels()[0],
                *self._window_runs(windows), memory, signal, self._next[1], self._next[0], out,
            ]  # fmt: skip
            self._launch_level_blocks(threshold_levels.count_level_events, inputs, align=1)
            return
        lanes = counting.widest_block(self.count, self.device, name)
        level, eps = self._thresholds_of_pixels()
        shared = level.shape[2] == 1 and bool(np.all(self._vectors[:, 0] == self._vectors[:, 1]))
        aligned = counting.samples_are_aligned(name, source, self.count)
        kernel = counting.counting_kernel(lanes, name, shared=shared, states=True, aligned=aligned)
        inputs = [
            source, 0, self._pixels, self.count, self.width, first, level, eps, *self._window_runs(windows),
            memory, self._next[1], self._next[0], out,
        ]  # fmt: skip
        launch.run_kernel(
            kernel, counting.block_count(self.count, lanes), inputs, self.device, batch=self.batch
        )

    def _launch_level_blocks(self, kernel: wp.Kernel, inputs: list[Any], *, align: int) -> None:
        blocks = counting.block_count(self.count, threshold_levels.LANES)
        launch.run_kernel(kernel, blocks, inputs, self.device, batch=self.batch, align=align)

    def _logarithms_in_order(self, name: str, source: Any) -> Any:
        """Return the log intensities of stored levels, or None where `threshold_levels` cannot take them."""
        if name != "levels" or self.count < threshold_levels.LANES:
            return None
        light = source.light.numpy()
        if self._logs is None or not np.array_equal(self._logs[0], light):
            _, eps = self._thresholds_of_pixels()
            logs = threshold_levels.logarithms_of_levels(source, eps, self.device)
            self._logs = light.copy(), logs if threshold_levels.have_intervals(logs) else None
        return self._logs[1]

    def _state_before(self, name: str, source: Any, samples: int) -> tuple[int, Any, Any]:
        """Return the first sample to compare, and memories and signals before it."""
        first = max(2 - self.samples, 0)
        if not first:
            return 0, self._state[1], self._state[0]
        level, eps = self._thresholds_of_pixels()
        inputs = [
            source, self._pixels, self.width, self.samples, samples, self.seed,
            stream_number("initial_phase"), level, eps,
            wp.array(self._vectors[:, 2], dtype=float, device=self.device), self._state[0],
            self._next[1], self._next[0],
        ]  # fmt: skip
        launch.run_kernel(counting.starting_kernel(name), self.count, inputs, self.device, batch=self.batch)
        # blocks may overlap, so what they read must not be what they write
        return first - 1, wp.clone(self._next[1]), wp.clone(self._next[0])

    def _prepare_thresholds_only(self, scene: Scene, times: NDArray[np.float64]) -> Callable[[Any], None]:
        """Return what emits keys into a sink with a kernel that knows nothing but thresholds."""
        self.bind_scene(scene)
        clock = self._upload_clock(times, np.zeros(len(times), np.int32))
        name, source = self.sensor.through_optics(scene).source(times, self.pixels, self.device)
        first, memory, signal = self._state_before(name, source, len(times))
        logs = self._logarithms_in_order(name, source)
        if logs is not None:
            inputs = [
                source.values, logs, clock, self.count, first, self._thresholds_of_pixels()[0], memory,
                signal, self._next[1], self._next[0],
            ]  # fmt: skip
            kernel, lanes = threshold_levels.emit_level_events, threshold_levels.LANES
        else:
            lanes = counting.widest_block(self.count, self.device, name)
            inputs = [
                source, clock, self._pixels, self.count, self.width, first, *self._thresholds_of_pixels(),
                memory, signal, self._next[1], self._next[0],
            ]  # fmt: skip
            kernel = threshold_events.emitting_kernel(lanes, name)
        size, align = counting.block_count(self.count, lanes), self.slab // lanes
        return lambda sink: launch.run_kernel(
            kernel, size, [*inputs, sink], self.device, batch=self.batch, align=align
        )

    def emit(self, scene: Scene, times: NDArray[np.float64]) -> EventsOfChunk:
        """Advance over `times` and return the events that leave the pixels, and for a batch the row of each.

        Readout effects come behind this, see `dase.simulation.readout_chain.ReadoutChain`.

        Args:
            scene: What the pixels see.
            times: Samples [s], shape (K,), following the last ones.
        """
        return self._collect(self._start(scene, times))

    def emit_chunks(
        self, scene: Scene, chunks: Iterable[NDArray[np.float64]], *, ahead: bool | None = None
    ) -> Iterator[tuple[NDArray[np.float64], EventsOfChunk]]:
        """Yield chunks of samples with what `emit` returns of them.

        Args:
            scene: What the pixels see.
            chunks: Samples [s], each of shape (K,), one chunk following the other.
            ahead: Whether pixels begin with the next chunk before the events of this one are ordered and
                copied, which a GPU does at the same time; None for where there is a GPU. Events are the same.
        """
        if not (self.device.is_cuda if ahead is None else ahead):
            for times in chunks:
                yield times, self.emit(scene, times)
            return
        if not self._idle:
            # a chunk may have to run again after the next one has begun, and needs its own begin for that
            self._idle.append(wp.zeros_like(self._state))
        before: tuple[NDArray[np.float64], _Launched] | None = None
        for times in chunks:
            launched = self._start(scene, times)
            if before is not None:
                yield before[0], self._collect(before[1])
            before = times, launched
        if before is not None:
            yield before[0], self._collect(before[1])

    def _start(self, scene: Scene, times: NDArray[np.float64]) -> _Launched:
        """Set the pixels to work on a chunk, and advance over it."""
        begin = self.begin if self.samples else float(times[0])
        self._check_length(begin, float(times[-1]))
        run = self._prepare_emission(scene, times)
        launched = _Launched(run, begin, float(times[-1]), None)
        self._fill(launched)
        self._advance(times)
        return launched

    def _check_length(self, begin: float, end: float) -> int:
        """Return how many bits keys of a chunk from `begin` to `end` [s] have; raises InputError above 63."""
        span = round(end * 1e9) - round(begin * 1e9)
        # an event that is held back may leave long after its chunk, and its key has to hold that time
        longest = span if self._late is None else span + round(pixel_stages.LATEST * 1e9)
        top = self._pixel_bits + self._low_bits + longest.bit_length()
        if top > 63:
            raise InputError(
                f"a chunk of {span * 1e-9:g} s with {self.batch * self.count} pixels is too long"
            )
        return top

    def _prepare_emission(self, scene: Scene, times: NDArray[np.float64]) -> Callable[[Any], None]:
        """Return what emits the keys of a chunk into a sink, as often as it is called."""
        if self._thresholds_only and self.device.is_cpu:
            return self._prepare_thresholds_only(scene, times)
        return self._prepare_launch(self.sink, scene, times, np.zeros(len(times), np.int32), align=self.slab)

    def _fill(self, launched: _Launched) -> None:
        """Run the pixels of a chunk with as much room as there is now."""
        shape = (self.batch, -(-self.count // self.slab), self._capacity)
        if launched.sink is None:
            # the other one may hold keys of the chunk before, which nobody has ordered yet
            self._buffers.reverse()
            if self._buffers[0] is None or self._buffers[0].shape != shape:
                self._buffers[0] = launch.new_array(shape, wp.int64, self.device)
            keys = self._buffers[0]
        else:
            # a second run is rare: the buffers that are kept stay those of their turns
            keys = launch.new_array(shape, wp.int64, self.device)
        sink = pixel_stages.EventKeys()
        room = self._later_room * self.slab if self._one_pixel_per_thread else 0
        if self._later is None or self._later.shape[2] != room:
            self._later = launch.new_array((*shape[:2], room), wp.int64, self.device)
        sink.keys, sink.later, sink.room = keys, self._later, self._later_room
        sink.most = wp.zeros(1, dtype=int, device=self.device)
        sink.used = wp.zeros(shape[:2], dtype=int, device=self.device)
        sink.slab, sink.bits, sink.low = self.slab.bit_length() - 1, self._pixel_bits, self._low_bits
        launched.run(sink)
        launched.sink = sink
        launched.done = self.device.stream.record_event() if self.device.is_cuda else None

    def _collect(self, launched: _Launched) -> EventsOfChunk:
        """Return the events of a chunk, once its pixels are done with it."""
        used, most = self._number_of_events(launched)
        # what there was room for is the sink's to say: a chunk before may have asked for more since
        while used.max() > launched.sink.keys.shape[2] or most > launched.sink.room + 1:
            self._later_room = max(self._later_room, most)
            # a quarter more spares the next, slightly busier chunk the same
            self._capacity = max(self._capacity, int(1.25 * used.max()) + 1)
            self.emitted_again += 1
            self._fill(launched)
            used, most = self._number_of_events(launched)
        with self._ordering_after(launched):
            top = self._check_length(launched.begin, launched.end)
            sink = launched.sink
            found = ordering.keys_in_order(
                sink.keys, sink.used, used, self._pixel_bits, self._low_bits, top, self.device, self._late,
                self._room,
            )  # fmt: skip
            events, row = self._decode_keys(found, launched.begin)
            if self._late is None:
                return events, row
            # what leaves after the chunk waits, with its time counted from the next chunk's begin
            end = round(launched.end * 1e9)
            now = int(np.searchsorted(events.t, 1e-9 * float(end), side="right"))
            span = end - round(launched.begin * 1e9)
            late = launch.copy_to_host(found[now:]) if now < len(events) else np.empty(0, np.int64)
            self._late = late - (span << (self._pixel_bits + self._low_bits))
            return events.select(slice(now)), None if row is None else row[:now]

    def _number_of_events(self, launched: _Launched) -> tuple[NDArray[np.int32], int]:
        """Return the events of each slab, (B, slabs), and most of a pixel in a sample, if too many."""
        with self._ordering_after(launched):
            used, most = (launch.copy_to_host(a) for a in (launched.sink.used, launched.sink.most))
            return used, int(most[0])

    def _ordering_after(self, launched: _Launched) -> AbstractContextManager[Any]:
        """Return what lets a GPU do what follows once a chunk is done, beside the pixels of the next."""
        if self.device.is_cpu:
            return nullcontext()
        if self._ordering is None:
            # its short kernels go before the rest of a long one, or they would wait for the next chunk
            self._ordering = wp.Stream(self.device, priority=-1)
        self._ordering.wait_event(launched.done)
        beside: AbstractContextManager[Any] = wp.ScopedStream(self._ordering, sync_enter=False)
        return beside

    def flush(self) -> EventsOfChunk:
        """Return the events that have not left yet, and their rows (N,), as `emit` does; time is over."""
        late = np.empty(0, np.int64) if self._late is None else self._late
        self._late = None if self._late is None else late[:0]
        return self._decode_keys(wp.array(late, dtype=wp.int64, device=self.device), self.begin)

    def bind_scene(self, scene: Scene) -> None:
        """Work out what pixels owe to the scene, once; it is done before the first sample in any case."""
        if self._maps_of_scene is None:
            self._maps_of_scene = self.sensor.bound_to(scene).maps(self.pixels, self.device)

    def _maps(self) -> list[Any]:
        return (
            self.sensor.maps(self.pixels, self.device) if self._maps_of_scene is None else self._maps_of_scene
        )

    def thresholds(self) -> NDArray[np.float32]:
        """Return the thresholds of each pixel [log intensity], shape (B, 2, N): OFF, ON.

        Where they depend on the scene, `bind_scene` it first.
        """
        level = self._thresholds_of_pixels()[0].numpy()
        return np.array(np.broadcast_to(level, (self.batch, 2, self.count)))

    def _thresholds_of_pixels(self) -> tuple[Any, Any]:
        """Return thresholds, of shape (B, 2, N), or (B, 2, 1) where all are the same, and log_eps, (B,)."""
        if self._levels is not None:
            return self._levels
        if not any(effect.functions for effect in self.stages):
            level = wp.array(self._vectors[:, 1::-1, None].copy(), dtype=float, device=self.device)
        else:
            kernel = pixel_compile.compose_thresholds(self.stages)
            level = wp.empty((self.batch, 2, self.count), dtype=float, device=self.device)
            inputs = [self._pixels, self.width, self.height, self.seed, self._parameters]
            inputs += [*self._maps(), level]
            launch.run_kernel(kernel, self.count, inputs, self.device, batch=self.batch)
        levels = level, wp.array(self._vectors[:, 3], dtype=float, device=self.device)
        self._levels = levels
        return levels

    def _prepare_launch(
        self,
        sink_name: str,
        scene: Scene,
        times: NDArray[np.float64],
        windows: NDArray[np.int32],
        align: int,
    ) -> Callable[[Any], None]:
        """Return what runs the composed kernel over a chunk into a sink, as often as it is called."""
        self.bind_scene(scene)
        source_name, source = self.sensor.through_optics(scene).source(times, self.pixels, self.device)
        lanes = self._count_lanes(source_name)
        kernel = pixel_compile.compose_pixels(self.stages, source_name, sink_name, lanes=lanes)
        clock = self._upload_clock(times, windows)
        inputs = [
            source, clock, self._pixels, self.width, self.height, self.samples, self.seed,
            self._parameters, *self._maps(), *(self._numbers_drawn(source_name, sink_name) if lanes else ()),
            self._state, self._next,
        ]  # fmt: skip
        size, align = (
            (counting.block_count(self.count, lanes), align // lanes) if lanes else (self.count, align)
        )
        return lambda sink: launch.run_kernel(
            kernel, size, [*inputs, sink], self.device, batch=self.batch, align=align
        )

    def _numbers_drawn(self, source_name: str, sink_name: str) -> list[Any]:
        """Return the numbers that pixels draw once, one array of shape (D, N), or none."""
        streams = pixel_compile.streams_drawn_once(self.stages, source_name, sink_name)
        if not streams:
            return []
        if streams not in self._drawn:
            out = launch.new_array((len(streams), self.count), wp.float32, self.device)
            given = [wp.array(of_all, dtype=int, device=self.device) for of_all in zip(*streams, strict=True)]
            inputs = [self._pixels, self.seed, *given, out]
            kernel = pixel_compile.drawing_kernel()
            launch.run_kernel(kernel, self.count, inputs, self.device, batch=len(streams))
            self._drawn[streams] = out
        return [self._drawn[streams]]

    def _count_lanes(self, source_name: str) -> int:
        """Return how many pixels a thread of the composed kernel works on; 0 for the kernel of one."""
        return (
            0 if self._one_pixel_per_thread else counting.widest_block(self.count, self.device, source_name)
        )

    @property
    def _one_pixel_per_thread(self) -> bool:
        """Whether threads of the composed kernel have one pixel each."""
        return bool(self.device.is_cuda)

    def _step_edges(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the end of the last step and the samples that follow [s], shape (K + 1,)."""
        first = self.samples == 0
        edges = np.concatenate([[float(times[0]) if first else self.begin], times])
        if not np.all(np.diff(edges)[first:] > 0) or not np.all(np.isfinite(edges)):
            raise InputError("sample times must increase")
        return edges

    def _window_runs(self, windows: NDArray[np.int32]) -> tuple[Any, Any]:
        """Return where runs of one window begin, so that a pixel writes its counts once, and the windows."""
        run = np.flatnonzero(np.diff(windows, prepend=windows[0] - 1))
        ends = np.append(run, len(windows)).astype(np.int32)
        return tuple(
            wp.array(a, dtype=int, device=self.device) for a in (ends, windows[run].astype(np.int32))
        )

    def _upload_clock(self, times: NDArray[np.float64], windows: NDArray[np.int32]) -> Any:
        edges = self._step_edges(times)
        return upload_clock(edges, self.samples == 0, *self._window_runs(windows), self.device)

    def _advance(self, times: NDArray[np.float64]) -> None:
        self._idle.append(self._state)
        self._state, self._next = self._next, self._idle.pop(0)
        self.samples += len(times)
        self.begin = float(times[-1])

    def _decode_keys(self, keys: Any, begin: float) -> EventsOfChunk:
        n, to = len(keys), self.device
        each = ordering.events_per_thread(to)
        inputs = [
            keys, self._pixel_bits, self._low_bits, self.count, self._xy, wp.int64(round(begin * 1e9)), each,
        ]  # fmt: skip
        out = self._columns.take(n)
        inputs += [out[name] for name in ("t", "x", "y", "p", "row", "label")]
        launch.run_kernel(ordering.decode_keys, -(-n // each), inputs, to)
        found = self._columns.bring(n)
        known = found["label"] if self.sink == "labels" else None
        t, x, y, p = (found[name] for name in "txyp")
        events = Events(t, x, y, p.view(np.bool_), self.width, self.height, known)
        return events, found["row"] if self.batch > 1 else None
