"""One run of a sensor over a scene: its pixels, the readout behind them, and the chunks of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.events import Events
from dase.scenes.scene import Scene
from dase.simulation.pixel_array import EventsOfChunk, PixelArray
from dase.simulation.readout_chain import ReadoutChain, WindowCounter, split_by_row
from dase.simulation.sensor import Sensor


@dataclass(frozen=True)
class ChunkSettings:
    """How many samples pixels take at once, and when they take the next.

    Few enough that layers which stay far from a pixel are skipped, enough to amortise a launch; events do not
    depend on it.
    """

    cpu: int = 64
    """Samples per chunk on a CPU, where a chunk's frames should stay within the caches."""
    cuda: int = 128
    """Samples per chunk on a GPU, where a launch costs more."""
    ahead: bool | None = None
    """Whether pixels run a chunk ahead of the order of their events; None for where there is a GPU."""


@dataclass(frozen=True)
class RunChunk:
    """What a run gives at once.

    Args:
        times: Samples of the chunk [s], shape (K,); empty for what comes after the last sample.
        events: Events that leave the sensor during the chunk, a stream for each parameter vector.
    """

    times: NDArray[np.float64]
    events: list[Events]


@dataclass(frozen=True)
class UnreadChunk:
    """What the pixels of a run gave at once, before the readout.

    Args:
        times: Samples of the chunk [s], shape (K,); empty for what comes after the last sample.
        read: Returns the events that leave the sensor during the chunk, a stream for each parameter vector.
            To be called once for each chunk in their order, on any thread: it needs neither the pixels nor
            a GPU.
    """

    times: NDArray[np.float64]
    read: Callable[[], list[Events]]


class SensorRun:
    """A sensor before a scene while time passes. A run goes over its scene once.

    It owns the pixels, the readout behind them and the chunks, so that every way to simulate one scene
    (`dase.stream`, `dase.count`, data sets, fits) cuts time in the same way and ends in the same way. Many
    scenes at once, for training, go through `PixelBatch`, whose steps their makers count.

    Args:
        scene: What the pixels see.
        sensor: What they do, and what is behind them.
        times: Samples [s], increasing, shape (K,); None takes those of `sample_times`.
        pixels: Row-major indices of the pixels to simulate, shape (N,); None for all.
        parameters: Parameter vectors to simulate at once with common random numbers, shape (B, P); None for
            the sensor's own.
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        labels: Whether events are marked with what they came from.
        chunk: Samples per chunk; None takes what `settings` say of the device.
        events_per_pixel: Room for events of a chunk at first; a chunk with more runs again with more room.
            None for what `dase.simulation.pixel_array.KeyRoom` says.
        settings: Sizes of chunks.

    Raises:
        InputError: Pixels outside the sensor, parameters of the wrong shape, or no such device.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        *,
        times: NDArray[np.float64] | None = None,
        pixels: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        seed: int = 0,
        device: str = "cpu",
        labels: bool = False,
        chunk: int | None = None,
        events_per_pixel: int | None = None,
        settings: ChunkSettings = ChunkSettings(),
    ):
        self.scene, self.sensor = scene, sensor
        self.pixel_array = PixelArray(
            sensor, scene.width, scene.height, pixels=pixels, parameters=parameters, seed=seed, device=device,
            labels=labels, events_per_pixel=events_per_pixel,
        )  # fmt: skip
        self.times = sample_times(scene, sensor) if times is None else times
        self.chunk = chunk or (settings.cuda if self.pixel_array.device.is_cuda else settings.cpu)
        self.ahead = settings.ahead

    def thresholds(self) -> NDArray[np.float32]:
        """Return the thresholds of each pixel before this scene [log intensity], shape (B, 2, N): OFF, ON."""
        self.pixel_array.bind_scene(self.scene)
        return self.pixel_array.thresholds()

    def chunks(self) -> Iterator[RunChunk]:
        """Yield what leaves the sensor chunk after chunk, in memory that does not grow.

        Events that leave the sensor late come with a later chunk, or in one more chunk without samples.
        """
        return self._chunks_behind(self.sensor)

    def unread_chunks(self) -> Iterator[UnreadChunk]:
        """Yield what the pixels give chunk after chunk, for who reads it while the next is simulated."""
        return self._unread_behind(self.sensor)

    def _chunks_behind(self, sensor: Sensor) -> Iterator[RunChunk]:
        """Yield what leaves the readout of a sensor that has these pixels."""
        for chunk in self._unread_behind(sensor):
            events = chunk.read()
            if len(chunk.times) or any(len(part) for part in events):
                yield RunChunk(chunk.times, events)

    def _unread_behind(self, sensor: Sensor) -> Iterator[UnreadChunk]:
        array = self.pixel_array
        readouts = [
            ReadoutChain(sensor, array.width, array.height, pixels=array.count, seed=array.seed)
            for _ in range(array.batch)
        ]

        def read(found: EventsOfChunk, end: float, last: bool) -> list[Events]:
            parts = zip(readouts, split_by_row(*found, array.batch), strict=True)
            if last:
                return [Events.concatenate([readout.push(p, end), readout.flush()]) for readout, p in parts]
            return [readout.push(part, end) for readout, part in parts]

        for times, found in array.emit_chunks(self.scene, self._cut_times(), ahead=self.ahead):
            # nothing emitted later is earlier than the last sample, which lets the readout hand events on
            yield UnreadChunk(times, partial(read, found, float(times[-1]), False))
        # first the pixels give up what they hold back, then the readout
        yield UnreadChunk(np.empty(0, np.float64), partial(read, array.flush(), array.begin, True))

    def events(self) -> list[Events]:
        """Return all events that leave the sensor, a stream for each parameter vector."""
        parts = [chunk.events for chunk in self.chunks()]
        # a concatenation copies, which a single long chunk need not pay for
        return [Events.concatenate(row) if len(row) > 1 else row[0] for row in zip(*parts, strict=True)]

    def count(self, edges: ArrayLike) -> NDArray[np.int32]:
        """Count what each pixel sends per window, without storing it where its readout allows that.

        What all pixels share is left out, see `Sensor.by_single_pixels`.

        Args:
            edges: Window edges [s], increasing, shape (W + 1,); a window holds edge < t <= next edge.

        Returns:
            Shape (B, W, 2, N): OFF counts in channel 0, ON counts in channel 1.

        Raises:
            InputError: Edges do not increase, or there are fewer than two.
        """
        edges, sensor = _checked_edges(edges), self.sensor.by_single_pixels()
        if sensor.changes_event_stream():
            return self._count_behind(sensor, edges)
        return self._count_at_pixels(edges)

    def count_leaving(self, edges: ArrayLike) -> NDArray[np.int32]:
        """Count what leaves the camera behind its whole readout, shape (B, W, 2, N); see `count`."""
        return self._count_behind(self.sensor, _checked_edges(edges))

    def _count_behind(self, sensor: Sensor, edges: NDArray[np.float64]) -> NDArray[np.int32]:
        """Count what leaves the readout of a sensor that has these pixels, shape (B, W, 2, N)."""
        array = self.pixel_array
        counters = [
            WindowCounter(edges, array.pixels, array.width * array.height) for _ in range(array.batch)
        ]
        for chunk in self._chunks_behind(sensor):
            for counter, part in zip(counters, chunk.events, strict=True):
                counter.add(part)
        return np.stack([counter.counts for counter in counters])

    def _count_at_pixels(self, edges: NDArray[np.float64]) -> NDArray[np.int32]:
        """Count the crossings of pixels, which leave as they are, shape (B, W, 2, N)."""
        array, windows_in_all = self.pixel_array, len(edges) - 1
        total = np.zeros((array.batch, windows_in_all, 2, array.count), np.int32)
        for times in self._cut_times():
            # a step counts for the window that its end lies in; -1 for none
            windows = (np.searchsorted(edges, times, side="left") - 1).astype(np.int32)
            windows[(windows < 0) | (windows >= windows_in_all)] = -1
            seen = windows[windows >= 0]
            if len(seen) == 0:
                # nothing to count, but the state of the pixels has to come along
                array.count_events(self.scene, times, windows, 1)
                continue
            # the kernel gets the windows of this chunk alone: memory for all would grow with the scene
            low, high = seen.min(), seen.max() + 1
            shifted = np.where(windows >= 0, windows - low, -1).astype(np.int32)
            total[:, low:high] += array.count_events(self.scene, times, shifted, high - low).numpy()
        return total

    def _cut_times(self) -> Iterator[NDArray[np.float64]]:
        """Cut the samples into chunks [s], each of shape (K,)."""
        for i in range(0, len(self.times), self.chunk):
            yield self.times[i : i + self.chunk]


def _checked_edges(edges: ArrayLike) -> NDArray[np.float64]:
    """Return window edges [s], shape (W + 1,), unless they do not increase."""
    edges = np.asarray(edges, np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise InputError("window edges must increase, and there must be at least 2")
    return edges


def sample_times(scene: Scene, sensor: Sensor) -> NDArray[np.float64]:
    """Return when to sample [s], shape (K,): as the scene asks and often enough for all effects.

    Steps that are longer than the sensor allows are cut into equal pieces where the scene takes any time.
    """
    times, step = scene.sample_times(), sensor.longest_step()
    if not scene.anytime or not np.isfinite(step):
        return times
    # the slack of 1e-9 keeps a step that is the longest one but for rounding in one piece
    pieces = np.maximum(np.ceil(np.diff(times) / step - 1e-9), 1)
    if np.all(pieces == 1):
        return times
    at = np.concatenate([[0], np.cumsum(pieces)])
    return np.interp(np.arange(at[-1] + 1), at, times)
