"""From one event-camera format to another."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--format", "format_", help="Format of TARGET.  [default: by its suffix]")
@click.option("--events-only", is_flag=True, help="Stream the events through, in bounded memory.")
def command(source: Path, target: Path, format_: str | None, events_only: bool) -> None:
    """Convert the events of SOURCE, any file dase reads, to TARGET.

    Formats are known by content, then by suffix. Frames go along where both formats have them; the file is
    then held in memory.
    """
    from dase import io

    notes: list[str] = []
    total = io.convert(source, target, format=format_, with_frames=not events_only, notes=notes)
    for note in notes:
        click.echo(f"note: {note}")
    click.echo(f"{total:,} events written to {target}")
