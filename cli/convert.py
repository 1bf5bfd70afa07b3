"""From one event-camera format to another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import check_output, reading_options

if TYPE_CHECKING:
    from dase.io.source import ReadOptions


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path), callback=check_output)
@click.option("--format", "format_", help="Format of TARGET.  [default: by its suffix]")
@click.option("--events-only", is_flag=True, help="Leave frames behind.")
@reading_options
def convert_command(
    source: Path, target: Path, format_: str | None, events_only: bool, reading: ReadOptions
) -> None:
    """Convert the events of SOURCE, any file dase reads, to TARGET.

    Formats are known by content, then by suffix. Frames go along where both formats have them. Files stream
    through, whatever their size; only what goes into a .npz waits in memory. A part of the time or of the
    sensor keeps the clock of SOURCE; its columns and rows begin at 0.
    """
    from tqdm import tqdm

    from dase import io

    notes: list[str] = []
    with tqdm(unit=" events", unit_scale=True, delay=1.0, leave=False, disable=None) as bar:
        total = io.convert(
            source,
            target,
            format=format_,
            with_frames=not events_only,
            notes=notes,
            progress=bar.update,
            **reading,
        )
    for note in notes:
        click.echo(f"{getattr(note, 'kind', 'note') + ':':<10}{note}")
    click.echo(f"{total:,} events written to {target}")
