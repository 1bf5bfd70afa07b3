"""Test pictures to show to a camera."""

from __future__ import annotations

from pathlib import Path

import click

from dase.cli.options import parse_size


def _parse_parts(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    return None if value is None else tuple(part.strip() for part in value.split(",") if part.strip())


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--refresh", default=60.0, show_default=True, help="Of your screen [Hz]: 60, 120, 144, ...")
@click.option(
    "--size", callback=parse_size, default="1280x720", show_default=True, metavar="WxH",
    help="Of the video [px]; it is shown pixel for pixel.",
)  # fmt: skip
@click.option(
    "--gamma", type=float,
    help="Of your screen, if it was measured.  [default: made for 2.2, and fitted from the recording]",
)  # fmt: skip
@click.option(
    "--black", default=0.001, show_default=True,
    help="Light of black relative to white: 1 / contrast, and what the room adds.",
)  # fmt: skip
@click.option(
    "--parts", callback=_parse_parts,
    help="What is shown between the flashes, with commas between.  [default: "
    "ladder,steps,ramps,chirp,edges]",
)  # fmt: skip
@click.option("--paper", default="a4", show_default=True, help="Of the sheet: a3, a4, a5 or letter.")
@click.option("--dpi", default=300.0, show_default=True, help="Of a sheet that is a PNG.")
def stimulus_command(
    out: Path,
    refresh: float,
    size: tuple[int, int],
    gamma: float | None,
    black: float,
    parts: tuple[str, ...] | None,
    paper: str,
    dpi: float,
) -> None:
    """Write test pictures to show to a camera, into the folder or file OUT.

    A folder gets all of them: a video for a screen with the JSON that `dase fit --stimulus` reads, a sheet
    for printing, and a protocol that says what to do with them, an LED and a lens cap. The suffix of a file
    chooses one: .mkv and .avi (lossless) or .mp4 (not) for the video, .pdf, .svg or .png for the sheet, .md
    or .txt for the protocol.

    Then: play the video, record it, and `dase fit SENSOR RECORDING --stimulus OUT/stimulus.json -o FILE`.
    """
    from tqdm import tqdm

    from dase.datasets.stimulus_files import StimulusJob, write_stimulus
    from dase.scenes.light import SRGB_GAMMA
    from dase.scenes.screen_stimulus import PARTS, ScreenStimulus

    stimulus = ScreenStimulus(
        refresh, size, SRGB_GAMMA if gamma is None else gamma, black, PARTS if parts is None else parts,
        gamma is not None,
    )  # fmt: skip
    with tqdm(total=stimulus.frame_count, unit=" frames", disable=None, leave=False) as bar:
        files = write_stimulus(
            StimulusJob(stimulus, paper, dpi), out, progress=lambda done, of: bar.update(done - bar.n)
        )
    for file in files:
        click.echo(f"{file}: {file.stat().st_size / 1e6:.2f} MB")
    if out.suffix.lower() == ".mp4":
        click.echo("note: MP4 loses some levels, and the chequerboards that tell gamma; .mkv loses nothing")
    truth = next((file for file in files if file.name.endswith(".json") and file.stem != "sheet"), None)
    if truth is not None:
        click.echo(
            f"Show the video ({stimulus.duration:.0f} s) pixel for pixel at {refresh:g} Hz to a camera at "
            f"rest, record it whole, then: dase fit SENSOR RECORDING --stimulus {truth} -o FILE"
        )
