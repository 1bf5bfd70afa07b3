"""What a trained network makes of recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dase.cli.options import reading_options

if TYPE_CHECKING:
    from dase.io.source import ReadOptions


@click.command()
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for a picture and a video of each file, and results.jsonl.",
)
@click.option(
    "--offset",
    default="0",
    show_default=True,
    metavar="SECONDS|auto",
    help="From the frames' times to the middles of their exposures; auto reads it off events and frames.",
)
@click.option("--lpips", type=click.Path(path_type=Path), help="Weights of LPIPS, an npz.")
@click.option("--normalise", is_flag=True, help="The network was trained on normalised voxels.")
@click.option("--device", help="cpu or cuda.  [default: cuda where it is]")
@reading_options
def evaluate_command(
    checkpoint: Path,
    files: tuple[Path, ...],
    output: Path | None,
    offset: str,
    lpips: Path | None,
    normalise: bool,
    device: str | None,
    reading: ReadOptions,
) -> None:
    """Judge the network of CHECKPOINT on FILES, any recordings that dase reads, beside their frames and flow.

    A network for reconstruction is judged by MSE (raw, and after an affine and a histogram match), SSIM and
    MS-SSIM; one for flow by FWL and, where the file has the true flow, by the endpoint error on pixels with
    events. CHECKPOINT is checkpoint.pt of a training with dase.tasks.
    """
    import json

    from dase.errors import InputError
    from dase.tasks import evaluate

    try:
        late = None if offset == "auto" else float(offset)
    except ValueError:
        raise InputError(f"--offset must be seconds or auto, got '{offset}'") from None
    for file in files:
        found = evaluate(
            checkpoint, file, out=output, offset=late, lpips=lpips, normalise=normalise, device=device,
            **reading,
        )  # fmt: skip
        click.echo(repr(found))
        if output is not None:
            with (output / "results.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps(found.to_json()) + "\n")
