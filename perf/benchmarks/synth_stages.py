"""Where the time of a whole `dase synth` goes: seconds of each stage on each kind of thread, in one process.

python -m perf.benchmarks.synth_stages --images FOLDER --device cuda

Seconds are exclusive: what a stage calls that is a stage itself is counted there alone. Beside those on the
clock are those of the processor: what lies between is waiting, for another thread, Python's lock, the GPU or
the disk. On a CPU a stage includes its kernels, with `DASE_THREADS=1` all of them. `perf.benchmarks.synth`
times the job undisturbed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any


class StageTimer:
    """Counts exclusive seconds of functions by stage and kind of thread."""

    def __init__(self) -> None:
        self.seconds: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
        """On the clock and of the processor [s], and calls, by kind of thread and stage."""
        self._open = threading.local()

    def watch(self, stage: str, owner: Any, *names: str) -> None:
        """Count what functions of a module or class take, methods included."""
        for name in names:
            setattr(owner, name, self._timed(stage, getattr(owner, name)))

    def _timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def run(*args: Any, **more: Any) -> Any:
            inside = self._open.__dict__.setdefault("inside", [[0.0, 0.0]])
            inside.append([0.0, 0.0])
            wall, work = time.perf_counter(), time.thread_time()
            try:
                return function(*args, **more)
            finally:
                took = time.perf_counter() - wall, time.thread_time() - work
                nested = inside.pop()
                kind = threading.current_thread().name.rstrip("0123456789_")
                found = self.seconds[kind, stage]
                for n in range(2):
                    found[n] += took[n] - nested[n]
                    inside[-1][n] += took[n]
                found[2] += 1

        return run


def since_start() -> float:
    """Return how long this process has run [s], NaN where the system does not tell."""
    try:
        ticks = float(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return float(Path("/proc/uptime").read_text().split()[0]) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return float("nan")


def watch_stages(timer: StageTimer, *, launches: bool) -> None:
    """Have the stages of `dase.datasets.generate` counted, launches of kernels as one if asked to."""
    # all within functions, as what is imported is timed, too
    from dase.datasets import generate, steps_in_order
    from dase.io import h5
    from dase.kernels import event_columns, event_keys, host_blocks, launch
    from dase.scenes import image_sources, layers, random_scenes
    from dase.simulation import pixel_array, readout_chain, sensor_run

    timer.watch("all else", generate, "generate_dataset", "_draw_sequence")
    timer.watch("all else", steps_in_order.StepsInOrder, "_do_steps")
    timer.watch("pictures: decode", image_sources, "decode_file")
    timer.watch("scene: draw", random_scenes, "draw_scene")
    timer.watch("sample times", generate, "sample_times")
    timer.watch("pixels: set up", pixel_array.PixelArray, "__init__", "bind_scene")
    timer.watch("pixels: set up", sensor_run.SensorRun, "thresholds")
    timer.watch("layers: place and upload", layers.LayerScene, "arrays")
    timer.watch("kernels: compile or load", import_module("warp._src.context").Module, "load")
    timer.watch("kernels: Warp starts", launch, "_start_warp")
    timer.watch("pixels: prepare a chunk", pixel_array.PixelArray, "_start")
    if launches:
        timer.watch("launches", import_module("warp"), "launch")
    timer.watch("pixels: wait for a chunk", pixel_array.PixelArray, "_number_of_events")
    timer.watch("events: order", event_keys, "keys_in_order")
    timer.watch("events: decode", pixel_array.PixelArray, "_decode_keys")
    timer.watch("events: copy to the host", event_columns.EventColumns, "bring")
    timer.watch("readout", readout_chain.ReadoutChain, "push", "flush")
    timer.watch("frames", layers.LayerScene, "grey_frames")
    timer.watch("flow", layers.LayerScene, "flow")
    timer.watch("frames, flow: copy to the host", host_blocks, "copy_to_host")
    timer.watch("HDF5: pack", h5, "pack_chunk")
    timer.watch("HDF5: events into blocks", h5._Writer, "_put_events")
    timer.watch("HDF5: events into the file", h5._Writer, "_flush")
    timer.watch("HDF5: frames", h5._Writer, "_put_frame")
    timer.watch("HDF5: wait for packing", h5._PackingLine, "_write_next")
    timer.watch("HDF5: end of the file", h5._Writer, "finish")
    timer.watch("flush to disk", os, "fsync")
    timer.watch("wait for reading out and writing", steps_in_order.StepsInOrder, "_put", "is_done")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", default="builtin")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--sequences", default=20, type=int)
    parser.add_argument("--duration", default=1.0, type=float)
    parser.add_argument("--sensor", default="davis346")
    options = parser.parse_args()
    python = since_start()

    from dase.datasets import generate
    from dase.simulation.sensor_file import dump_sensor, load_sensor

    imported = since_start()
    timer = StageTimer()
    watch_stages(timer, launches=options.device != "cpu")
    width, height = map(int, options.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        job = generate.DatasetJob(
            images=options.images, sensor=dump_sensor(load_sensor(options.sensor)),
            sequences=options.sequences, width=width, height=height, duration=options.duration,
            regime="mixed", backend=options.device,
        )  # fmt: skip
        begin = time.perf_counter()
        report = generate.generate_dataset(job, Path(folder) / "out")
        took = time.perf_counter() - begin
    print(f"Python {python:.2f} s, imports {imported - python:.2f} s, the job {took:.2f} s")
    print(f"{report.events:,} events, {report.samples:,} samples in {report.sequences} sequences")
    print("| thread | stage | s on the clock | s of the processor | calls |\n|---|---|---|---|---|")
    rows = sorted(timer.seconds.items(), key=lambda row: (row[0][0], -row[1][0]))
    for (kind, stage), (wall, work, calls) in rows:
        print(f"| {kind} | {stage} | {wall:.2f} | {work:.2f} | {calls:.0f} |")


if __name__ == "__main__":
    main()
