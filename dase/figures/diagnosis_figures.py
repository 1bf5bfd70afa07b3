"""Figures of a comparison and of a diagnosis, from plain arrays; every figure can be read alone."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from dase.figures.style import (
    WIDE,
    Colour,
    Plate,
    add_legend,
    colour_of,
    format_number,
    label_axes,
    log_axis,
    place_axes,
    titled_figure,
)
from dase.results import Curve, Estimate


def _write_beside(
    axes: Axes, text: str, at: tuple[float, float], shift: tuple[float, float], **how: Any
) -> None:
    """Write words beside a point of the data, `shift` in points."""
    how = {"fontsize": 8.5, "color": Colour.INK, "va": "center", **how}
    axes.annotate(text, at, shift, textcoords="offset points", **how)


def draw_staircase(
    steps: Sequence[str],
    errors: Sequence[float],
    *,
    floor: float = 1.0,
    gate: float | None = None,
    stand_ins: int = 0,
) -> Plate:
    """Draw how the error falls with every effect that is added.

    Args:
        steps: What was done, such as `as given`, `fitted`, `+ leak`.
        errors: Held-out error after each, shape (N,).
        floor: Error of two repeats of one measurement.
        gate: Error that 99 of 100 repeats stay below.
        stand_ins: How many of the last steps are not announced, as they do not reach the floor.
    """
    below = gate if gate is not None and math.isfinite(gate) else floor
    done = errors[-1] <= below and not stand_ins
    title = "The error falls to the noise floor" if done else "The error falls, but not to the noise floor"
    if len(errors) < 2:
        title = "The error is at the noise floor" if done else "The error is above the noise floor"
    figure = titled_figure(
        3.62, title, "on pixels and times that no fit has seen; 1 is what repeats of one measurement give"
    )
    axes = place_axes(figure, 0.85, 0.85, WIDE - 1.2, 2.4)
    n = len(errors)
    bottom, top = 0.66 * min([floor, *errors]), 1.45 * max([*errors, below])
    axes.set(xlim=(-0.5, n - 0.5), ylim=(bottom, top))
    axes.axhspan(bottom, below, color=Colour.BOTH, alpha=0.10, lw=0)
    axes.axhline(floor, color=Colour.BOTH, lw=1.2, ls=(0, (4, 2)))
    _draw_stairs(axes, errors, n - stand_ins, bottom)
    for i, error in enumerate(errors):
        # beside the line of the floor, not on it
        shift, side = ((0, -6), "top") if 0.6 * floor < error < floor else ((0, 5), "bottom")
        _write_beside(
            axes, format_number(error), (i, error), shift, fontsize=10, ha="center", va=side, weight="bold"
        )
        above = errors[i - 1] - floor if i else 0.0
        closed = (errors[i - 1] - error) / above if above > 0 else 0.0
        if closed > 0.2 and n < 7 and errors[i - 1] > 1.8 * error:  # else there is no room for words
            said = f"{100 * min(closed, 1.0):.0f} % of the way\nto the floor"
            _write_beside(
                axes, said, (i - 0.5, errors[i - 1]), (6, -1), fontsize=7.5, color=Colour.QUIET, va="top"
            )
    log_axis(axes, "y")
    axes.xaxis.set_major_locator(FixedLocator(list(range(n))))
    axes.set_xticklabels([textwrap.fill(step, max(10, 110 // n)) for step in steps], fontsize=9.5)
    axes.tick_params(axis="x", length=0)
    label_axes(axes, y="held-out error [noise floors]")
    shown = [
        ("line", Colour.INK, "error"),
        ("dash", Colour.BOTH, "noise floor"),
        ("box", Colour.CHANCE, "chance"),
    ]
    add_legend(
        figure, [*shown[:1], *([("dash", Colour.QUIET, "with a stand-in")] if stand_ins else []), *shown[1:]]
    )
    caption = (
        "Each step adds one physical effect and fits all parameters again. "
        f"The dashed line is the noise floor ({format_number(floor)}); inside the green band the model "
        "differs from the measurement by no more than another recording would."
    )
    if stand_ins:
        caption += " Stand-ins are what comes nearest of all effects known; they are not announced as found."
    return Plate(figure, caption)


def _draw_stairs(axes: Axes, errors: Sequence[float], sure: int, bottom: float) -> None:
    """Draw the steps; from the `sure`-th on they are dashed."""
    edges = np.arange(len(errors) + 1) - 0.5
    axes.stairs(errors, edges, baseline=bottom, color=Colour.INK, fill=True, alpha=0.07, lw=0)
    axes.stairs(errors[:sure], edges[: sure + 1], baseline=None, color=Colour.INK, lw=2.2)
    if sure < len(errors):
        x = np.repeat(edges[sure:], 2)[:-1]
        y = np.concatenate([[errors[sure - 1]], np.repeat(errors[sure:], 2)])
        axes.plot(x, y, color=Colour.QUIET, lw=1.8, ls=(0, (3, 1.5)))


def draw_families(errors: dict[str, float], *, floor: float = 1.0, gate: float | None = None) -> Plate:
    """Draw the error of each family of probes.

    Args:
        errors: Family in words to its error.
        floor: Error of two repeats of one measurement.
        gate: Error that 99 of 100 repeats stay below, of the mean over families.
    """
    ranked = sorted(errors.items(), key=lambda item: item[1])
    figure = titled_figure(
        1.4 + 0.27 * len(ranked), "What the model gets wrong", "error per kind of statistic, worst first"
    )
    axes = place_axes(figure, 2.9, 0.8, WIDE - 3.5, 0.27 * len(ranked))
    values = [max(value, 0.0) for _, value in ranked]
    limit = gate if gate is not None and math.isfinite(gate) else 2 * floor
    colours = [Colour.INK if value > limit else Colour.LINE for value in values]
    axes.barh(range(len(ranked)), values, color=colours, height=0.62)
    axes.axvline(floor, color=Colour.BOTH, lw=1.2, ls=(0, (4, 2)))
    for i, value in enumerate(values):
        _write_beside(axes, format_number(value), (value, i), (4, 0), bbox={"color": "white", "pad": 0.8})
    axes.set(xlim=(0, 1.12 * max([*values, 2 * floor])), ylim=(-0.6, len(ranked) - 0.4))
    axes.yaxis.set_major_locator(FixedLocator(list(range(len(ranked)))))
    axes.set_yticklabels([name for name, _ in ranked], fontsize=9)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    label_axes(axes, x="held-out error [noise floors]")
    add_legend(
        figure,
        [
            ("box", Colour.INK, "beyond chance"),
            ("box", Colour.LINE, "within chance"),
            ("dash", Colour.BOTH, "noise floor"),
        ],
    )
    caption = (
        "Each bar is the distance between model and measurement in one kind of statistic, in units of what "
        "two repeats of one measurement differ by. Dark bars are what the model lacks; grey ones are noise."
    )
    return Plate(figure, caption)


def draw_ranking(
    effects: Sequence[str],
    errors: Sequence[float],
    *,
    present: float,
    p_values: Sequence[float],
    chosen: Sequence[str] = (),
    ties: Sequence[str] = (),
    floor: float = 1.0,
    screened: int = 0,
) -> Plate:
    """Draw how far each candidate effect brings the error down.

    Args:
        effects: Names, best first.
        errors: Held-out error with each added and everything refitted.
        present: Error without any of them.
        p_values: Chance of such a fall when the present model is true, corrected over candidates.
        chosen: Those that were added.
        ties: Those that the data cannot tell apart from the chosen.
        floor: Error of two repeats of one measurement.
        screened: Candidates beside these that a first look ruled out.
    """
    n = len(effects)
    found = f"Missing: {' and '.join(chosen)}" if chosen else "No candidate explains the error"
    about = "held-out error with one more effect, everything refitted"
    about += f"; a first look ruled out {screened} more" if screened else ""
    figure = titled_figure(1.42 + 0.25 * n, found, about)
    axes = place_axes(figure, 1.6, 0.85, WIDE - 3.6, 0.25 * n)
    rows = np.arange(n)[::-1]
    low, high = 0.75 * min([floor, *errors]), 1.3 * max([present, *errors])
    for row, effect, error, p in zip(rows, effects, errors, p_values, strict=True):
        colour = Colour.INK if effect in chosen else Colour.QUIET if effect in ties else Colour.LINE
        axes.plot([present, error], [row, row], color=colour, lw=1.6, solid_capstyle="butt")
        axes.plot([error], [row], "o", ms=6, color=colour)
        said = f"p ≤ {format_number(p)}" if p < 0.05 else "by chance" if p > 0.5 else f"p = {p:.2f}"
        note = f"{format_number(error)}   {'' if math.isnan(p) else said}"
        note += "   found" if effect in chosen else "   as good" if effect in ties else ""
        axes.annotate(
            note, (1.02, row), xycoords=("axes fraction", "data"), fontsize=8.5, color=Colour.INK, va="center"
        )
    axes.axvline(present, color=Colour.INK, lw=1)
    axes.axvline(floor, color=Colour.BOTH, lw=1.2, ls=(0, (4, 2)))
    axes.set(xlim=(low, high), ylim=(-0.7, n - 0.3))
    log_axis(axes, "x")
    axes.yaxis.set_major_locator(FixedLocator(list(rows)))
    axes.set_yticklabels(effects, fontsize=9)
    for text, effect in zip(axes.get_yticklabels(), effects, strict=True):
        text.set_fontweight("bold" if effect in chosen else "normal")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    label_axes(axes, x="held-out error [noise floors]")
    add_legend(
        figure,
        [
            ("line", Colour.INK, "without"),
            ("dot", Colour.INK, "with the effect"),
            ("dash", Colour.BOTH, "noise floor"),
        ],
    )
    caption = (
        "Each line runs from the error of the present model to the error with that effect added; the longer "
        "it is, the more the effect explains. p is the chance that noise alone makes the best of all "
        "candidates fall as far."
    )
    return Plate(figure, caption)


def draw_parameters(
    values: Mapping[str, Estimate], ranges: Mapping[str, tuple[float, float]], units: Mapping[str, str]
) -> Plate:
    """Draw fitted parameters with their intervals, each within the range where real cameras lie.

    Args:
        values: `effect.parameter` to its estimate.
        ranges: `effect.parameter` to its plausible range.
        units: `effect.parameter` to its unit.
    """
    n = len(values)
    figure = titled_figure(
        1.0 + 0.32 * n, "Fitted parameters", "with 90 % confidence intervals, within their plausible ranges"
    )
    axes = place_axes(figure, 2.2, 0.8, 4.3, 0.32 * n)
    axes.set(xlim=(-0.06, 1.06), ylim=(-0.6, n - 0.4))
    for row, (name, estimate) in zip(range(n)[::-1], values.items(), strict=True):
        low, high = ranges[name]
        axes.plot([0, 1], [row, row], color=Colour.WASH, lw=9, solid_capstyle="butt", zorder=0)
        at = [_place_in_range(v, low, high) for v in (estimate.low, estimate.value, estimate.high)]
        outside = at[1] in (0.0, 1.0)
        axes.plot([at[0], at[2]], [row, row], color=Colour.BOTH, lw=2.4, solid_capstyle="butt")
        axes.plot(
            [at[1]], [row], "D" if outside else "o", ms=6.5, color=Colour.ON if outside else Colour.BOTH
        )
        for x, value, side in ((0, low, "left"), (1, high, "right")):
            axes.annotate(
                format_number(value), (x, row - 0.36), fontsize=6.5, color=Colour.QUIET, ha=side, va="center"
            )
        unit = "" if units[name] == "1" else f" {units[name]}"
        interval = f"{format_number(estimate.low)} to {format_number(estimate.high)}"
        said = f"{format_number(estimate.value)}{unit}   ({interval})"
        axes.annotate(
            said, (1.03, row), xycoords=("axes fraction", "data"), fontsize=8.5, color=Colour.INK, va="center"
        )
    axes.yaxis.set_major_locator(FixedLocator(list(range(n)[::-1])))
    axes.set_yticklabels(list(values), fontsize=9)
    axes.xaxis.set_major_locator(NullLocator())
    axes.tick_params(axis="y", length=0)
    axes.spines[["left", "bottom"]].set_visible(False)
    caption = (
        "The grey bar is the range in which real cameras lie, logarithmic where it spans more than a factor "
        "of ten; a red diamond means that the fit has reached its end, which is a reason to doubt the model."
    )
    return Plate(figure, caption)


def _place_in_range(value: float, low: float, high: float) -> float:
    """Return where a value lies in a range, 0 to 1."""
    if low > 0 and high / low > 10:
        value, low, high = (math.log(max(v, 1e-300)) for v in (value, low, high))
    return min(max((value - low) / (high - low), 0.0), 1.0)


def draw_curves(title: str, about: str, panels: Sequence[Curve], caption: str) -> Plate:
    """Draw statistics over an axis, measured and simulated, a panel each.

    Args:
        title: What the panels have in common.
        about: How they were made, in a few words.
        panels: At least one; the words ON and OFF in their titles choose the colour.
        caption: What to look for.
    """
    columns = {1: 1, 2: 2, 3: 3, 4: 2, 5: 3, 6: 3, 9: 3}.get(len(panels), 4)
    rows = math.ceil(len(panels) / columns)
    wide = (WIDE - 0.55) / columns
    same_x, same_y = (len({getattr(p, name) for p in panels}) == 1 for name in ("x_label", "y_label"))
    figure = titled_figure(0.95 + 2.55 * rows, title, about)
    colours: list[str] = []
    for i, panel in enumerate(panels):
        row, column = divmod(i, columns)
        axes = place_axes(figure, 0.85 + column * wide, 1.22 + row * 2.55, wide - 0.55, 1.6)
        colours.append(colour_of(panel.title))
        _draw_curve(axes, panel, colours[-1])
        words = textwrap.fill(panel.title, round(11.5 * wide))
        label_axes(axes, "" if same_x else panel.x_label, "" if same_y else panel.y_label, words)
    # what all panels have in common stands once
    once = {"fontsize": 9, "color": Colour.INK, "ha": "center", "va": "center"}
    tall = figure.get_figheight()
    if same_x:
        figure.text(0.5 + 0.15 / WIDE, 0.22 / tall, panels[0].x_label, once)
    if same_y:
        figure.text(0.28 / WIDE, 0.5 - 0.35 / tall, panels[0].y_label, once, rotation=90)
    named = {Colour.ON: "model, ON", Colour.OFF: "model, OFF", Colour.BOTH: "model"}
    entries = [
        ("line", colour, named[colour])
        for colour in (Colour.ON, Colour.OFF, Colour.BOTH)
        if colour in colours
    ]
    dense = any(_is_dense(panel) for panel in panels)
    add_legend(figure, [("line" if dense else "dot", Colour.INK, "measured"), *entries])
    return Plate(figure, caption)


def _is_dense(panel: Curve) -> bool:
    """Whether the points of a curve are too many to be drawn as dots."""
    return len(panel.x) > 60


def _draw_curve(axes: Axes, panel: Curve, colour: str) -> None:
    x = np.asarray(panel.x, float)
    measured, simulated, error = (
        np.asarray(v, float) for v in (panel.measured, panel.simulated, panel.error)
    )
    if panel.log_y:
        both = np.concatenate([measured, simulated])
        # on a logarithmic axis, less than a millionth of the largest is nothing
        positive = both[both > 1e-6 * max(both.max(), 1e-6)]
        least = 0.6 * positive.min() if len(positive) else 0.1
        measured, simulated = np.maximum(measured, least), np.maximum(simulated, least)
    low, high = measured - 2 * error, measured + 2 * error
    axes.fill_between(
        x, np.maximum(low, least) if panel.log_y else low, high, color=Colour.INK, alpha=0.13, lw=0
    )
    axes.plot(x, simulated, color=colour, lw=1.2 if _is_dense(panel) else 2, zorder=3)
    if _is_dense(panel):
        axes.plot(x, measured, color=Colour.INK, lw=0.8, alpha=0.8)
    else:
        axes.plot(x, measured, "o", color=Colour.INK, ms=3.2, zorder=4, clip_on=False)
    if panel.log_x:
        log_axis(axes, "x")
    if panel.log_y:
        log_axis(axes, "y")
    elif np.nanmin([measured.min(), simulated.min()]) >= 0:
        axes.set_ylim(bottom=0)


def draw_powers(
    tried: Mapping[str, Sequence[tuple[float, float]]], *, enough: float, names: tuple[str, str]
) -> Plate:
    """Draw how soon recordings tell two models apart.

    Args:
        tried: Recording to the durations tried [s] and the power of each.
        enough: Power at which two models count as told apart.
        names: Of the models.
    """
    n = len(tried)
    figure = titled_figure(
        1.36 + 0.36 * n, f"Which recording tells {names[0]} from {names[1]}", "share of recordings known"
    )
    axes = place_axes(figure, 1.35, 0.8, WIDE - 1.75, 0.36 * n)
    durations = sorted({seconds for steps in tried.values() for seconds, _ in steps})
    for row, steps in zip(range(n)[::-1], tried.values(), strict=True):
        for seconds, power in steps:
            done = power >= enough
            at = durations.index(seconds)
            across, down = (at - 0.48, at + 0.48), (row - 0.42, row + 0.42)
            axes.fill_between(
                across, *down, color=Colour.BOTH, alpha=1.0 if done else 0.05 + 0.45 * power, lw=0
            )
            colour, weight = ("white", "bold") if done else (Colour.INK, "normal")
            _write_beside(
                axes, f"{100 * power:.0f} %", (at, row), (0, 0), ha="center", color=colour, weight=weight
            )
    axes.set(xlim=(-0.55, max(len(durations), 6) - 0.45), ylim=(-0.5, n - 0.5))
    axes.yaxis.set_major_locator(FixedLocator(list(range(n)[::-1])))
    axes.set_yticklabels(list(tried), fontsize=9)
    axes.xaxis.set_major_locator(FixedLocator(list(range(len(durations)))))
    axes.set_xticklabels([format_number(seconds) for seconds in durations], fontsize=9)
    axes.tick_params(length=0)
    axes.spines[["left", "bottom"]].set_visible(False)
    label_axes(axes, x="duration of the recording [s]")
    caption = (
        f"Share of recordings of {names[1]} that are known when 5 % of those of {names[0]} are mistaken; "
        f"dark fields are at {100 * enough:.0f} % or more, where the search ends."
    )
    return Plate(figure, caption)
