"""A sheet of test patterns for printing, in its true size on paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from dase.errors import InputError
from dase.io.sequence import replacing

PAPERS = {"a3": (420.0, 297.0), "a4": (297.0, 210.0), "a5": (210.0, 148.0), "letter": (279.4, 215.9)}
"""Columns and rows of sheets, on their long side [mm]."""

MM_PER_INCH = 25.4


@dataclass(frozen=True)
class SheetSettings:
    """What is on a sheet, and where."""

    margin: float = 10.0
    """White that printers leave [mm]."""
    greys: int = 12
    darkest: float = 0.05
    """Reflectance of the darkest grey: ink on paper does not go far below."""
    bars: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    """Widths of bars [mm]."""
    slant: float = 0.0875
    """Slope of the slanted edge, 5 degrees: its picture is sampled at all parts of a pixel."""
    scale: float = 100.0
    """Length of the line that tells whether the sheet was printed in its size [mm]."""


SHEET = SheetSettings()


def printed_sheet(paper: str = "a4") -> tuple[Figure, dict[str, Any]]:
    """Return a sheet, and what is on it: places from its upper left corner [mm], nominal reflectances.

    Args:
        paper: One of `PAPERS`.

    Raises:
        InputError: The paper is not known.
    """
    if paper not in PAPERS:
        raise InputError(f"paper must be one of {', '.join(PAPERS)}, got '{paper}'", argument="paper")
    (width, height), s = PAPERS[paper], SHEET
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    left, wide, tall = s.margin, width - 2 * s.margin, height - 2 * s.margin - 8
    told: list[dict[str, Any]] = []

    def box(x: float, y: float, w: float, h: float, light: float, kind: str) -> None:
        level = light ** (1 / 2.2)
        axes.add_patch(Rectangle((x, y), w, h, color=(level,) * 3, linewidth=0, antialiased=False))
        if kind:
            told.append({"kind": kind, "box": [x, y, w, h], "reflectance": light})

    top, tallest = s.margin, 0.22 * tall
    for n, light in enumerate(np.geomspace(s.darkest, 0.9, s.greys)):
        box(left + n * wide / s.greys, top, wide / s.greys, tallest, float(light), "grey")
    top += tallest + 0.04 * tall
    for bar in s.bars:
        row = 0.1 * tall
        for n in range(0, int(wide / bar), 2):
            box(left + n * bar, top, bar, row, s.darkest, "")
        told.append({"kind": "bars", "width": bar, "box": [left, top, wide, row], "reflectance": s.darkest})
        top += row + 0.02 * tall
    rest = s.margin + tall - top
    slanted = [(left, top), (left + 0.3 * wide, top), (left + 0.3 * wide - s.slant * rest, top + rest)]
    axes.add_patch(Polygon([*slanted, (left, top + rest)], color=(s.darkest ** (1 / 2.2),) * 3, linewidth=0))
    told.append({"kind": "slanted edge", "corners": [list(corner) for corner in slanted]})
    for n, light in enumerate((0.9, 0.6, 0.4, 0.25, 0.16, 0.1, 0.05)):
        box(left + (0.36 + 0.09 * n) * wide, top, 0.045 * wide, rest, light, "contrast bar")
    line = height - s.margin - 1
    axes.plot([left, left + s.scale], [line, line], color="black", linewidth=1, solid_capstyle="butt")
    axes.text(
        left + s.scale + 3, line, f"{s.scale:g} mm: print at 100 %, without fitting to the page; matt paper",
        fontsize=7, va="center",
    )  # fmt: skip
    return figure, {"paper": paper, "size_mm": [width, height], "scale_mm": s.scale, "parts": told}


def write_sheet(path: Path, *, paper: str = "a4", dpi: float = 300.0) -> dict[str, Any]:
    """Write a sheet into a PDF, SVG or PNG of the paper's size; return what is on it.

    Args:
        path: Its suffix says the format.
        paper: One of `PAPERS`.
        dpi: Dots per inch of a PNG.

    Raises:
        InputError: The paper is not known, or `dpi` is out of range.
    """
    if not 50 <= dpi <= 1200:
        raise InputError(f"dpi must lie in 50..1200, got {dpi:g}", argument="dpi")
    figure, told = printed_sheet(paper)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return told
