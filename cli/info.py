"""What is in a file."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
def command(file: Path) -> None:
    """Say what is in FILE: format, sensor, rates, intervals, frames, and what looked odd."""
    from dase import io, show

    notes: list[str] = []
    name = io.find(file).name
    sequence = io.read(file, notes=notes)
    click.echo(f"{'format':<18}{name}")
    for key, value in show.table(show.statistics(sequence)):
        click.echo(f"{key:<18}{value}")
    for note in notes:
        click.echo(f"note: {note}")
