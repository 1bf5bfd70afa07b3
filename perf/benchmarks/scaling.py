"""How time grows with pixels, samples, batch, threads and effects; writes a table, a figure and JSON.

    python -m perf.benchmarks.scaling [--device cuda:0] --out docs/

Everything is timed in turns, round after round, beside a copy of memory, so that all see the same state of
the machine. Times are wall-clock, synchronised, and include what the host does for a chunk. The results of
one device are in `scaling_cpu.json` or `scaling_cuda.json`; `speed.md` and `scaling.png` show those that are
in the folder. `--draw` writes these two alone, `--parts goals` measures a part anew.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import warp as wp

import dase
from dase.effects.threshold import Threshold
from dase.kernels import launch
from dase.scenes.scene import Scene
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import load_sensor
from perf.benchmarks import numpy_baseline, scaling_page
from perf.benchmarks.kernels import Stored, bench_counts, commit, moving_layers

SIZES = {
    "cpu": ((80, 60), (160, 120), (320, 240), (640, 480), (1280, 960)),
    "cuda": ((320, 240), (640, 480), (1280, 960), (2560, 1440), (3840, 2160)),
}
LENGTHS = {"cpu": (16, 32, 64, 128, 256, 512, 1024), "cuda": (64, 128, 256, 512, 1024)}
BATCHES = {"cpu": (1, 2, 4, 8, 16, 32), "cuda": (1, 4, 16, 64, 256, 1024)}
SAMPLES = {"cpu": 32, "cuda": 64}
FIXED = {"cpu": (160, 120), "cuda": (1280, 960)}
"""Size of the sensor while the number of samples grows."""
CHUNK = {"cpu": 64, "cuda": 128}
PARTS = {"goals": ("goal",), "axes": ("pixels", "samples", "threads", "batch"), "effects": ("effect",)}
"""Parts to their axes."""
FEW = 2000
"""Pixels of a batch, as in a diagnosis."""
CAMERA = (346, 260)
CHUNKS = 16
"""Chunks of a stream whose events are made."""

WARPED, READ, NOISY, EVENTS = (
    "ideal, picture warped, counted",
    "ideal, stored, counted",
    "noisy, stored, counted",
    "noisy, stored, events",
)
CASES = (WARPED, READ, NOISY, EVENTS)


@dataclass(frozen=True)
class Work:
    """Something to time.

    Args:
        axis: What grows, or `goal`.
        case: Which curve.
        x: Where on the axis; for effects the name of the effect.
        samples: Pixels times samples times batch that one run works off.
        run: One run; returns what `events` reads.
        events: How many events a run makes.
        read: Whether the samples are read from memory.
        threads: On the CPU; None for all.
    """

    axis: str
    case: str
    x: float | str
    samples: int
    run: Callable[[], Any]
    events: Callable[[Any], float]
    read: bool = False
    threads: int | None = None


def chunked(scene: Scene, sensor: Sensor, times: np.ndarray, device: wp.Device, batch: int = 1) -> Any:
    """Return a function that counts the events of all samples, chunk by chunk."""
    parameters = np.repeat(sensor.parameters()[None], batch, 0)
    array = PixelArray(sensor, scene.width, scene.height, parameters=parameters, device=device.alias)
    size = min(CHUNK[kind(device)], len(times))

    def run() -> list[Any]:
        found = []
        for k in range(0, len(times), size):
            part = times[k : k + size]
            if array.samples:
                array.begin = float(part[0]) - 1e-3  # the same once more, as if it came next
            found.append(array.count_events(scene, part, np.zeros(len(part), np.int32), 1))
        return found

    return run


def streamed(scene: Scene, sensor: Sensor, size: int, device: wp.Device) -> Callable[[], int]:
    """Return a function that makes all events, in order of time, and counts them."""

    def run() -> int:
        return sum(len(part) for part in dase.stream(scene, sensor, device=device.alias, chunk=size))

    return run


def counted(found: list[Any]) -> float:
    """Return the events of a run of `chunked`."""
    return float(sum(part.numpy().sum() for part in found))


def kind(device: wp.Device) -> str:
    """Return `cpu` or `cuda`."""
    return "cuda" if device.is_cuda else "cpu"


class Repeated(Stored):
    """Stored samples, read again in every chunk."""

    def __init__(self, width: int, height: int, samples: int, device: wp.Device):
        super().__init__("frames", width, height, min(samples, CHUNK[kind(device)]), device)
        self.length, self.duration = samples, samples * 1e-3

    def sample_times(self) -> np.ndarray:
        return np.arange(self.length) * 1e-3


@lru_cache
def stored(width: int, height: int, samples: int, alias: str) -> Repeated:
    """Return samples on a device that all who read them share."""
    return Repeated(width, height, samples, launch.find_device(alias))


def case_work(
    axis: str, case: str, x: float, size: tuple[int, int], samples: int, device: wp.Device, **more: Any
) -> Work:
    """Return one point of a curve of `CASES`."""
    sensor = load_sensor("davis346") if "noisy" in case else load_sensor("ideal")
    times = np.arange(samples) * 1e-3
    scene = moving_layers(0, *size, samples) if case == WARPED else stored(*size, samples, device.alias)
    batch = more.pop("batch", 1)
    if case == EVENTS:
        run: Callable[[], Any] = streamed(scene, sensor, CHUNK[kind(device)], device)
        events: Callable[[Any], float] = float
    else:
        run, events = chunked(scene, sensor, times, device, batch), counted
    total = size[0] * size[1] * samples * batch
    return Work(axis, case, x, total, run, events, read=case != WARPED, **more)


def axes(device: wp.Device) -> Iterator[Work]:
    """Yield all points of the curves."""
    where = kind(device)
    samples, fixed = SAMPLES[where], FIXED[where]
    for case in CASES:
        for width, height in SIZES[where]:
            yield case_work("pixels", case, width * height, (width, height), samples, device)
        for length in LENGTHS[where]:
            yield case_work("samples", case, length, fixed, length, device)
        for threads in scaling_page.powers(launch.thread_count()) if where == "cpu" else ():
            yield case_work("threads", case, threads, (640, 480), samples, device, threads=threads)
    for batch in BATCHES[where]:
        yield case_work("batch", NOISY, batch, (FEW // 40, 40), CHUNK[where], device, batch=batch)


def effects(device: wp.Device, size: tuple[int, int] | None = None) -> Iterator[Work]:
    """Yield every effect alone and added to those before it, on stored samples, events made."""
    size = size or (CAMERA if device.is_cpu else (1280, 960))
    samples = CHUNK[kind(device)]
    scene = stored(*size, samples, device.alias)
    total = size[0] * size[1] * samples
    ideal = Sensor((Threshold(),))
    several = ideal
    yield Work("effect", "none", "none", total, streamed(scene, ideal, samples, device), float)
    for name, effect in dase.EFFECTS.items():
        if name == "threshold":
            continue
        several = several.with_effect(effect())
        for case, sensor in (("alone", ideal.with_effect(effect())), ("together", several)):
            yield Work("effect", case, name, total, streamed(scene, sensor, samples, device), float)


def compile_some(alias: str, first: int, step: int) -> None:
    """Run some of `effects` on few pixels, so that their kernels are in Warp's cache on disk."""
    for work in list(effects(launch.find_device(alias), (64, 48)))[first::step]:
        work.run()


def compile_effects(device: wp.Device, processes: int) -> None:
    """Compile the kernels of `effects` in several processes: for CUDA one takes seconds."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=spawn) as pool:
        jobs = [pool.submit(compile_some, device.alias, n, processes) for n in range(processes)]
        for job in jobs:
            job.result()


def goals(device: wp.Device) -> Iterator[Work]:
    """Yield what has a goal of its own, and what it is compared with."""
    if device.is_cuda:
        yield case_work("goal", NOISY, 0, (3840, 2160), 64, device)
        yield case_work("goal", WARPED, 0, (3840, 2160), 64, device)
        return
    (width, height), samples = CAMERA, 64
    scene, times = moving_layers(0, *CAMERA, samples), np.arange(samples) * 1e-3
    total = width * height * samples
    pictures = numpy_baseline.Pictures(scene, times)
    cv2.setNumThreads(1)

    def summed(found: Any) -> float:
        return float(sum(n.sum() for n in found))

    for threads in scaling_page.powers(launch.thread_count()):

        def tuned(threads: int = threads) -> Any:
            return numpy_baseline.count_tuned(pictures, samples, 0.2, threads)

        yield case_work("goal", WARPED, threads, CAMERA, samples, device, threads=threads)
        yield Work("goal", "NumPy tuned", threads, total, tuned, summed, threads=threads)
    plain = partial(numpy_baseline.count_plain, pictures, samples, 0.2)
    yield Work("goal", "NumPy plain", 1, total, plain, summed, threads=1)
    # a stream goes on: memory is new and too small in the first of its chunks alone
    long = CHUNKS * CHUNK[kind(device)]
    yield case_work("goal", EVENTS, 1, CAMERA, long, device, threads=1)
    busy, size = Sensor((Threshold(on=0.01, off=0.01),)), CHUNK[kind(device)]
    run = streamed(stored(*CAMERA, long, device.alias), busy, size, device)
    yield Work("goal", "busy, stored, events", 1, width * height * long, run, float, threads=1)


def measured(works: list[Work], rounds: int, device: wp.Device) -> list[dict[str, Any]]:
    """Time all works in turns; the first round, which compiles, counts their events."""
    threads = launch.thread_count()
    rows = []
    for work in works:
        rows.append({name: getattr(work, name) for name in ("axis", "case", "x", "samples", "read")})
        rows[-1] |= {"events": work.events(work.run()), "seconds": []}
    for _ in range(rounds):
        for work, row in zip(works, rows, strict=True):
            if launch.thread_count() != (work.threads or threads):
                launch.set_threads(work.threads or threads)
            wp.synchronize_device(device)
            begin = time.perf_counter()
            found = work.run()
            wp.synchronize_device(device)
            row["seconds"].append(time.perf_counter() - begin)
            del found
    launch.set_threads(threads)
    return rows


def copying(device: wp.Device) -> Work:
    """Return a copy of memory, much larger than any cache."""
    count = 16_000_000 if device.is_cpu else 256_000_000
    if device.is_cpu:
        a, b = np.ones(count, np.float32), np.zeros(count, np.float32)
        return Work("copy", "copy", 0, count, lambda: np.copyto(b, a), lambda _: 0.0)
    source, target = (wp.ones(count, dtype=float, device=device) for _ in range(2))
    return Work("copy", "copy", 0, count, lambda: wp.copy(target, source), lambda _: 0.0)


def processor() -> str:
    """Return what the CPU is called."""
    try:
        named = [
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")
        ]
    except OSError:
        named = []
    return f"{named[0].split(':')[1].strip()}, {len(named)} cores" if named else platform.processor() or "CPU"


def measure(device: wp.Device, parts: list[str], rounds: int, out: Path) -> None:
    """Time some parts and write them into the results of the device, in place of older ones."""
    begin = time.perf_counter()
    path = out / f"scaling_{kind(device)}.json"
    kept = json.loads(path.read_text())["rows"] if path.exists() else []
    work = {"goals": goals, "axes": axes, "effects": effects}
    beside = measured([copying(device)], rounds, device)
    copy = 8 * beside[0]["samples"] / statistics.median(beside[0]["seconds"])
    for part in parts:
        if part == "effects" and device.is_cuda:
            compile_effects(device, min(os.cpu_count() or 1, 8))
        rows = measured(list(work[part](device)), rounds, device)
        if part == "goals":
            size = (640, 480) if device.is_cpu else (3840, 2160)
            took, events = bench_counts(Stored("log", *size, 64, device), rounds, device)
            row = dict(axis="goal", case="stored log, training kernel", x=0, samples=64 * size[0] * size[1])
            rows.append(row | dict(read=True, events=events, seconds=[took]))
        kept = [row for row in kept if row["axis"] not in PARTS[part]] + rows
        name = processor() if device.is_cpu else device.name
        found = dict(
            device=name, kind=kind(device), threads=launch.thread_count(), commit=commit(), copy=copy
        )
        found["rows"] = kept
        path.write_text(json.dumps(found, indent=1) + "\n")
        print(f"{part}: {len(rows)} points after {time.perf_counter() - begin:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--parts", default=",".join(PARTS), help="of what; the rest stays as it was measured")
    parser.add_argument("--draw", action="store_true", help="draw what was measured before")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.draw:
        measure(launch.find_device(options.device), options.parts.split(","), options.rounds, options.out)
    scaling_page.write(options.out)


if __name__ == "__main__":
    main()
