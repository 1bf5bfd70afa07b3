"""Parameters of a sensor from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from dase.cli.options import (
    check_output,
    device_option,
    effects_option,
    fps_option,
    importing,
    open_recorded,
    part_options,
    scene_option,
    stimulus_option,
)
from dase.cli.output import print_plain_numbers, progress_bar


@click.command()
@click.argument("sensor")
@click.argument("recording", type=click.Path(path_type=Path))
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    callback=check_output,
    help="The fitted sensor.",
)
@click.option("--free", help="Effects or effect.parameter to fit, with commas between.  [default: all]")
@scene_option
@stimulus_option
@fps_option
@part_options
@effects_option
@click.option("--pixels", default=1500, show_default=True, help="In each part of the measurement.")
@device_option
@click.option("--seed", default=0, show_default=True, help="The same seed gives the same fit.")
@click.option("--force", is_flag=True, help="Write the file also where the fit should not be kept.")
@click.option("--quiet", is_flag=True, help="No progress.")
def fit_command(
    sensor: str,
    recording: Path,
    file: Path | None,
    output: Path,
    free: str | None,
    scene: str,
    stimulus: Path | None,
    fps: float | None,
    compared: dict[str, Any],
    effects: tuple[Path, ...],
    pixels: int,
    device: str,
    seed: int,
    force: bool,
    quiet: bool,
) -> None:
    """Fit the parameters of the model SENSOR to RECORDING; the comments of its file stay.

    A fit that is worse than SENSOR on pixels and time that it has not seen does not generalise, and one to a
    scene that the events contradict says nothing: nothing is written without --force, this is said, and the
    exit code is 1.

    Where only one of the starts came to the error of the best, the minimum may be a poor one: the file is
    written, this is said, and the exit code is 1.
    """
    with importing():
        from dase.diagnosis import sensor_update
        from dase.fitting.fit import fit
        from dase.simulation import sensor_edit
        from dase.simulation.user_effects import known_effects

    text = sensor_edit.read_sensor_text(sensor, known_effects(effects))
    model = text.sensor()
    measured = open_recorded(recording, scene, file, fps, compared, stimulus)
    with progress_bar(quiet) as tell:
        names = free.split(",") if free else None
        found = fit(measured, model, free=names, pixels=pixels, seed=seed, device=device, progress=tell)
    click.echo(f"error {found.before:.2f} → {found.error:.2f}; repeats stay below {found.gate:.2f}")
    for name, estimate in found.parameters.items():
        click.echo(f"  {name:24s} {estimate.value:10.4g}   {estimate.low:.4g} to {estimate.high:.4g}")
    print_plain_numbers(found.plain)
    for note in found.notes:
        click.echo(f"note: {note}")
    if found.refusal() and not force:
        click.echo(
            f"dase: {output} was not written: {found.refusal()}; --force writes it all the same", err=True
        )
        click.get_current_context().exit(1)
    sensor_edit.write_sensor_text(sensor_update.with_fit(text, found, recording.name), output)
    click.echo(f"{output}: {found.evaluations} simulations, {found.seconds:.1f} s")
    if found.poor:
        click.echo("dase: the fit may have ended in a poor minimum, see the note above", err=True)
        click.get_current_context().exit(1)
