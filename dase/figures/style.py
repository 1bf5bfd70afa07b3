"""What all figures of a report have in common: size, colours, title, legend, caption.

The measurement is dark grey or black. What a model makes is coloured: ON events red, OFF events blue, both
together green.
"""

from __future__ import annotations

import base64
import io
import math
import re
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray


class Colour(StrEnum):
    """Every colour of a figure or a page."""

    INK = "#262b30"
    """Words, and what was measured."""

    QUIET = "#80868c"
    """Words and lines that stand behind."""

    LINE = "#c4c8cc"
    """Axes and frames."""

    WASH = "#f3f4f5"
    """Surfaces behind marks."""

    ON = "#c0392b"
    """ON events of a model; also what is wrong."""

    OFF = "#2f6fb5"
    """OFF events of a model."""

    BOTH = "#1d8a6b"
    """Events of both polarities; also the noise floor and what is right."""

    CHANCE = "#dcefe8"
    """`BOTH` at the opacity of the band of chance, for legends."""

    DOUBT = "#c9952b"
    """Where a scene is in doubt, as words."""

    VEIL = "#edc25c"
    """The same laid over a picture."""

    BLIND = "#6f6f6f"
    """Where no frame tells anything, as words."""

    HATCH = "#cccccc"
    """The same as lines over a picture."""

    PAGE_QUIET = "#6b7278"
    """`QUIET` for small letters of a page, which need more contrast."""

    PAGE_LINE = "#e2e5e8"
    """Lines of a page."""

    PAGE_WASH = "#f6f7f8"
    """Surfaces of a page."""


TOO_FEW_TO_TOO_MANY = LinearSegmentedColormap.from_list(
    "dase", ["#1b4f8f", "#86add3", "#f5f5f3", "#dfa67f", "#a23b16"]
)
"""Colours of a map of differences, equal in the middle."""

WIDE = 9.6
"""Width of a figure [inch]."""


class ShownFigure(Figure):
    """A figure that notebooks show although nobody has imported pyplot."""

    def _repr_png_(self) -> bytes:
        out = io.BytesIO()
        self.savefig(out, format="png")
        return out.getvalue()


@dataclass(frozen=True)
class Plate:
    """A figure and the words under it.

    Args:
        figure: Has a title, axis labels with units, and a legend where there is more than one thing.
        caption: One to three sentences: what is drawn, and how to read it.
    """

    figure: Figure
    caption: str

    @property
    def title(self) -> str:
        """Title of the figure."""
        return str(self.figure.texts[0].get_text())

    def alone(self) -> Figure:
        """Return the figure with its caption under it, to be shown or saved without a page around it."""
        lines = textwrap.wrap(self.caption, 125)
        extra = 0.16 * len(lines) + 0.3
        width, height = self.figure.get_size_inches()
        alone = ShownFigure(figsize=(width, height + extra), dpi=self.figure.dpi, facecolor="white")
        FigureCanvasAgg(alone)
        axes = alone.add_axes((0, extra / (height + extra), 1, height / (height + extra)))
        axes.imshow(_rendered_pixels(self.figure), aspect="auto", interpolation="none")
        axes.axis("off")
        alone.text(
            0.3 / width,
            (extra - 0.12) / (height + extra),
            "\n".join(lines),
            va="top",
            fontsize=8.5,
            color=Colour.QUIET,
            linespacing=1.35,
        )
        return alone

    def save(self, path: Path) -> None:
        """Write the figure with its caption, in the format of the suffix."""
        self.alone().savefig(path)

    def svg(self) -> str:
        """Return the figure as an SVG image, letters as shapes, so that it looks the same everywhere."""
        out = io.StringIO()
        with rc_context({"svg.fonttype": "path", "svg.hashsalt": "dase"}):
            self.figure.savefig(out, format="svg", metadata={"Date": None, "Creator": "dase"})
        text = out.getvalue()
        return re.sub(r"\s+", " ", text[text.index("<svg") :])

    def data_uri(self) -> str:
        """Return the figure as a `data:` address for an HTML page."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg().encode()).decode()


def _rendered_pixels(figure: Figure) -> NDArray[np.uint8]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def titled_figure(height: float, title: str, about: str = "") -> Figure:
    """Return an empty figure with a title and a quieter line under it; axes begin 0.75 inch below the top."""
    figure = ShownFigure(figsize=(WIDE, height), dpi=160, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(
        0.3 / WIDE, 1 - 0.24 / height, title, fontsize=12.5, color=Colour.INK, weight="bold", va="center"
    )
    figure.text(0.3 / WIDE, 1 - 0.5 / height, about, fontsize=9, color=Colour.QUIET, va="center")
    return figure


def place_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return quiet axes; all in inches, `top` from the top."""
    wide, tall = figure.get_size_inches()
    axes = figure.add_axes((left / wide, 1 - (top + height) / tall, width / wide, height / tall))
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set(color=Colour.LINE, linewidth=0.8)
    axes.tick_params(colors=Colour.INK, labelsize=8.5, color=Colour.LINE, which="both", length=3)
    return axes


def label_axes(axes: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Name the axes, with units, and the panel."""
    axes.set_xlabel(x, fontsize=9, color=Colour.INK, labelpad=4)
    axes.set_ylabel(y, fontsize=9, color=Colour.INK, labelpad=4)
    axes.set_title(title, fontsize=9.5, color=Colour.INK, loc="left", pad=6)


def add_legend(figure: Figure, entries: Iterable[tuple[str, str, str]], right: float = 0.3) -> None:
    """Write a legend into the top right corner: (kind, colour, words), kind one of `dot`, `line`, `box`."""
    wide, tall = figure.get_size_inches()
    x = wide - right
    for kind, colour, words in reversed(list(entries)):
        said = figure.text(
            x / wide, 1 - 0.24 / tall, words, fontsize=9, color=Colour.INK, ha="right", va="center"
        )
        box = said.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        x -= box.width / figure.dpi + 0.1
        mark = place_axes(figure, x - 0.24, 0.14, 0.24, 0.2)
        mark.axis("off")
        mark.set(xlim=(0, 1), ylim=(0, 1))
        if kind == "dot":
            mark.plot([0.5], [0.5], "o", ms=4.5, color=colour)
        elif kind == "line":
            mark.plot([0, 1], [0.5, 0.5], color=colour, lw=2)
        elif kind == "dash":
            mark.plot([0, 1], [0.5, 0.5], color=colour, lw=1.2, ls=(0, (3, 2)))
        else:
            mark.fill_between([0.1, 0.9], 0.15, 0.85, color=colour, lw=0)
        x -= 0.24 + 0.22


def colour_of(words: str) -> str:
    """Return the colour of what a model makes: red where the words are about ON events, blue for OFF."""
    on, off = (bool(re.search(rf"\b{word}\b", words)) for word in ("ON", "OFF"))
    return Colour.ON if on and not off else Colour.OFF if off and not on else Colour.BOTH


def format_number(value: float) -> str:
    """Return a number with three digits at most, without an exponent where people would not write one."""
    if not math.isfinite(value):
        return "∞" if value > 0 else "−∞" if value < 0 else "?"
    if value and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.1e}".split("e")
        return f"{mantissa}·10" + str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    text = f"{value:.{max(digits, 0)}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")


def log_axis(axes: Axes, which: str) -> None:
    """Make an axis logarithmic, with plain numbers at its ticks."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    decades = math.log10(high / low) if low > 0 else 3
    axis.set_major_locator(LogLocator(subs=(1,) if decades > 2.5 else (1, 3) if decades > 1.2 else (1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: format_number(value)))
    axis.set_minor_formatter(NullFormatter())
