"""The main path: from a scene through a sensor to events."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.events import Events
from dase.scenes.scene import Scene
from dase.simulation.pixel_array import PixelArray
from dase.simulation.readout_chain import ReadoutChain, WindowCounter, split_by_row
from dase.simulation.sensor import Sensor

CHUNK = {"cpu": 64, "cuda": 128}
"""Samples per chunk: few enough that layers far from a pixel are skipped, enough to amortise a launch."""


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
    array = PixelArray(
        sensor, scene.width, scene.height, pixels=pixels, seed=seed, device=device, labels=labels
    )
    for parts in _leaving(scene, array, chunk):
        yield parts[0]


def _leaving(scene: Scene, array: PixelArray, chunk: int | None = None) -> Iterator[list[Events]]:
    """Yield what leaves the camera chunk after chunk, a stream for each row of the batch."""
    outlets = [
        ReadoutChain(array.sensor, array.width, array.height, pixels=array.count, seed=array.seed)
        for _ in range(array.batch)
    ]
    size = chunk or CHUNK["cuda" if array.device.is_cuda else "cpu"]
    for times in chunks(sample_times(scene, array.sensor), size):
        parts = split_by_row(*array.emit(scene, times), array.batch)
        yield [outlet.push(part, array.begin) for outlet, part in zip(outlets, parts, strict=True)]
    rest = zip(outlets, split_by_row(*array.flush(), array.batch), strict=True)
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
    array = PixelArray(
        sensor, scene.width, scene.height, pixels=pixels, parameters=parameters, seed=seed, device=device
    )
    if sensor.changes_event_stream():
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


def _count_leaving(scene: Scene, array: PixelArray, edges: NDArray[np.float64]) -> NDArray[np.int32]:
    """Count what leaves the camera, shape (B, W, 2, N)."""
    tallies = [WindowCounter(edges, array.pixels, array.width * array.height) for _ in range(array.batch)]
    for parts in _leaving(scene, array):
        for tally, part in zip(tallies, parts, strict=True):
            tally.add(part)
    return np.stack([tally.counts for tally in tallies])
