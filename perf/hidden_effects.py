"""The blind benchmark of the diagnosis: hides effects, hands over events and scene, scores what is found.

    python perf/hidden_effects.py --quick                            a few minutes on a CPU
    python perf/hidden_effects.py --jobs 8 --device cuda:0           everything; goes on where it stopped
    python perf/hidden_effects.py --hidden ../shared/hidden          data of another simulator
    python perf/hidden_effects.py --report                           the page and its picture from the log

The scenes are made for this and used nowhere else. The diagnosis sees events, scene and a sensor that lacks
what was hidden; the truth is compared with its answer afterwards. Each run is a line of the log.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from hidden_report import HIDDEN, STRENGTHS, right, short, write_report

PAIRS = (
    ("bandwidth", "leak"), ("bandwidth", "shot"), ("linlog", "mismatch"), ("mismatch", "leak"),
    ("jitter", "bandwidth"), ("refractory", "shot"), ("shot", "mismatch"), ("leak", "shot"),
    ("latency", "hot"), ("mismatch", "jitter"),
)  # fmt: skip

V2E = {
    "sigma_thres": "mismatch", "cutoff_hz": "bandwidth", "leak_rate_hz": "leak", "shot_noise_rate_hz": "shot",
    "refractory_period_s": "refractory",
}  # fmt: skip
"""Parameters of the other simulator's emulator, off at 0, to dase's effects."""

WIDTH, HEIGHT, RATE = 144, 108, 1000


@dataclass(frozen=True)
class Case:
    """One run: what is hidden in which scene; `removed` is taken out of the library."""

    kind: str
    effects: tuple[str, ...]
    strength: str
    scene: int
    seed: int
    removed: str = ""

    @property
    def name(self) -> str:
        parts = [
            self.kind,
            "+".join(self.effects) or "nothing",
            self.strength,
            str(self.scene),
            str(self.seed),
        ]
        return "/".join(parts)


@lru_cache(maxsize=4)
def scene_of(number: int) -> Any:
    """Return a scene with fast, slow and resting content over a wide range of light, 1 s at 1 kHz."""
    import cv2

    import dase

    rng = np.random.default_rng([number, 2024])
    images = dase.open_images("builtin")
    still = cv2.resize(images.background(rng).grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    turn = rng.uniform(0, 2 * np.pi)
    light = np.exp(1.6 * (np.cos(turn) * x + np.sin(turn) * y) - 1.6)
    still = np.clip(still, 0.02, 1) * light
    things = []
    for speed in np.geomspace(15, 900, 9) * rng.uniform(0.8, 1.25, 9):
        size = int(rng.uniform(18, 44))
        patch = cv2.resize(images.background(rng).grey, (size, size), interpolation=cv2.INTER_AREA)
        patch = np.clip(patch * np.exp(rng.uniform(-2.0, 0.3)), 0.004, 1)
        rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
        alpha = (np.hypot(rows, columns) < size / 2 - 1).astype(np.float32)
        things.append(
            (patch, alpha, speed, rng.uniform(0, 1, 2), rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9))
        )
    frames = np.empty((RATE + 1, HEIGHT, WIDTH), np.float32)
    for k in range(RATE + 1):
        frames[k] = _frame(still, things, k / RATE)
    return dase.VideoScene(frames, np.arange(RATE + 1) / RATE)


def _frame(still: np.ndarray, things: list[Any], t: float) -> np.ndarray:
    import cv2

    out = still.astype(np.float32)
    for patch, alpha, speed, where, angle, span in things:
        # back and forth along a line, so that pixels see both edges and pauses
        reach = 0.5 * span * WIDTH
        along = reach * np.sin(speed * t / max(reach, 1))
        corner = (
            where * (WIDTH, HEIGHT) + along * np.array([np.cos(angle), np.sin(angle)]) - patch.shape[0] / 2
        )
        first = np.floor(corner).astype(int)
        move = np.array([[1, 0, corner[0] - first[0]], [0, 1, corner[1] - first[1]]], np.float32)
        size = (patch.shape[0] + 1,) * 2
        cover = cv2.warpAffine(alpha, move, size)
        value = cv2.warpAffine(patch.astype(np.float32), move, size, borderMode=cv2.BORDER_REPLICATE)
        low = np.maximum(first, 0)
        high = np.minimum(first + size[0], (WIDTH, HEIGHT))
        if np.all(high > low):
            window = np.s_[low[1] : high[1], low[0] : high[0]]
            part = np.s_[low[1] - first[1] : high[1] - first[1], low[0] - first[0] : high[0] - first[0]]
            out[window] = out[window] * (1 - cover[part]) + value[part] * cover[part]
    return out


def truth_of(case: Case) -> tuple[Any, Any]:
    """Return the sensor that makes the data, and the one that the diagnosis begins with."""
    from dase.effects import EFFECTS, Threshold
    from dase.sensor import Sensor

    rng = np.random.default_rng([case.seed, case.scene, 99])
    on, off = 0.2 * np.exp(rng.uniform(-0.25, 0.25, 2))
    true = Sensor(effects=(Threshold(on=float(on), off=float(off)),), name="truth")
    given = Sensor(effects=(Threshold(on=0.25, off=0.25),), name="given")
    if "vignetting" in case.effects:  # is seen only by what depends on the light
        true = true.with_effect(EFFECTS["bandwidth"](cutoff=80.0, dark=0.02))
        given = given.with_effect(EFFECTS["bandwidth"](cutoff=120.0, dark=0.05))
    for name in case.effects:
        values = dict(HIDDEN[name][STRENGTHS.index(case.strength)])
        if name == "flicker":
            values["phase"] = float(rng.uniform(0, 1))
        if name == "refractory":
            values["mode"] = ("drop", "delay")[case.seed % 2]
        if name == "readout":
            values["rate"] *= 6e5
        true = true.with_effect(EFFECTS[name](**values))
    return true, given


def run_case(job: tuple[Case, str, int]) -> dict[str, Any]:
    """Make the data of a case, diagnose them, and compare the answer with the truth."""
    case, device, threads = job
    from dase.kernels import launch

    launch.set_threads(threads)
    import dase
    from dase.diagnosis import diagnose
    from dase.effects import EFFECTS

    scene = scene_of(case.scene)
    true, given = truth_of(case)
    events = dase.simulate(scene, true, seed=1000 + case.seed, device=device)
    library = {name: effect for name, effect in EFFECTS.items() if name != case.removed}
    begin = time.perf_counter()
    found = diagnose(events, scene, given, effects=library, seed=case.seed, device=device)
    truth = {f"{e.name}.{p.name}": float(getattr(e, p.name)) for e in true.effects for p in e.parameters()}
    return {
        "name": case.name,
        "case": asdict(case),
        "seconds": time.perf_counter() - begin,
        "events": len(events),
        "truth": truth,
        "answer": {k: v for k, v in found.to_json().items() if k not in ("history", "sensor")},
        "steps": [
            {"error": s.error, "gate": s.gate, "chosen": s.chosen, "ties": s.ties,
             "ranking": [(r.effect, r.error, r.fall, r.p_value) for r in s.ranking[:5]]}
            for s in found.history
        ],
    }  # fmt: skip


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the runs that are asked for."""
    names = options.only.split(",") if options.only else list(HIDDEN)
    scenes = range(options.scenes)
    strengths = options.strengths.split(",")
    if "single" in options.kinds:
        for strength in strengths:
            for seed in range(options.seeds):
                for scene in scenes:
                    for name in names:
                        yield Case("single", (name,), strength, scene, seed)
    if "nothing" in options.kinds:
        for seed in range(options.nothing):
            yield Case("nothing", (), "none", seed % options.scenes, 100 + seed)
    if "pairs" in options.kinds:
        for pair in PAIRS:
            for seed in range(options.seeds):
                yield Case("pair", pair, "medium", seed % options.scenes, seed)
    if "unknown" in options.kinds:
        for name in names:
            for seed in range(min(options.seeds, 3)):
                yield Case("unknown", (name,), "strong", seed % options.scenes, seed, removed=name)


def score_hidden(folder: Path, options: argparse.Namespace) -> None:
    """Diagnose the cases of another simulator; the truth is opened after all answers are in."""
    import dase
    from dase.diagnosis import diagnose, summary

    with np.load(folder / "clip_a.npz") as data:
        scene = dase.VideoScene(data["frames"].astype(np.float32) / 255, data["frame_us"] * 1e-6)
    answers = {}
    for path in sorted(folder.glob("a_*.npz")):
        if options.only and path.stem not in options.only.split(","):
            continue
        with np.load(path) as data:
            t, x, y, p = (data[k] for k in ("t_us", "x", "y", "p"))
        events = dase.Events(t * 1e-6, x, y, p.astype(bool), scene.width, scene.height)
        found = diagnose(events, scene, seed=options.seed, device=options.device)
        answers[path.stem] = found
        print(f"{path.stem}: {found.seconds:5.1f} s  {summary(found)}", flush=True)
        for step in found.history:
            ranks = ", ".join(f"{r.effect} {r.error:.2f}" for r in step.ranking[:4])
            print(
                f"      {step.error:6.2f} gate {step.gate:4.2f} {step.chosen} {step.ties or ''} [{ranks}]",
                flush=True,
            )
    print((folder / "truth.json").read_text() if options.truth else "")
    score = hidden_scores(json.loads((folder / "truth.json").read_text()), answers)
    print(f"right: {sum(score.values())} of {len(score)}; wrong: {[k for k, ok in score.items() if not ok]}")


def hidden_scores(truth: dict[str, Any], answers: dict[str, Any]) -> dict[str, bool]:
    """Return which answers are right; its lin-log mapping and time stamps may be named too."""
    out = {}
    for name, found in answers.items():
        want = true_effects(truth, name)
        ties = {t for e in found.selected for t in found.ties.get(e, ())}
        named = set(found.selected)
        out[name] = (
            want <= named | ties
            and named - {"linlog", "timestamp"} - ties <= want
            and found.unexplained is None
        )
    return out


def true_effects(truth: dict[str, Any], name: str) -> set[str]:
    """Return the effects of a case of the other simulator by dase's names."""
    params = truth[name]["params"]
    return {effect for key, effect in V2E.items() if float(params.get(key) or 0) > 0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", type=Path, default=Path("out/hidden_effects.jsonl"))
    parser.add_argument("--hidden", type=Path, help="folder of another simulator's cases")
    parser.add_argument("--kinds", default="single,nothing,pairs,unknown")
    parser.add_argument("--only", default="", help="effects, or cases of --hidden")
    parser.add_argument("--strengths", default="weak,medium,strong")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--nothing", type=int, default=120)
    parser.add_argument("--quick", action="store_true", help="one seed, one scene, strong and medium only")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", action="store_true")
    parser.add_argument("--report", action="store_true", help="only write the page from the log")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--where", default="", help="device and commit of the log, for the page")
    options = parser.parse_args()
    if options.hidden:
        score_hidden(options.hidden, options)
        return
    if options.quick:
        options.seeds = options.scenes = 1
        options.nothing, options.strengths = 5, "medium"
    if not options.report:
        _run(options)
    if options.log.exists():
        write_report(options.log, options.out, options.where)


def _run(options: argparse.Namespace) -> None:
    options.log.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if options.log.exists():
        lines = [json.loads(text) for text in options.log.read_text().splitlines() if text.strip()]
        done = {line["name"] for line in lines if "failed" not in line}
    todo = [case for case in cases(options) if case.name not in done]
    threads = max(1, (os.cpu_count() or 1) // options.jobs)
    jobs = [(case, options.device, threads) for case in todo]
    print(f"{len(done)} runs in the log, {len(jobs)} to do", flush=True)
    context = multiprocessing.get_context("spawn")
    with context.Pool(options.jobs) as pool, options.log.open("a") as log:
        for n, line in enumerate(pool.imap_unordered(_safely, jobs)):
            log.write(json.dumps(line) + "\n")
            log.flush()
            if "failed" in line:
                print(f"{line['name']}: {line['failed']}", flush=True)
                continue
            mark = "ok   " if right(line) else "WRONG"
            head = f"{n + 1}/{len(jobs)} {mark} {line['name']:40s} {line['seconds']:5.1f} s"
            print(head, short(line), flush=True)


def _safely(job: tuple[Case, str, int]) -> dict[str, Any]:
    try:
        return run_case(job)
    except Exception as error:  # one bad run must not end the others
        import traceback

        return {
            "name": job[0].name,
            "case": asdict(job[0]),
            "failed": f"{error!r} {traceback.format_exc()[-600:]}",
        }


if __name__ == "__main__":
    main()
