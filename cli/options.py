"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path

import click

effects_option = click.option(
    "--effects",
    type=click.Path(path_type=Path),
    multiple=True,
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
