"""The sensor: an ordered list of effects, and the main path from a scene to events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.effects import EFFECTS
from dase.effects.base import Effect
from dase.effects.stream import StreamEffect
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import Events
from dase.history import Entry
from dase.kernels import events as ordering
from dase.kernels import launch, pixel
from dase.outlet import Outlet, Tally, rows_of
from dase.scene import Scene

CHUNK = {"cpu": 64, "cuda": 128}
"""Samples per chunk: few enough that layers far from a pixel are skipped, enough to amortise a launch."""


@dataclass(frozen=True)
class Sensor:
    """An event camera: a threshold and any further effects, in the order in which they act.

    Args:
        effects: At most one of each kind; a `Threshold` among them.
        name: For the user.
        size: Columns and rows of the camera [px], for work that has no size of its own; a scene brings its
            own size. None leaves it open.
        log_eps: Added to intensities before the logarithm, so that black is finite (ESIM: 0.001).
        history: How the sensor came to be; changes nothing.
    """

    effects: tuple[Effect, ...] = (Threshold(),)
    name: str = "ideal"
    size: tuple[int, int] | None = None
    log_eps: float = 1e-3
    history: tuple[Entry, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        names = [effect.name for effect in self.effects]
        if len(set(names)) != len(names):
            raise InputError(f"sensor '{self.name}': each effect may appear once, got {', '.join(names)}")
        if "threshold" not in names:
            raise InputError(
                f"sensor '{self.name}' needs the effect 'threshold', got {', '.join(names) or 'none'}"
            )
        if not 0 < self.log_eps < 1:
            raise InputError(f"sensor '{self.name}': log_eps must lie in (0, 1), got {self.log_eps:g}")
        if self.size is not None and min(self.size) < 1:
            raise InputError(
                f"sensor '{self.name}': size must be at least 1x1, got {self.size[0]}x{self.size[1]}"
            )

    def __getitem__(self, name: str) -> Effect:
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise KeyError(f"sensor '{self.name}' has no effect '{name}'")

    def __contains__(self, name: str) -> bool:
        return any(effect.name == name for effect in self.effects)

    def with_effect(self, effect: Effect) -> Sensor:
        """Return the sensor with `effect` added where it acts, or in place of the one of the same name."""
        if effect.name in self:
            return replace(self, effects=tuple(effect if e.name == effect.name else e for e in self.effects))
        place = {name: i for i, name in enumerate(EFFECTS)}
        later = [place.get(e.name, 0) > place.get(effect.name, len(place)) for e in self.effects]
        at = later.index(True) if True in later else len(later)
        return replace(self, effects=(*self.effects[:at], effect, *self.effects[at:]))

    def without(self, name: str) -> Sensor:
        """Return the sensor without the effect `name`."""
        return replace(self, effects=tuple(e for e in self.effects if e.name != name))

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows all effects [s]."""
        return min(effect.longest_step() for effect in self.effects)

    def stages(self) -> tuple[pixel.Stages, ...]:
        """Return the pixels' effects as the kernel composer sees them; the threshold is part of its core."""
        apart = (Threshold, StreamEffect)
        return tuple(effect.compiled() for effect in self.effects if not isinstance(effect, apart))

    def streams(self) -> tuple[StreamEffect, ...]:
        """Return the effects behind the pixels that are not off."""
        return tuple(e for e in self.effects if isinstance(e, StreamEffect) and not e.is_off())

    def retimes(self) -> bool:
        """Whether events leave at other times than their crossings', or not all of them leave."""
        late = (e for e in self.effects if isinstance(e, StreamEffect) or "delay" in e.stages)
        return not all(effect.is_off() for effect in late)

    def parameter_names(self) -> list[str]:
        """Return `effect.parameter` for every place of a parameter vector."""
        core = ["threshold.on", "threshold.off", "threshold.phase", "sensor.log_eps"]
        return core + [f"{s.name}.{p}" for s in self.stages() for p in s.parameters]

    def parameters(self) -> NDArray[np.float32]:
        """Return the parameter vector of this sensor, shape (P,)."""
        values = [
            self.log_eps if n == "sensor.log_eps" else getattr(self[n.split(".")[0]], n.split(".")[1])
            for n in self.parameter_names()
        ]
        return np.array(values, np.float32)

    def table(self) -> dict[str, Any]:
        """Return the sensor as it stands in a sensor file."""
        out: dict[str, Any] = {"name": self.name}
        if self.size is not None:
            out["size"] = list(self.size)
        out["log_eps"] = self.log_eps
        for effect in self.effects:
            out[effect.name] = {f.name: getattr(effect, f.name) for f in fields(effect)}
        return out


class Pixels:
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
    ):
        try:
            self.device = launch.device(device)
        except ValueError as error:
            raise InputError(str(error)) from error
        self.sensor, self.width, self.height = sensor, width, height
        self.seed = seed & 0x7FFFFFFF  # a key of random numbers has 31 bits
        self.stages = sensor.stages()
        self.pixels = (
            np.arange(width * height, dtype=np.int32) if pixels is None else np.asarray(pixels, np.int32)
        )
        vectors = sensor.parameters()[None] if parameters is None else np.asarray(parameters, np.float32)
        if vectors.ndim != 2 or vectors.shape[1] != len(sensor.parameter_names()):
            raise InputError(
                f"parameters must have shape (B, {len(sensor.parameter_names())}), got {vectors.shape}"
            )
        if (
            self.pixels.ndim != 1
            or len(self.pixels) == 0
            or self.pixels.min() < 0
            or self.pixels.max() >= width * height
        ):
            raise InputError(f"pixels must be indices of the {width}x{height} sensor, shape (N,), N >= 1")
        self.batch, self.count = len(vectors), len(self.pixels)
        self._pixels = wp.array(self.pixels, dtype=int, device=self.device)
        self._parameters = wp.array(vectors, dtype=float, device=self.device)
        self.sink = "labels" if labels else "keys"
        shape = (len(pixel.states(self.stages, self.sink)), self.batch, self.count)
        # two copies, so that a chunk whose events overran their buffer can be run again
        self._state = wp.zeros(shape, dtype=float, device=self.device)
        self._next = wp.zeros(shape, dtype=float, device=self.device)
        self.samples = 0
        self.begin = 0.0
        self.slab = 256 if self.device.is_cuda else 2048
        self._capacity = 4 * self.slab
        self._bits = max((self.batch * self.count - 1).bit_length(), 1)
        self._low = 3 if labels else 1
        delays = any(stage == "delay" for effect in self.stages for stage, _ in effect.functions)
        # keys of events that leave after the chunk, counted from its end
        self._late = np.empty(0, np.int64) if delays else None

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
        sink = pixel.Counts()
        if np.any(np.diff(windows[windows >= 0]) < 0):
            raise InputError("windows must not decrease from sample to sample")
        shape = (self.batch, size, 2, self.count)
        # the kernel writes each window it meets, whole
        new = wp.empty if len(np.unique(windows[windows >= 0])) == size else wp.zeros
        sink.counts = new(shape, dtype=int, device=self.device)
        self._launch("counts", sink, scene, times, windows, align=16)
        self._advance(times)
        return sink.counts

    def emit(self, scene: Scene, times: NDArray[np.float64]) -> tuple[Events, NDArray[np.int32] | None]:
        """Advance over `times` and return the events that leave the pixels, and for a batch the row of each.

        Readout effects come behind this, see `dase.outlet.Outlet`.

        Args:
            scene: What the pixels see.
            times: Samples [s], shape (K,), following the last ones.
        """
        begin = self.begin if self.samples else float(times[0])
        span = round(float(times[-1]) * 1e9) - round(begin * 1e9)
        longest = span if self._late is None else span + round(pixel.LATEST * 1e9)
        if self._bits + self._low + longest.bit_length() > 63:
            raise InputError(
                f"a chunk of {span * 1e-9:g} s with {self.batch * self.count} pixels is too long"
            )
        keys, used = self._keys(scene, times)
        self._advance(times)
        found = ordering.ordered(keys, used, self._bits, self._low, self.device, self._late)
        events, row = self._decode(found, begin)
        if self._late is None:
            return events, row
        now = int(np.searchsorted(events.t, 1e-9 * float(round(self.begin * 1e9)), side="right"))
        self._late = found.numpy()[now:] - (span << (self._bits + self._low))
        return events.select(slice(now)), None if row is None else row[:now]

    def flush(self) -> tuple[Events, NDArray[np.int32] | None]:
        """Return the events that have not left the pixels yet, as `emit` does; time is over."""
        late = np.empty(0, np.int64) if self._late is None else self._late
        self._late = None if self._late is None else late[:0]
        return self._decode(wp.array(late, dtype=wp.int64, device=self.device), self.begin)

    def _keys(self, scene: Scene, times: NDArray[np.float64]) -> tuple[Any, NDArray[np.int32]]:
        """Run the pixels until all their events fit; return the keys and how many there are per slab."""
        slabs = -(-self.count // self.slab)
        while True:
            sink = pixel.Keys()
            sink.keys = wp.empty((self.batch, slabs, self._capacity), dtype=wp.int64, device=self.device)
            sink.used = wp.zeros((self.batch, slabs), dtype=int, device=self.device)
            sink.slab, sink.bits, sink.low = self.slab, self._bits, self._low
            self._launch(self.sink, sink, scene, times, np.zeros(len(times), np.int32), align=self.slab)
            used = sink.used.numpy()
            if used.max() <= self._capacity:
                return sink.keys, used
            self._capacity = int(1.25 * used.max()) + 1

    def thresholds(self) -> NDArray[np.float32]:
        """Return the thresholds of each pixel [log intensity], shape (B, 2, N): OFF, ON."""
        kernel = pixel.compose_thresholds(self.stages)
        out = wp.empty((self.batch, 2, self.count), dtype=float, device=self.device)
        inputs = [self._pixels, self.width, self.height, self.seed, self._parameters, out]
        launch.run(kernel, self.count, inputs, self.device, batch=self.batch)
        return np.asarray(out.numpy())

    def _launch(
        self,
        sink_name: str,
        sink: Any,
        scene: Scene,
        times: NDArray[np.float64],
        windows: NDArray[np.int32],
        align: int,
    ) -> None:
        source_name, source = scene.source(times, self.pixels, self.device)
        kernel = pixel.compose(self.stages, source_name, sink_name)
        clock = self._clock(times, windows)
        inputs = [
            source, clock, self._pixels, self.width, self.height, self.samples, self.seed,
            self._parameters, self._state, self._next, sink,
        ]  # fmt: skip
        launch.run(kernel, self.count, inputs, self.device, batch=self.batch, align=align)

    def _clock(self, times: NDArray[np.float64], windows: NDArray[np.int32]) -> Any:
        first = self.samples == 0
        previous = float(times[0]) if first else self.begin
        edges = np.concatenate([[previous], times])
        dt = np.diff(edges)
        if not np.all(dt[first:] > 0) or not np.all(np.isfinite(edges)):
            raise InputError("sample times must increase")
        clock = pixel.Clock()
        if first:
            dt[0] = pixel.REST
        stamps = np.round(edges * 1e9)
        begin, length = stamps[:-1] - stamps[0], np.diff(stamps)
        # rounded down, so that no event comes after the end of its step
        short = length.astype(np.float32)
        short = np.where(short > length, np.nextafter(short, np.float32(0)), short)
        to = self.device
        clock.t = wp.array(times.astype(np.float32), dtype=float, device=to)
        clock.t64 = wp.array(times, dtype=wp.float64, device=to)
        clock.dt = wp.array(dt.astype(np.float32), dtype=float, device=to)
        clock.begin = wp.array(begin.astype(np.int64), dtype=wp.int64, device=to)
        clock.span = wp.int64(int(stamps[-1] - stamps[0]))
        clock.length = wp.array(short, dtype=float, device=to)
        # runs of one window, so that a pixel writes its counts once per window
        run = np.flatnonzero(np.diff(windows, prepend=windows[0] - 1))
        clock.run = wp.array(np.append(run, len(windows)).astype(np.int32), dtype=int, device=to)
        clock.window = wp.array(windows[run].astype(np.int32), dtype=int, device=to)
        return clock

    def _advance(self, times: NDArray[np.float64]) -> None:
        self._state, self._next = self._next, self._state
        self.samples += len(times)
        self.begin = float(times[-1])

    def _decode(self, keys: Any, begin: float) -> tuple[Events, NDArray[np.int32] | None]:
        n, to = len(keys), self.device
        out = [wp.empty(n, dtype=d, device=to) for d in (wp.float64, wp.uint16, wp.uint16, wp.uint8)]
        row = wp.empty(n if self.batch > 1 else 0, dtype=int, device=to)
        label = wp.empty(n if self.sink == "labels" else 0, dtype=wp.int8, device=to)
        inputs = [
            keys, self._bits, self._low, self.count, self._pixels, self.width,
            wp.int64(round(begin * 1e9)), *out, row, label,
        ]  # fmt: skip
        launch.run(ordering.decode, n, inputs, to)
        t, x, y, p = (a.numpy() for a in out)
        known = label.numpy() if self.sink == "labels" else None
        events = Events(t, x, y, p.view(np.bool_), self.width, self.height, known)
        return events, row.numpy() if self.batch > 1 else None


def sample_times(scene: Scene, sensor: Sensor) -> NDArray[np.float64]:
    """Return when to sample [s]: as the scene asks and, where it can, often enough for all effects."""
    times, step = scene.sample_times(), sensor.longest_step()
    if not scene.anytime or not np.isfinite(step):
        return times
    pieces = np.maximum(np.ceil(np.diff(times) / step - 1e-9), 1)
    if np.all(pieces == 1):
        return times
    at = np.concatenate([[0], np.cumsum(pieces)])
    return np.interp(np.arange(at[-1] + 1), at, times)


def chunks(times: NDArray[np.float64], size: int) -> Iterator[NDArray[np.float64]]:
    """Cut sample times into runs of `size`."""
    for i in range(0, len(times), size):
        yield times[i : i + size]


def stream(
    scene: Scene,
    sensor: Sensor,
    *,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    chunk: int | None = None,
    labels: bool = False,
) -> Iterator[Events]:
    """Simulate a scene and yield its events chunk after chunk, in memory that does not grow.

    Args:
        scene: What the sensor sees.
        sensor: What it does.
        seed: Of every random number; the same seed gives the same events, whatever `chunk` is.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate; None for all.
        chunk: Samples per chunk.
        labels: Whether events are marked with what they came from.

    Yields:
        Events in order of time. Those that leave the sensor late come with a later chunk, or in one more part
        at the end.
    """
    array = Pixels(sensor, scene.width, scene.height, pixels=pixels, seed=seed, device=device, labels=labels)
    for parts in _leaving(scene, array, chunk):
        yield parts[0]


def _leaving(scene: Scene, array: Pixels, chunk: int | None = None) -> Iterator[list[Events]]:
    """Yield what leaves the camera chunk after chunk, a stream for each row of the batch."""
    outlets = [
        Outlet(array.sensor, array.width, array.height, pixels=array.count, seed=array.seed)
        for _ in range(array.batch)
    ]
    size = chunk or CHUNK["cuda" if array.device.is_cuda else "cpu"]
    for times in chunks(sample_times(scene, array.sensor), size):
        parts = rows_of(*array.emit(scene, times), array.batch)
        yield [outlet.push(part, array.begin) for outlet, part in zip(outlets, parts, strict=True)]
    rest = zip(outlets, rows_of(*array.flush(), array.batch), strict=True)
    last = [Events.concatenate([outlet.push(part, array.begin), outlet.flush()]) for outlet, part in rest]
    if any(len(part) for part in last):
        yield last


def simulate(
    scene: Scene,
    sensor: Sensor,
    *,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    labels: bool = False,
) -> Events:
    """Simulate a scene: light → photoreceptor → change detector → readout; see `stream` for the arguments."""
    return Events.concatenate(stream(scene, sensor, seed=seed, device=device, pixels=pixels, labels=labels))


def count(
    scene: Scene,
    sensor: Sensor,
    edges: ArrayLike,
    *,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> NDArray[np.int32]:
    """Simulate a scene and count events, without ever storing a frame.

    Events are not stored either, but where the sensor has effects that move or lose them behind the change
    detector, latency and readout effects; then a window holds the events with edge < t <= next edge.

    Args:
        scene: What the sensor sees.
        sensor: What it does.
        edges: Window edges [s], increasing, shape (W + 1,); a step counts for the window its end lies in.
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate, N of them; None for all.
        parameters: Parameter vectors to simulate at once, shape (B, P); None for the sensor's own.

    Returns:
        Shape (B, W, 2, N): OFF counts in channel 0, ON counts in channel 1.
    """
    edges = np.asarray(edges, np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise InputError("window edges must increase, and there must be at least 2")
    array = Pixels(
        sensor, scene.width, scene.height, pixels=pixels, parameters=parameters, seed=seed, device=device
    )
    if sensor.retimes():
        return _count_leaving(scene, array, edges)
    total = np.zeros((array.batch, len(edges) - 1, 2, array.count), np.int32)
    for times in chunks(sample_times(scene, sensor), CHUNK["cuda" if array.device.is_cuda else "cpu"]):
        windows = (np.searchsorted(edges, times, side="left") - 1).astype(np.int32)
        windows[(windows < 0) | (windows >= len(edges) - 1)] = -1
        seen = windows[windows >= 0]
        if len(seen) == 0:
            array.count_events(scene, times, windows, 1)
            continue
        low, high = seen.min(), seen.max() + 1
        part = array.count_events(
            scene, times, np.where(windows >= 0, windows - low, -1).astype(np.int32), high - low
        )
        total[:, low:high] += part.numpy()
    return total


def _count_leaving(scene: Scene, array: Pixels, edges: NDArray[np.float64]) -> NDArray[np.int32]:
    """Count what leaves the camera, shape (B, W, 2, N)."""
    tallies = [Tally(edges, array.pixels, array.width * array.height) for _ in range(array.batch)]
    for parts in _leaving(scene, array):
        for tally, part in zip(tallies, parts, strict=True):
            tally.add(part)
    return np.stack([tally.counts for tally in tallies])
