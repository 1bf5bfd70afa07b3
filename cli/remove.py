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
def remove_command(sensor: str, effect: str, output: Path | None, effects: tuple[Path, ...]) -> None:
    """Remove EFFECT from SENSOR, a preset or a TOML file, whose comments stay.

    The comment right above the effect goes with it. The change is noted at the end of the file.
    """
    from dase.simulation import sensor_edit
    from dase.simulation.user_effects import known_effects

    text = sensor_edit.read_sensor_text(sensor, known_effects(effects)).without_effect(effect)
    entry = sensor_edit.history_entry_today(f"remove {effect}")
    sensor_edit.write_sensor_text(text.with_history(entry), output)
    if output is not None:
        click.echo(f"{output}: {effect} removed")
