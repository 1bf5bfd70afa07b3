"""A first look: pictures in, events out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomlkit

from dase import io
from dase.datasets import generate
from dase.errors import InputError
from dase.figures import event_images
from dase.simulation.sensor_file import dump_sensor, load_sensor

PICTURE_MARK = "dase demo"
"""What the picture says it was made with, so that a later demo knows it for its own."""


def run_demo(out: Path, *, device: str = "cpu", say: Callable[[str], object] = print) -> tuple[Path, Path]:
    """Simulate one second of photographs before a DAVIS346 and draw it.

    Args:
        out: Folder; the files of an earlier demo in it are made anew, and nothing else is touched.
        device: `cpu` or `cuda`.
        say: Takes lines meant for the user.

    Returns:
        The picture and the event file.

    Raises:
        InputError: A file that the demo would write exists, and is not of an earlier demo.
    """
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
    events = job.path(out, 0)
    picture = events.with_suffix(".png")
    _remove_earlier_demo(job, out / generate.RECORD_FILE, events, picture)
    say("Simulating 1 s of a DAVIS346 before moving photographs (the first run compiles the kernels) ...")
    report = generate.generate_dataset(job, out)
    say(f"{report.events:,} events from {report.samples} time samples in {report.seconds:.1f} s")
    figure = event_images.draw_sequence(
        io.read(events), title="dase demo: davis346 before moving photographs"
    )
    with io.replacing(picture) as temporary:
        figure.savefig(temporary, metadata={"Software": PICTURE_MARK})
    return picture, events


def _remove_earlier_demo(job: generate.DatasetJob, record: Path, events: Path, picture: Path) -> None:
    """Remove the three files of an earlier demo, once it is sure of each that a demo made it."""
    checks: dict[Path, Callable[[], bool]] = {
        record: lambda: _is_job_of_demo(job, record.read_text("utf-8")),
        events: lambda: _is_job_of_demo(job, io.read(events).configuration),
        picture: lambda: _software_of(picture) == PICTURE_MARK,
    }
    earlier = [path for path in checks if path.exists()]
    for path in earlier:
        try:
            own = checks[path]()
        except (ValueError, OSError):  # not UTF-8, not TOML, a damaged file: nothing that says it is ours
            own = False
        if not own:
            raise InputError(f"{path} is not of an earlier demo: choose another folder", argument="out")
    for path in earlier:
        path.unlink()


def _is_job_of_demo(job: generate.DatasetJob, text: str | None) -> bool:
    """Whether a record is that of a demo, of whatever version and device."""

    def identity(text: str) -> dict[str, Any]:
        table = dict(tomlkit.parse(text).unwrap())
        sensor = table.pop("sensor", {})
        free = ("dase", "backend", "sequence")
        return {name: value for name, value in table.items() if name not in free} | {
            "sensor": sensor.get("name") if isinstance(sensor, dict) else None
        }

    return text is not None and identity(text) == identity(job.text())


def _software_of(picture: Path) -> str:
    """Return which program a PNG says it was made with."""
    from PIL import Image  # only where a folder is there already

    with Image.open(picture) as opened:
        return str(opened.info.get("Software"))
