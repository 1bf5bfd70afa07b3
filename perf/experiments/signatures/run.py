"""Signatures on simulated recordings: false alarms and hits, with 95 % limits.

    python -m perf.experiments.signatures.run OUT.jsonl [--seeds 1,2,3] [--cases plain,hot] [--seconds 1.0]
    python -m perf.experiments.signatures.run OUT.jsonl --report

Every case is a scene, a sensor and what a camera adds on the way out. Scenes are random textures and shapes
that shake, pan, turn, or move before a still background; every second recording has frames. Effects that dase
does not simulate are put into the events: bursts with the frames, double events, rows that are read together.
A signature counts as a false alarm where it is found and none of a case's effects makes it. Scenes, strengths
and seeds are random: nothing here is taken from a recording.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import stats

import dase
from dase.effects import EFFECTS
from dase.effects.readout import Readout
from dase.io.sequence import Sequence

SIZE = 120, 90
GAP = 0.04
"""Time from frame to frame [s]."""

EXPLAINED = {
    "coupling": {"frame coupling"},
    "flicker": {"flicker"},
    "hot": {"hot pixels"},
    "shot": {"opposite pairs"},
    "voltage_noise": {"opposite pairs"},
    "mismatch": {"fixed pattern"},
    "rows": {"grouping"},
    "row_scan": {"time stamps"},
    "timestamp": {"time stamps"},
    "doubles": {"double events"},
    "readout": {"full bus"},
}
"""Signatures that an effect should show."""

BESIDE = {
    "row_scan": {"grouping"},  # a scan reads rows together
    "hot": {"opposite pairs"},  # those that are only warm remain
    "noisy": {"opposite pairs"},  # some shot noise, perhaps too little
    "leak": {"opposite pairs"},
    # as made here, events of one pixel that wait together leave together, and rows have their turn
    "rows": {"double events", "time stamps"},
    "readout": {"time stamps"},  # a bus that sends at even steps
}
"""Signatures that an effect may show: counted neither as hits nor as false alarms."""


def draw_texture(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Return a picture in [0.03, 1]: noise of all sizes with some sharp shapes, through a lens."""
    y, x = (
        np.fft.fftfreq(n)[:, None] if k == 0 else np.fft.fftfreq(n)[None]
        for k, n in enumerate((height, width))
    )
    spectrum = rng.standard_normal((height, width)) + 1j * rng.standard_normal((height, width))
    field = np.fft.ifft2(spectrum / np.maximum(np.hypot(x, y), 0.5 / width) ** rng.uniform(1.2, 2.0)).real
    field = (field - field.mean()) / field.std()
    for _ in range(int(rng.integers(0, 25))):
        at = tuple(int(v) for v in rng.integers(0, (width, height)))
        far = tuple(int(v) for v in np.array(at) + rng.integers(3, 50, 2))
        cv2.rectangle(field, at, far, float(rng.normal(0, 1.5)), -1)
    picture = 0.2 * np.exp(rng.uniform(0.3, 0.8) * field)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.7, 1.2)), 0.01, 1).astype(np.float32)


def smooth_path(rng: np.random.Generator, times: np.ndarray, reach: float) -> np.ndarray:
    """Return a hand's motion, shape (2, N) [px]."""
    out = np.zeros((2, len(times)))
    for axis in range(2):
        for frequency in rng.uniform(0.5, 6.0, 5):
            out[axis] += reach / (1 + frequency) * np.sin(2 * np.pi * (frequency * times + rng.uniform()))
    return out


def draw_scene(rng: np.random.Generator, kind: str, seconds: float) -> dase.Scene:
    """Return a scene of one kind, sampled every millisecond."""
    width, height = SIZE
    times = np.arange(0, seconds, 1e-3)
    picture = draw_texture(rng, 3 * width, 3 * height)
    out = np.empty((len(times), height, width), np.float32)
    dx, dy = smooth_path(rng, times, rng.uniform(4, 25))
    if kind == "pan":
        speed = rng.uniform(20, 100) * np.exp(2j * np.pi * rng.uniform())
        dx, dy = dx / 4 + speed.real * (times - seconds / 2), dy / 4 + speed.imag * (times - seconds / 2)
    turn = rng.uniform(60, 400) * times if kind == "turn" else np.zeros(len(times))
    still = picture[height : 2 * height, width : 2 * width]
    mask = np.zeros((3 * height, 3 * width), np.float32)
    for _ in range(3):
        at = rng.integers((width * 1.2, height * 1.2), (width * 1.8, height * 1.8))
        cv2.circle(mask, (int(at[0]), int(at[1])), int(rng.integers(4, 14)), 1.0, -1)
    mask = cv2.GaussianBlur(mask, (0, 0), 0.8)
    for k in range(len(times)):
        m = cv2.getRotationMatrix2D((1.5 * width, 1.5 * height), float(turn[k]), 1.0)
        m[:, 2] += dx[k] - width, dy[k] - height
        if kind == "objects":
            m[:, 2] += dx[k], dy[k]
            cover = cv2.warpAffine(mask, m, SIZE)
            out[k] = still * (1 - cover) + 0.6 * cover
        elif kind == "static":
            out[k] = still
        else:
            out[k] = cv2.warpAffine(picture, m, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return dase.VideoScene(np.clip(out, 0.005, 1), times)


def draw_effect(rng: np.random.Generator, name: str) -> Any:
    """Return an effect of a random strength that would trouble somebody."""
    draws: dict[str, Callable[[], dict[str, Any]]] = {
        "flicker": lambda: {
            "frequency": rng.choice([100.0, 120.0]) + rng.normal(0, 0.1), "depth": rng.uniform(0.08, 0.4),
            "phase": rng.uniform(),
        },
        "hot": lambda: {"share": rng.uniform(0.001, 0.004), "rate": rng.uniform(30, 200)},
        "voltage_noise": lambda: {"sigma": rng.uniform(0.055, 0.075), "cutoff": rng.uniform(50, 150)},
        "mismatch": lambda: {"spread": rng.uniform(0.1, 0.25)},
        "row_scan": lambda: {"line": rng.uniform(2e-6, 2e-5)},
        "timestamp": lambda: {"step": rng.choice([1e-4, 1e-3, 4e-3])},
        "bandwidth": lambda: {"cutoff": rng.uniform(60, 400)},
        "leak": lambda: {"rate": rng.uniform(0.05, 0.5)},
        "shot": lambda: {"rate": rng.uniform(0.3, 3.0)},
        "refractory": lambda: {"period": rng.uniform(5e-4, 2e-3)},
    }  # fmt: skip
    return EFFECTS[name](**draws[name]())


def add_bursts(rng: np.random.Generator, events: dase.Events, begin: float) -> dase.Events:
    """Return events with bursts of the array in step with frames."""
    off, on = rng.uniform(0.1, 0.4) * GAP, rng.uniform(0.5, 0.9) * GAP
    share = rng.uniform(0.05, 0.3)
    pieces = []
    for start in np.arange(begin, events.t[-1], GAP):
        for phase, polarity in ((off, False), (on, True)):
            chosen = np.flatnonzero(rng.random(events.width * events.height) < share)
            t = start + phase + rng.normal(0, 4e-4, len(chosen))
            pieces.append((t, chosen % events.width, chosen // events.width, np.full(len(chosen), polarity)))
    t, x, y, p = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return merge_events(events, t, x, y, p)


def merge_events(events: dase.Events, t: Any, x: Any, y: Any, p: Any) -> dase.Events:
    """Return events and others in order of time."""
    t = np.concatenate((events.t, t))
    order = np.argsort(t, kind="stable")
    columns = ((events.x, x), (events.y, y), (events.p, p))
    x, y, p = (np.concatenate(pair).astype(pair[0].dtype)[order] for pair in columns)
    keep = t[order] >= 0
    return dase.Events(t[order][keep], x[keep], y[keep], p[keep], events.width, events.height)


def double_events(rng: np.random.Generator, events: dase.Events) -> dase.Events:
    """Return events of which some are sent twice."""
    some = np.flatnonzero(rng.random(len(events)) < rng.uniform(0.003, 0.03))
    later = events.t[some] + rng.uniform(2e-6, 15e-6, len(some))
    return merge_events(events, later, events.x[some], events.y[some], events.p[some])


def read_rows(rng: np.random.Generator, events: dase.Events) -> dase.Events:
    """Return events that an arbiter takes row by row: those that wait together leave together."""
    wait = rng.uniform(8, 40) * max(events.t[-1], 1e-3) / len(events)
    slot = np.floor(events.t / wait).astype(np.int64)
    order = np.lexsort((rng.random(len(slot)), rng.permutation(events.height)[events.y], slot))
    return dase.Events(
        events.t, events.x[order], events.y[order], events.p[order], events.width, events.height
    )


BASES = {"plain": (), "noisy": ("bandwidth", "leak", "shot", "refractory")}
CASES: dict[str, tuple[str, ...]] = {
    "plain": (), "coupling": ("coupling",), "flicker": ("flicker",), "hot": ("hot",),
    "shot": ("shot",), "voltage_noise": ("voltage_noise",), "mismatch": ("mismatch",), "rows": ("rows",),
    "row_scan": ("row_scan",), "timestamp": ("timestamp",), "doubles": ("doubles",), "readout": ("readout",),
    "camera": ("coupling", "flicker", "hot", "mismatch", "rows"), "lit": ("flicker", "mismatch", "hot"),
    "uneven": ("flicker", "mismatch"),
}  # fmt: skip


def make_recording(
    rng: np.random.Generator, kind: str, base: str, effects: tuple[str, ...], seconds: float, seed: int
) -> tuple[dase.Events, bool]:
    """Return the events of a camera, and whether it has frames."""
    sensor = dase.Sensor().with_effect(
        EFFECTS["threshold"](on=rng.uniform(0.15, 0.3), off=rng.uniform(0.15, 0.3))
    )
    for name in (*BASES[base], *effects):
        if name in EFFECTS and name != "readout":
            sensor = sensor.with_effect(draw_effect(rng, name))
    events = dase.simulate(draw_scene(rng, kind, seconds), sensor, seed=seed)
    if "coupling" in effects and len(events):
        events = add_bursts(rng, events, 0.003)
    if "rows" in effects and len(events):
        events = read_rows(rng, events)
    if "doubles" in effects and len(events):
        events = double_events(rng, events)
    if "readout" in effects and len(events):
        per_step = np.bincount((events.t / 1e-3).astype(int))
        rate = max(float(np.quantile(per_step, rng.uniform(0.5, 0.9))) * 1e3, 1e3)
        events = Readout(rate=rate).reader(events.width, events.height, 0).push(events, np.inf)[0]
    return events, bool(rng.random() < 0.5)


def run_case(case: str, seed: int, seconds: float) -> dict[str, Any] | None:
    """Return what is found in one recording; None where it has no events to speak of."""
    rng = np.random.default_rng([seed, *case.encode()])
    base = "plain" if case == "shot" else str(rng.choice(list(BASES)))
    kind = str(rng.choice(["shake", "pan", "turn", "objects", "static"]))
    effects = CASES[case]
    began = time.perf_counter()
    events, framed = make_recording(rng, kind, base, effects, seconds, seed)
    if len(events) < 200:
        return None
    simulated = time.perf_counter()
    source: Any = events
    if framed:
        times = np.arange(0.003, seconds - GAP, GAP)
        frames = np.zeros((len(times), events.height, events.width), np.uint8)
        source = Sequence(events, frames, times + 0.005, frame_exposure=np.full(len(times), 0.01))
    found = dase.find_signatures(source)
    return {
        "case": case, "seed": seed, "base": base, "kind": kind, "frames": framed, "events": len(events),
        "simulation": simulated - began, "seconds": time.perf_counter() - simulated,
        "entries": found.to_json()["entries"],
    }  # fmt: skip


def limits(count: int, total: int) -> str:
    """Return a count with its 95 % limits (Clopper and Pearson)."""
    if not total:
        return "-"
    low = 100 * stats.beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = 100 * stats.beta.ppf(0.975, count + 1, total - count) if count < total else 100.0
    return f"{count} of {total} ({low:.0f} to {high:.0f} %)"


def print_report(rows: list[dict[str, Any]]) -> None:
    """Print false alarms and hits by signature."""
    names = [entry["name"] for entry in rows[0]["entries"]]
    head = (
        "signature",
        "false alarms (95 %)",
        "hits, alone",
        "cannot say",
        "hits, with others",
        "cannot say",
    )
    print(f"| {' | '.join(head)} |")
    print("|---|---|---|---|---|---|")
    alarmed = []
    for k, name in enumerate(names):
        absent, alone, beside = [], [], []
        for row in rows:
            effects = (*CASES[row["case"]], row["base"])
            answer = row["entries"][k]["answer"]
            if any(name in EXPLAINED.get(effect, ()) for effect in effects):
                (alone if len(CASES[row["case"]]) == 1 else beside).append(answer)
            elif not any(name in BESIDE.get(effect, ()) for effect in effects):
                absent.append(answer)
                if answer == "found":
                    entry = row["entries"][k]
                    alarmed.append((name, row, entry))
        cells = [limits(answers.count("found"), len(answers)) for answers in (absent, alone, beside)]
        unsaid = [str(answers.count("cannot say")) for answers in (alone, beside)]
        print(f"| {name} | {cells[0]} | {cells[1]} | {unsaid[0]} | {cells[2]} | {unsaid[1]} |")
    wrong = len({(row["case"], row["seed"]) for _, row, _ in alarmed})
    print(f"\n{len(rows)} recordings, {wrong} with a false alarm: {limits(wrong, len(rows))}")
    for name, row, entry in alarmed:
        what = f"{row['case']} {row['seed']} {row['base']} {row['kind']} {'frames' if row['frames'] else ''}"
        print(f"  {name} in {what} {row['events']}: p {entry['p']:.1g} {entry['sentence']}")


def main() -> None:
    """Run or report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if not options.report:
        with options.out.open("a") as out:
            for seed in (int(part) for part in options.seeds.split(",")):
                for case in options.cases.split(","):
                    row = run_case(case, seed, options.seconds)
                    if row is not None:
                        out.write(json.dumps(row) + "\n")
                        out.flush()
    print_report([json.loads(line) for line in options.out.read_text().splitlines()])


if __name__ == "__main__":
    main()
