"""Which effect a model lacks."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dase.cli.options import (
    check_output,
    check_suffix,
    device_option,
    effects_option,
    fps_option,
    importing,
    json_option,
    open_recorded,
    part_options,
    scene_option,
    stimulus_option,
)
from dase.cli.output import (
    STANDARD_OUTPUT,
    plates_or_note,
    print_plain_numbers,
    progress_bar,
    write_json,
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
@stimulus_option
@click.option("--auto", is_flag=True, help="Add what is found and go on until nothing is missing.")
@click.option("--free", help="Parameters that may be refitted, with commas between.  [default: all]")
@json_option
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
@part_options
@effects_option
@click.option("--pixels", default=1500, show_default=True, help="In each part of the measurement.")
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
    stimulus: Path | None,
    fps: float | None,
    compared: dict[str, Any],
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

    Every effect that the sensor does not have is fitted, and judged on pixels and time held out. An effect is
    announced where the events alone show it (certain), or where next to nothing of the error is left with it
    and its own test holds (supported); else what it cannot be told apart from is said.
    """
    with importing():
        from dase.diagnosis import sensor_update
        from dase.diagnosis.diagnose import diagnose
        from dase.simulation import sensor_edit
        from dase.simulation.user_effects import known_effects

    library = known_effects(effects)
    text = sensor_edit.read_sensor_text(sensor, library)
    model = text.sensor()
    measured = open_recorded(recording, scene, file, fps, compared, stimulus)
    names = free.split(",") if free else None
    # without --auto, the first effect that is missing
    look = diagnose if auto else partial(diagnose, most=1)
    known: list[Diagnosis] = []

    def keep(interim: Diagnosis) -> None:
        known.append(interim)
        if auto:
            if not quiet:
                click.echo(f"so far: {interim.finding()}", err=True)
            if json_ not in (None, STANDARD_OUTPUT):
                write_json(json_, interim.to_json())

    try:
        with progress_bar(quiet) as tell:
            found = look(
                measured, model, effects=library, free=names, pixels=pixels, seed=seed, device=device,
                progress=tell, so_far=keep,
            )  # fmt: skip
    except KeyboardInterrupt:
        if not known:
            raise
        # hours may have gone into it: what is known is said, and nothing is written as if it were found
        _say_findings(known[-1], json_, quiet)
        click.get_current_context().exit(130)
    _say_findings(found, json_, quiet)
    if output is not None:
        sensor_edit.write_sensor_text(sensor_update.with_diagnosis(text, found, recording.name), output)
    # what was found took minutes and is said and written by now: a picture that fails costs the picture
    drawn = draw is None or draw_or_say(draw, found)
    if report is not None:
        from dase.figures import report as pages

        plates = plates_or_note(measured, found.sensor, seed=seed, device=device)
        page = pages.diagnosis_page(found, recording=recording.name, model=Path(sensor).stem, plates=plates)
        pages.write_page(report, page)
    if not drawn:
        click.get_current_context().exit(1)


def draw_or_say(path: Path, found: Diagnosis) -> bool:
    """Draw what was found into a file; say why where that fails, and return whether it did not."""
    from dase.figures.plot import plot
    from dase.io import replacing

    try:
        with replacing(path) as part:
            plot(found).savefig(part)
    except Exception as error:  # whatever matplotlib stumbles over
        click.echo(f"dase: {path} could not be drawn: {type(error).__name__}: {error}", err=True)
        return False
    return True


def _say_findings(found: Diagnosis, json_: Path | None, quiet: bool) -> None:
    """Write findings as JSON, if that was asked for, and print them, unless JSON is printed."""
    if json_ is not None:
        write_json(json_, found.to_json())
    if json_ != STANDARD_OUTPUT:
        _print_findings(found, quiet)


def _print_findings(found: Diagnosis, quiet: bool) -> None:
    from dase.results import NO_CLAIM

    click.echo(found.finding())
    if quiet:
        return
    for one in (*found.findings, *found.stand_ins):
        click.echo(f"  {one.sentence()}")
    for text in found.unexplained.whereabouts() if found.unexplained else ():
        click.echo(f"  {text}")
    for text in found.record:
        click.echo(f"record next: {text}")
    click.echo(f"error as given {found.before:.2f}; 1 is what two repeats of the recording give")
    for step in found.history:
        click.echo(f"\n{' + '.join(step.model)}: error {step.error:.2f}, repeats stay below {step.gate:.2f}")
        for rank in step.ranking[:5]:
            if math.isnan(rank.error):  # given up before it was judged
                continue
            mark = "+" if rank.effect == step.chosen else " "
            click.echo(
                f"  {mark} {rank.effect:14s} error {rank.error:6.2f}  {100 * rank.share:3.0f} % of the way "
                f"to the floor"
            )
        if step.ties:
            click.echo(f"    cannot be told apart from {step.chosen}: {', '.join(step.ties)}")
        for cell in step.cells[:3]:
            click.echo(f"    {cell.sentence}")
    click.echo("\nparameters, with 90 % intervals" if found.parameters_hold else f"\n{NO_CLAIM}")
    for name, estimate in found.parameters.items():
        interval = f"   {estimate.low:.4g} to {estimate.high:.4g}" if found.parameters_hold else ""
        click.echo(f"  {name:24s} {estimate.value:10.4g}{interval}")
    if found.not_seen:
        click.echo("\nnot seen")
        for limit in found.not_seen:
            click.echo(f"  {limit.sentence}")
    print_plain_numbers(found.plain)
    for note in found.notes:
        click.echo(f"note: {note}")
    click.echo(f"{found.evaluations} simulations, {found.seconds:.1f} s")
