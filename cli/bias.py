"""A sensor with other biases."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import effects_option, sensor_output


@click.command()
@click.argument("sensor", required=False)
@click.argument("settings", nargs=-1, metavar="[NAME=BEFORE:AFTER]...")
@sensor_output
@effects_option
def bias_command(
    sensor: str | None, settings: tuple[str, ...], output: Path | None, effects: tuple[Path, ...]
) -> None:
    """Change SENSOR, a DAVIS346 fitted to a recording, to other biases; the comments of its file stay.

    A setting is coarse/fine, as the camera's software shows it, or a current: ONBn=5/255:6/200,
    RefrBp=2nA:8nA. That after may be relative: OFFBn=4/1:+50%. One that has not changed stands alone:
    DiffBn=4/39. Thresholds follow ONBn and OFFBn relative to DiffBn, so name that with them.

    Without SENSOR: what is known of biases.
    """
    from dase.simulation import biases, sensor_edit
    from dase.simulation.user_effects import known_effects

    if sensor is None:
        for law in biases.DAVIS_LAWS:
            click.echo(f"{', '.join(law.biases)}: {', '.join(law.values) or 'nothing'}")
            for name in ("law", "source", "uncertainty"):
                click.echo(f"    {name}: {getattr(law, name)}")
        return
    if not settings:
        raise click.UsageError("which bias? Such as ONBn=5/255:6/200")
    text = sensor_edit.read_sensor_text(sensor, known_effects(effects))
    before = text.sensor()
    after = biases.with_biases(before, *biases.parse_biases(settings))
    entry = sensor_edit.history_entry_today(f"bias {' '.join(settings)}")
    more = text.describing(after, because="by biases").with_history(entry)
    sensor_edit.write_sensor_text(more, output)
    if output is not None:
        changes = [
            f"{effect.name}.{name} {getattr(effect, name):.4g} → {getattr(after[effect.name], name):.4g}"
            for effect in before.effects for name in effect.settings()
            if getattr(effect, name) != getattr(after[effect.name], name)
        ]  # fmt: skip
        click.echo(f"{output}: {', '.join(changes) or 'nothing changed'}")
