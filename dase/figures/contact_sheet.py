"""The contact sheet of `dase.figures.event_images`: pictures of moments, the event rate, and intervals
between events."""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Sequence as Items
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter
from numpy.typing import NDArray

from dase.figures.style import Colour, ShownFigure
from dase.formatting import format_seconds
from dase.io.sequence import Sequence
from dase.recordings.interval_statistics import IntervalStatistics
from dase.recordings.statistics import RecordingSurvey, Statistics
from dase.recordings.summary import statistics_table


def draw_contact_sheet(
    sequence: Sequence,
    survey: RecordingSurvey,
    panels: Items[NDArray[np.uint8]],
    times: Items[float],
    window: float,
    title: str,
) -> Figure:
    """Lay out the sheet.

    Args:
        sequence: What is shown.
        survey: What is in it.
        panels: Pictures, each (H, W, 3), red, green, blue.
        times: Their times [s].
        window: Span of the events in each [s].
        title: Name over the sheet.
    """
    begin, end = sequence.span
    aspect = sequence.events.height / sequence.events.width
    figure, pictures, (rate, histogram) = _lay_out(len(times), aspect)
    unknown = sequence.frames is not None and sequence.frame_times is None
    _draw_header(
        figure,
        survey.statistics(),
        title,
        window,
        "times of frames unknown, spread evenly" if unknown else "",
    )
    for axes, panel, time in zip(pictures, panels, times, strict=True):
        # three dots per pixel keep single events sharp where matplotlib interpolates
        axes.imshow(panel.repeat(3, 0).repeat(3, 1), extent=(0, 1, 0, aspect))
        axes.set(xticks=[], yticks=[])
        axes.set_title(_time_label(time, end - begin), fontsize=9, color=Colour.INK, loc="left", pad=3)
    _draw_rate(rate, sequence, times)
    _draw_intervals(histogram, survey.intervals)
    return figure


def _lay_out(count: int, aspect: float) -> tuple[Figure, list[Axes], list[Axes]]:
    """Return a figure with `count` axes of height / width `aspect`, and two for plots below them."""
    columns = min(count, 3 if aspect < 1.2 else 6)
    rows = math.ceil(count / columns)
    wide, side, head, gap, label, foot = 11.0, 0.4, 0.85, 0.15, 0.28, 3.1  # all in inches
    across = min((wide - 2 * side - gap * (columns - 1)) / columns, 6.5 / aspect)
    down = across * aspect
    tall = head + rows * (down + label) + foot
    left = (wide - columns * across - gap * (columns - 1)) / 2
    figure, axes = figure_in_inches(wide, tall)
    pictures = [
        axes(
            left + (k % columns) * (across + gap),
            head + label + (k // columns) * (down + label),
            across,
            down,
        )
        for k in range(count)
    ]
    plots = [axes(x, tall - foot + 0.6, 4.5, 1.9) for x in (side + 0.5, wide - side - 4.5)]
    for plot in plots:
        plot.spines[["top", "right"]].set_visible(False)
    return figure, pictures, plots


def figure_in_inches(wide: float, tall: float) -> tuple[Figure, Callable[[float, float, float, float], Axes]]:
    """Return an empty figure, and what puts pale axes onto it; all in inches from the upper left corner.

    Args:
        wide: Width of the figure.
        tall: Its height.
    """
    figure = ShownFigure(figsize=(wide, tall), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)

    def axes(x: float, y: float, width: float, height: float) -> Axes:
        made = figure.add_axes((x / wide, 1 - (y + height) / tall, width / wide, height / tall))
        made.spines[:].set(color=Colour.LINE, linewidth=0.6)
        made.tick_params(colors=Colour.INK, labelsize=8, color=Colour.LINE, which="both")
        return made

    return figure, axes


def _draw_header(figure: Figure, s: Statistics, title: str, window: float, note: str) -> None:
    tall = figure.get_figheight()
    rows = dict(statistics_table(s))
    facts = [f"{s.width} × {s.height} pixels", format_seconds(s.duration), f"{rows['events']} events"]
    facts += [f"{rows['ON share']} ON"] if s.events else []
    facts += [note] if note else []
    left, right, first, second = 0.4 / 11, 1 - 0.4 / 11, 1 - 0.3 / tall, 1 - 0.57 / tall
    figure.text(
        left, first, title, fontsize=13, color=Colour.INK, weight="bold", va="center", parse_math=False
    )
    figure.text(left, second, "   ".join(facts), fontsize=9, color=Colour.INK, va="center")
    said = f"events of {format_seconds(window)} around each time"
    figure.text(right, first, said, fontsize=9, color=Colour.INK, va="center", ha="right")
    for x, colour, name in ((right - 0.055, Colour.ON, "ON"), (right, Colour.OFF, "OFF")):
        figure.text(x, second, f"\N{BLACK SQUARE} {name}", fontsize=9, color=colour, va="center", ha="right")


def _time_label(time: float, span: float) -> str:
    """Return a time [s] with as many digits as tell moments of a span [s] apart."""
    digits = max(0, 2 - math.floor(math.log10(span))) if span > 0 else 3
    return f"{time:.{digits}f} s"


def _draw_rate(axes: Axes, sequence: Sequence, times: Items[float]) -> None:
    events, (begin, end) = sequence.events, sequence.span
    axes.set_xlabel("time [s]", fontsize=9, color=Colour.INK)
    axes.set_ylabel("event rate [1/s]", fontsize=9, color=Colour.INK)
    if not len(events) or end <= begin:
        return _say_nothing(axes, "no events")
    edges = np.linspace(begin, end, 201)
    bounds = np.searchsorted(events.t, np.append(edges[:-1], np.nextafter(end, math.inf)))
    on = np.array([np.count_nonzero(events.p[i:j]) for i, j in pairwise(bounds)])
    for counts, colour, name in ((on, Colour.ON, "ON"), (np.diff(bounds) - on, Colour.OFF, "OFF")):
        axes.stairs(counts / np.diff(edges), edges, baseline=None, color=colour, linewidth=1.0, label=name)
    axes.set_xlim(begin, end)
    axes.set_ylim(bottom=0)
    axes.plot(
        times, np.zeros(len(times)), "^", color=Colour.QUIET, ms=5, clip_on=False, zorder=3, label="shown"
    )
    axes.yaxis.set_major_formatter(EngFormatter(sep="\N{THIN SPACE}"))
    legend = axes.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=3, fontsize=8, frameon=False)
    for text in legend.get_texts():
        text.set_color(Colour.INK)


def _draw_intervals(axes: Axes, intervals: IntervalStatistics) -> None:
    axes.set_xlabel("time between events of one pixel", fontsize=9, color=Colour.INK)
    axes.set_ylabel("share of intervals [%]", fontsize=9, color=Colour.INK)
    bins = intervals.histogram(12)
    if not bins:
        return _say_nothing(axes, "no pixel with two events")
    least, most = (math.log10(intervals.quantile(share, positive=True)) for share in (0.001, 0.999))
    first, last = math.floor(least), math.floor(most) + 1
    edges = np.logspace(first, last, 12 * (last - first) + 1)
    begin, _, counts = np.array(bins).T
    # outliers, and pairs at one time, which are in no bin of the histogram: in the outer bins
    place = np.clip(np.rint(12 * (np.log10(begin) - first)), 0, len(edges) - 2).astype(np.int64)
    shares = np.bincount(place, counts, minlength=len(edges) - 1).astype(np.float64)
    shares[0] += intervals.zeros
    shares = 100 * shares / intervals.count
    axes.stairs(shares, edges, color=Colour.INK, fill=True, alpha=0.25)
    axes.stairs(shares, edges, color=Colour.INK, linewidth=0.8)
    low, median, high = (intervals.quantile(share) for share in (0.01, 0.5, 0.99))
    axes.axvline(median, color=Colour.INK, linewidth=1.0, linestyle="--")
    axes.set_xscale("log")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_formatter(EngFormatter("s", sep="\N{THIN SPACE}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    said = f"median {format_seconds(median)},  1 to 99 %: {format_seconds(low)} to {format_seconds(high)}"
    axes.set_title(said, fontsize=8, color=Colour.INK, loc="right", pad=5)


def _say_nothing(axes: Axes, why: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.text(
        0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center", color=Colour.QUIET, fontsize=9
    )
