"""Options that several commands share, and their values."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from dase.fitting.measurement import Measurement


@contextmanager
def importing() -> Iterator[None]:
    """Import what a command needs without collections of garbage, then and later on.

    They would go through the half a million objects of Warp and others again and again, and find nothing.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        if enabled:
            gc.enable()


def parse_size(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Return (columns, rows) of a text such as 640x480."""
    if value is None:
        return None
    try:
        width, height = (int(part) for part in value.lower().split("x"))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not of the form WxH, such as 640x480") from None
    if width < 1 or height < 1 or max(width, height) > 16384:
        raise click.BadParameter(f"{value!r} must lie between 1x1 and 16384x16384")
    return width, height


def parse_region(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[int, int, int, int] | None:
    """Return (x, y, columns, rows) of a text such as 0,0,320,240."""
    if value is None:
        return None
    try:
        x, y, width, height = (int(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not of the form x,y,w,h, such as 0,0,320,240") from None
    return x, y, width, height


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add what a user may say about a file that is read; a command gets it as the mapping `reading`.

    The mapping is the keywords of `dase.io.read`, see `dase.io.ReadOptions`.
    """

    @wraps(command)
    def gathered(*args: Any, **given: Any) -> Any:
        from dase.io.source import Part

        begin, end, region = (given.pop(name) for name in ("begin", "end", "region"))
        part = None
        if (begin, end, region) != (None, None, None):
            span = -math.inf if begin is None else begin, math.inf if end is None else end
            part = Part(*span, region)
        reading = {name: given.pop(name) for name in ("size", "chip", "columns")} | {"part": part}
        return command(*args, reading=reading, **given)

    options = (
        click.option("--size", callback=parse_size, metavar="WxH", help="Columns x rows, else the file's."),
        click.option("--from", "begin", type=float, metavar="SECONDS", help="Read from this time on."),
        click.option("--to", "end", type=float, metavar="SECONDS", help="Read up to this time."),
        click.option("--region", callback=parse_region, metavar="X,Y,W,H", help="Read these pixels."),
        click.option("--chip", metavar="NAME", help="Chip of an AEDAT 1 or 2 that names none, as davis240."),
        click.option("--columns", metavar="ORDER", help="Order of columns without names, as txyp."),
    )  # fmt: skip
    for option in reversed(options):
        gathered = option(gathered)
    return gathered


effects_option = click.option(
    "--effects",
    type=click.Path(path_type=Path),
    multiple=True,
    is_eager=True,  # options that answer at once may need them
    metavar="FILE",
    help="Python file with effects of your own (`dase effects new`): its code is run, so only files that you "
    "trust. May be given again.",
)
"""`--effects FILE`: a command gets a tuple of paths, for `dase.simulation.user_effects.known_effects`."""

bias_option = click.option(
    "--bias",
    "biases",
    multiple=True,
    metavar="NAME=BEFORE:AFTER",
    help="Another bias of a DAVIS346 than it was fitted with, as ONBn=5/255:6/200 (`dase bias`). "
    "May be given again.",
)
"""`--bias NAME=BEFORE:AFTER`: a command gets a tuple of texts, for `dase.simulation.biases.parse_biases`."""

scene_option = click.option(
    "--scene",
    default="frames",
    show_default=True,
    help="What the camera saw: its own frames, video FILE (a clip, a folder, an npz with frames), or static.",
)
"""`--scene NAME` of commands that compare with a recording, for `open_recorded`."""

stimulus_option = click.option(
    "--stimulus",
    type=click.Path(path_type=Path),
    metavar="JSON",
    help="What the camera saw: the video of `dase stimulus`, of which this JSON tells; found in the events.",
)
"""`--stimulus JSON` of commands that compare with a recording, for `open_recorded`."""

fps_option = click.option(
    "--fps", type=float, help="Frames per second of the clip of --scene.  [default: what the file says]"
)
"""`--fps N` of commands that compare with a recording, for `open_recorded`."""


def check_output(ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a file that could not be written in the end, before any work."""
    from dase.errors import InputError
    from dase.files.atomic_file import refuse_unwritable

    if value is not None:
        try:
            refuse_unwritable(value)
        except InputError as error:
            raise click.BadParameter(str(error)) from None
    return value


sensor_output = click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_output,
    help="Sensor file to write; may be SENSOR itself.  [default: print it]",
)
"""`-o FILE` of commands that write a sensor file; a command gets a path or None."""


json_option = click.option(
    "--json",
    "json_",
    type=click.Path(path_type=Path, allow_dash=True),
    callback=check_output,
    help="Write what is found as JSON to this file; - prints that and nothing else.",
)
"""`--json FILE` of commands that say something; a command gets a path or None, for `write_json`."""


class _FirstSpelling(click.Option):
    """An option whose help shows its first spelling only; the others are for those who know them."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the line of the help, with one name."""
        spellings, self.opts = self.opts, self.opts[:1]
        try:
            return super().get_help_record(ctx)
        finally:
            self.opts = spellings


device_option = click.option("--device", default="cpu", show_default=True, help="cpu or cuda.")
"""`--device NAME`, where Warp kernels run; a command gets the name."""

device_or_backend_option = click.option(
    "--device",
    "--backend",  # what these commands called it at first
    "device",
    cls=_FirstSpelling,
    default="cpu",
    show_default=True,
    help="cpu or cuda.",
)
"""`--device NAME` of commands that also take it as `--backend`."""


def check_suffix(*suffixes: str) -> Callable[[click.Context, click.Parameter, Path | None], Path | None]:
    """Return a callback that refuses another suffix, and a folder that is not there, before any work."""

    def check(ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
        if value is not None and value.suffix.lower() not in suffixes:
            raise click.BadParameter(f"'{value}' must end with {' or '.join(suffixes)}")
        return check_output(ctx, parameter, value)

    return check


def part_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the part of a recording that is compared; a command gets it as the mapping `compared`.

    The mapping is the keywords of `dase.fitting.measurement.Measurement.part`.
    """

    @wraps(command)
    def gathered(*args: Any, **given: Any) -> Any:
        return command(
            *args, compared={name: given.pop(name) for name in ("begin", "end", "region")}, **given
        )

    options = (
        click.option("--from", "begin", type=float, metavar="SECONDS", help="Compare from this time on."),
        click.option("--to", "end", type=float, metavar="SECONDS", help="Compare up to this time."),
        click.option(
            "--region", callback=parse_region, metavar="X,Y,W,H", help="Compare W x H pixels from X,Y only."
        ),
    )
    for option in reversed(options):
        gathered = option(gathered)
    return gathered


def refuse_beside(option: str, *names: str) -> None:
    """Raise UsageError where the user gave one of these parameters, which do nothing beside an option."""
    context = click.get_current_context()
    for parameter in context.command.params:
        given = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and given is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{parameter.opts[0]} has no meaning beside {option}")


def open_recorded(
    recording: Path,
    scene: str,
    file: Path | None = None,
    fps: float | None = None,
    part: dict[str, Any] | None = None,
    stimulus: Path | None = None,
) -> Measurement:
    """Open a part of a recording and its scene, with the frame rate of its clip where the user gives it."""
    if stimulus is not None:
        refuse_beside("--stimulus", "scene", "file", "fps")
        from dase.errors import InputError
        from dase.fitting.measurement import open_measurement

        if stimulus.suffix.lower() != ".json":
            raise InputError(
                f"--stimulus takes the JSON that lies beside the video, got {stimulus}", argument="stimulus"
            )
        return open_measurement(recording, stimulus).part(**(part or {}))
    return _open_whole(recording, scene, file, fps).part(**(part or {}))


def _open_whole(recording: Path, scene: str, file: Path | None, fps: float | None) -> Measurement:
    from dase.errors import InputError
    from dase.fitting.measurement import open_measurement
    from dase.scenes.video import open_video

    clip = file if scene == "video" else Path(scene)
    if clip is None:
        raise InputError("--scene video needs the file: --scene video FILE")
    if scene in ("frames", "static"):
        if file is not None:
            raise InputError(f"--scene {scene} takes no file, got {file}")
        if fps is not None:
            raise click.UsageError("--fps goes with --scene video FILE")
        return open_measurement(recording, scene)
    return open_measurement(recording, clip if fps is None else open_video(clip, fps=fps))
