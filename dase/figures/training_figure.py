"""A picture of what a training run has learned: scenes, events of both sides, and the maps of thresholds."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from dase.errors import InputError
from dase.figures.contact_sheet import figure_in_inches
from dase.figures.style import Colour


def draw_training(folder: Path) -> tuple[Figure, list[tuple[str, str]]]:
    """Return the picture of a run, and lines of (name, value) that say the same in numbers.

    Args:
        folder: Of the run.

    Raises:
        InputError: The run has not come to its end.
    """
    path = folder / "examples.npz"  # as a training run leaves it
    if not path.is_file():
        raise InputError(f"{folder} holds a run that has not ended; resume it first")
    with np.load(path) as data:
        found = {name: data[name] for name in data.files}
    rows = _read_log(folder / "log.csv")
    figure, pictures, plots = _lay_out(len(found["grey"]), found["grey"].shape[2] / found["grey"].shape[1])
    same = np.allclose(found["grey"], found["real_grey"], atol=2e-3)
    target = "events of the target" if same else "target, other scenes"
    titles = ("scene", target, "simulated events", "mean threshold", "spread")
    scales = {name: tuple(np.percentile(found[name], (1, 99))) for name in ("mu", "sigma")}
    most = float(np.percentile(np.concatenate([found["real"], found["simulated"]]).sum(1), 99.5))
    for n, line in enumerate(pictures):
        line[0].imshow(found["grey"][n], cmap="gray", vmin=0, vmax=1)
        greys = found["real_grey"][n], found["grey"][n]
        for axes, name, grey in zip(line[1:3], ("real", "simulated"), greys, strict=True):
            axes.imshow(_event_picture(found[name][n], grey, max(most, 1.0)))
        for axes, name in zip(line[3:], ("mu", "sigma"), strict=True):
            low, high = scales[name]
            shown = axes.imshow(found[name][n], cmap="viridis", vmin=low, vmax=max(high, low * 1.01))
            if n == 0:
                _draw_scale(figure, axes, shown)
        for axes, title in zip(line, titles, strict=True):
            axes.set(xticks=[], yticks=[])
            if n == 0:
                axes.set_title(title, fontsize=9, color=Colour.INK, loc="left", pad=4)
    _draw_curves(plots, rows)
    tall = figure.get_figheight()
    figure.text(
        0.35 / 11,
        1 - 0.3 / tall,
        folder.name,
        fontsize=13,
        color=Colour.INK,
        weight="bold",
        va="center",
        parse_math=False,
    )
    lines = _summary_lines(rows[-1], found, same=same)
    said = "   ".join(f"{name} {value}" for name, value in lines[:4])
    figure.text(0.35 / 11, 1 - 0.57 / tall, said, fontsize=9, color=Colour.INK, va="center")
    return figure, lines


def _read_log(path: Path) -> list[dict[str, float]]:
    if not path.is_file():
        raise InputError(f"{path} is missing, so the run cannot be drawn")
    with path.open(newline="", encoding="utf-8") as file:
        return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]


def _summary_lines(
    row: dict[str, float], found: dict[str, NDArray[Any]], *, same: bool
) -> list[tuple[str, str]]:
    out = [
        ("thresholds", f"{row['mu']:.3f} ± {row['sigma']:.3f}"),
        ("between pixels", f"± {row['mu_spread']:.3f}"),
        ("ON / OFF", f"{row['ratio']:.3f}"),
        ("steps", f"{row['step']:.0f} in {row['seconds']:.0f} s"),
    ]
    if same:
        ratio = found["simulated"].mean() / max(found["real"].mean(), 1e-9)
        out.append(("events", f"{ratio:.2f} of the target's here"))
    if "kl" in row:
        out.append(("KL from truth", f"{row['kl']:.4f}"))
    return out


def _lay_out(rows: int, aspect: float) -> tuple[Figure, list[list[Axes]], list[Axes]]:
    wide, side, gap, head, foot = 11.0, 0.35, 0.12, 1.0, 2.75  # all in inches
    across = (wide - 2 * side - 4 * gap - 0.75) / 5
    down = across / aspect
    tall = head + rows * (down + gap) + foot
    figure, axes = figure_in_inches(wide, tall)
    pictures = [
        # the maps stand apart, to leave room for their scales
        [
            axes(side + k * (across + gap) + (0.36 if k > 3 else 0), head + n * (down + gap), across, down)
            for k in range(5)
        ]
        for n in range(rows)
    ]
    top = head + rows * (down + gap) + 0.6
    plots = [axes(side + 0.5, top, 4.4, 1.6), axes(wide - side - 4.4, top, 4.4, 1.6)]
    for plot in plots:
        plot.spines[["top", "right"]].set_visible(False)
    return figure, pictures, plots


def _event_picture(counts: NDArray[Any], grey: NDArray[Any], most: float) -> NDArray[np.float64]:
    """Return counts (2, H, W) in colours over a pale picture, shape (H, W, 3)."""
    pale = np.repeat(0.75 + 0.25 * np.clip(grey, 0, 1)[..., None], 3, -1).astype(np.float64)
    total = counts.sum(0)
    on = (counts[1] / np.maximum(total, 1e-9))[..., None]
    colour = on * np.array(to_rgb(Colour.ON)) + (1 - on) * np.array(to_rgb(Colour.OFF))
    opacity = np.where(total > 0, 0.35 + 0.65 * np.minimum(total / most, 1), 0)[..., None]
    return np.asarray(pale * (1 - opacity) + colour * opacity)


def _draw_scale(figure: Figure, axes: Axes, shown: Any) -> None:
    """Draw the scale of a map beside its first picture."""
    box = axes.get_position()
    thin = 0.07 / figure.get_figwidth()
    place = figure.add_axes((box.x1 + 0.6 * thin, box.y0, thin, box.height))
    bar = figure.colorbar(shown, cax=place, ticks=MaxNLocator(4, prune="both"))
    bar.outline.set_visible(False)
    place.tick_params(labelsize=6.5, colors=Colour.INK, length=2, width=0.5, pad=1.5)


def _draw_curves(plots: list[Axes], rows: list[dict[str, float]]) -> None:
    """Draw how the thresholds went, and how far both sides are apart."""
    trained = [row for row in rows if row["step"] >= 0]
    steps = [row["step"] for row in trained]
    for name, label, colour in (("mu", "mean", Colour.INK), ("sigma", "spread", Colour.QUIET)):
        plots[0].plot(steps, [row[name] for row in trained], color=colour, linewidth=1.2, label=label)
    plots[0].set_ylim(bottom=0)
    plots[0].set_ylabel("threshold [log intensity]", fontsize=9, color=Colour.INK)
    shown = [("distance", "distance", Colour.QUIET)]
    shown += [("kl", "KL from the truth", Colour.ON)] if "kl" in trained[-1] else []
    shown += [("held_out", "held out", Colour.OFF)] if any("held_out" in row for row in trained) else []
    for name, label, colour in shown:
        known = [(row["step"], row[name]) for row in trained if row.get(name, 0) > 0]
        if known:
            plots[1].plot(*zip(*known, strict=True), color=colour, linewidth=1.2, label=label)
    plots[1].set_yscale("log")
    for plot in plots:
        plot.set_xlabel("step", fontsize=9, color=Colour.INK)
        legend = plot.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=3, fontsize=8, frameon=False)
        for text in legend.get_texts():
            text.set_color(Colour.INK)
