"""Networks trained on simulated events of several sensors, judged by the frames of a real recording.

    python -m perf.experiments.downstream.real RECORDING --camera davis240c --photos FOLDER --out OUT

Reconstruction as in `run`: the same size, scenes and seeds, trained on ESIM's default, broad randomisation,
S2R's threshold tuned to the recording's rate of events, the preset of its camera, and with `--fitted` and
`--diagnosed` what `dase fit` and `dase diagnose` made of the recording. Each network is judged half way and
at the end of its training, as `dase evaluate` does, and all on the same frames. The same call goes on where
it stopped. `results.jsonl` has a line for each network; the table is printed at the end. `published` judges a
published network beside them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dase
from dase.files.atomic_file import replacing
from perf.experiments.downstream.run import SMALL, Job, Size, Study, run_jobs, unpack_photos
from perf.experiments.downstream.sensors import (
    Training,
    in_midst,
    plain_sensor,
    tune_threshold,
    tuned_thresholds,
)
from perf.experiments.downstream.table import mean_text, read_rows

KINDS = ("esim", "broad", "tuned", "camera", "fitted", "diagnosed")
"""What is trained on."""
METRICS = ("mse", "mse_affine", "mse_histogram", "ssim", "ms_ssim")
"""What the table has."""


@dataclass
class RealStudy(Study):
    """The study with a recording for a target, whose name stands where that of a target stands.

    Args:
        recording: File with frames.
        camera: Preset of its camera.
        offset: From the frames' times to the middles of their exposures [s].
        fitted: File of the sensor that was fitted to the recording.
        diagnosed: File of the sensor that a diagnosis left of it.
    """

    recording: str = ""
    camera: str = ""
    offset: float = 0.0
    fitted: str = ""
    diagnosed: str = ""

    def learned(self) -> set[tuple[str, str]]:
        """Return what has been learned of the recording: a threshold that is tuned, and what was fitted."""
        tuned = self.learned_file("tune", self.camera).exists()
        return {(task, self.camera) for task, there in (("tune", tuned), ("fit", self.fitted)) if there}

    def learn(self, task: str, target: str) -> None:
        """Tune a threshold to the rate of the recording."""
        sequence = dase.io.read(self.recording)
        events = sequence.events
        each = np.histogram(events.t, np.arange(events.t[0], events.t[-1] + 0.5))[0]
        rate = float(np.median(each)) / (events.width * events.height)
        scenes, windows = (4, 6) if self.size is SMALL else (16, 60)
        base = tune_threshold(rate, self.train, self.device, scenes=scenes, windows=windows)
        path = self.learned_file(task, target)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"rate": rate, "tuned": base}) + "\n", "utf-8")

    def training(self, kind: str, target: str) -> Training:
        """Return what is trained on."""
        if kind == "camera":
            return Training(dase.load_sensor(self.camera))
        if kind in ("fitted", "diagnosed"):
            return Training(in_midst(dase.load_sensor(self.fitted if kind == "fitted" else self.diagnosed)))
        if kind == "tuned":
            base = json.loads(self.learned_file("tune", target).read_text("utf-8"))["tuned"]
            return Training(plain_sensor(base), tuned_thresholds(base))
        return super().training(kind, target)

    def do(self, job: Job) -> list[dict[str, Any]]:
        """Train a network and return its line; or tune, and return none."""
        if job.task == "tune":
            self.learn(job.task, job.target)
            return []
        begin, found = time.monotonic(), {}
        steps = self.size.steps(job.task)
        for name, stop in (("half_way", steps // 2), ("end", steps)):
            note = self.folder(job) / f"{name}.json"
            # a call that goes on has a network of later steps
            if not note.exists():
                self.train_one(job, stop)
                file = self.folder(job) / "checkpoint.pt"
                judged = dase.tasks.evaluate(file, self.recording, offset=self.offset, device=self.device)
                seen = {metric: round(value, 5) for metric, value in judged.metrics.items()}
                with replacing(note) as temporary:
                    temporary.write_text(json.dumps(seen | {"frames": judged.windows}) + "\n", "utf-8")
            found[name] = json.loads(note.read_text("utf-8"))
        frames = {one.pop("frames") for one in found.values()}.pop()
        row = {"recording": Path(self.recording).stem, "kind": job.kind, "camera": self.camera}
        seconds = round(time.monotonic() - begin, 1)
        how = {"steps": steps, "scene_batches": self.size.scene_batches, "seconds": seconds}
        return [{**row, "seed": job.seed, **found, "frames": frames, **how}]


def table(rows: list[dict[str, Any]]) -> str:
    """Return means over seeds at the end, and how many runs ended worse than half way, in Markdown."""
    out = [
        f"| trained on | {' | '.join(METRICS)} | worse than half way (MSE, affine) |",
        "|---|" + "---|" * 6,
    ]
    for kind in KINDS:
        of = sorted((row for row in rows if row["kind"] == kind), key=lambda row: row["seed"])
        cells = [mean_text([row["end"][name] for row in of if name in row["end"]], 4) for name in METRICS]
        worse = sum(row["end"]["mse_affine"] > row["half_way"]["mse_affine"] for row in of)
        out.append(f"| {kind} | {' | '.join(cells)} | {worse} of {len(of)} |")
    return "\n".join(out)


def main() -> None:
    """Run what is left to do."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("recording", type=Path)
    ask.add_argument("--camera", required=True, help="preset")
    ask.add_argument("--offset", type=float, default=0.0)
    ask.add_argument("--photos", type=Path, required=True)
    ask.add_argument("--out", type=Path, required=True)
    ask.add_argument("--devices", default="cuda:0", help="`cpu`, or GPUs: cuda:0,cuda:1")
    ask.add_argument("--jobs", type=int, default=1, help="trainings side by side on each device")
    ask.add_argument("--minutes", type=float, default=1e6)
    ask.add_argument("--seeds", type=int, default=5)
    ask.add_argument("--fitted", default="", help="sensor file that was fitted to the recording")
    ask.add_argument("--diagnosed", default="", help="sensor file that a diagnosis left of the recording")
    ask.add_argument("--kinds", default=",".join(KINDS))
    ask.add_argument("--steps", type=int, default=Size.reconstruction_steps, help="batches of a training")
    ask.add_argument("--scene-batches", type=int, default=4, help="batches that a scene goes on for")
    ask.add_argument("--small", action="store_true", help="Do all parts work?")
    args = ask.parse_args()
    deadline = time.monotonic() + 60 * args.minutes
    args.out.mkdir(parents=True, exist_ok=True)
    train, test = unpack_photos(args.photos, args.out)
    size = SMALL if args.small else Size(reconstruction_steps=args.steps, scene_batches=args.scene_batches)
    study = RealStudy(
        train, test, args.out, "cpu", size, deadline,
        recording=str(args.recording), camera=args.camera, offset=args.offset,
        fitted=args.fitted, diagnosed=args.diagnosed,
    )  # fmt: skip
    log = args.out / "results.jsonl"
    # published networks have rows, and no trainings
    rows = [row for row in read_rows(str(log)) if row["kind"] in KINDS] if log.exists() else []
    # trainings of other lengths are neither done nor to be averaged with these, nor those of other scenes
    asked = size.reconstruction_steps, size.scene_batches
    if {(row["steps"], row.get("scene_batches", 1)) for row in rows} - {asked}:
        ask.error(f"{log} has trainings of other steps or batches of a scene than {asked}")
    done = {(row["kind"], row["seed"]) for row in rows}
    # the quickest first: what is tuned is waited for
    given = {"fitted": args.fitted, "diagnosed": args.diagnosed}
    kinds = [kind for kind in args.kinds.split(",") if given.get(kind, True)]
    plan = [Job("tune", "", args.camera, 0)] if "tuned" in kinds else []
    plan = [job for job in plan if (job.task, job.target) not in study.learned()]
    each = itertools.product(range(args.seeds), kinds)
    plan += [
        Job("reconstruction", kind, args.camera, seed) for seed, kind in each if (kind, seed) not in done
    ]
    failed = run_jobs(study, plan, args.devices.split(","), args.jobs)
    print(table(read_rows(str(log))) if log.exists() else "nothing was trained")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
