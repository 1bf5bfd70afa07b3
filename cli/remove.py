"""A sensor without one of its effects."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import effects_option, sensor_output


@click.command()
@click.argument("sensor")
@click.argument("effect")
@sensor_output
@effects_option
def command(sensor: str, effect: str, output: Path | None, effects: tuple[Path, ...]) -> None:
    """Remove EFFECT from SENSOR, a preset or a TOML file, whose comments stay.

    The comment right above the effect goes with it. The change is noted at the end of the file.
    """
    from dase import edit
    from dase.effect_files import known_effects

    text = edit.read(sensor, known_effects(effects)).removed(effect)
    edit.write(text.noted(edit.today(f"remove {effect}")), output)
    if output is not None:
        click.echo(f"{output}: {effect} removed")
