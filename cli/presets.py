"""Built-in sensors, and where their numbers come from."""

from __future__ import annotations

import textwrap

import click


@click.group()
def presets_command() -> None:
    """List the built-in sensors, or show one and where its numbers come from."""


@presets_command.command("list")
def list_presets() -> None:
    """List all presets."""
    from dase.simulation.preset_sources import preset_sources
    from dase.simulation.sensor_file import read_presets

    known = sorted(read_presets())
    width = max(map(len, known))
    for name in known:
        click.echo(f"{name:{width}}  {preset_sources(name).about.split('. ')[0].rstrip('.')}")


@presets_command.command("show")
@click.argument("name")
def show_preset(name: str) -> None:
    """Show the preset NAME: each value, its unit and its source."""
    from dase.simulation.preset_sources import preset_sources

    found = preset_sources(name)
    click.echo("\n".join(textwrap.wrap(f"{name}: {found.about}", 100)) + "\n")
    cells = [(one.name, f"{one.value} {one.unit}".strip(), one.source) for one in found.values]
    widths = [max(len(row[n]) for row in cells) for n in range(2)]
    for key, value, source in cells:
        click.echo(f"  {key:{widths[0]}}  {value:{widths[1]}}  {source}".rstrip())
