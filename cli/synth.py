"""Event sequences from pictures or a video."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import (
    bias_option,
    device_or_backend_option,
    effects_option,
    importing,
    parse_size,
    refuse_beside,
)
from dase.datasets.worker_start import start_importing

if TYPE_CHECKING:
    from dase.datasets.generate import WorkReport


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--images", default="builtin", show_default=True, help="Folder, coco:ANNOTATIONS,FOLDER or builtin."
)
@click.option("--sensor", default="davis346", show_default=True, help="Preset or TOML file.")
@bias_option
@effects_option
@click.option("--sequences", default=10, show_default=True, help="How many sequences.")
@click.option(
    "--size",
    callback=parse_size,
    metavar="WxH",
    help="Columns x rows.  [default: the sensor's, else 346x260 or the video's]",
)
@click.option("--duration", default=1.0, show_default=True, help="Of each sequence [s].")
@click.option(
    "--regime",
    default="mixed",
    show_default=True,
    help="How things move: background, slow, medium, fast, variety or mixed.",
)
@click.option(
    "--seed", default=0, show_default=True, help="The same seed gives the same bytes, whatever --jobs is."
)
@click.option("--jobs", type=int, help="Processes that share the work.  [default: one per core]")
@click.option(
    "--format",
    "format_",
    type=click.Choice(["h5", "npz"]),
    default="h5",
    show_default=True,
    help="h5 is the layout of S2R.",
)
@click.option(
    "--frame-rate", default=60.0, show_default=True, help="Of the frames and the flow that are stored [Hz]."
)
@click.option(
    "--exposure",
    default=0.0,
    show_default=True,
    help="Of each stored frame [s], which blurs it; the sensor's effect `exposure` is then in step with it.",
)
@click.option(
    "--stereo",
    type=float,
    default=0.0,
    show_default=True,
    help="Baseline of a pair of cameras [m]: files of both, and disparity and depth beside each.",
)
@click.option("--focal", default=0.0, help="Of the pair [px].  [default: the width]")
@click.option(
    "--depths", type=(float, float), default=(1.0, 10.0), show_default=True, help="Nearest, farthest [m]."
)
@click.option(
    "--travel",
    default=0.5,
    show_default=True,
    help="Pixels that things move between two samples of the light: less is more exact, and takes longer.",
)
@click.option("--labels", is_flag=True, help="Mark events as signal, leak, shot noise or hot pixel.")
@device_or_backend_option
@click.option(
    "--video",
    type=click.Path(path_type=Path),
    help="Simulate this instead: a video, a folder of frames, or a recording with frames.",
)
@click.option("--fps", type=float, help="Frames per second of --video.  [default: what the file says]")
@click.option(
    "--gamma",
    type=float,
    help="Light is value ** gamma in --video.  [default: what the file says, else 2.2; 1 for a recording]",
)
@click.option(
    "--between",
    type=click.Choice(["auto", "motion", "lines"]),
    default="auto",
    show_default=True,
    help="Between the frames of --video: follow their motion, or straight lines. auto: motion if over 2 ms.",
)
@click.option("--resume", is_flag=True, help="Finish what an interrupted run left in OUT.")
def synth_command(
    out: Path,
    images: str,
    sensor: str,
    biases: tuple[str, ...],
    effects: tuple[Path, ...],
    sequences: int,
    size: tuple[int, int] | None,
    duration: float,
    regime: str,
    seed: int,
    jobs: int | None,
    format_: str,
    frame_rate: float,
    exposure: float,
    stereo: float,
    focal: float,
    depths: tuple[float, float],
    travel: float,
    labels: bool,
    device: str,
    video: Path | None,
    fps: float | None,
    gamma: float | None,
    between: str,
    resume: bool,
) -> None:
    """Simulate event sequences into the folder OUT.

    Pictures move over each other as in S2R's training data; each sequence is one file with events, frames,
    optical flow, the thresholds used and everything that made it. `dase show FILE` draws it.

    With --video, the events of your own high-speed video are written to the file OUT instead.
    """
    if video is not None:
        refuse_beside(
            "--video", "images", "sequences", "duration", "regime", "jobs", "format_", "resume", "stereo",
            "focal", "depths", "travel",
        )  # fmt: skip
        _synth_video(
            out, video, fps, sensor, biases, effects, size, seed, device, frame_rate, exposure, labels, gamma,
            between,
        )  # fmt: skip
        return
    given = {"--fps": fps is not None, "--gamma": gamma is not None, "--between": between != "auto"}
    for option in (name for name in given if given[name]):
        raise click.UsageError(f"{option} goes with --video")
    count = jobs if jobs is not None else (1 if device.startswith("cuda") else os.cpu_count() or 1)
    if count > 1 and sequences > 1:
        start_importing()  # beside the imports here
    with importing():
        from dase.datasets import generate
        from dase.simulation.biases import parse_biases, with_biases
        from dase.simulation.sensor_file import dump_sensor, load_sensor
        from dase.simulation.user_effects import known_effects

    chosen = with_biases(load_sensor(sensor, known_effects(effects)), *parse_biases(biases))
    chosen = replace(chosen, history=())
    width, height = size or chosen.size or (346, 260)
    job = generate.DatasetJob(
        images=images,
        sensor=dump_sensor(chosen),
        sequences=sequences,
        width=width,
        height=height,
        duration=duration,
        regime=regime,
        seed=seed,
        format=format_,
        backend=device,
        frame_rate=frame_rate,
        exposure=exposure,
        stereo=stereo,
        focal=focal,
        depths=depths,
        travel=travel,
        labels=labels,
        effects=tuple(map(str, effects)),
    )
    with _progress_bar(job.files, "sequences") as advance:
        report = generate.generate_dataset(
            job, out, jobs=count, resume=resume, progress=advance, say=lambda line: click.echo(line, err=True)
        )
    _print_summary(report)
    click.echo(f"Look at one: dase show {job.path(out, 0)}")


def _synth_video(
    out: Path,
    video: Path,
    fps: float | None,
    sensor: str,
    biases: tuple[str, ...],
    effects: tuple[Path, ...],
    size: tuple[int, int] | None,
    seed: int,
    device: str,
    frame_rate: float,
    exposure: float,
    labels: bool,
    gamma: float | None,
    between: str,
) -> None:
    """Simulate one video into the file `out`."""
    from dase.datasets import generate
    from dase.files.atomic_file import refuse_unwritable
    from dase.io import find_writable_format
    from dase.scenes.video import open_video
    from dase.simulation.biases import parse_biases, with_biases
    from dase.simulation.sensor_file import load_sensor
    from dase.simulation.sensor_run import sample_times
    from dase.simulation.user_effects import known_effects

    refuse_unwritable(out)
    find_writable_format(out)
    model = with_biases(load_sensor(sensor, known_effects(effects)), *parse_biases(biases))
    notes: list[str] = []
    scene = open_video(
        video, fps=fps, size=size or model.size, gamma=gamma, between=between, colour=model.sees_colour(),
        notes=notes,
    )  # fmt: skip
    for note in notes:
        click.echo(note)
    with _progress_bar(len(sample_times(scene, model)), "frames") as advance:
        report = generate.record_scene(
            scene,
            model,
            out,
            frame_rate=frame_rate,
            exposure=exposure,
            seed=seed,
            device=device,
            labels=labels,
            progress=advance,
        )
    _print_summary(report)
    click.echo(f"Look at it: dase show {out}")


@contextmanager
def _progress_bar(total: int, unit: str) -> Iterator[Callable[[WorkReport], None]]:
    """Show a progress bar on a terminal; give the function that a finished piece of work is reported to."""
    from tqdm import tqdm

    with tqdm(total=total, unit=f" {unit}", disable=None) as bar:
        events = 0
        begin = time.perf_counter()

        def advance(done: WorkReport) -> None:
            nonlocal events
            events += done.events
            rate = events / (time.perf_counter() - begin)
            bar.set_postfix_str(f"{events:,} events, {rate / 1e6:.2f} Mevents/s", refresh=False)
            bar.update(done.sequences if unit == "sequences" else done.samples)

        yield advance


def _print_summary(report: WorkReport) -> None:
    seconds = max(report.seconds, 1e-9)
    click.echo(
        f"{report.events:,} events in {report.sequences} sequence{'s' * (report.sequences != 1)}, "
        f"{report.seconds:.1f} s: {report.events / seconds / 1e6:.2f} Mevents/s, "
        f"{report.pixels / seconds / 1e9:.3f} Gsample/s"
    )
    if report.sequences:
        click.echo(
            f"{report.samples:,} time samples rendered, {report.samples / report.sequences:.0f} per sequence"
        )
