"""Another effect for a sensor."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import effects_option, sensor_output


@click.command()
@click.argument("sensor")
@click.argument("effect")
@click.option("--set", "settings", multiple=True, metavar="PARAMETER=VALUE", help="Other than the default.")
@sensor_output
@effects_option
def command(
    sensor: str,
    effect: str,
    settings: tuple[str, ...],
    output: Path | None,
    effects: tuple[Path, ...],
) -> None:
    """Add EFFECT to SENSOR, a preset or a TOML file, whose comments stay.

    The effect gets its default values and goes where it acts. The change is noted at the end of the file.
    """
    from dase import edit
    from dase.config import read_sensor
    from dase.effect_files import known_effects
    from dase.effects import find

    values = dict(split(setting) for setting in settings)
    known = known_effects(effects)
    chosen = edit.parse_values(find(effect, known), values)
    text = edit.SensorText(*read_sensor(sensor), known).added(chosen)
    edit.write(text.noted(edit.today(f"add {effect}")), output)
    if output is not None:
        said = ", ".join(
            f"{p.name} {getattr(chosen, p.name):g} {p.unit}".removesuffix(" 1") for p in chosen.parameters()
        )
        click.echo(f"{output}: {effect} added ({said})")


def split(setting: str) -> tuple[str, str]:
    """Return name and value of a text such as rate=0.2."""
    name, equals, value = setting.partition("=")
    if not equals or not name.strip():
        raise click.BadParameter(f"{setting!r} is not of the form PARAMETER=VALUE", param_hint="--set")
    return name.strip(), value.strip()
