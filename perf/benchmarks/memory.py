"""Simulates a long scene with every effect on and watches the memory: it must not grow with time.

    python -m perf.benchmarks.memory [--size 640x480] [--seconds 10] [--fps 1000] [--json OUT]

Events are taken chunk by chunk, as `dase synth` does, and not kept. Prints their number and the resident
memory after every simulated second, then the peak and the slope of a straight line through all seconds but
the first, in which buffers grow to their size. Ends with status 1 where the slope is 1 MiB per simulated
second or more.

The C library keeps some of what was freed and hands it out again, which looks like growth for some seconds.
So that only what the simulation holds is seen, the script starts itself again with glibc told to give large
blocks back at once; `--as-it-is` leaves that out.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

import dase
from dase.scenes.scene import Scene
from perf.benchmarks.kernels import commit, moving_layers
from perf.benchmarks.peer_worker import forget, memory

STEADY = 2.0
"""Begin of the seconds that the slope is fitted to [s]; the last is left out, for then late events leave."""


def everything() -> dase.Sensor:
    """Return a sensor that has every effect, with its default numbers."""
    return dase.Sensor(tuple(effect() for effect in dase.EFFECTS.values()), name="everything")


class Swinging(Scene):
    """Photographs that move to and fro for as long as it is asked for, sampled at a fixed rate.

    Args:
        width: Columns [px].
        height: Rows [px].
        duration: Length [s].
        rate: Samples per second.
    """

    def __init__(self, width: int, height: int, duration: float, rate: float):
        self.width, self.height, self.duration = width, height, duration
        self.rate = rate
        self._inside = moving_layers(3, width, height, 1000)

    def sample_times(self) -> np.ndarray:
        return np.arange(round(self.duration * self.rate) + 1) / self.rate

    def _folded(self, times: np.ndarray) -> np.ndarray:
        """Return times inside the scene that runs forwards and backwards."""
        turn = np.mod(times, 2 * self._inside.duration)
        return np.minimum(turn, 2 * self._inside.duration - turn)

    def source(self, times: np.ndarray, pixels: np.ndarray, device: object) -> tuple[str, object]:
        return self._inside.source(self._folded(times), pixels, device)

    def frames(self, times: np.ndarray, device: str = "cpu") -> np.ndarray:
        return self._inside.frames(self._folded(times), device)


def resident() -> int:
    """Return the memory of this process that is resident now [bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def watch(scene: Scene, sensor: dase.Sensor, device: str) -> list[dict[str, float]]:
    """Simulate and return events, resident memory and time taken after every simulated second."""
    rows: list[dict[str, float]] = []
    events, now, begin = 0, 0.0, time.perf_counter()
    for part in dase.stream(scene, sensor, device=device):
        events += len(part)
        now = float(part.t[-1]) if len(part) else now
        if now >= len(rows) + 1:
            took = time.perf_counter() - begin
            rows.append(dict(second=len(rows) + 1, events=events, resident=resident(), took=took))
            mebibytes = rows[-1]["resident"] / 2**20
            print(f"{len(rows):3d} s  {events:12,} events  {mebibytes:8.1f} MiB  {took:7.1f} s", flush=True)
    rows.append(dict(second=now, events=events, resident=resident(), took=time.perf_counter() - begin))
    return rows


def give_back_at_once() -> None:
    """Start this script again with a C library that returns large blocks when they are freed."""
    if "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        several = {"MALLOC_MMAP_THRESHOLD_": "262144", "MALLOC_ARENA_MAX": "1"}
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **several})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--fps", type=float, default=1000.0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--as-it-is", action="store_true", help="leave the C library as it is")
    options = parser.parse_args()
    if not options.as_it_is:
        give_back_at_once()
    width, height = map(int, options.size.split("x"))
    scene, sensor = Swinging(width, height, options.seconds, options.fps), everything()
    samples = len(scene.sample_times())
    print(f"{options.size}, {samples} samples, {len(sensor.effects)} effects, commit {commit()}")
    forget()
    rows = watch(scene, sensor, options.device)
    steady = [row for row in rows if STEADY <= row["second"] < options.seconds]
    slope = float("nan")
    if len(steady) > 1:
        slope = float(np.polyfit([r["second"] for r in steady], [r["resident"] for r in steady], 1)[0])
    peak, last = memory(), rows[-1]
    speed = width * height * samples / last["took"] / 1e6
    print(f"{speed:.1f} Mpx-samples/s, {last['events']:,} events in {last['took']:.0f} s")
    print(f"peak {peak / 2**20:.0f} MiB, slope {slope / 2**20:+.3f} MiB per simulated second")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        found = dict(size=options.size, samples=samples, effects=len(sensor.effects), commit=commit())
        found |= dict(peak=peak, slope=slope, rows=rows)
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    sys.exit(0 if slope < 2**20 or np.isnan(slope) else 1)


if __name__ == "__main__":
    main()
