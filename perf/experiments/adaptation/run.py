"""How well thresholds are learned: the experiments of docs/adaptation.md, each by its name.

    python -m perf.experiments.adaptation.run --list
    python -m perf.experiments.adaptation.run --plan all --budget 900 --out FOLDER
    python -m perf.experiments.adaptation.run --row full-s0 --row 'maps-*' --seconds 60 --jobs 2 --out FOLDER
    python -m perf.experiments.adaptation.run --table --out out/adaptation

Every row appends its line to OUT/rows.jsonl as it ends, and logs to OUT/NAME/log.csv meanwhile, so a run
that is cut short loses nothing that is done, and the same command goes on with the rows that are missing.
Neither network nor matplotlib is needed; `--table` writes the tables and pictures of docs/adaptation.md from
the lines, anywhere. The rows `real-*` need `--recording FILE`, with frames and their times.
"""

from __future__ import annotations

import argparse
import fnmatch
import gc
import json
import math
import platform
import shutil
import statistics
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dase.diagnosis.compare import compare
from dase.learning.adversarial import PatchHash
from dase.learning.baselines import RandomThresholds, constant_thresholds
from dase.learning.evaluation import HeldOutScore
from dase.learning.job import compose_training, make_baseline, write_examples, write_sensor
from dase.learning.recipe import Recipe
from dase.learning.recorded_target import ReplayedScenes, cut_windows, open_target
from dase.learning.run import RunSchedule, train_in_folder
from dase.learning.scene_batches import Scenery, SceneSettings
from dase.learning.targets import TRUTHS, EndlessTarget, FiniteTarget, Pairs, Target, record_pairs
from dase.learning.training import Training
from dase.networks.threshold_network import NetworkShape
from dase.recordings.recording import open_recording
from dase.scenes import image_sources
from dase.scenes.between_frames import CameraScene, TrustSettings
from dase.simulation.sensor_file import load_sensor
from perf.data_folder import data_folder, default_images
from perf.experiments.adaptation import jobs
from perf.experiments.adaptation.rows import Planned, Row, plan, rows

ROOT = Path(__file__).resolve().parents[3]

LEARNED = 8.0
"""Seconds of the recording that are learned from."""

DRAWN = 8
"""Sensors of broad randomisation whose errors in the probes are averaged."""

OBJECTS = 8
"""Objects for every background in a pool of which either side has half: a scene shows about ten."""


def prepare(row: Row, args: argparse.Namespace) -> Training:
    """Return the run of a row."""
    device, pictures, small = args.device, args.images, args.small
    looks = (
        SceneSettings(regime="mixed")
        if not small
        else SceneSettings(regime="mixed", width=96, height=96, samples=12)
    )
    recipe: dict[str, Any] = {"steps": 10**6, **row.recipe}
    how, network = dict(row.hash), dict(row.network)
    if small:
        recipe["batch"], recipe["warmup"] = 4, 30
        how["size"] = max(how.get("size", 40) * 2 // 5 // 4 * 4, 4)
        network |= {"channels": 8, "depth": 2}
        if "pattern" in network:
            network["pattern"] = (96, 96)
    made = Recipe.from_names(hash=PatchHash(**how), network=NetworkShape(**network), **recipe)
    if row.real:
        path = Path(args.recording)
        target, scenes = open_target([path], end=open_recording(path).begin + LEARNED, device=device)
        return compose_training(made, target, scenes)
    source = image_sources.open_images(pictures)
    scenery = Scenery(
        source,
        looks,
        device=device,
        backgrounds=row.textures,
        objects=(OBJECTS if row.disjoint else 2) * row.textures,
        seed=recipe.get("seed", 0),
    )
    ours, theirs = scenery.split(0.5) if row.disjoint else (scenery, scenery)
    seed = recipe.get("seed", 0)
    target: Target = EndlessTarget(theirs, TRUTHS[row.truth](), seed=1000 + seed)
    if row.finite:
        pairs = record_pairs(target, np.random.default_rng([seed, 77]), row.finite)
        target = FiniteTarget(pairs, augment=row.augment, truth=target.truth)
    return compose_training(made, target, ours)


def judge(row: Row, training: Training, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Return how the adapted sensor or the baselines do on the part of the recording that came later."""
    recording = open_recording(args.recording)
    recording = recording.masked(~recording.hot)
    later = recording.slice(recording.begin + LEARNED, recording.end)
    windows = cut_windows(later)
    scenes = ReplayedScenes(windows, window=0.05, device=args.device)
    grey, counts = (torch.from_numpy(part).to(args.device) for part in (windows.grey, windows.counts))
    held = HeldOutScore(scenes, Pairs(grey, counts), doubt=0.2)
    out: dict[str, Any] = {"trusted": windows.trusted}
    for name in row.judged:
        net = training.mean if name == "adapted" else make_baseline(name, training.target, training.scenery)
        out[name] = held.statistics(net)
        sensors = [_drawn(n) for n in range(DRAWN)] if name == "random" else [net]
        errors = [_probes(later, name, one, folder) for one in sensors]
        out[name] |= {"probes": statistics.mean(errors), "probes_each": errors}
        print(f"{folder.name} {name}: {out[name]}", flush=True)
    return out


def _drawn(seed: int) -> Any:
    """Return a sensor that broad randomisation may draw: a recording is of one."""
    maps = RandomThresholds(seed)(torch.zeros(1, 16, 16))
    mu = float(maps.mu.mean())
    return constant_thresholds(mu, float(maps.sigma.mean()), float(maps.ratio))


def _probes(later: Any, name: str, net: Any, folder: Path) -> float:
    """Return the headline error of `dase compare` on the later part."""
    place = folder / name
    place.mkdir(exist_ok=True)
    mu = float(net(torch.full((1, 8, 8), 0.4, device=net.level.device)).mu.mean().detach())
    sensor = load_sensor(write_sensor(place, net.to("cpu"), mu=mu, name=name))
    assert later.frames is not None
    assert later.frame_begin is not None
    scene = CameraScene(later.frames, later.frame_begin, later.frame_end)

    def trust(times: Any, pixels: Any) -> Any:
        at = np.clip(times, scene.times[0], scene.times[-1])
        return scene.doubt(at, pixels=pixels) <= TrustSettings.tolerance

    return compare(later.events, sensor, scene=scene, trust=trust, pixels=800).error


def measure(name: str, seconds: float, args: argparse.Namespace) -> dict[str, Any]:
    """Run one row and return its line."""
    row = rows()[name]
    torch.manual_seed(0)
    begin = time.perf_counter()
    training = prepare(row, args)
    history: list[dict[str, float]] = []

    def look(line: dict[str, float]) -> None:
        history.append(line)
        if sys.stdout.isatty() or args.verbose:
            shown = ("step", "seconds", "distance", "raw_kl", "kl", "kl_active", "mu", "slope", "held_out")
            print(name, " ".join(f"{k}={line[k]:.4g}" for k in shown if k in line), flush=True)

    schedule = RunSchedule(seconds=seconds, save_every=math.inf, log_every=args.look)
    folder = Path(args.out) / name
    shutil.rmtree(folder, ignore_errors=True)
    last = train_in_folder(training, folder, schedule=schedule, on_row=look)
    scored = [line for line in history if "held_out" in line]
    best = min(scored, key=lambda line: line["held_out"]) if scored else last
    if training.step and (row.real or row.truth != "uniform"):
        write_examples(folder, training)
    real = judge(row, training, args, folder) if row.real else None
    return {
        "row": name,
        "real": real,
        "seed": training.recipe.seed,
        "device": _device(args.device),
        "commit": _commit(args.commit),
        "images": Path(args.images).name,
        "small": args.small,
        "jobs": args.alone if training.recipe.objective == "wgan" else args.jobs,
        "wall": time.perf_counter() - begin,
        "steps_per_second": training.recipe.steps / max(last["seconds"], 1e-9),
        "at_001": next((h["seconds"] for h in history if h.get("kl", 1) <= 0.01), None),
        "last": last,
        "best": best,
        "curve": [[h["seconds"], h.get("raw_kl"), h.get("kl"), h.get("held_out")] for h in history],
    }


def _device(name: str) -> str:
    return torch.cuda.get_device_name() if name.startswith("cuda") else f"{platform.machine()} CPU"


def _commit(given: str | None) -> str:
    if given:
        return given
    command = ["git", "rev-parse", "--short", "HEAD"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def work(planned: list[Planned], args: argparse.Namespace) -> None:
    """Run the rows that OUT/rows.jsonl does not hold yet."""
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    lines = out / "rows.jsonl"
    done = set()
    if lines.exists():
        done = {line["row"] for line in map(json.loads, lines.read_text().splitlines()) if "last" in line}

    def tell(line: dict[str, Any]) -> None:
        with lines.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(_brief(line), flush=True)

    tasks = [
        jobs.Task(p.name, args.scale * p.seconds, 1 / (args.alone if p.adversarial else args.jobs))
        for p in planned
        if p.name not in done
    ]
    args.commit = _commit(args.commit)
    devices = args.device.split(",")
    jobs.run_all(tasks, partial(_runner, args), tell, budget=args.budget, devices=devices)


def _runner(args: argparse.Namespace, device: str) -> jobs.Run:
    if device.startswith("cuda:"):
        torch.cuda.set_device(device)
    return partial(_measured, argparse.Namespace(**{**vars(args), "device": device}))


def _measured(args: argparse.Namespace, name: str, seconds: float) -> dict[str, Any]:
    try:
        return measure(name, seconds, args)
    finally:
        # the next rows are other processes' as well
        gc.collect()
        torch.cuda.empty_cache()


def _brief(line: dict[str, Any]) -> str:
    if "error" in line:
        return f"{line['row']}: {line['error']}"
    last, best = line["last"], line["best"]
    keys = ("raw_kl", "kl", "kl_active", "mu", "sigma", "slope", "correlation", "ratio", "held_out")
    shown = " ".join(f"{k}={last[k]:.4g}" for k in keys if k in last)
    return (
        f"{line['row']}: {last['step']:.0f} steps, {last['seconds']:.0f} s, "
        f"{line['steps_per_second']:.1f}/s, KL<=.01 at {line['at_001']}; {shown}; "
        f"best held out: kl={best.get('kl', math.nan):.4g} at {best['seconds']:.0f} s"
    )


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--row", action="append", default=[], help="name or pattern; may be repeated")
    parser.add_argument("--list", action="store_true", help="print all names")
    parser.add_argument("--plan", help="main, tables or all: rows in the order of their importance")
    parser.add_argument("--seconds", type=float, default=60.0, help="training time of each --row")
    parser.add_argument("--scale", type=float, default=1.0, help="all training times are multiplied by this")
    parser.add_argument("--budget", type=float, default=math.inf, help="seconds after which all ends")
    parser.add_argument("--out", default="out/adaptation")
    parser.add_argument("--jobs", type=int, default=1, help="rows at a time on a device, without critics")
    parser.add_argument("--alone", type=int, default=1, help="the same for rows that have critics")
    parser.add_argument(
        "--device", default="cuda" if torch.cuda.is_available() else "cpu", help="or some: cuda:0,cuda:1"
    )
    parser.add_argument("--images", default=default_images())
    parser.add_argument(
        "--recording", default=str((data_folder() or Path()) / "recordings/davis240c_camerashake.npz")
    )
    parser.add_argument("--look", type=int, default=100, help="steps between lines of the log")
    parser.add_argument("--small", action="store_true", help="tiny scenes, to try things on a CPU")
    parser.add_argument("--verbose", action="store_true", help="print every line of the log")
    parser.add_argument(
        "--table", action="store_true", help="only write docs/adaptation.md from OUT/rows.jsonl"
    )
    parser.add_argument("--commit", help="what to record where there is no git")
    return parser.parse_args(argv)


def main() -> None:
    """Run or list rows."""
    args = parse()
    if args.table:
        from perf.experiments.adaptation import report

        report.write(Path(args.out), ROOT / "docs" / "adaptation.md")
        return
    every = rows()
    if args.list:
        print("\n".join(every))
        return
    planned = plan(args.plan) if args.plan else []
    names = [n for pattern in args.row for n in every if fnmatch.fnmatch(n, pattern)]
    planned += [
        Planned(n, args.seconds, every[n].recipe.get("objective") != "moments") for n in dict.fromkeys(names)
    ]
    if not planned:
        raise SystemExit("no row of that name; --list shows them")
    work(planned, args)


if __name__ == "__main__":
    main()
