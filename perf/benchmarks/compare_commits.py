"""Speed before and after a change, in one run and as ratios, so that the machine's mood cancels.

    python -m perf.benchmarks.compare_commits ../before ../after
    python -m perf.benchmarks.compare_commits ../before ../after --device cuda:0
    python -m perf.benchmarks.compare_commits ../before ../after --only count simulate --rounds 5
    python -m perf.benchmarks.compare_commits ../before ../after --only diagnose --hidden FOLDER --case a_01

In each round each checkout gets a fresh process, itself in front of the PYTHONPATH. Both are on the same core
and take turns, so that only one works at a time: A B, B A, A B, ... Each call is warm and waits for the
device at its end. On a CPU the processor time of the process is taken, which other work on the machine hardly
changes; on a GPU the time on the clock. A ratio is the time after divided by the time before of one pair:
below 1 is faster. Printed are the median of all pairs and its 90 % interval, the times themselves, and
whether both compute the same. The interval is a bootstrap over rounds and the pairs in them, for two
processes of the same code differ by some per cent as long as they live. A figure that a checkout cannot run
is named and left out.

`--hidden FOLDER --case a_01` diagnoses a case of another simulator, `a_01.npz` with `clip_a.npz` beside it,
as `perf.experiments.blind_diagnosis.run` reads them, instead of a made one. `--sensor FILE`
gives both the same noisy sensor, where their presets differ.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

PAIRS = {"count": 12, "simulate": 12, "diagnose": 3, "train": 12}
"""Figures, and pairs of calls in a round: fewer of what takes long."""

TRAINING = ("dase.learning.job", "dase.adaptation")
"""Homes of the job of a training run, new and old."""


@dataclass
class Work:
    """A figure in a worker.

    Args:
        call: What is timed; returns something that a hash can be made of.
        inner: Calls between two looks at the clock.
    """

    call: Callable[[], Any]
    inner: int = 1


def located(modules: tuple[str, ...]) -> Any:
    """Return the first of the modules that this checkout, the working directory, has.

    Whether one can be imported does not tell: an editable installation lends those of its own checkout.
    """
    for module in modules:
        if Path(*module.split(".")).with_suffix(".py").is_file():
            return import_module(module)
    raise ModuleNotFoundError(f"none of {', '.join(modules)} is there")


def clip(width: int, height: int, samples: int) -> Any:
    """Return a scene of stored frames at 1 kHz: drifting waves of several scales, brighter to the right."""
    import dase

    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    waves = [(rng.uniform(0.03, 0.6), *rng.uniform(0, 6.28, 2), rng.uniform(10, 120)) for _ in range(8)]
    frames = np.empty((samples, height, width), np.float32)
    for k in range(samples):
        sums = sum(np.sin(f * (x * np.cos(a) + y * np.sin(a)) + b + s * k / 1000) for f, a, b, s in waves)
        frames[k] = np.clip((0.3 + 0.08 * sums) * np.exp(x / width - 1), 0.01, 1)
    return dase.VideoScene(frames, np.arange(samples) / 1000)


def make_count(options: argparse.Namespace) -> Work:
    """Counts of ideal pixels from stored frames."""
    import dase

    size = (640, 480, 256) if options.device != "cpu" else (240, 180, 256)
    scene, sensor, edges = clip(*size), dase.Sensor(), np.linspace(0, 0.255, 6)
    return Work(lambda: dase.count(scene, sensor, edges, seed=1, device=options.device))


def make_simulate(options: argparse.Namespace) -> Work:
    """Events of a noisy sensor, in order of time."""
    import dase

    size = (346, 260, 256) if options.device != "cpu" else (173, 130, 256)
    scene, sensor = clip(*size), dase.load_sensor(options.sensor)

    def call() -> list[Any]:
        events = dase.simulate(scene, sensor, seed=1, device=options.device)
        return [events.t, events.x, events.y, events.p]

    return Work(call)


def make_diagnose(options: argparse.Namespace) -> Work:
    """One diagnosis: a made case, which lacks a bandwidth, or one of a folder."""
    import dase

    if options.hidden:
        with np.load(options.hidden / f"clip_{options.case[0]}.npz") as data:
            scene = dase.VideoScene(data["frames"].astype(np.float32) / 255, data["frame_us"] * 1e-6)
        with np.load(options.hidden / f"{options.case}.npz") as data:
            t, x, y, p = (data[k] for k in ("t_us", "x", "y", "p"))
        events = dase.Events(t * 1e-6, x, y, p.astype(bool), scene.width, scene.height)
        given, pixels = None, 1500
    else:
        scene, pixels = clip(96, 64, 400), 400
        threshold, bandwidth = dase.EFFECTS["threshold"], dase.EFFECTS["bandwidth"]
        given = dase.Sensor(effects=(threshold(on=0.25, off=0.25),))
        true = dase.Sensor(effects=(threshold(on=0.22, off=0.19),)).with_effect(bandwidth(cutoff=40.0))
        events = dase.simulate(scene, true, seed=5, device="cpu")

    # the scene was the second argument once
    named = "scene" in inspect.getfullargspec(dase.diagnose).kwonlyargs
    asked = ((events, given), {"scene": scene}) if named else ((events, scene, given), {})

    def call() -> Any:
        found = dase.diagnose(*asked[0], **asked[1], most=1, pixels=pixels, device=options.device)
        return [sorted(found.selected), list(found.errors), found.evaluations]

    return Work(call)


def make_train(options: argparse.Namespace) -> Work:
    """Steps of learning thresholds; its state goes on, so each call is the next step of both."""
    job = located(TRAINING)
    # it was called `prepare` once
    open_training = getattr(job, "open_training", None) or job.prepare
    training = open_training(
        job.Job(targets=("esim",), preset="tiny", sequences=24, steps=100_000, backend=options.device)
    )
    for _ in range(30):
        training.advance()

    def call() -> Any:
        return {k: float(v) for k, v in training.advance().items() if k == "loss"}

    return Work(call, inner=1 if options.device == "cpu" else 10)


MAKERS = {"count": make_count, "simulate": make_simulate, "diagnose": make_diagnose, "train": make_train}


def digest(value: Any) -> str:
    """Return a hash of arrays and numbers."""
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
    if isinstance(value, list):
        return hashlib.sha256(" ".join(map(digest, value)).encode()).hexdigest()[:16]
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def serve(options: argparse.Namespace) -> None:
    """Answer requests, one per line: `warm FIGURE`, `time FIGURE`; each answer is a line of JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever is printed is no answer
    works: dict[str, Work] = {}

    clock = time.process_time if options.device == "cpu" else time.perf_counter

    def wait() -> None:
        if options.device.startswith("cuda"):
            import warp

            warp.synchronize()
            if "torch" in sys.modules:
                sys.modules["torch"].cuda.synchronize()

    for line in sys.stdin:
        order, name = line.split()
        try:
            if order == "warm":
                works[name] = MAKERS[name](options)
                for _ in range(1 if name == "diagnose" else 3):
                    works[name].call()
            work = works[name]
            wait()
            begin = clock()
            for _ in range(work.inner):
                result = work.call()
            wait()
            answer = {"seconds": (clock() - begin) / work.inner, "result": digest(result)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


class Worker:
    """A process that runs the figures of one checkout."""

    def __init__(self, checkout: Path, options: argparse.Namespace):
        one = {name: "1" for name in ("DASE_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        command = [sys.executable, __file__, "--worker", "--device", options.device]
        command += ["--sensor", options.sensor]
        if options.hidden:
            command += ["--hidden", str(options.hidden.resolve()), "--case", options.case]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if options.verbose else subprocess.DEVNULL,
            text=True,
            cwd=checkout,
            env=os.environ | one | {"PYTHONPATH": python_path(checkout)},
            preexec_fn=lambda: pin(options.core),
        )

    def ask(self, order: str) -> dict[str, Any]:
        """Return the answer to one request."""
        assert self.process.stdin
        assert self.process.stdout
        print(order, file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        return json.loads(line) if line else {"error": "the worker ended; --verbose shows why"}

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()


def python_path(checkout: Path) -> str:
    """Return the PYTHONPATH of a checkout: itself first, then what lies there now, such as a Warp of its own.

    Other checkouts on it are left out: dase must come from this one, and from nowhere if it is not here.
    """
    places = [place for place in os.environ.get("PYTHONPATH", "").split(os.pathsep) if place]
    others = [place for place in places if not (Path(place) / "dase").is_dir()]
    return os.pathsep.join([str(checkout.resolve()), *others])


def pin(core: int | None) -> None:
    """Keep this process on one core, where the system can."""
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


@dataclass
class Figure:
    """What was measured of one figure.

    Args:
        rounds: Pairs of times before and after [s], a list for each round.
        same: Whether all results were the same.
    """

    rounds: list[list[tuple[float, float]]] = field(default_factory=list)
    same: bool = True

    def summary(self) -> dict[str, Any]:
        """Return medians, and the interval of that of the ratios."""
        rounds = [np.array(pairs) for pairs in self.rounds if pairs]
        ratios = [pairs[:, 1] / pairs[:, 0] for pairs in rounds]
        rng = np.random.default_rng(0)
        draws = []
        for _ in range(2000):
            some = [ratios[k] for k in rng.integers(len(ratios), size=len(ratios))]
            draws.append(np.median(np.concatenate([rng.choice(r, len(r)) for r in some])))
        low, high = np.quantile(draws, (0.05, 0.95))
        before, after = np.median(np.concatenate(rounds), axis=0)
        return {
            "ratio": float(np.median(np.concatenate(ratios))), "low": float(low), "high": float(high),
            "before_s": float(before), "after_s": float(after), "pairs": sum(map(len, ratios)),
            "same_result": self.same,
        }  # fmt: skip


def measure_round(
    options: argparse.Namespace, figures: dict[str, Figure], faults: dict[str, str], *, turned: bool
) -> None:
    """Add one round of pairs to all figures, with fresh processes; `turned` if the later one begins."""
    order = (1, 0) if turned else (0, 1)
    begun = {side: Worker((options.before, options.after)[side], options) for side in order}
    workers = [begun[0], begun[1]]
    try:
        for name in options.only:
            if name in faults:
                continue
            for side in order:
                answer = workers[side].ask(f"warm {name}")
                if "error" in answer:
                    faults[name] = f"{('before', 'after')[side]}: {answer['error']}"
            if name in faults:
                continue
            figures[name].rounds.append([])
            for pair in range(PAIRS[name] if options.pairs is None else options.pairs):
                found: dict[int, dict[str, Any]] = {}
                for side in order if pair % 2 == 0 else order[::-1]:
                    found[side] = workers[side].ask(f"time {name}")
                wrong = [answer["error"] for answer in found.values() if "error" in answer]
                if wrong:
                    faults[name] = wrong[0]
                    break
                figures[name].rounds[-1].append((found[0]["seconds"], found[1]["seconds"]))
                figures[name].same &= found[0]["result"] == found[1]["result"]
    finally:
        for worker in workers:
            worker.close()


def commit_of(checkout: Path) -> str:
    """Return the commit of a checkout, marked where files are changed."""
    if not (checkout / ".git").exists():  # a copy: Git would tell of a repository around it
        return "unknown"
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=10"]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return said or "unknown"


def device_name(device: str) -> str:
    """Return the name of the device."""
    if device.startswith("cuda"):
        import torch

        return str(torch.cuda.get_device_name(device))
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.machine()
    return f"{name}, one core"


def main() -> int:
    """Measure and print; the exit code is 1 where a figure could not be measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("before", type=Path, nargs="?", help="checkout before the change")
    parser.add_argument("after", type=Path, nargs="?", help="checkout after it")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--only", nargs="+", choices=MAKERS, default=list(MAKERS))
    parser.add_argument("--rounds", type=int, default=4, help="fresh pairs of processes")
    parser.add_argument("--pairs", type=int, help="pairs of calls in a round  [default: by figure]")
    parser.add_argument("--core", type=int, help="core of both  [default: the last one]")
    parser.add_argument("--sensor", default="davis346", help="noisy sensor: preset or file")
    parser.add_argument("--hidden", type=Path, help="folder of cases of another simulator")
    parser.add_argument("--case", default="a_01", help="case in it")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    parser.add_argument("--verbose", action="store_true", help="show what the workers print")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        serve(options)
        return 0
    if options.after is None:
        parser.error("name two checkouts")
    if Path(options.sensor).is_file():  # the checkouts are the working directories
        options.sensor = str(Path(options.sensor).resolve())
    if options.core is None and hasattr(os, "sched_getaffinity"):
        options.core = max(os.sched_getaffinity(0))
    commits = {"before": commit_of(options.before), "after": commit_of(options.after)}
    where = device_name(options.device)
    print(f"{where}: {commits['after']} compared with {commits['before']}", flush=True)
    figures = {name: Figure() for name in options.only}
    faults: dict[str, str] = {}
    for number in range(options.rounds):
        begin = time.perf_counter()
        measure_round(options, figures, faults, turned=number % 2 == 1)
        print(f"round {number + 1} of {options.rounds}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    found = {name: figure.summary() for name, figure in figures.items() if any(figure.rounds)}
    print(f"{'':10s} {'after/before':>12s} {'90 % interval':>16s} {'before':>11s} {'after':>11s}  results")
    for name, row in found.items():
        print(
            f"{name:10s} {row['ratio']:12.3f} {row['low']:7.3f} to {row['high']:.3f} "
            f"{1e3 * row['before_s']:8.1f} ms {1e3 * row['after_s']:8.1f} ms  "
            f"{'same' if row['same_result'] else 'DIFFERENT'}, {row['pairs']} pairs"
        )
    for name, fault in faults.items():
        print(f"{name}: not measured; {fault}")
    if options.output:
        table = {"device": where, "commits": commits, "figures": found, "faults": faults}
        options.output.write_text(json.dumps(table, indent=1) + "\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
