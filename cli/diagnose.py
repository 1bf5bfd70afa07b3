"""Which effect a model lacks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import (
    check_output,
    check_suffix,
    device_option,
    effects_option,
    fps_option,
    open_recorded,
    scene_option,
)

if TYPE_CHECKING:
    from dase.results import Diagnosis


def print_explanation(ctx: click.Context, parameter: click.Parameter, value: str | None) -> None:
    """Say what an effect is and what it does to the probes, and exit.

    Not eager: `--effects`, which is, must be known by then wherever it stands; options that are given come
    before arguments that are not, which nobody misses here.
    """
    if value is None or ctx.resilient_parsing:
        return
    from dase.diagnosis.explain_effect import explain_effect
    from dase.simulation.user_effects import known_effects

    click.echo(explain_effect(value, known_effects(ctx.params.get("effects", ()))))
    ctx.exit()


@click.command()
@click.argument("sensor")
@click.argument("recording", type=click.Path(path_type=Path))
@click.argument("file", required=False, type=click.Path(path_type=Path))
@scene_option
@click.option("--auto", is_flag=True, help="Add what is found and go on until nothing is missing.")
@click.option("--free", help="Parameters that may be refitted, with commas between.  [default: all]")
@click.option(
    "--json",
    "json_",
    type=click.Path(path_type=Path),
    callback=check_output,
    help="Write the findings to this file.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_output,
    help="Write the sensor with what was found.",
)
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    callback=check_suffix(".html"),
    help="Write everything into this HTML file, with pictures.",
)
@click.option(
    "--draw",
    type=click.Path(path_type=Path),
    callback=check_suffix(".png", ".svg", ".pdf"),
    help="Draw the falling error into this PNG, SVG or PDF.",
)
@fps_option
@effects_option
@click.option("--pixels", default=1500, show_default=True, help="In each half of the measurement.")
@device_option
@click.option("--seed", default=0, show_default=True, help="The same seed gives the same findings.")
@click.option("--quiet", is_flag=True, help="Only the finding, no progress.")
@click.option("--explain", metavar="EFFECT", callback=print_explanation, expose_value=False,
              help="Say what EFFECT is and what it does to the probes, and exit.")  # fmt: skip
def diagnose_command(
    sensor: str,
    recording: Path,
    file: Path | None,
    scene: str,
    fps: float | None,
    auto: bool,
    free: str | None,
    json_: Path | None,
    output: Path | None,
    report: Path | None,
    draw: Path | None,
    effects: tuple[Path, ...],
    pixels: int,
    device: str,
    seed: int,
    quiet: bool,
) -> None:
    """Find the effect that the model SENSOR lacks to explain RECORDING.

    Every effect that the sensor does not have is fitted, and judged on pixels and time held out. Nothing is
    announced unless it brings the error to what two repeats of the recording would give.
    """
    from dase.diagnosis import sensor_update
    from dase.diagnosis.diagnose import diagnose
    from dase.io import replacing
    from dase.simulation import sensor_edit
    from dase.simulation.user_effects import known_effects

    known = known_effects(effects)
    text = sensor_edit.read_sensor_text(sensor, known)
    model = text.sensor()
    measured = open_recorded(recording, scene, file, fps)
    names = free.split(",") if free else None
    with progress_bar(quiet) as tell:
        # without --auto, the first effect that is missing
        look = diagnose if auto else partial(diagnose, most=1)
        found = look(
            measured, model, effects=known, free=names, pixels=pixels, seed=seed, device=device, progress=tell
        )
    if json_ is not None:
        with replacing(json_) as part:
            part.write_text(json.dumps(found.to_json(), indent=2) + "\n")
    if output is not None:
        sensor_edit.write_sensor_text(sensor_update.with_diagnosis(text, found, recording.name), output)
    if draw is not None:
        from dase.figures.plot import plot

        with replacing(draw) as part:
            plot(found).savefig(part)
    if report is not None:
        from dase.figures import report as pages

        plates = pages.measurement_plates(measured, found.sensor, seed=seed, device=device)
        page = pages.diagnosis_page(found, recording=recording.name, model=Path(sensor).stem, plates=plates)
        pages.write_page(report, page)
    _print_findings(found, quiet)


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[str, float, float], None]]:
    """Show on a terminal what is being done, how far it is, and the present error."""
    from tqdm import tqdm

    layout = "{desc:32.32} |{bar}| {postfix}"
    with tqdm(total=1.0, disable=True if quiet else None, bar_format=layout, leave=False) as shown:

        def tell(text: str, share: float, error: float) -> None:
            shown.n = share
            shown.set_description_str(text, refresh=False)
            shown.set_postfix_str("" if error != error else f"error {error:.2f}", refresh=False)
            shown.refresh()

        yield tell


def _print_findings(found: Diagnosis, quiet: bool) -> None:

    click.echo(found.finding())
    if quiet:
        return
    click.echo(f"error as given {found.before:.2f}; 1 is what two repeats of the recording give")
    for step in found.history:
        click.echo(f"\n{' + '.join(step.model)}: error {step.error:.2f}, repeats stay below {step.gate:.2f}")
        for rank in step.ranking[:5]:
            if math.isnan(rank.error):  # given up before it was judged
                continue
            mark = "+" if rank.effect == step.chosen else " "
            click.echo(
                f"  {mark} {rank.effect:14s} error {rank.error:6.2f}  {100 * rank.share:3.0f} % of the way "
                f"to the floor  p {rank.p_value:.3f}"
            )
        if step.ties:
            click.echo(f"    cannot be told apart from {step.chosen}: {', '.join(step.ties)}")
        for cell in step.cells[:3]:
            click.echo(f"    {cell.sentence}")
    click.echo("\nparameters, with 90 % intervals")
    for name, estimate in found.parameters.items():
        click.echo(f"  {name:24s} {estimate.value:10.4g}   {estimate.low:.4g} to {estimate.high:.4g}")
    for note in found.notes:
        click.echo(f"note: {note}")
    click.echo(f"{found.evaluations} simulations, {found.seconds:.1f} s")
