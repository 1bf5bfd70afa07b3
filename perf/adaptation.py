"""How well thresholds are learned: the experiments of docs/adaptation.md, each by its name.

    python perf/adaptation.py --list
    python perf/adaptation.py --row full-s0 --seconds 60 --out out/adaptation
    python perf/adaptation.py --row 'table4-*' --row 'maps-*' --seconds 60 --jobs 2 --out out/adaptation
    python perf/adaptation.py --table --out out/adaptation

Every row appends its line to OUT/rows.jsonl as it ends, and logs to OUT/NAME/log.csv meanwhile, so a run that
is cut short loses nothing that is done. `--table` writes the tables of docs/adaptation.md.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import math
import os
import platform
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import adaptation_page
import numpy as np
import torch

from dase import images
from dase.networks import NetworkShape
from dase.objectives import Hash
from dase.run import Pace, run
from dase.scenery import Looks, Scenery
from dase.targets import TRUTHS, Endless, Finite, Pairs, Target, record
from dase.training import Recipe, Training

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"

LEARNED = 8.0
"""Seconds of the recording that are learned from."""


@dataclass(frozen=True)
class Row:
    """One experiment.

    Args:
        truth: Name of the sensor to be learned.
        finite: Sequences of real data, recorded once; 0 for new ones in every step.
        disjoint: Whether real scenes have textures that simulated ones have not.
        textures: Backgrounds in the pool, of which disjoint sides get a half each; twice as many objects.
        augment: Whether finite data is mirrored and turned.
        recipe: What differs from the default recipe.
        hash: What differs from the default hash.
        network: What differs from the default network.
        real: Whether the target is the recording: 8 s to learn from, what follows to judge by.
    """

    truth: str = "uniform"
    finite: int = 0
    disjoint: bool = False
    textures: int = 48
    augment: bool = True
    recipe: dict[str, Any] = field(default_factory=dict)
    hash: dict[str, Any] = field(default_factory=dict)
    network: dict[str, Any] = field(default_factory=dict)
    real: bool = False

    def but(self, **changes: Any) -> Row:
        """Return the row with some options changed, dictionaries merged."""
        merged = {
            name: {**getattr(self, name), **value} if isinstance(value, dict) else value
            for name, value in changes.items()
        }
        return replace(self, **merged)


FULL = Row()
LOW = dict(mu=0.1, sigma=0.02)
MOMENTS = Row(recipe=dict(objective="moments", rate=1e-4, anchor=1.0), network=dict(table=(6, 5)))
ATTRIBUTES = {"angle": ("orientations", 24), "contrast": ("contrast", 3), "coherence": ("coherence", 3)}


def rows() -> dict[str, Row]:
    """Return all experiments by name."""
    out: dict[str, Row] = {}
    for seed in range(3):
        out[f"full-s{seed}"] = FULL.but(recipe=dict(seed=seed))
        out[f"full-low-s{seed}"] = FULL.but(recipe=dict(seed=seed, **LOW))
        out[f"moments-s{seed}"] = MOMENTS.but(recipe=dict(seed=seed))
        out[f"moments-low-s{seed}"] = MOMENTS.but(recipe=dict(seed=seed, **LOW))
        for count in (600, 100):
            for name, base in (("wgan", FULL), ("moments", MOMENTS)):
                row = base.but(finite=count, disjoint=True, textures=200, recipe=dict(seed=seed))
                out[f"finite{count}-{name}-s{seed}"] = row
    one = dict(orientations=1, coherence=1, contrast=1)
    out["table4-global"] = FULL.but(hash=one)
    out["table4-uniform"] = FULL.but(recipe=dict(uniform=1.0))
    for kind in ("energy", "events"):
        for n in range(8):
            used = [name for bit, name in enumerate(ATTRIBUTES) if n >> bit & 1]
            how = {**one, **dict(ATTRIBUTES[name] for name in used), "contrast_from": kind}
            out[f"table5-{kind}-{'+'.join(used) or 'none'}"] = FULL.but(hash=how)
    out["table5-ranked"] = FULL.but(hash=dict(contrast_from="events-ranked"))
    out["fig3-no-kl"] = FULL.but(recipe=dict(kl=0.0))
    out["fig3-literal"] = FULL.but(recipe=dict(anchor=0.0), network=dict(literal=True))
    out["fig3-literal-no-kl"] = out["fig3-literal"].but(recipe=dict(kl=0.0))
    out["paper"] = FULL.but(
        recipe=dict(
            optimizer="adabelief", rate=4e-4, rate_scalars=4e-4, critic_rate=4e-4, critic_cosine=True,
            anchor=0.0, average=0.0, surrogate="interval", warmup=0,
        ),
        hash=dict(contrast_from="events"),
        network=dict(literal=True),
    )  # fmt: skip
    for size in (8, 16, 24, 40, 60, 80):
        out[f"fig5-{size}"] = FULL.but(hash=dict(size=size))
    for surrogate in ("interval", "events"):
        out[f"surrogate-{surrogate}"] = FULL.but(recipe=dict(surrogate=surrogate))
    for anchor in (0.0, 1.0, 30.0):
        out[f"anchor-{anchor:g}"] = FULL.but(recipe=dict(anchor=anchor))
    recorded = dict(doubt=0.2, batch=8)
    out["real-moments"] = MOMENTS.but(real=True, recipe=recorded, network=dict(split=True))
    out["real-moments-doubt.1"] = out["real-moments"].but(recipe=dict(doubt=0.1))
    out["real-moments-flat"] = out["real-moments"].but(network=dict(table=None), recipe=dict(rate=0.0))
    out["real-wgan"] = FULL.but(
        real=True, recipe=dict(batch=8, anchor=0.5), hash=dict(orientations=8), network=dict(split=True)
    )
    out.update(_finite_variants())
    out.update(_maps())
    return out


def _finite_variants() -> dict[str, Row]:
    base = FULL.but(finite=600, textures=200)
    return {
        "finite600-wgan-same-textures": base,
        "finite600-wgan-plain": base.but(augment=False, disjoint=True),
        "finite600-wgan-slow-critic": base.but(disjoint=True, recipe=dict(critic_rate=5e-5)),
        "finite600-wgan-cosine-critic": base.but(disjoint=True, recipe=dict(critic_cosine=True)),
        "finite600-wgan-penalty10": base.but(disjoint=True, recipe=dict(penalty=10.0)),
        "finite600-wgan-global": base.but(disjoint=True, hash=dict(orientations=1, coherence=1, contrast=1)),
        "finite600-moments-same-textures": MOMENTS.but(finite=600),
        "finite600-moments-24-textures": MOMENTS.but(finite=600, disjoint=True, textures=48),
        "finite600-wgan-24-textures": base.but(disjoint=True, textures=48),
        "finite600-moments-flat": MOMENTS.but(
            finite=600, disjoint=True, textures=200, recipe=dict(rate=0.0), network=dict(table=None)
        ),
    }


def _maps() -> dict[str, Row]:
    """Targets whose thresholds differ from pixel to pixel, and ways to learn them."""
    ways = {
        "moments": MOMENTS,
        "moments-table-only": MOMENTS.but(recipe=dict(rate=0.0)),
        "moments-unet-only": MOMENTS.but(recipe=dict(rate=1e-3, anchor=0.01), network=dict(table=None)),
        "moments-unet": MOMENTS.but(recipe=dict(rate=1e-3, anchor=0.01)),
        "wgan": FULL.but(recipe=dict(anchor=0.5)),
        "wgan-table": FULL.but(recipe=dict(anchor=5.0), network=dict(table=(6, 5))),
        "wgan-image-table": FULL.but(recipe=dict(critic_image=True), network=dict(table=(6, 5))),
        "wgan-image": FULL.but(recipe=dict(anchor=0.5, critic_image=True)),
        "wgan-intensity": FULL.but(
            recipe=dict(anchor=0.5), hash=dict(orientations=8, coherence=1, contrast=3, intensity=6)
        ),
        "wgan-small": FULL.but(
            recipe=dict(anchor=0.5, rate=3e-4), hash=dict(size=16, orientations=8, coherence=1, intensity=6)
        ),
    }
    out = {}
    for truth in ("intensity", "edges"):
        for name, way in ways.items():
            out[f"maps-{truth}-{name}"] = way.but(truth=truth)
    pattern = dict(pattern=(240, 240))
    out["maps-column-moments"] = ways["moments"].but(truth="column", network=pattern)
    out["maps-column-wgan"] = FULL.but(truth="column", network=pattern)
    out["maps-column-moments-finite600"] = out["maps-column-moments"].but(finite=600, augment=False)
    for truth in ("intensity", "edges"):
        out[f"maps-{truth}-moments-finite600"] = MOMENTS.but(
            truth=truth, finite=600, disjoint=True, textures=200
        )
    for name in ("moments", "wgan"):
        out[f"maps-asymmetric-{name}"] = ways[name].but(truth="asymmetric", network=dict(split=True))
    return out


def prepare(row: Row, args: argparse.Namespace) -> Training:
    """Return the run of a row."""
    device, pictures, small = args.device, args.images, args.small
    looks = Looks(regime="mixed") if not small else Looks(regime="mixed", width=96, height=96, samples=12)
    recipe: dict[str, Any] = dict(steps=10**6, **row.recipe)
    how, network = dict(row.hash), dict(row.network)
    if small:
        recipe["batch"], recipe["warmup"] = 4, 30
        how["size"] = max(how.get("size", 40) * 2 // 5 // 4 * 4, 4)
        network |= {"channels": 8, "depth": 2}
        if "pattern" in network:
            network["pattern"] = (96, 96)
    made = Recipe(hash=Hash(**how), network=NetworkShape(**network), **recipe)
    if row.real:
        from dase.recorded import open_target

        target, scenes = open_target([Path(args.recording)], until=LEARNED, device=device)
        return Training(made, target, scenes)
    source = images.open_images(pictures)
    scenery = Scenery(source, looks, device=device, backgrounds=row.textures, objects=2 * row.textures)
    ours, theirs = scenery.split(0.5) if row.disjoint else (scenery, scenery)
    seed = recipe.get("seed", 0)
    target: Target = Endless(theirs, TRUTHS[row.truth](), seed=1000 + seed)
    if row.finite:
        pairs = record(target, np.random.default_rng([seed, 77]), row.finite)
        target = Finite(pairs, augment=row.augment, truth=target.truth)
    return Training(made, target, ours)


def judge(training: Training, args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Return how the adapted sensor and the baselines do on the part of the recording that came later."""
    from dase.adaptation import baseline
    from dase.evaluation import HeldOut
    from dase.recorded import Replayed, windows_of
    from dase.recording import open_recording

    recording = open_recording(args.recording)
    recording = recording.masked(~recording.hot)
    later = recording.slice(recording.begin + LEARNED, recording.end)
    windows = windows_of(later)
    scenes = Replayed(windows, window=0.05, device=args.device)
    grey = np.exp(windows.log[:, windows.log.shape[1] // 2].astype(np.float32)) - np.float32(1e-3)
    pairs = Pairs(torch.from_numpy(grey).to(args.device), torch.from_numpy(windows.counts).to(args.device))
    held = HeldOut(scenes, pairs, doubt=0.2)
    nets: dict[str, Any] = {"adapted": training.mean}
    for kind in ("esim", "rate", "random"):
        nets[kind] = baseline(kind, training.target, training.scenery)
    out: dict[str, Any] = {"trusted": windows.trusted}
    for name, net in nets.items():
        out[name] = held.statistics(net)
        if name != "random":
            out[name]["probes"] = _probes(later, name, net, folder)
            print(f"{folder.name} {name}: {out[name]}", flush=True)
    return out


def _probes(later: Any, name: str, net: Any, folder: Path) -> float | str:
    """Return the headline error of `dase compare` on the later part."""
    try:
        from dase.adaptation import write_sensor
        from dase.camera import TOLERANCE, CameraScene
        from dase.comparison import compare
        from dase.config import load_sensor

        place = folder / name
        place.mkdir(exist_ok=True)
        mu = float(net(torch.full((1, 8, 8), 0.4, device=net.level.device)).mu.mean().detach())
        sensor = load_sensor(write_sensor(place, net.to("cpu"), mu=mu, name=name))
        assert later.frames is not None
        assert later.frame_begin is not None
        scene = CameraScene(later.frames, later.frame_begin, later.frame_end)

        def trust(times: Any, pixels: Any) -> Any:
            at = np.clip(times, scene.times[0], scene.times[-1])
            return scene.doubt(at, pixels=pixels) <= TOLERANCE

        return compare(later.events, scene, sensor, trust=trust, pixels=800).error
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def measure(name: str, args: argparse.Namespace) -> dict[str, Any]:
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

    pace = Pace(seconds=args.seconds, save=math.inf, look=args.look)
    last = run(training, Path(args.out) / name, pace=pace, look=look)
    scored = [line for line in history if "held_out" in line]
    best = min(scored, key=lambda line: line["held_out"]) if scored else last
    real = judge(training, args, Path(args.out) / name) if row.real else None
    return {
        "row": name,
        "real": real,
        "seed": training.recipe.seed,
        "device": _device(args.device),
        "commit": _commit(args.commit),
        "images": Path(args.images).name,
        "small": args.small,
        "wall": time.perf_counter() - begin,
        "steps_per_second": training.recipe.steps / last["seconds"],
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


def work(names: list[str], args: argparse.Namespace) -> None:
    """Run rows one after the other, or several processes at a time."""
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    end = time.perf_counter() + args.budget
    if args.jobs == 1:
        for name in names:
            if time.perf_counter() + args.seconds > end:
                print(f"no time left for {name}")
                continue
            try:
                line = measure(name, args)
            except Exception as error:
                line = {"row": name, "error": f"{type(error).__name__}: {error}"}
            with (out / "rows.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(_brief(line), flush=True)
        return
    environment = {**os.environ, "OMP_NUM_THREADS": str(max((os.cpu_count() or 2) // args.jobs // 2, 1))}

    def one(name: str) -> None:
        left = end - time.perf_counter()
        if left < args.seconds:
            print(f"no time left for {name}")
            return
        options = [
            f"--{k}={getattr(args, k)}" for k in ("seconds", "out", "device", "images", "recording", "look")
        ]
        options += [f"--commit={_commit(args.commit)}", *(["--small"] if args.small else [])]
        command = [sys.executable, __file__, f"--row={name}", "--jobs=1", *options]
        try:
            subprocess.run(command, env=environment, timeout=left, check=False)
        except subprocess.TimeoutExpired:
            print(f"{name}: cut off")

    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(one, names))


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


def _default_images() -> str:
    beside = SHARED / "photos"
    return str(beside) if beside.is_dir() else "builtin"


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--row", action="append", default=[], help="name or pattern; may be repeated")
    parser.add_argument("--list", action="store_true", help="print all names")
    parser.add_argument("--seconds", type=float, default=60.0, help="training time of a row")
    parser.add_argument("--budget", type=float, default=math.inf, help="seconds after which no row is begun")
    parser.add_argument("--out", default="out/adaptation")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time on the one device")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--images", default=_default_images())
    parser.add_argument(
        "--recording", default=str(ROOT.parent / "shared/recordings/davis240c_camerashake.npz")
    )
    parser.add_argument("--look", type=int, default=50, help="steps between lines of the log")
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
        adaptation_page.write(Path(args.out), ROOT / "docs" / "adaptation.md", args.jobs)
        return
    every = rows()
    names = [n for pattern in args.row for n in every if fnmatch.fnmatch(n, pattern)]
    names = list(dict.fromkeys(names))
    if args.list or not names:
        print("\n".join(every if args.list else ["no row of that name; --list shows them"]))
        return
    work(names, args)


if __name__ == "__main__":
    main()
