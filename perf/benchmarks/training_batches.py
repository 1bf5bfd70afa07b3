"""How fast `dase.torch.Stream` makes batches, kernel by kernel, and whether its memory stays.

    python -m perf.benchmarks.training_batches --device cuda --batch 64 --steps 24
    python -m perf.benchmarks.training_batches --device cpu --batch 4 --steps 6 --regimes shake
    python -m perf.benchmarks.training_batches --device cuda --batch 64 --steps 24 --openeb PATH
    python -m perf.benchmarks.training_batches --device cuda --memory 10000

A line of JSON each. A GPU is measured by the clock on the wall, several batches in a row; a CPU, which others
may share, by the time that this process worked, on one thread.

`--openeb` puts OpenEB's simulator beside it in the same run (`openeb_batches`). It is given pictures that lie
on the device: making scenes and labels is in the time of `dase.torch.Stream`, not in its own. The ratios are
of samples per second, to its speed with the same slots and all windows at once, and to its best.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

import dase
from dase.kernels import launch
from dase.torch.stream import BatchMaker
from perf.benchmarks.openeb_batches import measure_openeb, nearest_settings


def timer(device: torch.device) -> tuple[Callable[[], float], Callable[[], None]]:
    """Return the clock [s] that a device is measured by, and what waits for all that it has to do."""
    if device.type == "cuda":
        return time.perf_counter, torch.cuda.synchronize
    return time.process_time, lambda: None


def seconds_each(work: Callable[[int], Any], *, device: torch.device, repeats: int) -> float:
    """Return how long `work`, which is given numbers from 0 on, takes [s] after it was done three times."""
    clock, wait = timer(device)
    for number in range(3):
        work(number)
    wait()
    begin = clock()
    for number in range(3, 3 + repeats):
        work(number)
    wait()
    return (clock() - begin) / repeats


def measure_speed(stream: dase.torch.Stream, repeats: int) -> dict[str, Any]:
    """Return windows and pixel samples per second, and what the kernels cost [ms per batch]."""
    clock, wait = timer(stream.device)
    maker = BatchMaker(stream)
    each = seconds_each(maker.make, device=stream.device, repeats=repeats)
    batch = maker.make(2 + repeats)
    mass = float(batch.inputs.abs().sum() / batch.frames.numel())
    spent: Counter[str] = Counter()
    plain = launch.run_kernel

    def timed(kernel: Any, *arguments: Any, **options: Any) -> None:
        wait()
        begin = clock()
        plain(kernel, *arguments, **options)
        wait()
        spent[kernel.key] += clock() - begin

    launch.run_kernel = timed
    try:
        for number in range(3 + repeats, 6 + repeats):
            maker.make(number)
    finally:
        launch.run_kernel = plain
        maker.close()
    windows = stream.steps * stream.plan.batch
    samples = windows * stream.samples * stream.plan.size[0] * stream.plan.size[1]
    return {
        "batch_ms": round(1e3 * each, 2),
        "windows_per_s": round(windows / each),
        "Gsample_per_s": round(1e-9 * samples / each, 4),
        "absolute_sum_per_pixel_and_window": round(mass, 3),
        "kernels_ms": {name: round(1e3 * value / 3, 2) for name, value in spent.items()},
    }


def watch_memory(stream: dase.torch.Stream, batches: int) -> dict[str, Any]:
    """Return the memory of the process [MiB], and of the GPU, after tenths of so many batches."""
    found = []
    for number, _ in enumerate(stream):
        if number % max(batches // 10, 1) == 0:
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * 4096
            row = {"batches": number, "resident": round(resident / 2**20, 1)}
            if stream.device.type == "cuda":
                free, total = torch.cuda.mem_get_info()
                row["gpu"] = round((total - free) / 2**20, 1)
            found.append(row)
        if number >= batches:
            return {"memory": found}
    raise AssertionError("a stream has no end")


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--device", default="cpu")
    ask.add_argument("--sensor", default="davis240c")
    ask.add_argument("--images", default="builtin")
    ask.add_argument("--batch", type=int, default=12)
    ask.add_argument("--steps", type=int, default=24)
    ask.add_argument("--side", type=int, default=128)
    ask.add_argument("--regimes", default="shake,mixed")
    ask.add_argument("--repeats", type=int, default=10)
    ask.add_argument("--memory", type=int, default=0, help="batches to watch the memory over, instead")
    ask.add_argument("--openeb", type=Path, help="checkout of prophesee-ai/openeb, or folder of its Python")
    args = ask.parse_args()
    if args.device == "cpu":
        launch.set_threads(1)
        torch.set_num_threads(1)
    stream = dase.torch.Stream(
        args.images, args.sensor, batch=args.batch, steps=args.steps, size=(args.side, args.side),
        regimes=tuple(args.regimes.split(",")), device=args.device, renew=500 if args.memory else 0,
    )  # fmt: skip
    found = watch_memory(stream, args.memory) if args.memory else measure_speed(stream, args.repeats)
    if args.openeb and not args.memory:
        measured = partial(seconds_each, device=stream.device, repeats=args.repeats)
        rows = measure_openeb(args.openeb, stream, measured)
        found |= {"openeb": rows, "openeb_settings": nearest_settings(stream.sensor)}
        ratios = [found["Gsample_per_s"] / row["Gsample_per_s"] for row in rows]
        found |= {"times_openeb": round(ratios[0], 2), "times_openeb_at_its_best": round(min(ratios), 2)}
    print(json.dumps(vars(args) | found, default=str))


if __name__ == "__main__":
    main()
