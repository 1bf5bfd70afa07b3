"""Networks for one sensor trained on another: how much does it matter what is simulated?

    python -m perf.experiments.downstream.run --photos FOLDER --out OUT --devices cuda:0 --jobs 5
    python -m perf.experiments.downstream.table OUT/results.jsonl

Four targets with physics beyond thresholds (`sensors.py`) are recorded for 60 s each. Networks are
trained on ESIM's default, on broad randomisation, on a camera's preset, and for each target on S2R's tuned
threshold, on what `dase.fit` makes of the recording, on thresholds that `dase train` learns of it (alone, by
the paper's preset, and on top of the fit), on volumes of EventGAN (reconstruction alone), and on the true
sensor; then tested on each target's simulated scenes of photographs that no training has seen. A seed has
the same first weights and scenes whatever the sensor. Each training stands alone: it is checkpointed,
`--minutes` ends a call, the same call goes on, and several machines may take `--seeds` apart. `--jobs`
trainings share a device: each is small, and waits for Python more than for the GPU. What waits for no fit
comes first and seed by seed, so that a call that ends early leaves whole tables of fewer seeds; a fit
takes up to an hour of a core, which machines without a GPU can spend. `results.jsonl` has a line for each
network and target, `sensors/` what was tuned and fitted: with both in OUT, another machine goes on.
`results.jsonl` and `learned_sensors/` of this folder are of photographs that are no part of the project.
`--photos` may be a tar of pictures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import sys
import tarfile
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

import dase
from dase.files.atomic_file import replacing
from dase.tasks.flow_metrics import flow_errors
from dase.tasks.image_metrics import structural_similarity
from dase.torch import Batch
from perf.experiments.downstream.eventgan import EventGan, GanTraining, save_eventgan, train_eventgan
from perf.experiments.downstream.sensors import (
    CAMERA,
    FAST,
    KINDS,
    LEARNED_AFTER,
    LEARNED_BY,
    LEARNED_WITH,
    OF_NO_TARGET,
    TARGETS,
    VIEW,
    WITHOUT_FLOW,
    LearnSettings,
    TargetRecording,
    Training,
    broad_thresholds,
    fit_target,
    in_midst,
    plain_sensor,
    record_target,
    train_on,
    tune_threshold,
    tuned_thresholds,
)

FILES = {
    "tune": ".json", "fit": ".toml", "gan": ".pt", **{task: f"-{task}/sensor.toml" for task in LEARNED_WITH},
}  # fmt: skip
"""Ends of the names of what is learned from a target's recording."""


class OutOfTime(Exception):
    """A call has come to its end; the last checkpoint is good."""


@dataclass(frozen=True)
class Size:
    """How large the study is.

    Args:
        crop: Columns and rows of training and tests [px].
        windows: Of a batch for reconstruction.
        scene_batches: Of reconstruction that a scene goes on for.
        batch: Sequences of a batch for reconstruction.
        flow_batch: Sequences, of `flow_windows` each, of a batch for flow.
        flow_windows: See `flow_batch`.
        reconstruction_channels: Of the networks.
        flow_channels: Of the networks.
        reconstruction_steps: Batches of a training.
        flow_steps: Batches of a training.
        samples: Of a window.
        gan_steps: Of the generator of EventGAN.
        learning: Of thresholds by `dase train`.
        learning_paper: Of thresholds by `dase train --preset paper`.
        recorded: Duration of a target's recording [s].
        test_batches: On each target.
        backgrounds: Pictures in a pool.
        objects: Cut-outs in a pool.
    """

    crop: tuple[int, int] = (112, 112)
    windows: int = 16
    scene_batches: int = 1
    batch: int = 6
    flow_batch: int = 16
    flow_windows: int = 3
    reconstruction_channels: int = 16
    flow_channels: int = 32
    reconstruction_steps: int = 500
    flow_steps: int = 12000
    samples: int = 16
    gan_steps: int = 3000
    learning: LearnSettings = field(default_factory=LearnSettings)
    learning_paper: LearnSettings = field(default_factory=lambda: LearnSettings(seconds=60.0))
    recorded: float = 60.0
    test_batches: int = 8
    backgrounds: int = 48
    objects: int = 96

    def steps(self, task: str) -> int:
        """Return the batches of a training."""
        return self.flow_steps if task == "flow" else self.reconstruction_steps

    def channels(self, task: str) -> int:
        """Return the channels of a network."""
        return self.flow_channels if task == "flow" else self.reconstruction_channels

    def is_of(self, row: dict[str, Any]) -> bool:
        """Return whether a line of results is of networks and trainings of this size."""
        task = row["task"]
        return (row["steps"], row["channels"]) == (self.steps(task), self.channels(task))


SMALL = Size(
    crop=(32, 32), windows=4, batch=2, flow_batch=2, flow_windows=2, reconstruction_channels=4,
    flow_channels=4,
    reconstruction_steps=4,
    flow_steps=4, samples=8, gan_steps=2, recorded=1.0, test_batches=1, backgrounds=3, objects=4,
    learning=LearnSettings(steps=2, windows=4, batch=2),
    learning_paper=LearnSettings(steps=1, windows=4, batch=1),
)  # fmt: skip
"""As little as shows that all parts work together."""


@dataclass
class Study:
    """What is to be done and where.

    Args:
        train: Folder of photographs for training and recordings.
        test: Folder of photographs for tests.
        out: Folder of all results.
        device: PyTorch's and dase's, of the process that works.
        size: How large it is.
        deadline: When the call ends, on `time.monotonic`.
    """

    train: str
    test: str
    out: Path
    device: str
    size: Size
    deadline: float
    _tests: dict[tuple[str, str], list[Batch]] = field(default_factory=dict)

    def stream(self, task: str, how: Training, images: str, seed: int, first: int = 0) -> dase.torch.Stream:
        """Return batches of a task."""
        size, flow = self.size, task == "flow"
        return dase.torch.Stream(
            images, how.sensor, batch=size.flow_batch if flow else size.batch, size=size.crop, view=VIEW,
            steps=size.flow_windows if flow else size.windows, window=1 / 30 if flow else 1 / 60,
            samples=2 * size.samples if flow else size.samples, randomise=how.randomise, augment=how.augment,
            device=self.device, seed=seed, regimes=FAST, backgrounds=size.backgrounds, objects=size.objects,
            first_batch=first, scene_batches=1 if flow else size.scene_batches,
        )  # fmt: skip

    def check_time(self) -> None:
        """Raise OutOfTime where the call is to end."""
        if time.monotonic() > self.deadline:
            raise OutOfTime

    def timed(self, batches: dase.torch.Stream) -> Iterator[Batch]:
        """Yield batches until the call ends."""
        for batch in batches:
            self.check_time()
            yield batch

    def learned_file(self, task: str, target: str) -> Path:
        """Return the file of what a task of LEARNED_BY has learned from a target's recording."""
        return self.out / "sensors" / f"{target}{FILES[task]}"

    def learned(self) -> set[tuple[str, str]]:
        """Return the tasks of LEARNED_BY that are done, each with its target."""
        tasks = itertools.product(LEARNED_BY.values(), TARGETS)
        return {(task, target) for task, target in tasks if self.learned_file(task, target).exists()}

    def learn(self, task: str, target: str) -> None:
        """Tune or fit to a target's recording, and leave a file."""
        path = self.learned_file(task, target)
        path.parent.mkdir(parents=True, exist_ok=True)
        recorded = record_target(TARGETS[target], self.train, self.size.recorded, self.device)
        if task == "gan":
            settings = GanTraining(steps=self.size.gan_steps, crop=self.size.crop)
            made = train_eventgan(
                recorded.events, recorded.frames, recorded.times, self.device, settings, self.check_time
            )
            print(f"eventgan {target}: scale {made['scale']}, {json.dumps(made['log'])}", flush=True)
            save_eventgan(path, made)
            return
        if task in LEARNED_WITH:
            self.learn_thresholds(task, target, recorded)
            return
        if task == "fit":
            text = dase.dump_sensor(fit_target(recorded, self.device))
        else:
            scenes, windows = (4, 6) if self.size is SMALL else (16, 60)
            base = tune_threshold(recorded.rate, self.train, self.device, scenes=scenes, windows=windows)
            found = {"target": target, "events": len(recorded.events), "rate": recorded.rate, "tuned": base}
            text = json.dumps(found, indent=1) + "\n"
        with replacing(path) as temporary:
            temporary.write_text(text, "utf-8")

    def learn_thresholds(self, task: str, target: str, recorded: TargetRecording) -> None:
        """Learn thresholds from a target's recording, and leave their sensor, its weights and the log."""
        folder = self.learned_file(task, target).parent
        before = LEARNED_AFTER.get(task)
        known = in_midst(dase.load_sensor(self.learned_file(before, target))) if before else None
        how = self.size.learning_paper if task == "train_paper" else self.size.learning
        begin = time.monotonic()
        with tempfile.TemporaryDirectory(dir=folder.parent) as work:
            run = Path(work) / folder.name
            made = train_on(
                recorded,
                run,
                LEARNED_WITH[task],
                self.device,
                known=known,
                settings=how,
                keep_going=self.check_time,
            )
            (made.parent / "result.pt").unlink()  # the weights again
            (made.parent / "best.pt").unlink(missing_ok=True)
            made.parent.replace(folder)
        print(f"{task} {target}: {time.monotonic() - begin:.0f} s after the recording", flush=True)

    def training(self, kind: str, target: str) -> Training:
        """Return what is trained on."""
        if kind in ("esim", "preset"):
            return Training(dase.load_sensor(CAMERA if kind == "preset" else kind))
        if kind == "broad":
            augment = dase.torch.Augment(flips=0.5, noise=0.05, hot=5e-4)
            return Training(plain_sensor(0.2), broad_thresholds, augment)
        if kind == "true":
            return Training(TARGETS[target])
        if kind == "tuned":
            base = json.loads(self.learned_file("tune", target).read_text("utf-8"))["tuned"]
            return Training(plain_sensor(base), tuned_thresholds(base))
        if kind == "eventgan":
            # its scenes are taken, and not its events
            return Training(plain_sensor(0.2), remake=EventGan(self.learned_file("gan", target)))
        sensor = dase.load_sensor(self.learned_file(LEARNED_BY[kind], target))
        return Training(in_midst(sensor) if kind == "fitted" else sensor)

    def folder(self, job: Job) -> Path:
        """Return where a training is kept."""
        return (
            self.out / "runs" / "-".join(filter(None, map(str, (job.task, job.kind, job.target, job.seed))))
        )

    def train_one(self, job: Job, stop_at: int | None = None) -> torch.nn.Module:
        """Return a trained network, gone on with where the last call stopped, up to `stop_at` steps."""
        task, kind, target, seed = job
        how, size, folder = self.training(kind, target), self.size, self.folder(job)

        def batches(first: int) -> Iterator[Batch]:
            for batch in self.timed(self.stream(task, how, self.train, seed, first)):
                yield batch if how.remake is None else replace(batch, inputs=how.remake(batch))

        options = {"seed": seed, "device": self.device, "stop_at": stop_at}
        if task == "flow":
            # 57 MB, which are flushed to the disk: every 100 steps that is a tenth of the time
            settings = dase.tasks.FlowTraining(
                steps=size.flow_steps, average=0.998, save_every=1000, **options
            )
            return dase.tasks.train_flow(
                dase.tasks.EvFlowNet(5, size.flow_channels), batches, folder, settings
            )
        steps = size.reconstruction_steps
        settings = dase.tasks.ReconstructionTraining(steps=steps, average=0.995, save_every=100, **options)
        network = dase.tasks.E2VidNet(5, size.reconstruction_channels)
        return dase.tasks.train_reconstruction(network, batches, folder, settings)

    def test_batches(self, task: str, target: str) -> list[Batch]:
        """Return the batches that all networks are tested with."""
        if (task, target) not in self._tests:
            stream = self.stream(task, Training(TARGETS[target]), self.test, 1_000_000)
            self._tests[task, target] = list(itertools.islice(stream, self.size.test_batches))
        return self._tests[task, target]

    @torch.no_grad()
    def test_one(self, network: torch.nn.Module, task: str, target: str) -> dict[str, float]:
        """Return what a network is worth on a target."""
        rows: list[dict[str, float]] = []
        for batch in self.test_batches(task, target):
            made, _ = network.sequence(batch.inputs, batch.reset)
            if task == "flow":
                truth = batch.flow.flatten(0, 1) / 30
                seen = batch.inputs.flatten(0, 1).abs().sum(1) > 0
                found = flow_errors(made.flatten(0, 1), truth, seen)
            else:
                half = len(made) // 2  # before, little is known
                a, b = made[half:].flatten(0, 1).clamp(0, 1), batch.frames[half:].flatten(0, 1)
                found = {
                    "l1": (a - b).abs().mean(), "ssim": structural_similarity(a, b).mean(),
                    # what is to be had without any event: one grey for everything
                    "l1_grey": (b - b.median()).abs().mean(),
                }  # fmt: skip
            rows.append({name: float(value) for name, value in found.items()})
        return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}

    def do(self, job: Job) -> list[dict[str, Any]]:
        """Train a network and return its line for each target it is tested on; or learn, and return none."""
        if job.task in LEARNED_BY.values():
            self.learn(job.task, job.target)
            return []
        begin = time.monotonic()
        network = self.train_one(job)
        seconds = round(time.monotonic() - begin, 1)
        where = torch.cuda.get_device_name() if self.device == "cuda" else self.device
        steps, channels = self.size.steps(job.task), self.size.channels(job.task)
        rows = []
        for tested in [job.target] if job.target else TARGETS:
            found = self.test_one(network, job.task, tested)
            rows.append(
                {"task": job.task, "kind": job.kind, "trained_for": job.target, "target": tested,
                 "seed": job.seed, **{name: round(value, 5) for name, value in found.items()}, "steps": steps,
                 "channels": channels, "seconds": seconds, "device": where, "torch": torch.__version__}
            )  # fmt: skip
        return rows


def unpack_photos(photos: Path, out: Path) -> tuple[str, str]:
    """Return folders of photographs for training and, every fifth, for tests."""
    if photos.is_file():
        with tarfile.open(photos) as archive:
            archive.extractall(out / "photos", filter="data")
        photos = out / "photos"
    folders = [out / "split" / name for name in ("train", "test")]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(sorted(one for one in photos.iterdir() if one.suffix in (".jpg", ".png"))):
        place = folders[number % 5 == 4] / path.name
        if not place.exists():
            place.write_bytes(path.read_bytes())
    return str(folders[0]), str(folders[1])


class Job(NamedTuple):
    """A training and its tests; or with a task of LEARNED_BY what is learned from a target's recording."""

    task: str
    kind: str
    target: str  # that is trained for; empty for kinds that know none
    seed: int


def study_plan(
    tasks: Sequence[str], kinds: Sequence[str], targets: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    """Return all jobs in the order in which they are wanted.

    What is quick and others wait for comes first, then seed by seed what waits for no fit; fits take up to
    an hour each, and they and what waits for them come last, again seed by seed.
    """

    def of_kinds(some: Sequence[str]) -> list[Job]:
        known = [kind for kind in some if kind not in OF_NO_TARGET]
        each = [(kind, "") for kind in some if kind in OF_NO_TARGET]
        each += [(kind, target) for target in targets for kind in known]
        return [
            Job(task, kind, target, seed) for seed in seeds for kind, target in each for task in tasks
            if task != "flow" or kind not in WITHOUT_FLOW
        ]  # fmt: skip

    def learning(some: Sequence[str]) -> list[Job]:
        return [
            Job(LEARNED_BY[kind], "", target, 0) for kind in some if kind in LEARNED_BY for target in targets
        ]

    after_fit = ["fit", *(task for task, before in LEARNED_AFTER.items() if before == "fit")]
    slow = [kind for kind in kinds if LEARNED_BY.get(kind) in after_fit]
    quick = [kind for kind in kinds if kind not in slow]
    return learning(quick) + of_kinds(quick) + learning(slow) + of_kinds(slow)


def next_job(
    waiting: Sequence[Job], learned: set[tuple[str, str]], left: float, longest: dict[str, float]
) -> Job | None:
    """Return the first job that can be done now.

    Args:
        waiting: Jobs in the order in which they are wanted.
        learned: Tasks of LEARNED_BY that are done, and their targets.
        left: Time left to this call [s].
        longest: Time that a job of a task took [s]; one that cannot come to its end is not begun.
    """
    for job in waiting:
        needs = LEARNED_BY.get(job.kind) if job.kind else LEARNED_AFTER.get(job.task)
        if (needs is None or (needs, job.target) in learned) and longest.get(job.task, 0.0) < left:
            return job
    return None


_study: Study | None = None
"""Of a process that does jobs: what it has tested on stays in its memory."""


def begin_process(study: Study, device: str) -> None:
    """Prepare a process that does jobs on one device."""
    global _study
    torch.set_num_threads(1)
    _study = study
    study.device = device.partition(":")[0]


@contextmanager
def alone_visible(device: str) -> Iterator[None]:
    """Let processes that start meanwhile see one GPU alone, before anything in them can ask for CUDA."""
    before, number = os.environ.get("CUDA_VISIBLE_DEVICES"), device.partition(":")[2]
    if number:
        os.environ["CUDA_VISIBLE_DEVICES"] = number
    try:
        yield
    finally:
        if before is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = before
        else:
            os.environ.pop("CUDA_VISIBLE_DEVICES", None)


def do_job(job: Job) -> list[dict[str, Any]] | None:
    """Return lines of results, none for what is learned; None where the time was over."""
    assert _study is not None
    try:
        return _study.do(job)
    except OutOfTime:
        return None


def run_jobs(study: Study, plan: Sequence[Job], devices: Sequence[str], jobs: int) -> int:
    """Do jobs in processes of their own, append lines to `results.jsonl`; return how many failed."""
    context = multiprocessing.get_context("spawn")
    pools = {
        device: ProcessPoolExecutor(jobs, context, initializer=begin_process, initargs=(study, device))
        for device in devices
    }
    waiting, failed = list(plan), 0
    running: dict[Future[Any], tuple[Job, str, float]] = {}
    longest: dict[str, float] = {}
    learned = study.learned()
    while True:
        for place in range(jobs * len(devices)):
            device = devices[place % len(devices)]
            left = study.deadline - time.monotonic()
            job = next_job(waiting, learned, left, longest)
            if job is None or left < 0:
                break
            if sum(where == device for _, where, _ in running.values()) < jobs:
                waiting.remove(job)
                with alone_visible(device):
                    future = pools[device].submit(do_job, job)
                running[future] = job, device, time.monotonic()
        if not running:
            break
        for one in wait(running, return_when=FIRST_COMPLETED).done:
            job, _, begin = running.pop(one)
            try:
                rows = one.result()
            except Exception:
                failed += 1
                print(job, traceback.format_exc(), file=sys.stderr, flush=True)
                continue
            if rows is None:
                continue
            seconds = time.monotonic() - begin
            longest[job.task] = max(longest.get(job.task, 0.0), seconds)
            if not job.kind:
                learned.add((job.task, job.target))
            print(f"{seconds:6.1f} s {' '.join(map(str, job))}", flush=True)
            # all lines of a network together, so that none is left out where a call is ended
            with (study.out / "results.jsonl").open("a") as file:
                file.write("".join(json.dumps(row) + "\n" for row in rows))
    for pool in pools.values():
        pool.shutdown()
    if waiting:
        print(f"{len(waiting)} jobs are left; the same call goes on", flush=True)
    return failed


def main() -> None:
    """Run what is left to do."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--photos", type=Path, required=True)
    ask.add_argument("--out", type=Path, required=True)
    ask.add_argument("--devices", default="cuda:0", help="`cpu`, or GPUs: cuda:0,cuda:1")
    ask.add_argument("--jobs", type=int, default=1, help="trainings side by side on each device")
    ask.add_argument("--minutes", type=float, default=1e6)
    ask.add_argument("--tasks", default="reconstruction,flow")
    ask.add_argument("--kinds", default=",".join(KINDS))
    ask.add_argument("--targets", default=",".join(TARGETS))
    ask.add_argument("--seeds", default="0,1,2")
    ask.add_argument("--small", action="store_true", help="A minute on two cores: do all parts work?")
    args = ask.parse_args()
    deadline = time.monotonic() + 60 * args.minutes
    args.out.mkdir(parents=True, exist_ok=True)
    train, test = unpack_photos(args.photos, args.out)
    study = Study(train, test, args.out, "cpu", SMALL if args.small else Size(), deadline)
    log = args.out / "results.jsonl"
    lines = log.read_text().splitlines() if log.exists() else []
    rows = [row for row in map(json.loads, lines) if study.size.is_of(row)]
    done = {Job(row["task"], row["kind"], row["trained_for"], row["seed"]) for row in rows}
    done |= {Job(task, "", target, 0) for task, target in study.learned()}
    asked = (one.split(",") for one in (args.tasks, args.kinds, args.targets))
    seeds = [int(seed) for seed in args.seeds.split(",")]
    plan = [job for job in study_plan(*asked, seeds) if job not in done]
    if run_jobs(study, plan, args.devices.split(","), args.jobs):
        sys.exit(1)


if __name__ == "__main__":
    main()
