"""A first look: pictures in, events out."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from dase import io
from dase.datasets import generate
from dase.figures import event_images
from dase.simulation.sensor_file import dump_sensor, load_sensor


def run_demo(out: Path, *, device: str = "cpu", say: Callable[[str], object] = print) -> tuple[Path, Path]:
    """Simulate one second of photographs before a DAVIS346 and draw it.

    Args:
        out: Folder, replaced if it holds an earlier demo.
        device: `cpu` or `cuda`.
        say: Takes lines meant for the user.

    Returns:
        The picture and the event file.
    """
    if (out / generate.RECORD_FILE).exists():
        shutil.rmtree(out)
    sensor = load_sensor("davis346")
    assert sensor.size is not None
    job = generate.DatasetJob(
        images="builtin",
        sensor=dump_sensor(sensor),
        sequences=1,
        width=sensor.size[0],
        height=sensor.size[1],
        duration=1.0,
        regime="medium",
        seed=1,
        backend=device,
    )
    say("Simulating 1 s of a DAVIS346 before moving photographs (the first run compiles the kernels) ...")
    report = generate.generate_dataset(job, out)
    say(f"{report.events:,} events from {report.samples} time samples in {report.seconds:.1f} s")
    events = job.path(out, 0)
    picture = events.with_suffix(".png")
    figure = event_images.draw_sequence(
        io.read(events), title="dase demo: davis346 before moving photographs"
    )
    with io.replacing(picture) as temporary:
        figure.savefig(temporary)
    return picture, events
