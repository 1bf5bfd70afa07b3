"""Kernel micro-benchmarks: what the fused pixel costs, as a share of what the memory allows.

    python -m perf.benchmarks.kernels --device cuda --size 3840x2160 --samples 64

Every figure is the median of warm, synchronised runs of one process, each of four chunks in a row.
Bandwidths compare with a device copy (numpy.copyto on the CPU) of as many bytes in the same run: the samples
alone, and all that the kernel has to move, memories and counts included.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from dase.kernels import launch, pixel_stages, threshold_counts
from dase.scenes.image_sources import open_images
from dase.scenes.layers import Layer, LayerScene, Motion
from dase.scenes.scene import Scene
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import load_sensor

CHUNKS = 4
"""Chunks per timed run."""


class Stored(Scene):
    """Samples that lie on the device: log intensity of a moving texture."""

    def __init__(self, kind: str, width: int, height: int, samples: int, device: wp.Device):
        self.kind, self.width, self.height, self.duration = kind, width, height, samples * 1e-3
        self.samples = samples
        self.data = pixel_stages.Frames()
        self.data.values = wp.empty((samples, width * height), dtype=float, device=device)
        inputs = [width, int(kind == "log"), self.data.values]
        launch.run_kernel(texture, width * height, inputs, device, batch=samples)

    def sample_times(self) -> np.ndarray:
        return np.arange(self.samples) * 1e-3

    def source(
        self, times: np.ndarray, pixels: np.ndarray, device: wp.Device
    ) -> tuple[str, pixel_stages.Frames]:
        return self.kind, self.data

    def frames(self, times: np.ndarray, device: str = "cpu") -> np.ndarray:
        raise NotImplementedError


@wp.kernel(enable_backward=False)
def texture(first: int, width: int, logarithm: int, out: wp.array2d[float]):
    """A texture that moves by a tenth of a pixel per sample."""
    k, i = wp.tid()
    i += first
    x = float(i % width) + 0.1 * float(k)
    y = float(i / width)
    value = 0.5 + 0.24 * wp.sin(0.11 * x + 0.05 * y) + 0.2 * wp.sin(0.29 * x - 0.17 * y)
    if logarithm == 1:
        value = wp.log(value)
    out[k, i] = value


def median_time(work: Callable[[], object], repeats: int, device: wp.Device) -> float:
    """Return the median duration of `work` [s] after two runs that do not count; on CUDA by device events."""
    took = []
    for n in range(repeats + 2):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        if device.is_cuda:
            first, last = (wp.Event(device, enable_timing=True) for _ in range(2))
            wp.record_event(first)
            work()
            wp.record_event(last)
            wp.synchronize_event(last)
            seconds = wp.get_event_elapsed_time(first, last) * 1e-3
        else:
            work()
            seconds = time.perf_counter() - begin
        if n >= 2:
            took.append(seconds)
    return statistics.median(took)


def copy_bandwidth(count: int, repeats: int, device: wp.Device) -> float:
    """Return bytes read plus written per second of a copy of `count` floats."""
    if device.is_cpu:
        a, b = np.ones(count, np.float32), np.zeros(count, np.float32)
        return 8 * count / median_time(lambda: np.copyto(b, a), repeats, device)
    a, b = (wp.ones(count, dtype=float, device=device) for _ in range(2))
    return 8 * count / median_time(lambda: wp.copy(b, a), repeats, device)


def moving_layers(foregrounds: int, width: int, height: int, samples: int) -> LayerScene:
    """Return a scene of photographs; everything moves by half a pixel per sample or less."""
    images, rng = open_images("builtin"), np.random.default_rng(7)
    duration = samples * 1e-3
    shift = 0.4 * samples / width
    layers = [Layer(images.background(rng), Motion(x=(0, shift), angle=(0.1, 0.11)))]
    for _ in range(foregrounds):
        x, y = rng.uniform(-0.4, 0.4, 2)
        size = (0.3, 0.3)
        motion = Motion(x=(x, x - shift), y=(y, y + 0.2 * shift), scale_x=size, scale_y=size)
        layers.append(Layer(images.foreground(rng), motion))
    return LayerScene(layers, width=width, height=height, duration=duration, shortest=1e-4, longest=1e-3)


def cases(width: int, height: int, samples: int, device: wp.Device) -> list[tuple[str, Scene, Sensor, str]]:
    """Return (name, scene, sensor, sink) of every benchmark."""
    ideal, noisy = load_sensor("ideal"), load_sensor("davis346")
    log = Stored("log", width, height, samples, device)
    stored = Stored("frames", width, height, samples, device)
    plain, crowded = (moving_layers(n, width, height, samples) for n in (0, 6))
    return [
        ("count stored log frames, ideal sensor", log, ideal, "counts"),
        ("count stored frames, ideal sensor", stored, ideal, "counts"),
        ("count stored frames, noisy sensor", stored, noisy, "counts"),
        ("emit from stored frames, noisy sensor", stored, noisy, "events"),
        ("fused warp, background, ideal sensor", plain, ideal, "counts"),
        ("fused warp, 6 objects, ideal sensor", crowded, ideal, "counts"),
        ("fused warp, 6 objects, noisy sensor", crowded, noisy, "counts"),
        ("emit from fused warp, 6 objects, noisy sensor", crowded, noisy, "events"),
    ]


def bench(
    scene: Scene, sensor: Sensor, sink: str, samples: int, repeats: int, device: wp.Device
) -> tuple[float, float]:
    """Return seconds and events of one chunk of `samples`."""
    times = np.arange(samples) * 1e-3
    windows = np.zeros(samples, np.int32)
    array = PixelArray(sensor, scene.width, scene.height, device=device.alias)
    found: list[Any] = []

    def work() -> None:
        found.clear()
        for _ in range(CHUNKS):  # one after the other, as a long recording streams
            if array.samples:
                array.samples, array.begin = (
                    samples,
                    -1e-3,
                )  # the same samples once more, as if they came next
            if sink == "counts":
                found.append(array.count_events(scene, times, windows, 1))
            else:
                found.append(len(array.emit(scene, times)[0]))

    took = median_time(work, repeats, device) / CHUNKS
    return took, float(found[-1].numpy().sum()) if sink == "counts" else found[-1]


def bench_counts(scene: Stored, repeats: int, device: wp.Device) -> tuple[float, float]:
    """Return seconds and events of the counting kernel that training uses, several pixels per thread."""
    samples, pixels = scene.data.values.shape
    lanes = threshold_counts.widest_block(pixels, device, "log")
    aligned = threshold_counts.samples_are_aligned("log", scene.data, pixels)
    kernel = threshold_counts.counting_kernel(lanes, "log", shared=True, states=False, aligned=aligned)
    out = wp.zeros((1, 1, 2, pixels), dtype=float, device=device)
    nothing = wp.empty((1, 0), dtype=float, device=device)
    arguments = [
        scene.data, 0, wp.empty(0, dtype=int, device=device), pixels, scene.width, 1,
        wp.full((1, 1, pixels), 0.2, dtype=float, device=device),
        wp.zeros(1, dtype=float, device=device),
        wp.array([0, samples], dtype=int, device=device),
        wp.zeros(1, dtype=int, device=device),
        wp.clone(scene.data.values[:1]),
        nothing, nothing, out,
    ]  # fmt: skip

    def work() -> None:
        launch.run_kernel(kernel, threshold_counts.block_count(pixels, lanes), arguments, device)

    took = median_time(work, repeats, device)
    out.zero_()
    work()
    return took, float(out.numpy().sum())


def commit() -> str:
    """Return what was measured; "unknown" where there is no git."""
    command = ["git", "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip() or "unknown"
    except FileNotFoundError:
        return "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=launch.thread_count())
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    device = launch.find_device(options.device)
    launch.set_threads(options.threads)
    where = f"{device.name}, {options.threads} threads, commit {commit()}"
    print(f"{where}: {options.size}, {options.samples} samples\n")
    copy = copy_bandwidth(width * height * options.samples, options.repeats, device)
    print(f"copy: {copy / 1e9:.0f} GB/s read plus written\n")
    print("| benchmark | ms | Gsample/s | Mevents/s | share of copy |\n|---|---|---|---|---|")
    todo = cases(width, height, options.samples, device)
    todo.insert(0, ("count stored log frames, training kernel", todo[0][1], None, ""))
    for name, scene, sensor, sink in todo:
        if sensor is None:
            took, events = bench_counts(scene, options.repeats, device)
        else:
            took, events = bench(scene, sensor, sink, options.samples, options.repeats, device)
        samples = width * height * options.samples
        share = "-"
        if isinstance(scene, Stored):
            read = 4 * samples / took / copy
            share = f"{read:.0%}"
            if sensor is None or (sensor.name == "ideal" and sink == "counts"):
                # a row is one number for every pixel: memory in and out, signal or threshold, two counts
                rows = 4 if sensor is None else 5
                share += f", all {read * (options.samples + rows) / options.samples:.0%}"
        rates = f"{samples / took / 1e9:.2f} | {events / took / 1e6:.0f} | {share}"
        print(f"| {name} | {took * 1e3:.2f} | {rates} |", flush=True)


if __name__ == "__main__":
    main()
