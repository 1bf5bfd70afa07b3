"""Options that several commands share, and their values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click


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


effects_option = click.option(
    "--effects",
    type=click.Path(path_type=Path),
    multiple=True,
    is_eager=True,  # options that answer at once may need them
    metavar="FILE",
    help="Python file with effects of your own (`dase effects new`); may be given again.",
)
"""`--effects FILE`: a command gets a tuple of paths, for `dase.effect_files.known_effects`."""

sensor_output = click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Sensor file to write; may be SENSOR itself.  [default: print it]",
)
"""`-o FILE` of commands that write a sensor file; a command gets a path or None."""


def check_suffix(*suffixes: str) -> Callable[[click.Context, click.Parameter, Path | None], Path | None]:
    """Return a callback that refuses another suffix, and a folder that is not there, before any work."""

    def check(ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
        if value is not None and value.suffix.lower() not in suffixes:
            raise click.BadParameter(f"'{value}' must end with {' or '.join(suffixes)}")
        if value is not None and not value.parent.is_dir():
            raise click.BadParameter(f"the folder '{value.parent}' does not exist")
        return value

    return check
