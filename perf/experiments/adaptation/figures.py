"""Pictures of docs/adaptation.md: how runs went, what was learned, and the maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dase.figures import training_figure
from dase.figures.style import Colour
from dase.learning.targets import TRUTHS

Lines = dict[str, dict[str, Any]]

COLOURS = {"moments": Colour.ON, "full": Colour.OFF}
MAPS = {"intensity": "rise with brightness", "edges": "higher at edges", "column": "by column"}


def draw(out: Path, found: Lines, folder: Path) -> list[tuple[Path, str]]:
    """Write the pictures for which there are rows; return the paths and titles of those for the page.

    What was learned from the recording (the paper's Fig. 6) stays beside its row, as OUT/real-*/learned.png:
    a recording may have no licence.
    """
    shown = []
    for run in sorted(out.glob("real-*/examples.npz")):
        _save(training_figure.draw_training(run.parent)[0], run.with_name("learned.png"))
    if any(name.startswith(tuple(COLOURS)) for name in found):
        shown.append((folder / "adaptation-runs.png", "How runs went, what was learned, sizes of patches"))
        _save(_runs(found), shown[-1][0])
    maps = [name for name in MAPS if (out / f"maps-{name}-moments" / "examples.npz").is_file()]
    if maps:
        shown.append((folder / "adaptation-maps.png", "Learned against true thresholds"))
        _save(_maps(out, maps), shown[-1][0])
    return shown


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path)


def _figure(wide: float, tall: float) -> Figure:
    figure = Figure(figsize=(wide, tall), dpi=150, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _quiet(plot: Axes, title: str, x: str, y: str) -> None:
    plot.spines[["top", "right"]].set_visible(False)
    plot.spines[:].set(color=Colour.LINE, linewidth=0.6)
    plot.tick_params(colors=Colour.INK, labelsize=8, color=Colour.LINE, which="both")
    plot.set_title(title, fontsize=10, color=Colour.INK, loc="left")
    plot.set_xlabel(x, fontsize=9, color=Colour.INK)
    plot.set_ylabel(y, fontsize=9, color=Colour.INK)
    if plot.get_legend_handles_labels()[0]:
        plot.legend(fontsize=8, frameon=False, labelcolor=Colour.INK)


def _runs(found: Lines) -> Figure:
    figure = _figure(11, 3.4)
    curves, densities, sizes = figure.subplots(1, 3)
    names = {"moments": "moments", "full": "critics"}
    for kind, colour in COLOURS.items():
        mine = [line for name, line in found.items() if name.startswith(f"{kind}-")]
        for n, line in enumerate(mine):
            points = [(s, kl) for s, _, kl, _ in line["curve"] if kl is not None and s > 0]
            label = names[kind] if n == 0 else None
            curves.plot(*zip(*points, strict=True), color=colour, linewidth=1, alpha=0.8, label=label)
    curves.axhline(1.5, color=Colour.QUIET, linewidth=0.8, linestyle=":")
    curves.text(15, 1.7, "the paper's full model", fontsize=7, color=Colour.QUIET)
    curves.axhline(0.01, color=Colour.QUIET, linewidth=0.8, linestyle=":")
    curves.set_yscale("log")
    _quiet(curves, "all seeds, both starts", "seconds, others at the same time", "KL from the truth")
    _densities(densities, found)
    points = sorted((int(n[5:]), line["last"]["kl"]) for n, line in found.items() if n.startswith("fig5-"))
    if points:
        sizes.plot(*zip(*points, strict=True), "o-", color=Colour.OFF, linewidth=1.2, markersize=4)
        sizes.set_yscale("log")
    _quiet(sizes, "sizes of patches (Fig. 5)", "side of a patch [px]", "KL from the truth")
    return figure


def _densities(plot: Axes, found: Lines) -> None:
    theta = np.linspace(0.0, 0.5, 400)

    def normal(mu: float, sigma: float) -> Any:
        return np.exp(-0.5 * ((theta - mu) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))

    plot.fill_between(theta, normal(0.2, 0.05), color="#dddddd", linewidth=0, label="truth")
    shown = {
        "full-s0": ("critics", Colour.OFF, "-"),
        "moments-s0": ("moments", Colour.ON, "-"),
        "fig3-no-kl": ("critics, no KL term", Colour.OFF, "--"),
        "fig3-literal": ("straight from the network", Colour.INK, "-"),
        "fig3-literal-no-kl": ("the same, no KL term", Colour.INK, "--"),
    }
    for name, (label, colour, style) in shown.items():
        if name in found:
            last = found[name]["last"]
            sigma = max(last["sigma"], 2e-3)
            plot.plot(
                theta, normal(last["mu"], sigma), color=colour, linestyle=style, linewidth=1.2, label=label
            )
    plot.set_ylim(0, 14)
    _quiet(plot, "what was learned (Fig. 3)", "threshold [log intensity]", "density")


def _maps(out: Path, names: list[str]) -> Figure:
    """Draw learned against true thresholds; photographs themselves are not ours to publish."""
    figure = _figure(3.6 * len(names), 3.9)
    for plot, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        with np.load(out / f"maps-{name}-moments" / "examples.npz") as data:
            grey, got = data["grey"], data["mu"]
        want = TRUTHS[name]()(torch.from_numpy(grey))[0].mean(1).numpy()
        if name == "column":
            want, got = want[0, 0], got.mean((0, 1))
            plot.plot(want, got, ".", color=Colour.OFF, markersize=3, label="a column each")
            low, high = want.min(), want.max()
        else:
            low, high = np.percentile(want, (0.1, 99.9))
            image, x, y = np.histogram2d(want.ravel(), got.ravel(), 120, [(low, high)] * 2)
            plot.pcolormesh(x, y, np.log1p(image.T), cmap="Blues", rasterized=True)
        plot.plot((low, high), (low, high), color=Colour.ON, linewidth=0.8, label="right")
        plot.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        _quiet(plot, f"thresholds: {MAPS[name]}", "true mean threshold", "learned")
    return figure
