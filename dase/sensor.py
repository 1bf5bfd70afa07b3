"""The sensor: an ordered list of effects, and the main path from a scene to events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.effects import EFFECTS
from dase.effects.base import Effect
from dase.effects.optics import SceneEffect
from dase.effects.stream import StreamEffect
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import Events
from dase.history import Entry
from dase.kernels import pixel
from dase.outlet import Outlet, Tally, rows_of
from dase.pixels import Pixels
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
        apart = (Threshold, SceneEffect, StreamEffect)
        return tuple(effect.compiled() for effect in self.effects if not isinstance(effect, apart))

    def seen(self, scene: Scene) -> Scene:
        """Return what the pixels see of `scene`."""
        for effect in self.effects:
            scene = effect.seen(scene) if isinstance(effect, SceneEffect) else scene
        return scene

    def streams(self) -> tuple[StreamEffect, ...]:
        """Return the effects behind the pixels that are not off."""
        return tuple(e for e in self.effects if isinstance(e, StreamEffect) and not e.is_off())

    def located(self, folder: Path) -> Sensor:
        """Return the sensor with the files of its effects found from `folder`, in which its own file lies."""
        return replace(self, effects=tuple(effect.located(folder) for effect in self.effects))

    def bound_to(self, scene: Scene) -> Sensor:
        """Return the sensor with whatever its pixels owe to the scene worked out."""
        if not any(effect.maps for effect in self.effects):
            return self
        return replace(self, effects=tuple(effect.bound_to(scene) for effect in self.effects))

    def maps(self, pixels: NDArray[np.int32], device: Any) -> list[Any]:
        """Return what kernels get beside parameters: an array (M, N) of maps where effects have any."""
        values = [effect.map_values(pixels) for effect in self.effects if effect.maps]
        return [wp.array(np.concatenate(values), dtype=float, device=device)] if values else []

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
            out[effect.name] = {name: getattr(effect, name) for name in effect.settings()}
        return out


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
