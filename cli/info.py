"""What is in a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import json_option, reading_options
from dase.cli.output import STANDARD_OUTPUT, write_json

if TYPE_CHECKING:
    from dase.io.source import ReadOptions


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--signatures",
    is_flag=True,
    help="Also say which effects FILE shows by itself, without a scene or a model.",
)
@json_option
@reading_options
def info_command(file: Path, signatures: bool, json_: Path | None, reading: ReadOptions) -> None:
    """Say what is in FILE: rates, intervals, hot pixels, frames, what was repaired and what looks odd.

    FILE streams through, whatever its size. Isolated events are counted on a sample; all else on all events.
    """
    from tqdm import tqdm

    from dase import io
    from dase.recordings import summary
    from dase.recordings.anomalies import find_anomalies
    from dase.recordings.statistics import survey_file

    notes: list[str] = []
    shown = None
    name = io.find_format(file).name
    with tqdm(unit=" events", unit_scale=True, delay=1.0, leave=False, disable=None) as bar:
        found = survey_file(file, notes=notes, progress=bar.update, **reading).statistics()
        if signatures and found.events:
            # only here, as its statistical distributions take longer to load than most files to read
            from dase.signatures.find import find_signatures

            shown = find_signatures(file, progress=bar.update, **reading)
    said = [note for note in (*notes, *find_anomalies(found)) if isinstance(note, io.Note)]
    if json_ is not None:
        content = summary.as_json(name, found, said)
        if shown is not None:
            content["signatures"] = shown.to_json()
        write_json(json_, content)
        if json_ == STANDARD_OUTPUT:
            return
    click.echo(f"{'format':<18}{name}")
    for key, value in summary.statistics_table(found):
        click.echo(f"{key:<18}{value}")
    click.echo("\ntime between successive events of one pixel")
    for line in summary.interval_histogram(found):
        click.echo(line)
    if shown is not None:
        click.echo()
        for line in shown.lines():
            click.echo(line)
    if said:
        click.echo()
    for note in said:
        click.echo(f"{note.kind + ':':<10}{note}")
