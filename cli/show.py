"""The command `dase show`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import check_output, reading_options

if TYPE_CHECKING:
    from dase.io.sequence import Sequence
    from dase.io.source import ReadOptions


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    callback=check_output,
    help="PNG or MP4.  [default: FILE as .png]",
)
@click.option("--at", type=float, metavar="SECONDS", help="Show this time only.")
@click.option(
    "--window",
    type=float,
    metavar="SECONDS",
    help="Events per picture.  [default: fits the rate]",
)
@click.option("--trust", is_flag=True, help="Show how far the scene between the frames can be trusted.")
@reading_options
def show_command(
    file: Path,
    output: Path | None,
    at: float | None,
    window: float | None,
    trust: bool,
    reading: ReadOptions,
) -> None:
    """Draw the events of FILE over its frames and print its statistics.

    A PNG is a contact sheet: moments with events in red (ON) and blue (OFF), the event rate, and the
    intervals between events of one pixel. An MP4 shows all of it, a picture per frame. With --trust the PNG
    shows moments between frames, veiled where what the frames tell of them is in doubt.

    The folder of a training run is drawn as the thresholds it has learned, over some of its scenes.
    """
    from dase import io
    from dase.errors import InputError, printable
    from dase.figures import event_images
    from dase.recordings import summary
    from dase.recordings.statistics import survey_sequence

    if file.is_dir() and (file / "job.json").is_file():
        _draw_run(file, output or file / "learned.png")
        return
    output = output or file.with_suffix(".trust.png" if trust else ".png")
    suffix = output.suffix.lower()
    if suffix not in (".png", ".mp4"):
        raise InputError(f"output: must end with .png or .mp4, got '{output}'")
    if suffix == ".mp4" and at is not None:
        raise InputError("at: shows one moment, which a video cannot; leave it out or write a .png")
    if trust and (suffix == ".mp4" or at is not None):
        raise InputError("trust: is a picture of several moments, which takes neither --at nor .mp4")
    sequence = io.read(file, **reading)
    survey = survey_sequence(sequence)
    if trust:
        _draw_trust(sequence, output, printable(file.stem), window)
    elif suffix == ".mp4":
        if not event_images.write_video(sequence, output, window=window).plays_in_browsers:
            click.echo(
                "this OpenCV has neither H.264 nor VP9: the video is MPEG-4, which browsers do not play"
            )
    else:
        figure = event_images.draw_sequence(
            sequence, title=printable(file.stem), at=at, window=window, survey=survey
        )
        with io.replacing(output) as temporary:
            figure.savefig(temporary)
    for name, value in summary.statistics_table(survey.statistics()):
        click.echo(f"{name:<18}{value}")
    click.echo(f"{'written':<18}{output}")


def _draw_run(folder: Path, output: Path) -> None:
    """Draw what a training run has learned."""
    from dase import io
    from dase.errors import InputError
    from dase.figures import training_figure

    if output.suffix.lower() != ".png":
        raise InputError(f"output: a training run is drawn as a .png, got '{output}'")
    figure, lines = training_figure.draw_training(folder)
    with io.replacing(output) as temporary:
        figure.savefig(temporary)
    for name, value in lines:
        click.echo(f"{name:<18}{value}")
    click.echo(f"{'written':<18}{output}")


def _draw_trust(sequence: Sequence, output: Path, title: str, window: float | None) -> None:
    """Draw it, and say how much is trusted."""
    from dase import io
    from dase.figures import trust_figure
    from dase.fitting.measurement import scene_between_frames

    notes: list[str] = []
    scene = scene_between_frames(sequence, notes)
    figure = trust_figure.draw_trust(scene, sequence.events, title=title, window=window)
    with io.replacing(output) as temporary:
        figure.savefig(temporary)
    click.echo(f"{100 * scene.trusted().mean():.0f} % of pixels and times trusted")
    for note in notes:
        click.echo(note)
