r"""Compares dase with other simulators that the user has, side by side in one run, on the same clip.

    python -m perf.benchmarks.peers --v2e PATH --openeb PATH --esim \
        [--clip FILE] [--size 346x260] [--json OUT] [--processor-time]

PATH is a checkout; `--esim` needs the module esim_py. Each runs in a process of its own with what it needs
installed; one that is not given is said to be so. Runs take turns, so that all see the same state of the
machine. Every simulator gets 8-bit pictures in memory (esim_py: in files) and returns events in memory;
`video to HDF5` and `video to DAT` are whole jobs, from a file of pictures to a file of events, each in the
way of the simulator's own command. `photograph moved` makes the pictures itself, by warping a photograph;
its time includes that. On a machine that others use, too, `--processor-time` counts what the process works,
on one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import dase
from perf.benchmarks import kernels

ROOT = Path(__file__).resolve().parents[2]

INSTALLED = {"v2e": "v2ecore", "openeb": "metavision_core_ml", "esim": "esim_py"}
"""Simulators by the module that is there where they are installed."""


class Worker:
    """A simulator in its process.

    Args:
        peer: A name of `peer_worker.PEERS`.
        clip: Folder of the clip.
        threads: How many the simulator may use.
        path: Of its checkout.
        processor_time: Whether the time that counts is that of the processor, not that on the clock.
    """

    def __init__(
        self, peer: str, clip: Path, threads: int, path: Path | None, *, processor_time: bool = False
    ):
        command = [sys.executable, "-m", "perf.benchmarks.peer_worker", peer, str(clip)]
        command += ["--threads", str(threads), *(["--path", str(path.resolve())] if path else [])]
        command += ["--processor-time"] if processor_time else []
        limits = ("OMP", "MKL", "OPENBLAS", "NUMBA")
        several = {f"{name}_NUM_THREADS": str(threads) for name in limits}
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115  # it lives as long as the process
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True,
            env={**os.environ, **several, "DASE_THREADS": str(threads)}, cwd=ROOT,
        )  # fmt: skip
        self.runs: dict[str, list[str]] = self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._log.seek(0)
            raise RuntimeError((self._log.read().strip() or "it ended without a word").splitlines()[-1])
        return json.loads(line)

    def run(self, task: str, setting: str) -> dict[str, float]:
        """Return seconds, events, memory before and greatest memory of one run [bytes]."""
        assert self._process.stdin is not None
        print(json.dumps([task, setting]), file=self._process.stdin, flush=True)
        found: dict[str, float] = self._answer()
        return found

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def make_clip(folder: Path, options: argparse.Namespace) -> tuple[int, int, int]:
    """Write the clip; return its samples, height and width."""
    width, height = map(int, options.size.split("x"))
    if options.clip is None:
        scene: dase.Scene = kernels.moving_layers(0, width, height, options.samples)
        times = np.arange(options.samples) * 1e-3
        (folder / "moved").touch()
    else:
        scene = dase.open_video(options.clip, size=(width, height))
        times = scene.sample_times()[: options.samples]
    frames = np.rint(255 * scene.frames(times).clip(0, 1)).astype(np.uint8)
    np.save(folder / "frames.npy", frames)
    np.save(folder / "times.npy", times - times[0])
    (folder / "pictures").mkdir()
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / "pictures" / f"{k:06d}.bmp"), frame)
    video = cv2.VideoWriter(str(folder / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1000, (width, height))
    for frame in frames:
        video.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    video.release()
    (folder / "out").mkdir()
    return len(frames), height, width


def measure(
    clip: Path, threads: int, peers: dict[str, Path | None], rounds: int, *, processor_time: bool
) -> Iterator[tuple[str, str, list[dict[str, float]]]]:
    """Yield task, setting and runs of every simulator, without the first run of each, which compiles."""
    workers: dict[str, Worker] = {}
    for peer, path in peers.items():
        try:
            workers[peer] = Worker(peer, clip, threads, path, processor_time=processor_time)
        except RuntimeError as error:
            print(f"{peer}: does not start: {error}")
    for setting in ("clean", "as v2e", "noisy"):
        todo = [(peer, task) for peer, w in workers.items() for task, has in w.runs.items() if setting in has]
        found: dict[str, list[dict[str, float]]] = {task: [] for _, task in todo}
        for turn in range(rounds + 1):
            for peer, task in todo:
                if peer not in workers:
                    continue
                try:
                    result = workers[peer].run(task, setting)
                except RuntimeError as error:
                    print(f"{peer}: {task}, {setting}: {error}")
                    del workers[peer]
                    continue
                found[task] += [result] if turn else []
        for task, runs in found.items():
            if runs:
                yield task, setting, runs
    for worker in workers.values():
        worker.close()


def row(task: str, setting: str, threads: int, runs: list[dict[str, float]], work: int) -> dict[str, Any]:
    """Return one line of the table."""
    seconds = sorted(run["s"] for run in runs)
    middle = statistics.median(seconds)
    events = statistics.median(run["events"] for run in runs)
    return {
        "simulator": task,
        "setting": setting,
        "threads": threads,
        "Mpx-samples/s": work / middle / 1e6,
        "slowest": work / seconds[-1] / 1e6,
        "fastest": work / seconds[0] / 1e6,
        "Mevents/s": events / middle / 1e6,
        "events": int(events),
        "peak MiB": max(run["peak"] for run in runs) / 2**20,
        "MiB of the run": max(run["peak"] - run["before"] for run in runs) / 2**20,
    }


def processor_name() -> str:
    """Return what the system calls the processor, with family and model where it says them."""
    try:
        lines = [line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
    except OSError:
        return platform.processor() or platform.machine()
    said = {name.strip(): value.strip() for name, value in reversed(lines)}
    if "model name" not in said:
        return platform.processor() or platform.machine()
    return f"{said['model name']} (family {said.get('cpu family')}, model {said.get('model')})"


def shown(line: dict[str, Any]) -> str:
    """Return a line of the table in Markdown."""
    speed = f"{line['Mpx-samples/s']:.1f} ({line['slowest']:.1f} to {line['fastest']:.1f})"
    silent = line["simulator"].startswith("reading")
    rate = "-" if silent else f"{line['Mevents/s']:.2f} | {line['events']:,}"
    rate += " | -" if silent else ""
    return (
        f"| {line['simulator']} | {line['setting']} | {line['threads']} | {speed} | {rate} "
        f"| {line['peak MiB']:.0f} | {line['MiB of the run']:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--v2e", type=Path, help="checkout of SensorsINI/v2e")
    parser.add_argument(
        "--openeb", type=Path, help="checkout of prophesee-ai/openeb, or folder of its Python"
    )
    parser.add_argument("--esim", action="store_true", help="esim_py can be imported")
    parser.add_argument("--clip", type=Path, help="video instead of a moving photograph")
    parser.add_argument("--size", default="346x260")
    parser.add_argument("--samples", type=int, default=200, help="pictures")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--processor-time", action="store_true", help="of one thread")
    options = parser.parse_args()
    peers: dict[str, Path | None] = {"dase": None, "numpy": None}
    for name in ("v2e", "openeb", "esim"):
        given = getattr(options, name)
        installed = find_spec(INSTALLED[name])
        if isinstance(given, Path):
            peers[name] = given
        elif installed is not None and installed.origin is not None:
            peers[name] = Path(installed.origin).parents[1]
        else:
            print(f"{name}: neither given nor installed")
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        samples, height, width = make_clip(Path(folder), options)
        about = f"{width}x{height}, {samples} pictures, {processor_name()}, "
        about += f"{os.cpu_count()} cores, commit {kernels.commit()}"
        about += ", processor time" if options.processor_time else ""
        print(f"\n{about}; median of {options.rounds} rounds (slowest to fastest)\n")
        print(
            "| simulator | setting | threads | Mpx-samples/s | Mevents/s | events | peak MiB | of the run |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for threads in sorted({1, 1 if options.processor_time else os.cpu_count() or 1}):
            for task, setting, runs in measure(
                Path(folder), threads, peers, options.rounds, processor_time=options.processor_time
            ):
                lines.append(row(task, setting, threads, runs, samples * height * width))
                print(shown(lines[-1]), flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"about": about, "rows": lines}, indent=1) + "\n")


if __name__ == "__main__":
    main()
