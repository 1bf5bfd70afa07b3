"""Learn a camera from its recordings."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dase.cli.options import device_or_backend_option, parse_region, parse_size

if TYPE_CHECKING:
    from collections.abc import Callable


@click.command()
@click.argument("targets", nargs=-1, required=True)
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Folder of the run.")
@click.option(
    "--images",
    help="What the simulator's scenes are made of: frames (of the recordings), a folder, "
    "coco:ANNOTATIONS,FOLDER or builtin.  [default: frames; builtin for a sensor file]",
)
@click.option("--preset", default="default", show_default=True, help="default, tiny (for a CPU) or paper.")
@click.option("--objective", default="", help="moments or wgan.  [default: the preset's]")
@click.option(
    "--sensor", default="", metavar="TEXT", help="Preset or sensor file of what is known of the camera, as "
    "`dase fit` writes it: thresholds are learned on top of its other effects."
)  # fmt: skip
@click.option("--steps", default=0, help="Generator steps.  [default: the preset's]")
@click.option("--minutes", type=float, help="Time to take, reading included, instead of a number of steps.")
@click.option("--samples", default=0, help="Time samples of scenes in a window.  [default: the preset's]")
@click.option("--window", default=0.05, show_default=True, help="Time in which events are counted [s].")
@click.option("--size", callback=parse_size, metavar="WxH", help="Of scenes, if the target is a sensor file.")
@click.option("--sequences", default=300, show_default=True, help="Simulated by a sensor file as the target.")
@click.option("--pattern", is_flag=True, help="Learn an offset for every column and row of the sensor.")
@click.option("--from", "begin", type=float, metavar="SECONDS", help="Learn from this time on.")
@click.option("--to", "end", type=float, metavar="SECONDS", help="Learn up to this time.")
@click.option("--region", callback=parse_region, metavar="X,Y,W,H", help="Learn from these pixels alone.")
@click.option("--seed", default=0, show_default=True, help="The same seed learns the same on one device.")
@device_or_backend_option
@click.option("--resume", is_flag=True, help="Go on where an interrupted run stopped.")
@click.option("--tensorboard", is_flag=True, help="Write the log for TensorBoard, too.")
def train_command(
    targets: tuple[str, ...],
    output: Path,
    images: str | None,
    preset: str,
    objective: Any,
    sensor: str,
    steps: int,
    minutes: float | None,
    samples: int,
    window: float,
    size: tuple[int, int] | None,
    sequences: int,
    pattern: bool,
    begin: float | None,
    end: float | None,
    region: tuple[int, int, int, int] | None,
    seed: int,
    device: str,
    resume: bool,
    tensorboard: bool,
) -> None:
    """Learn the thresholds of a camera from TARGETS, its recordings with frames.

    Nothing has to be paired or calibrated. The folder gets sensor.toml, which `dase synth --sensor`,
    `dase compare` and `dase diagnose` take, its weights, a log and checkpoints; `dase show FOLDER` draws the
    learned maps. What is learned so far is there from the first minute on. A sensor file as TARGETS is
    simulated first: a test with known thresholds.

    On several GPUs: torchrun --nproc-per-node 4 --no-python dase train ... --device cuda
    """
    from dase.errors import InputError, how_to_install
    from dase.files.folder_lock import locking_folder

    try:
        from dase.learning import distributed
        from dase.learning import job as learning_job
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise InputError(f"learning needs {error.name}: {how_to_install('learn')}") from None
    job = learning_job.Job(
        targets=targets, images=images or "", preset=preset, objective=objective, steps=steps, window=window,
        size=size, sequences=sequences, pattern=pattern, seed=seed, backend=device,
        begin=begin, end=end, region=region, sensor=sensor,
        samples=samples,
    )  # fmt: skip
    device = distributed.join_processes(device)
    first = distributed.process_rank() == 0
    with locking_folder(output) if first else nullcontext():
        _train_job(job, output, device, minutes=minutes, resume=resume, tensorboard=tensorboard, first=first)
    distributed.leave_processes()


def _train_job(
    job: Any,
    output: Path,
    device: str,
    *,
    minutes: float | None,
    resume: bool,
    tensorboard: bool,
    first: bool,
) -> None:
    """Learn, in a folder that no other run writes to."""
    began = time.monotonic()
    from dase.learning import job as learning_job
    from dase.learning.run import RunFile, RunSchedule, train_in_folder

    if first:
        learning_job.record_job(job, output, resume=resume)
    with _OpeningBar(silent=not first) as opened:
        training = learning_job.open_training(replace(job, backend=device), progress=opened)
    if first and training.physics is not None and training.physics.left_out:
        click.echo(f"left out while learning: {', '.join(training.physics.left_out)}")
    looks = 100 if device.startswith("cuda") else 25
    schedule = RunSchedule(
        log_every=10 if job.preset == "tiny" else looks,
        seconds=None if minutes is None else max(60 * minutes - (time.monotonic() - began), 1.0),
    )
    with _LiveLine(training, output if tensorboard and first else None, silent=not first) as look:
        # killed before its first checkpoint, a run begins anew
        resume = resume and (output / RunFile.CHECKPOINT).is_file()
        last = train_in_folder(
            training,
            output,
            schedule=schedule,
            resume=resume,
            on_row=look,
            on_result=lambda row: _write_sensor(job, output, training, row),
        )
    if first:
        _write_results(job, output, training, last)


def _write_results(job: Any, output: Path, training: Any, last: dict[str, float]) -> None:
    """Write the sensor and say what was learned."""
    from dase.learning import job as learning_job

    path = _write_sensor(job, output, training, last)
    learning_job.write_examples(output, training)
    for line in summary_of_run(last):
        click.echo(line)
    click.echo(f"{path}: try dase synth --sensor {path}, or look at it: dase show {output}")


def _write_sensor(job: Any, output: Path, training: Any, row: dict[str, float]) -> Path:
    """Write what has been learned so far as a sensor."""
    from dase.learning import job as learning_job

    width, height = training.scenery.scene_settings.width, training.scenery.scene_settings.height
    recorded = None if job.targets_sensor else (width, height)
    path: Path = learning_job.write_sensor(
        output, training.mean, mu=row["mu"], name=output.name or "learned", size=recorded,
        known=None if training.physics is None else training.physics.given,
    )  # fmt: skip
    return path


def summary_of_run(row: dict[str, float]) -> list[str]:
    """Return what was learned, in a few lines."""
    lines = [
        f"thresholds {row['mu']:.3f} ± {row['sigma']:.3f} (mean over pixels; the mean varies by "
        f"{row['mu_spread']:.3f} from pixel to pixel), ON/OFF {row['ratio']:.2f}"
    ]
    if "kl" in row:
        lines.append(
            f"from the truth: KL {row['kl']:.4f}, |Δμ| {row['mu_diff']:.4f}, |Δσ| {row['sigma_diff']:.4f}"
        )
    return lines


class _OpeningBar:
    """A progress bar for what is opened."""

    def __init__(self, *, silent: bool):
        self.silent = silent

    def __enter__(self) -> Callable[[str, int, int], None]:
        from tqdm import tqdm

        self.bar: Any = tqdm(delay=0.5, leave=False, disable=self.silent or None)
        return self._tell

    def _tell(self, what: str, done: int, total: int) -> None:
        self.bar.set_description(what, refresh=False)
        self.bar.total = total
        self.bar.n = done
        self.bar.refresh()

    def __exit__(self, *error: object) -> None:
        self.bar.close()


class _LiveLine:
    """The live line of a run, and TensorBoard's log."""

    def __init__(self, training: Any, folder: Path | None, *, silent: bool):
        self.training, self.folder, self.writer, self.silent = training, folder, None, silent

    def __enter__(self) -> Callable[[dict[str, float]], None]:
        from tqdm import tqdm

        if self.folder is not None:
            from dase.errors import InputError

            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError:
                raise InputError("--tensorboard needs tensorboard: pip install tensorboard") from None
            self.writer = SummaryWriter(str(self.folder))
        self.bar: Any = tqdm(total=self.training.recipe.steps, unit=" steps", disable=self.silent or None)
        return self._look

    def _look(self, row: dict[str, float]) -> None:
        self.bar.total = self.training.recipe.steps
        self.bar.n = max(int(row["step"]), 0)
        shown = {"distance": "distance", "kl": "KL", "mu_diff": "|Δμ|", "sigma_diff": "|Δσ|", "mu": "μ"}
        self.bar.set_postfix_str(", ".join(f"{t} {row[n]:.3g}" for n, t in shown.items() if n in row))
        if self.writer is not None:
            for name, value in row.items():
                self.writer.add_scalar(name, value, int(row["step"]))

    def __exit__(self, *error: object) -> None:
        self.bar.close()
        if self.writer is not None:
            self.writer.close()
