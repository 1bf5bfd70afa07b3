"""The blind benchmark of the diagnosis: a key draws scenes, strengths and seeds that nobody has seen before.

    # every kind, on a GPU, in pieces: what is in the log is not run again
    python -m perf.experiments.blind_diagnosis.run --key KEY --device cuda:0 --jobs 8 --minutes 8 --log LOG
    # other simulators' sets
    python -m perf.experiments.blind_diagnosis.run --kinds other --hidden $DASE_DATA/hidden --log LOG.jsonl
    # the table from the log
    python -m perf.experiments.blind_diagnosis.run --report --log LOG.jsonl

A new key makes a new benchmark. What was changed after a run is run with another key. The diagnosis sees
events, scene and a sensor that lacks what was hidden; the truth is compared with its answer afterwards.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from perf.experiments.blind_diagnosis.scenes import draw_scene

Line = dict[str, Any]

STRENGTHS = ("weak", "medium", "strong")

HIDDEN: dict[str, tuple[dict[str, Any], ...]] = {
    "flicker": tuple(dict(frequency=100.0, depth=d) for d in (0.08, 0.15, 0.3)),
    "vignetting": tuple(dict(loss=x) for x in (0.3, 0.6, 0.8)),
    "dark": tuple(dict(current=c, spread=0.3) for c in (0.003, 0.01, 0.04)),
    "linlog": tuple(dict(knee=k, slope=2.5) for k in (0.03, 0.08, 0.16)),
    "bandwidth": tuple(dict(cutoff=f) for f in (600.0, 150.0, 40.0)),
    "second_order": tuple(dict(cutoff=f, damping=0.5) for f in (500.0, 150.0, 50.0)),
    "voltage_noise": tuple(dict(sigma=s, cutoff=50.0) for s in (0.05, 0.07, 0.1)),
    "mismatch": tuple(dict(spread=s) for s in (0.08, 0.15, 0.3)),
    "jitter": tuple(dict(spread=s) for s in (0.1, 0.2, 0.35)),
    "leak": tuple(dict(rate=r) for r in (0.3, 1.0, 4.0)),
    "shot": tuple(dict(rate=r) for r in (0.5, 2.0, 10.0)),
    "hot": tuple(dict(share=s, rate=r) for s, r in ((0.003, 50.0), (0.01, 100.0), (0.02, 200.0))),
    "refractory": tuple(dict(period=p) for p in (2e-3, 5e-3, 15e-3)),
    "dead": tuple(dict(share=s) for s in (0.003, 0.015, 0.03)),
    "latency": tuple(dict(delay=d) for d in (1e-3, 3e-3, 8e-3)),
    "row_scan": tuple(dict(line=x) for x in (3e-6, 1e-5, 3e-5)),
    "readout": tuple(dict(rate=r) for r in (1.5, 0.8, 0.5)),
    "timestamp": tuple(dict(step=s, jitter=0.0) for s in (1e-4, 3e-4, 1e-3)),
    "optics_blur": tuple(dict(sigma=s) for s in (0.5, 1.0, 2.0)),
}
"""Effect to its parameters at weak, medium and strong; the rate of `readout` is in 600,000 events/s."""

KINDS = ("other", "nothing", "single", "pair", "triple", "unknown", "noisy", "frames", "foreign")

FRAMES = {"25": 0.04, "100": 0.01}
"""Name of a camera's frame rate to the time from frame to frame [s]."""

CLASHES = ({"bandwidth", "second_order"}, {"shot", "voltage_noise"}, {"timestamp", "row_scan"},
           {"timestamp", "readout"}, {"row_scan", "readout"}, {"linlog", "dark"})  # fmt: skip
"""Effects of which only one is hidden at a time: two poles beside one, two clocks of one readout."""

SHOWN = {"flicker", "hot", "readout", "timestamp", "row_scan"}
"""Effects that the events show by themselves, however well the scene is known."""

IN_FRAMES = {"optics_blur"}
"""Effects that a camera's own frames have as well, so that nothing tells them there."""

HABITS = {"linlog", "timestamp"}
"""What v2e does in all of its cases, and what may be named there."""


@dataclass(frozen=True)
class Case:
    """One run: what is hidden beside which base, and how the scene is known.

    Args:
        kind: Row of the table.
        effects: What is hidden; of another simulator nothing is said before the answer is in.
        strength: Of `STRENGTHS`; of another simulator the name of the case.
        number: Draws all else.
        removed: Effect that is taken out of the library.
        noisy: Whether the sensor that is handed over has noise, mismatch and bandwidth of its own.
        frames: Frame rate of the camera by which the scene is known [Hz], "" for 1 kHz without noise.
    """

    kind: str
    effects: tuple[str, ...]
    strength: str
    number: int
    removed: str = ""
    noisy: bool = False
    frames: str = ""

    @property
    def name(self) -> str:
        """Name in the log."""
        hidden = "+".join(self.effects) or "nothing"
        base = "noisy" if self.noisy else "plain"
        return f"{self.kind}/{hidden}/{self.strength}/{base}/{self.frames or 'exact'}/{self.number}"


@dataclass(frozen=True)
class Job:
    """A case, and how it is run.

    From `until` on [s since 1970] no case may begin; names of those that did go to the file `begun`.
    """

    case: Case
    key: int
    device: str
    threads: int
    folder: Path | None = None
    until: float = float("inf")
    begun: Path | None = None


def number_of(key: str) -> int:
    """Return the number that a key stands for."""
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:6], "big")


@lru_cache(maxsize=3)
def _scene(key: int, number: int) -> Any:
    return draw_scene(np.random.default_rng([key, number, 1]))


def truth_of(case: Case, key: int) -> tuple[Any, Any]:
    """Return the sensor that makes the data, and the one that the diagnosis begins with."""
    from dase.effects import EFFECTS, Threshold
    from dase.simulation.sensor import Sensor

    rng = np.random.default_rng([key, case.number, 2])
    on, off = 0.2 * np.exp(rng.uniform(-0.35, 0.35, 2))
    true = Sensor(effects=(Threshold(on=float(on), off=float(off)),), name="truth")
    given = Sensor(effects=(Threshold(on=0.25, off=0.25),), name="given")

    def both(name: str, there: dict[str, float], here: dict[str, float]) -> None:
        nonlocal true, given
        true, given = true.with_effect(EFFECTS[name](**there)), given.with_effect(EFFECTS[name](**here))

    if case.noisy:
        base = {
            "bandwidth": dict(cutoff=300.0), "mismatch": dict(spread=0.08), "leak": dict(rate=0.2),
            "shot": dict(rate=1.0), "refractory": dict(period=1e-3),
        }  # fmt: skip
        for name, usual in base.items():
            if name not in case.effects and not any({name, e} in CLASHES for e in case.effects):
                wrong = {k: v * float(np.exp(rng.uniform(-0.5, 0.5))) for k, v in usual.items()}
                both(name, wrong, usual)
    # is seen only by what depends on the light
    if "vignetting" in case.effects and "bandwidth" not in true:
        both("bandwidth", dict(cutoff=80.0, dark=0.02), dict(cutoff=120.0, dark=0.05))
    for name in case.effects:
        values: dict[str, Any] = {
            k: v * float(np.exp(rng.uniform(-0.2, 0.2))) if isinstance(v, float) and v else v
            for k, v in HIDDEN[name][STRENGTHS.index(case.strength)].items()
        }
        if name == "flicker":
            values |= dict(phase=float(rng.uniform(0, 1)), frequency=float(rng.choice([100.0, 120.0])))
        if name == "refractory":
            values["mode"] = str(rng.choice(["drop", "delay"]))
        if name == "readout":
            values["rate"] *= 6e5
        true = true.with_effect(EFFECTS[name](**values))
    return true, given


def known_by_frames(scene: Any, rate: str, rng: np.random.Generator) -> Any:
    """Return a scene as a camera's frames show it: some time apart, exposed, with noise, in 8 bits."""
    from dase.fitting.measurement import camera_scene

    times = scene.sample_times()
    dense = scene.frames(times)
    dense = dense / dense.max()
    gap = FRAMES[rate]
    exposure = gap * float(rng.uniform(0.05, 0.5))
    begins = np.arange(times[0], times[-1] - exposure, gap)
    frames = []
    for begin in begins:
        part = dense[(times >= begin - 1e-9) & (times < begin + max(exposure, 1.1e-3) - 1e-9)]
        frames.append(part.mean(0) + 0.004 * rng.standard_normal(part.shape[1:]))
    grey = np.clip(np.rint(np.array(frames) * 255), 0, 255).astype(np.uint8)
    return camera_scene(grey, begins, begins + exposure, [])


def measured(job: Job) -> tuple[Any, Any, Any, Any]:
    """Return events, their scene, the sensor that the diagnosis begins with, and the true one if known."""
    import dase

    case = job.case
    if case.kind == "foreign":
        return *_foreign(case, job.key), None, None
    if case.kind != "other":
        exact = _scene(job.key, case.number)
        true, given = truth_of(case, job.key)
        events = dase.simulate(exact, true, seed=case.number + job.key % 100_000, device=job.device)
        rng = np.random.default_rng([job.key, case.number, 3])
        return events, known_by_frames(exact, case.frames, rng) if case.frames else exact, given, true
    assert job.folder is not None
    with np.load(job.folder / f"clip_{case.strength[0]}.npz") as data:
        scene = dase.VideoScene(data["frames"].astype(np.float32) / 255, data["frame_us"] * 1e-6)
    with np.load(job.folder / f"{case.strength}.npz") as data:
        t, x, y, p = (data[k] for k in ("t_us", "x", "y", "p"))
    return dase.Events(t * 1e-6, x, y, p.astype(bool), scene.width, scene.height), scene, None, None


def _foreign(case: Case, key: int) -> tuple[Any, Any]:
    """Return events of a simulator with other habits, and their scene."""
    from perf.experiments.blind_diagnosis import foreign

    rng = np.random.default_rng([key, case.number, 5])
    habits, (on, off) = foreign.draw_habits(rng), 0.2 * np.exp(rng.uniform(-0.25, 0.25, 2))
    ends = {name: np.log(foreign.HIDEABLE[name]) for name in case.effects}
    effects = {name: float(np.exp(rng.uniform(*some))) for name, some in ends.items()}
    scene = _scene(key, case.number)
    times = scene.sample_times()
    frames, times = foreign.clip_of(scene.frames(times), times, habits, rng)
    events = foreign.simulate(frames, times, float(on), float(off), effects, habits, case.number)
    return events, type(scene)(frames.astype(np.float32), times)


def _habits_of(case: Case, key: int) -> list[str]:
    """Return what a world of another simulator does by habit, and what may be named there."""
    from perf.experiments.blind_diagnosis import foreign

    return sorted(foreign.draw_habits(np.random.default_rng([key, case.number, 5])).named())


def run_case(job: Job) -> Line:
    """Make the data of a case, diagnose them, and note the truth beside the answer."""
    from dase.diagnosis.diagnose import diagnose
    from dase.effects import EFFECTS
    from dase.kernels import launch

    launch.set_threads(job.threads)
    case = job.case
    events, scene, given, true = measured(job)
    removed = {case.removed, *(n for n, e in EFFECTS.items() if case.removed in e.includes)}
    library = {name: effect for name, effect in EFFECTS.items() if name not in removed}
    begin = time.perf_counter()
    found = diagnose(events, given, scene=scene, effects=library, seed=case.number, device=job.device)
    truth = (
        {} if true is None else
        {f"{e.name}.{p.name}": float(getattr(e, p.name)) for e in true.effects for p in e.parameters()}
    )  # fmt: skip
    answer = found.to_json()
    return {
        "name": case.name, "case": asdict(case), "seconds": time.perf_counter() - begin, "truth": truth,
        "events": len(events), "finding": found.finding(),
        "answer": {k: v for k, v in answer.items() if k not in ("history", "sensor", "plain", "unexplained")},
        "unexplained": None if found.unexplained is None else found.unexplained.error,
        "steps": [
            {"error": s.error, "chosen": s.chosen, "ties": s.ties,
             "ranking": [(r.effect, r.error) for r in s.ranking[:5] if r.error == r.error]}
            for s in found.history
        ],
    }  # fmt: skip


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the runs that are asked for: rows of the table take turns, each in an order that the key draws.

    So what was reached in some minutes has its share of every row, and is no choice of effects.
    """
    from perf.experiments.blind_diagnosis import foreign

    rng = np.random.default_rng([number_of(options.key), 4])
    names = [n for n in HIDDEN if not options.only or n in options.only.split(",")]
    kinds: dict[str, list[Case]] = {kind: [] for kind in KINDS}
    count = 0

    def add(kind: str, effects: tuple[str, ...], strength: str, **more: Any) -> None:
        nonlocal count
        kinds[kind].append(Case(kind, effects, strength, count, **more))
        count += 1

    for _ in range(options.repeats):
        for name in names:
            for strength in STRENGTHS:
                add("single", (name,), strength)
                add("unknown", (name,), strength, removed=name)
            strength = STRENGTHS[int(rng.integers(1, 3))]
            add("noisy", (name,), strength, noisy=True)
            rate = str(rng.choice(["25", "100"]))
            if name not in IN_FRAMES:
                add("frames", (name,), strength, frames=rate)
            add("pair", _together(rng, names, 2), "medium")
            add("triple", _together(rng, names, 3), "medium")
            add("nothing", (), "none")
        for n in range(len(names)):
            add("noisy", (), "none", noisy=True)
            add("frames", (), "none", frames=("25", "100")[n % 2], noisy=n % 4 > 1)
        for name in foreign.HIDEABLE:
            for _ in range(3):
                add("foreign", (name,), "drawn")
            add("foreign", (), "drawn")
            add("foreign", _together(rng, list(foreign.HIDEABLE), 2), "drawn")
    found = sorted(options.hidden.glob("[a-z]_*.npz")) if options.hidden else ()
    kinds["other"] = [Case("other", (), path.stem, 0) for path in found]
    rows: dict[str, list[Case]] = {}
    for kind in (kind for kind in KINDS if kind in options.kinds.split(",")):
        for case in kinds[kind]:
            part = case.strength if kind in ("single", "unknown") else str(len(case.effects))
            rows.setdefault(f"{kind} {part}", []).append(case)
    turns = [
        ((n + 0.5) / len(row), name, row[k])
        for name, row in rows.items() for n, k in enumerate(rng.permutation(len(row)))
    ]  # fmt: skip
    yield from (case for _, _, case in sorted(turns, key=lambda turn: turn[:2]))


def _together(rng: np.random.Generator, names: list[str], many: int) -> tuple[str, ...]:
    """Draw effects that can be hidden together."""
    while True:
        some = {str(n) for n in rng.choice(names, many, replace=False)}
        if not any(len(clash & some) > 1 for clash in CLASHES):
            return tuple(sorted(some))


def true_effects(folder: Path, name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what is hidden in a case of another simulator by dase's names, and what may be named beside.

    A set says it by `effects` and `allowed`, or by the parameters that v2e was given.
    """
    case = json.loads((folder / "truth.json").read_text())[name]
    if "effects" in case:
        return tuple(sorted(case["effects"])), tuple(sorted(case.get("allowed", ())))
    values = {key: float(value or 0) for key, value in case["params"].items() if not isinstance(value, str)}
    of = {
        "sigma_thres": "mismatch", "cutoff_hz": "bandwidth", "leak_rate_hz": "leak",
        "shot_noise_rate_hz": "shot", "refractory_period_s": "refractory",
    }  # fmt: skip
    hidden = {effect for key, effect in of.items() if values.get(key, 0) > 0}
    if values.get("photoreceptor_noise"):  # then its shot noise is noise of the voltage
        hidden = (hidden - {"shot"}) | {"voltage_noise"}
    if "2nd_order" in case["case"]:
        hidden = (hidden - {"bandwidth"}) | {"second_order"}
    return tuple(sorted(hidden)), tuple(sorted(HABITS)) if "v2e " in case["generator"] else ()


@dataclass(frozen=True)
class Score:
    """An answer beside the truth.

    Args:
        announced: Effects said to be certain or supported.
        wrong: Those of them that are not there.
        found: Hidden effects that are announced.
        offered: Hidden effects that are one of an either ... or, and not announced.
        hidden: How many are hidden.
    """

    announced: int
    wrong: int
    found: int
    offered: int
    hidden: int


def score(line: Line) -> Score:
    """Compare an answer with the truth; a removed effect need not be found."""
    from dase.effects import EFFECTS
    from dase.effects.made_signatures import makers_of

    want = set(line["case"]["effects"])
    allowed = want | set(line.get("allowed", ()))
    findings = line["answer"]["findings"]
    sure = {one["effect"] for one in findings if one["grade"] in ("certain", "supported")}
    # "opposite pairs" or "fixed pattern" says what there is, and is true of any effect that makes it
    sure -= {name for name in sure - want if allowed & makers_of(name, EFFECTS).keys()}
    offered = {
        n for one in findings if one["grade"] == "either" for n in (one["effect"], *one["alternatives"][:1])
    }
    if line["case"]["removed"]:
        want = set()  # no model can name it; the events alone may show it, which is true
    habits = sure & (allowed - want)
    return Score(
        len(sure - habits), len(sure - allowed), len(want & sure), len((want & offered) - sure), len(want)
    )


def interval(good: int, count: int) -> str:
    """Return a share with its 95 % limits by Clopper and Pearson."""
    from scipy.stats import beta

    if not count:
        return "-"
    low = beta.ppf(0.025, good, count - good + 1) if good else 0.0
    high = beta.ppf(0.975, good + 1, count - good) if good < count else 1.0
    return f"{good} of {count} ({100 * low:.0f} to {100 * high:.0f} %)"


def table(lines: list[Line], open_: list[Case]) -> list[str]:
    """Return the table of results: a row for each kind of case.

    Args:
        lines: Of the log.
        open_: Cases that were begun and have no answer.
    """
    good = [line for line in lines if "failed" not in line] + [{"case": asdict(case)} for case in open_]

    def of(kind: str, strength: str = "", **more: Any) -> list[Line]:
        return [
            n for n in good
            if n["case"]["kind"] == kind and strength in ("", n["case"]["strength"])
            and all(n["case"][k] == v for k, v in more.items())
        ]  # fmt: skip

    rows: list[tuple[str, list[Line]]] = [(f"one effect, {s}", of("single", s)) for s in STRENGTHS]
    rows += [("two effects", of("pair")), ("three effects", of("triple"))]
    rows += [(f"not in the library, {s}", of("unknown", s)) for s in STRENGTHS]
    rows += [("nothing hidden", of("nothing"))]
    rows += [("noisy base, one effect", [n for n in of("noisy") if n["case"]["effects"]])]
    rows += [("noisy base, nothing hidden", [n for n in of("noisy") if not n["case"]["effects"]])]
    framed = [n for n in of("frames") if n["case"]["effects"]]
    seen, rest = (
        [n for n in framed if (n["case"]["effects"][0] in SHOWN) == shown] for shown in (True, False)
    )
    rows += [("scene known at 25 or 100 Hz, an effect that events alone show", seen)]
    rows += [("scene known at 25 or 100 Hz, another effect", rest)]
    bare = [n for n in of("frames") if not n["case"]["effects"]]
    rows += [("scene known at 25 or 100 Hz, nothing hidden", bare)]
    for words, some in (("nothing hidden", 0), ("one effect", 1), ("two effects", 2)):
        rows += [
            (f"worlds slightly off, {words}", [n for n in of("foreign") if len(n["case"]["effects"]) == some])
        ]
    letters = sorted({n["case"]["strength"][0] for n in of("other")})
    rows += [
        (f"other simulators, set {x}", [n for n in of("other") if n["case"]["strength"][0] == x])
        for x in letters
    ]
    out = [
        "| cases | answered | of them with something wrong announced | announced and true "
        "| hidden effects announced | ... or in an either ... or |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for words, mine in rows:
        scores = [score(line) for line in mine if "answer" in line]
        if mine:
            announced, wrong = (sum(getattr(s, n) for s in scores) for n in ("announced", "wrong"))
            hidden, found, offered = (
                sum(getattr(s, n) for s in scores) for n in ("hidden", "found", "offered")
            )
            out.append(
                f"| {words} | {len(scores)} of {len(mine)} "
                f"| {interval(sum(s.wrong > 0 for s in scores), len(scores))} "
                f"| {interval(announced - wrong, announced)} | {interval(found, hidden)} "
                f"| {interval(found + offered, hidden)} |"
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--key", default="development", help="draws scenes, strengths and seeds")
    parser.add_argument("--log", type=Path, default=Path("out/blind.jsonl"))
    parser.add_argument("--hidden", type=Path, help="folder of other simulators' cases")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--only", default="", help="effects, with commas between")
    parser.add_argument("--repeats", type=int, default=1, help="of every kind and effect")
    parser.add_argument("--device", default="cpu", help="or some, which share the runs: cuda:0,cuda:1")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--part", default="1/1", help="K/N: each Nth case from the Kth on, for machines that share"
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no run begins after these")
    parser.add_argument(
        "--longest-first", action="store_true", help="begin with what takes long, where all can be done"
    )
    parser.add_argument("--report", action="store_true", help="only print the table of the log")
    options = parser.parse_args()
    if not options.report:
        _run(options)
    lines = [json.loads(text) for text in options.log.read_text().splitlines() if text.strip()]
    print("\n".join(table(lines, unanswered(lines, options))))
    print(f"\n{reached(lines, options)}")


def begun_file(log: Path) -> Path:
    """Return the file that names the cases of a log that were begun: those that never ended among them."""
    return log.with_suffix(".begun")


def unanswered(lines: list[Line], options: argparse.Namespace) -> list[Case]:
    """Return the cases that were begun and have no answer, because they failed or time was over."""
    done = {line["name"] for line in lines if "failed" not in line and line["key"] == options.key}
    file, key = begun_file(options.log), str(number_of(options.key))
    text = file.read_text().splitlines() if file.exists() else []
    begun = {name for number, name in (line.split(" ", 1) for line in text) if number == key}
    return [case for case in cases(options) if case.name in begun - done]


def reached(lines: list[Line], options: argparse.Namespace) -> str:
    """Return how far a log goes in the order that its key draws, and which cases have no answer."""
    done = {line["name"] for line in lines if "failed" not in line and line["key"] == options.key}
    order = [case.name for case in cases(options)]
    open_ = [case.name for case in unanswered(lines, options)]
    failed = {line["name"] for line in lines if "failed" in line} - done
    never = [name for name in order if name not in done and name not in open_]
    return (
        f"key {options.key}: {len(done)} of {len(order)} cases were answered, {len(never)} were never begun; "
        f"{len(open_)} were begun and have no answer, {len(failed)} of them failed"
        f"{': ' if open_ else ''}{', '.join(open_)}"
    )


def _run(options: argparse.Namespace) -> None:
    begin = time.time()
    options.log.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if options.log.exists():
        lines = [json.loads(text) for text in options.log.read_text().splitlines() if text.strip()]
        done = {line["name"] for line in lines if "failed" not in line and line["key"] == options.key}
    first, step = (int(number) for number in options.part.split("/"))
    todo = [case for case in list(cases(options))[first - 1 :: step] if case.name not in done]
    threads = max(1, len(os.sched_getaffinity(0)) // options.jobs)
    if options.jobs > 1:  # processes that are started: libraries must not take all cores in each
        os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)))
    devices = options.device.split(",")
    make = partial(
        Job, key=number_of(options.key), device=devices[0], threads=threads, folder=options.hidden,
        until=begin + 60 * options.minutes, begun=begun_file(options.log),
    )  # fmt: skip
    if options.longest_first:  # which end last, whatever the order; a scene known by frames takes longest
        todo.sort(key=lambda case: (not case.frames, not case.noisy))
    jobs = [make(case) for case in todo]
    print(f"{len(done)} runs in the log, {len(jobs)} to do", flush=True)
    note = partial(_note, options=options)
    with options.log.open("a") as log:
        if options.jobs == 1:
            for job in jobs:
                note(log, _safely(job))
            return
        context = multiprocessing.get_context("spawn")
        places = context.SimpleQueue()
        for n in range(options.jobs):
            places.put(devices[n % len(devices)])
        with context.Pool(options.jobs, _settle, (places,)) as pool:
            for line in pool.imap_unordered(_safely, jobs):
                note(log, line)


def _note(log: Any, line: Line, *, options: argparse.Namespace) -> None:
    """Write a run to the log, and a word about it; looks up the truth of another simulator's cases."""
    if "late" in line:
        return
    line["key"] = options.key
    if line["case"]["kind"] == "foreign":
        line["allowed"] = _habits_of(Case(**line["case"]), number_of(options.key))
    if line["case"]["kind"] == "other":
        line["case"]["effects"], line["allowed"] = true_effects(options.hidden, line["case"]["strength"])
    log.write(json.dumps(line) + "\n")
    log.flush()
    if "failed" in line:
        print(f"{line['name']}: {line['failed']}", flush=True)
        return
    one = score(line)
    mark = (
        "WRONG"
        if one.wrong
        else "ok   "
        if one.found == one.hidden
        else "part "
        if one.found + one.offered
        else "mute "
    )
    print(f"{mark} {line['name']:46s} {line['seconds']:5.1f} s {line['finding'][:150]}", flush=True)


_place: list[str] = []
"""The device of this process, if it has one to itself or shares it with others."""


def _settle(places: Any) -> None:
    _place[:] = [places.get()]


def _safely(job: Job, run: Callable[[Job], Line] = run_case) -> Line:
    if time.time() > job.until:
        return {"late": job.case.name}
    job = replace(job, device=_place[0]) if _place else job
    if job.begun:
        with job.begun.open("a") as names:
            names.write(f"{job.key} {job.case.name}\n")
    try:
        return run(job)
    except Exception as error:  # one bad run must not end the others
        import traceback

        said = f"{error!r} {traceback.format_exc()[-600:]}"
        return {"name": job.case.name, "case": asdict(job.case), "failed": said}


if __name__ == "__main__":
    main()
