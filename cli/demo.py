"""A first look: pictures in, events out."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import device_or_backend_option


@click.command()
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("out/demo"),
    show_default=True,
    help="Folder.",
)
@device_or_backend_option
def demo_command(output: Path, device: str) -> None:
    """Simulate a DAVIS346 before moving photographs, and draw what it sees."""
    from dase.datasets import demo

    picture, events = demo.run_demo(output, device=device, say=click.echo)
    click.echo(f"Look at the picture  {picture}")
    click.echo(f"and at the events in {events} (dase show {events})")
