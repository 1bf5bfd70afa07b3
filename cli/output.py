"""What several commands show: how far they are, numbers that need no explanation, pictures."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from dase.figures.style import Plate
    from dase.fitting.measurement import Measurement
    from dase.simulation.sensor import Sensor

STANDARD_OUTPUT = Path("-")
"""The file that stands for what a command prints, in `--json -`."""


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object to a file, or print it."""
    from dase.io import replacing

    text = json.dumps(content, indent=2)
    if path == STANDARD_OUTPUT:
        return click.echo(text)
    with replacing(path) as part:
        part.write_text(text + "\n")


@contextmanager
def progress_bar(quiet: bool, *, pause: float = 10.0) -> Iterator[Callable[[str, float, float], None]]:
    """Show what is being done, how far it is, and the present error: a bar, or in a pipe a line now and then.

    Args:
        quiet: Whether to show nothing.
        pause: Least time between two lines in a pipe [s].
    """
    from tqdm import tqdm

    layout = "{desc:32.32} |{bar}| {postfix}"
    piped, last = not quiet and not sys.stderr.isatty(), time.monotonic()
    with tqdm(total=1.0, disable=True if quiet else None, bar_format=layout, leave=False) as shown:

        def tell(text: str, share: float, error: float) -> None:
            nonlocal last
            known = "" if error != error else f"error {error:.2f}"
            if piped and time.monotonic() - last >= pause:
                last = time.monotonic()
                click.echo(", ".join(filter(None, (text, f"{100 * share:.0f} %", known))), err=True)
            shown.n = share
            shown.set_description_str(text, refresh=False)
            shown.set_postfix_str(known, refresh=False)
            shown.refresh()

        yield tell


def print_plain_numbers(plain: Mapping[str, tuple[float, float]]) -> None:
    """Print what measurement and model have in units that need no explanation."""
    from dase.results import plain_rows

    for name, measured, simulated in plain_rows(plain):
        click.echo(f"  {name:34s} measured {measured:>9s}   simulated {simulated:>9s}")


def plates_or_note(measured: Measurement, sensor: Sensor, *, seed: int, device: str) -> list[Plate]:
    """Return pictures of a measurement beside what a model makes of it; none and a note if that fails."""
    from dase.figures.report import measurement_plates

    try:
        return measurement_plates(measured, sensor, seed=seed, device=device)
    except Exception as error:  # whatever a scene or matplotlib stumbles over
        click.echo(f"note: no pictures of the events: {type(error).__name__}: {error}", err=True)
        return []
