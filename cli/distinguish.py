"""Which recording would tell two models apart."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import check_suffix, device_option, effects_option


@click.command()
@click.argument("a")
@click.argument("b")
@click.option("--longest", default=60.0, show_default=True, help="Longest recording to try [s].")
@click.option(
    "--pixels", default=1500, show_default=True, help="Of a recording that are looked at, as in a diagnosis."
)
@click.option("--seed", default=0, show_default=True, help="Of the simulated recordings.")
@device_option
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_suffix(".png", ".svg", ".pdf"),
    help="Draw it into this PNG, SVG or PDF.",
)
@effects_option
def distinguish_command(
    a: str,
    b: str,
    longest: float,
    pixels: int,
    seed: int,
    device: str,
    output: Path | None,
    effects: tuple[Path, ...],
) -> None:
    """Say which recording would tell the sensors A and B apart, presets or TOML files.

    Recordings that anybody can make (at rest in the dark and in light, slow and fast edges, flicker) are
    simulated with both models, longer and longer, until one can be told from the other by the statistics that
    a diagnosis uses: with 95 % power at 5 % false alarms.
    """
    from tqdm import tqdm

    from dase.diagnosis import distinguish, standard_stimuli
    from dase.simulation.sensor_file import load_sensor
    from dase.simulation.user_effects import known_effects

    known = known_effects(effects)
    names = (Path(a).stem, Path(b).stem) if Path(a).stem != Path(b).stem else ("A", "B")
    models = (load_sensor(a, known), load_sensor(b, known))
    with tqdm(total=len(standard_stimuli.STANDARD_STIMULI), unit=" recordings", disable=None) as bar:

        def progress(stimulus: str, seconds: float, power: float, last: bool) -> None:
            bar.set_postfix_str(f"{stimulus}, {seconds:g} s: {100 * power:.0f} %", refresh=True)
            bar.update(int(last))

        found = distinguish.distinguish(
            *models, names=names, longest=longest, pixels=pixels, seed=seed, device=device, progress=progress
        )
    table = list(distinguish.table_rows(found, *names))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        click.echo("  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    click.echo(f"\n{found.sentence}")
    if output is not None:
        from dase.figures.plot import plot
        from dase.io import replacing

        with replacing(output) as temporary:
            plot(found, names=names).savefig(temporary)
