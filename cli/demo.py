"""A first look: pictures in, events out."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/demo"), show_default=True, help="Folder."
)
@click.option("--backend", default="cpu", show_default=True, help="cpu or cuda.")
def demo_command(out: Path, backend: str) -> None:
    """Simulate a DAVIS346 before moving photographs, and draw what it sees."""
    from dase.datasets import demo

    picture, events = demo.run_demo(out, backend=backend, say=click.echo)
    click.echo(f"Look at the picture  {picture}")
    click.echo(f"and at the events in {events} (dase show {events})")
