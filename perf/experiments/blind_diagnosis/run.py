"""The blind benchmark of the diagnosis: hides effects, hands over events and scene, scores what is found.

    # a few minutes on a CPU
    python -m perf.experiments.blind_diagnosis.run --quick
    # everything
    python -m perf.experiments.blind_diagnosis.run --jobs 14 --device cuda:0 --hidden $DASE_DATA/hidden
    # data of another simulator
    python -m perf.experiments.blind_diagnosis.run --kinds other --hidden $DASE_DATA/hidden
    # the page and its picture from the log
    python -m perf.experiments.blind_diagnosis.run --report

The scenes are made for this and used nowhere else. The diagnosis sees events, scene and a sensor that lacks
what was hidden; the truth is compared with its answer afterwards. Each run is a line of the log, and what is
in the log is not run again. Kinds take turns, so that wherever it is stopped every row of the table has its
share.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from perf.experiments.blind_diagnosis.report import HIDDEN, STRENGTHS, right, short, write_report
from perf.experiments.blind_diagnosis.scenes import scene_of

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


@dataclass(frozen=True)
class Case:
    """One run: what is hidden in which scene; `removed` is taken out of the library.

    With it go the effects that include it, which explain all that it does; of kind `included` they stay.
    Of another simulator `strength` is the name of the case; its effects are looked up when the answer is in.
    """

    kind: str
    effects: tuple[str, ...]
    strength: str
    scene: int
    seed: int
    removed: str = ""

    @property
    def name(self) -> str:
        """Name in the log."""
        if self.kind in ("other", "time"):
            return f"{self.kind}/{self.strength}"
        hidden = "+".join(self.effects) or "nothing"
        return f"{self.kind}/{hidden}/{self.strength}/{self.scene}/{self.seed}"


@dataclass(frozen=True)
class Job:
    """A case, and how it is run; `until` is when no case may begin any more [s since 1970]."""

    case: Case
    device: str
    threads: int
    folder: Path | None = None
    until: float = float("inf")


def truth_of(case: Case) -> tuple[Any, Any]:
    """Return the sensor that makes the data, and the one that the diagnosis begins with."""
    from dase.effects import EFFECTS, Threshold
    from dase.simulation.sensor import Sensor

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


def measured(job: Job) -> tuple[Any, Any, Any, Any]:
    """Return events, their scene, the sensor that the diagnosis begins with, and the true one if known."""
    import dase

    case = job.case
    if case.kind not in ("other", "time"):
        scene = scene_of(case.scene)
        true, given = truth_of(case)
        return dase.simulate(scene, true, seed=1000 + case.seed, device=job.device), scene, given, true
    assert job.folder is not None
    with np.load(job.folder / "clip_a.npz") as data:
        scene = dase.VideoScene(data["frames"].astype(np.float32) / 255, data["frame_us"] * 1e-6)
    with np.load(job.folder / f"{case.strength}.npz") as data:
        t, x, y, p = (data[k] for k in ("t_us", "x", "y", "p"))
    return dase.Events(t * 1e-6, x, y, p.astype(bool), scene.width, scene.height), scene, None, None


def run_case(job: Job) -> dict[str, Any]:
    """Make the data of a case, diagnose them, and note the truth beside the answer."""
    from dase.kernels import launch

    launch.set_threads(job.threads)
    from dase.diagnosis.diagnose import diagnose
    from dase.effects import EFFECTS

    case = job.case
    events, scene, given, true = measured(job)
    removed = {case.removed, *(including(case.removed) if case.kind == "unknown" else ())}
    library = {name: effect for name, effect in EFFECTS.items() if name not in removed}
    begin = time.perf_counter()
    found = diagnose(events, given, scene=scene, effects=library, seed=case.seed, device=job.device)
    seconds = time.perf_counter() - begin
    truth = (
        {} if true is None else
        {f"{e.name}.{p.name}": float(getattr(e, p.name)) for e in true.effects for p in e.parameters()}
    )  # fmt: skip
    line = {
        "name": case.name,
        "case": asdict(case),
        "seconds": seconds,
        "events": len(events),
        "truth": truth,
        "answer": {k: v for k, v in found.to_json().items() if k not in ("history", "sensor")},
        "steps": [
            {"error": s.error, "gate": s.gate, "chosen": s.chosen, "ties": s.ties,
             "ranking": [(r.effect, r.error, r.fall, r.p_value) for r in s.ranking[:5]]}
            for s in found.history
        ],
    }  # fmt: skip
    if case.removed:
        line["missing"] = missing_cells(job, events, scene, true.without(case.removed))
    return line


def including(name: str) -> list[str]:
    """Return the effects that have another as a special case."""
    from dase.effects import EFFECTS

    return [other for other, effect in EFFECTS.items() if name in effect.includes]


def missing_cells(job: Job, events: Any, scene: Any, sensor: Any) -> list[list[str]]:
    """Return the cells in which data differ from the truth less what is hidden: where it is to be seen."""
    from dase.diagnosis.cell_descriptions import worst_cells
    from dase.fitting.data_split import split_measurement
    from dase.fitting.model import model_of

    evidence = split_measurement(events, scene, seed=job.case.seed, device=job.device)
    judgement = model_of(sensor.bound_to(scene)).judge(evidence.held, repeats=24, seed=1)
    return [[c.probe, c.where, c.what] for c in worst_cells(evidence, judgement, shown=1000)]


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the runs that are asked for: kinds take turns, each in proportion to what it has to do."""
    kinds = {
        "single": list(singles(options)),
        "nothing": [
            Case("nothing", (), "none", n % options.scenes, 100 + n) for n in range(options.nothing)
        ],
        "pairs": [
            Case("pair", pair, "medium", seed % options.scenes, seed)
            for seed in range(options.seeds) for pair in PAIRS
        ],
        "unknown": [
            Case("unknown", (name,), "strong", seed % options.scenes, seed, removed=name)
            for seed in range(min(options.seeds, 3)) for name in names_of(options)
        ],
        "included": [
            Case("included", (name,), "strong", seed % options.scenes, seed, removed=name)
            for seed in range(min(options.seeds, 3)) for name in names_of(options) if including(name)
        ],
        "other": [
            Case("other", (), path.stem, 0, 0)
            for path in sorted(options.hidden.glob("a_*.npz") if options.hidden else ())
        ],
    }  # fmt: skip
    asked = options.kinds.split(",")
    turns = [
        ((n + 0.5) / len(group), kind, case)
        for kind, group in kinds.items() if kind in asked for n, case in enumerate(group)
    ]  # fmt: skip
    yield from (case for _, _, case in sorted(turns, key=lambda turn: turn[:2]))


def names_of(options: argparse.Namespace) -> list[str]:
    return options.only.split(",") if options.only else list(HIDDEN)


def singles(options: argparse.Namespace) -> Iterator[Case]:
    """Yield single effects: every effect at every strength before the next scene and seed."""
    order = sorted(options.strengths.split(","), key=("medium", "strong", "weak").index)
    for seed, scene, strength in product(range(options.seeds), range(options.scenes), order):
        for name in names_of(options):
            yield Case("single", (name,), strength, scene, seed)


def true_effects(folder: Path, name: str) -> tuple[str, ...]:
    """Return the effects of a case of the other simulator by dase's names."""
    params = json.loads((folder / "truth.json").read_text())[name]["params"]
    return tuple(sorted(effect for key, effect in V2E.items() if float(params.get(key) or 0) > 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", type=Path, default=Path("out/hidden_effects.jsonl"))
    parser.add_argument("--hidden", type=Path, help="folder of another simulator's cases")
    parser.add_argument("--kinds", default="single,nothing,pairs,unknown,included,other")
    parser.add_argument("--only", default="", help="effects, with commas between")
    parser.add_argument("--strengths", default="weak,medium,strong")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--nothing", type=int, default=100)
    parser.add_argument("--quick", action="store_true", help="one seed, one scene, medium only")
    parser.add_argument("--device", default="cpu", help="or some, which share the runs: cuda:0,cuda:1")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no run begins after these")
    parser.add_argument("--report", action="store_true", help="only write the page from the log")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--where", default="", help="device and commit of the log, for the page")
    options = parser.parse_args()
    if options.quick:
        options.seeds = options.scenes = 1
        options.nothing, options.strengths = 5, "medium"
    if not options.report:
        _run(options)
    if options.log.exists():
        options.out.mkdir(parents=True, exist_ok=True)
        write_report(options.log, options.out, options.where)


def _run(options: argparse.Namespace) -> None:
    begin = time.time()
    options.log.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if options.log.exists():
        lines = [json.loads(text) for text in options.log.read_text().splitlines() if text.strip()]
        done = {line["name"] for line in lines if "failed" not in line}
    todo = [case for case in cases(options) if case.name not in done]
    threads = max(1, (os.cpu_count() or 1) // options.jobs)
    until = begin + 60 * options.minutes
    devices = options.device.split(",")
    jobs = [Job(case, devices[0], threads, options.hidden, until) for case in todo]
    print(f"{len(done)} runs in the log, {len(jobs)} to do", flush=True)
    context = multiprocessing.get_context("spawn")
    with options.log.open("a") as log:
        if options.hidden and "other" in options.kinds and "time/a_01" not in done and options.minutes > 0:
            _note(log, _timed(options), options, "alone")
        places = context.SimpleQueue()
        for n in range(options.jobs):
            places.put(devices[n % len(devices)])
        with context.Pool(options.jobs, _settle, (places,)) as pool:
            for n, line in enumerate(pool.imap_unordered(_safely, jobs)):
                _note(log, line, options, f"{n + 1}/{len(jobs)}")


def _timed(options: argparse.Namespace) -> dict[str, Any]:
    """Run one case of the other simulator twice, alone: the first time compiles."""
    device = options.device.split(",")[0]
    job = Job(Case("time", (), "a_01", 0, 0), device, os.cpu_count() or 1, options.hidden)
    first = _safely(job)
    return _safely(job) | {"first": first.get("seconds")}


def _note(log: Any, line: dict[str, Any], options: argparse.Namespace, count: str) -> None:
    """Write a run to the log, and a word about it; looks up the truth of another simulator's cases."""
    if "late" in line:
        return
    if line["case"]["kind"] in ("other", "time"):
        line["case"]["effects"] = true_effects(options.hidden, line["case"]["strength"])
    log.write(json.dumps(line) + "\n")
    log.flush()
    if "failed" in line:
        print(f"{line['name']}: {line['failed']}", flush=True)
        return
    mark = "ok   " if right(line) else "WRONG"
    print(f"{count} {mark} {line['name']:40s} {line['seconds']:5.1f} s", short(line), flush=True)


_place: list[str] = []
"""The device of this process, if it has one to itself or shares it with others."""


def _settle(places: Any) -> None:
    _place[:] = [places.get()]


def _safely(job: Job) -> dict[str, Any]:
    if time.time() > job.until:
        return {"late": job.case.name}
    job = replace(job, device=_place[0]) if _place else job
    try:
        return run_case(job)
    except Exception as error:  # one bad run must not end the others
        import traceback

        said = f"{error!r} {traceback.format_exc()[-600:]}"
        return {"name": job.case.name, "case": asdict(job.case), "failed": said}


if __name__ == "__main__":
    main()
