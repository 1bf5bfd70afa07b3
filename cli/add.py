"""Another effect for a sensor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import device_option, effects_option, sensor_output
from dase.cli.output import progress_bar

if TYPE_CHECKING:
    from dase.effects import Effect
    from dase.simulation.sensor import Sensor
    from dase.simulation.sensor_history import HistoryEntry


@click.command()
@click.argument("sensor")
@click.argument("effect")
@click.option("--set", "settings", multiple=True, metavar="PARAMETER=VALUE", help="Other than the default.")
@click.option(
    "--fit",
    "recording",
    type=click.Path(path_type=Path),
    metavar="RECORDING",
    help="Fit all parameters to this recording, and note the error before and after.",
)
@click.option(
    "--scene",
    default="frames",
    show_default=True,
    help="What the camera saw in RECORDING: its own frames, a video FILE, or static.",
)
@device_option
@click.option("--seed", default=0, show_default=True, help="The same seed gives the same fit.")
@sensor_output
@effects_option
def add_command(
    sensor: str,
    effect: str,
    settings: tuple[str, ...],
    recording: Path | None,
    scene: str,
    device: str,
    seed: int,
    output: Path | None,
    effects: tuple[Path, ...],
) -> None:
    """Add EFFECT to SENSOR, a preset or a TOML file, whose comments stay.

    The effect gets its default values and goes where it acts. The change is noted at the end of the file.
    """
    from dase.effects import find_effect
    from dase.simulation import sensor_edit
    from dase.simulation.user_effects import known_effects

    values = dict(split_setting(setting) for setting in settings)
    known = known_effects(effects)
    chosen = sensor_edit.parse_values(find_effect(effect, known), values)
    text = sensor_edit.read_sensor_text(sensor, known)
    more = text.with_effect(chosen)
    entry = sensor_edit.history_entry_today(f"add {effect}")
    if recording is not None:
        fitted, entry = _fit_effect(text.sensor(), chosen, recording, scene, device, seed)
        more = more.describing(fitted)
    sensor_edit.write_sensor_text(more.with_history(entry), output)
    for name in sorted(more.sensor().idle_parameters() - text.sensor().idle_parameters()):
        if not name.startswith(f"{effect}."):
            click.echo(f"note: {name} changes nothing beside {effect}", err=True)
    for part, whole in more.sensor().doubled_effects().items():
        if effect in (part, whole):
            click.echo(f"note: {part} acts beside {whole}, which does the same and more", err=True)
    if output is None:
        return
    click.echo(f"{output}: {effect} added ({describe_values(more.sensor()[effect])})")
    if entry.error_before is not None and entry.error_after is not None:
        errors = f"error {entry.error_before:.2f} before, {entry.error_after:.2f} after"
        click.echo(f"{errors}; 1 is what two repeats of the recording give")


def _fit_effect(
    sensor: Sensor, effect: Effect, recording: Path, scene: str, device: str, seed: int
) -> tuple[Sensor, HistoryEntry]:
    """Return the sensor with the effect, fitted to a recording, and what is to be noted."""
    from dase.diagnosis import sensor_update
    from dase.diagnosis.add_effect import fit_added
    from dase.fitting.measurement import open_measurement
    from dase.simulation import sensor_edit

    data = open_measurement(recording, scene)
    with progress_bar(False) as tell:
        before, found = fit_added(data, sensor, effect, seed=seed, device=device, progress=tell)
    for note in found.notes:
        click.echo(f"note: {note}", err=True)
    entry = sensor_edit.history_entry_today(
        f"add {effect.name}",
        recording=recording.name,
        error_before=round(before, 3),
        error_after=round(found.error, 3),
        floor=found.floor,
    )
    return sensor_update.round_parameters(found.sensor), entry


def describe_values(effect: Effect) -> str:
    """Return the values of an effect in a line."""
    return ", ".join(
        f"{p.name} {getattr(effect, p.name):g} {p.unit}".removesuffix(" 1") for p in effect.parameters()
    )


def split_setting(setting: str) -> tuple[str, str]:
    """Return name and value of a text such as rate=0.2."""
    name, equals, value = setting.partition("=")
    if not equals or not name.strip():
        raise click.BadParameter(f"{setting!r} is not of the form PARAMETER=VALUE", param_hint="--set")
    return name.strip(), value.strip()
