"""The main path: from a scene through a sensor to events."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import checked_integer
from dase.events import Events
from dase.scenes.scene import Scene
from dase.scenes.video import as_scene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor
from dase.simulation.sensor_run import SensorRun


def stream(
    scene: Scene | ArrayLike,
    sensor: Sensor | str | PathLike[str],
    *,
    fps: float | None = None,
    times: ArrayLike | None = None,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    chunk: int | None = None,
    labels: bool = False,
) -> Iterator[Events]:
    """Simulate a scene and yield its events chunk after chunk, in memory that does not grow.

    Args:
        scene: What the sensor sees: a scene, or frames of linear intensity, shape (F, H, W). Whole numbers
            without a sign are taken by the range of their type (255 or 65535 is white), others in [0, 1].
        sensor: What it does: a `Sensor`, the name of a preset, or the path of a sensor file.
        fps: Frames per second, for frames.
        times: Times of the frames [s], shape (F,), instead of `fps`.
        seed: Of every random number; the same seed gives the same events, whatever `chunk` is.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate, shape (N,); None for all.
        chunk: Samples per chunk, at least 1; None for what suits the device.
        labels: Whether events are marked with what they came from.

    Yields:
        Events in order of time. Those that leave the sensor late come with a later chunk, or in one more part
        at the end.
    """
    if chunk is not None:
        chunk = checked_integer("chunk", chunk, 1)
    run = SensorRun(
        as_scene(scene, fps=fps, times=times), as_sensor(sensor), pixels=pixels, seed=seed, device=device,
        labels=labels, chunk=chunk,
    )  # fmt: skip
    return (part.events[0] for part in run.chunks())


def simulate(
    scene: Scene | ArrayLike,
    sensor: Sensor | str | PathLike[str],
    *,
    fps: float | None = None,
    times: ArrayLike | None = None,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    labels: bool = False,
) -> Events:
    """Simulate a scene, or frames: light → photoreceptor → change detector → readout.

        events = dase.simulate(frames, "davis346", fps=1000)

    Args:
        scene: What the sensor sees: a scene, or frames of linear intensity, shape (F, H, W), see `stream`.
        sensor: What it does: a `Sensor`, the name of a preset, or the path of a sensor file.
        fps: Frames per second, for frames.
        times: Times of the frames [s], shape (F,), instead of `fps`.
        seed: Of every random number; the same seed gives the same events.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate, shape (N,); None for all.
        labels: Whether events are marked with what they came from.

    Returns:
        Events in order of time. `stream` gives the same in parts, as they are made.
    """
    return Events.concatenate(
        stream(
            scene, sensor, fps=fps, times=times, seed=seed, device=device, pixels=pixels, labels=labels
        )
    )  # fmt: skip


def count(
    scene: Scene | ArrayLike,
    sensor: Sensor | str | PathLike[str],
    edges: ArrayLike,
    *,
    fps: float | None = None,
    times: ArrayLike | None = None,
    seed: int = 0,
    device: str = "cpu",
    pixels: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> NDArray[np.int32]:
    """Simulate a scene and count what each pixel sends, without ever storing a frame.

    Where what becomes of an event depends on other pixels, counts are taken before: `readout`, `rate_control`
    and `anti_flicker` are left out, so that any pixels can be counted alone, and so are the ticks of a clock,
    `timestamp` without jitter. `simulate(scene, sensor).counts(edges)` counts what is left behind them, much
    less where a bus is full.

    Events are not stored either, but where the sensor has other effects that move or lose them behind the
    change detector, such as latency; then a window holds the events with edge < t <= next edge.

    Args:
        scene: What the sensor sees, a scene or frames; see `stream`.
        sensor: What it does; see `stream`.
        edges: Window edges [s], increasing, shape (W + 1,); a step counts for the window its end lies in.
        fps: Frames per second, for frames.
        times: Times of the frames [s], shape (F,), instead of `fps`.
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        pixels: Row-major indices of the pixels to simulate, N of them; None for all.
        parameters: Parameter vectors to simulate at once, shape (B, P); None for the sensor's own.

    Returns:
        Shape (B, W, 2, N): OFF counts in channel 0, ON counts in channel 1.
    """
    run = SensorRun(
        as_scene(scene, fps=fps, times=times), as_sensor(sensor), pixels=pixels, parameters=parameters,
        seed=seed, device=device,
    )  # fmt: skip
    return run.count(edges)
