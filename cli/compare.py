"""How far a model is from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from dase.cli.options import (
    check_suffix,
    device_option,
    effects_option,
    fps_option,
    importing,
    open_recorded,
    part_options,
    scene_option,
    stimulus_option,
)
from dase.cli.output import plates_or_note, print_plain_numbers, progress_bar, write_json


@click.command()
@click.argument("sensor")
@click.argument("recording", type=click.Path(path_type=Path))
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_suffix(".html"),
    help="Report, one HTML file; its numbers go beside it as .json.",
)
@scene_option
@stimulus_option
@fps_option
@part_options
@effects_option
@click.option("--pixels", default=1500, show_default=True, help="In each part of the measurement.")
@device_option
@click.option("--seed", default=0, show_default=True, help="The same seed gives the same numbers.")
@click.option("--quiet", is_flag=True, help="No progress.")
def compare_command(
    sensor: str,
    recording: Path,
    file: Path | None,
    output: Path | None,
    scene: str,
    stimulus: Path | None,
    fps: float | None,
    compared: dict[str, Any],
    effects: tuple[Path, ...],
    pixels: int,
    device: str,
    seed: int,
    quiet: bool,
) -> None:
    """Compare the model SENSOR with RECORDING: how large the error is, and where it sits.

    1 is the error that two repeats of the recording would have. Nothing is fitted: `dase fit` does that.
    """
    with importing():
        from dase.diagnosis.compare import compare
        from dase.simulation.sensor_file import load_sensor
        from dase.simulation.user_effects import known_effects

    model = load_sensor(sensor, known_effects(effects))
    measured = open_recorded(recording, scene, file, fps, compared, stimulus)
    with progress_bar(quiet) as tell:
        found = compare(measured, model, pixels=pixels, seed=seed, device=device, progress=tell)
    click.echo(
        f"error {found.error:.2f}; 1 is what two repeats of the recording give, "
        f"which stay below {found.gate:.2f}"
    )
    width = max(map(len, found.families))
    for name, error in sorted(found.families.items(), key=lambda item: -item[1]):
        click.echo(f"  {name:{width}s} {error:7.2f}")
    for cell in found.cells[:8]:
        click.echo(f"  {cell.sentence}")
    print_plain_numbers(found.plain)
    for note in found.notes:
        click.echo(f"note: {note}")
    if output is not None:
        from dase.figures import report

        write_json(output.with_suffix(".json"), found.to_json())
        plates = plates_or_note(measured, model, seed=seed, device=device)
        page = report.comparison_page(found, recording=recording.name, model=Path(sensor).stem, plates=plates)
        report.write_page(output, page)
        click.echo(f"{output}: open it in a browser")
