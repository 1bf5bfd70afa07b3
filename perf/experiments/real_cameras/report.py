"""Writes docs/real-cameras.md and its picture from what `real_cameras.py` found."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from dase.figures.event_images import overlay_events
from dase.figures.style import Colour, format_number


def write_page(cameras: Mapping[str, Any], log: Path, out: Path) -> None:
    """Write the page from what was found; recordings that were not diagnosed are left out."""
    found = {}
    for name in cameras:
        if (log / f"{name}.json").exists():
            with np.load(log / f"{name}.npz") as data:
                found[name] = json.loads((log / f"{name}.json").read_text()), dict(data)
    if not found:
        return
    draw(cameras, found, out / "real-cameras.png")
    names = ", ".join(name for name in cameras if name not in found)
    left = f"\nNot diagnosed yet: {names}.\n" if names else ""
    parts = [section(name, cameras[name], *found[name]) for name in found]
    seconds = [what["seconds"] for what, _ in found.values()]
    page = PAGE.format(
        table=table(cameras, found), parts="\n\n".join(parts), left=left, made=made_at(found),
        times=f"{min(seconds):.0f} to {max(seconds):.0f}",
    )  # fmt: skip
    (out / "real-cameras.md").write_text(page)


def made_at(found: Mapping[str, Any]) -> str:
    """Return a sentence with the commits at which recordings were diagnosed."""
    at: dict[str, list[str]] = {}
    for name, (what, _) in found.items():
        at.setdefault(what.get("commit", ""), []).append(name)
    if len(at) == 1:
        return f" All are of commit {next(iter(at))}." if all(at) else ""
    known = (f"{commit or 'unknown'} ({', '.join(names)})" for commit, names in at.items())
    return f" Commits: {', '.join(known)}."


def answer(found: dict[str, Any]) -> str:
    """Return what a diagnosis found, in a few words: effects by how sure they are, and what is left."""
    said = []
    for grade in ("certain", "supported", "either"):
        names = [
            " or ".join((one["effect"], *one["alternatives"], *one["unknown"] * ("something unknown",)))
            for one in found["findings"] if one["grade"] == grade
        ]  # fmt: skip
        said += [f"{grade}: {', '.join(names)}"] if names else []
    left = found["unexplained"]
    if left is not None:
        near = f", nearest {' + '.join(left['nearest'])}" if left["nearest"] else ""
        said.append(f"{100 * left['share']:.0f} % unexplained{near}")
    return "; ".join(said) or "nothing is missing"


def path_of(found: dict[str, Any]) -> tuple[list[str], list[float], int]:
    """Return steps, their errors, and how many of the last are not announced: offered, or stand-ins."""
    steps, errors = ["thresholds"], list(found["errors"])
    steps += [f"+ {name}" for name in found["selected"]]
    left = found["unexplained"]
    all_of = found["findings"]
    offered = [one for one in all_of if one["grade"] == "either" and one["error_with"] is not None]
    if left is None or not left["nearest"]:
        if not offered:
            return steps, errors, 0
        last = "+ " + " + ".join(one["effect"] for one in offered)
        return [*steps, last], [*errors, offered[0]["error_with"]], 1
    history = found["history"]
    after = {a["chosen"]: b["error"] for a, b in pairwise(history) if a["chosen"]}
    names = [*(one["effect"] for one in offered), *left["nearest"]]
    if all(name in after for name in names[:-1]):
        return (
            [*steps, *(f"+ {n}" for n in names)],
            [*errors, *(after[n] for n in names[:-1]), left["error"]],
            len(names),
        )
    return [*steps, "+ " + " + ".join(names)], [*errors, left["error"]], 1


def table(cameras: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Return the table of all recordings."""
    lines = ["| recording | error at first | at last | answer | time |", "|---|---|---|---|---|"]
    for name, (what, _) in found.items():
        _, errors, _ = path_of(what)
        lines.append(
            f"| {name} ({cameras[name].sensor}) | {format_number(errors[0])} | {format_number(errors[-1])} | "
            f"{answer(what)} | {what['seconds']:.0f} s |"
        )
    return "\n".join(lines)


def section(name: str, camera: Any, found: dict[str, Any], facts: dict[str, Any]) -> str:
    """Return what is said of one recording."""
    lines = [f"## {name}", "", f"{camera.sensor}; {camera.shows}. {plain(facts)}", ""]
    lines += [
        f"**{answer(found)}.** " + _estimates(found),
        "",
        "| visible in the events | the diagnosis |",
        "|---|---|",
    ]
    near = found["unexplained"]["nearest"] if found["unexplained"] else []
    grades = {one["effect"]: one["grade"] for one in found["findings"]}
    for words, effects in camera.visible:
        said = [f"{e} ({grades[e]})" for e in effects if e in grades]
        stand = [e for e in effects if e in near]
        verdict = ", ".join(said) if said else f"stand-in: {', '.join(stand)}" if stand else "not found"
        lines.append(f"| {words} | {_threshold(found) if effects == ('threshold',) else verdict} |")
    seen = [one["seen"] for one in found["findings"] if one["seen"]]
    if seen:
        lines += ["", "The events alone show:", "", *(f"- {text}" for text in seen)]
    left = found["unexplained"]
    if left and left["cells"]:
        sits = ", ".join(f"{kind} pixels {100 * share:.0f} %" for kind, share in left["places"].items())
        scene = f"; the scene may be blamed for {100 * left['of_scene']:.0f} % of what the model is off by"
        about = f" ({sits}{scene if left['of_scene'] else ''})" if sits else ""
        lines += ["", f"What stays unexplained{about}, worst first:", ""]
        lines += [f"- {c['sentence']}" for c in left["cells"][:3]]
    if found["record"]:
        lines += ["", "Record next:", "", *(f"- {text}" for text in found["record"])]
    if found["not_seen"]:
        lines += ["", f"Not seen: {'; '.join(one['sentence'] for one in found['not_seen'])}."]
    if found["notes"]:
        lines += ["", *(f"- note: {note}" for note in found["notes"])]
    return "\n".join(lines)


def plain(facts: dict[str, Any]) -> str:
    """Return what can be counted without a model."""
    f = {k: float(facts[k]) for k in ("events", "seconds", "rate", "on", "shortest", "busiest", "hot")}
    return (
        f"{f['events']:,.0f} events in {f['seconds']:.3g} s, {100 * f['on']:.0f} % of them ON; one in a "
        f"thousand intervals of a pixel is shorter than {format_number(1e3 * f['shortest'])} ms; the busiest "
        f"pixel sends {format_number(f['busiest'])} events per second; {f['hot']:,.0f} pixels send ten "
        "times as many as those around them."
    )


def _threshold(found: dict[str, Any]) -> str:
    if not found["parameters_hold"]:
        return "no claim: too much is left"
    both = [found["parameters"].get(f"threshold.{p}") for p in ("on", "off")]
    if None in both:
        return "not fitted"
    on, off = (f"{e['value']:.3g} ({e['low']:.3g} to {e['high']:.3g})" for e in both)
    return f"thresholds ON {on}, OFF {off}"


def _estimates(found: dict[str, Any]) -> str:
    chosen = [(n, e) for n, e in found["parameters"].items()]
    if not found["parameters_hold"]:
        return "Too much is left for any claim about thresholds and other values."
    said = [f"`{n}` {e['value']:.3g} ({e['low']:.3g} to {e['high']:.3g})" for n, e in chosen]
    return f"Fitted, with 90 % intervals: {', '.join(said)}." if said else ""


OPEN = {"davis346_cuke_cradle", "dvx_noise_static"}
"""Recordings of which a picture may be published here: MIT, Apache-2.0."""

CLOSED_IN_A_ROW = 2
"""Staircases of the others, side by side."""


def draw(cameras: Mapping[str, Any], found: Mapping[str, Any], path: Path) -> None:
    """Draw measured events, the model's and the staircase of the error; of closed recordings that alone."""
    shown = {name: both for name, both in found.items() if name in OPEN}
    others = {name: both for name, both in found.items() if name not in OPEN}
    heights = [n for n in (len(shown), -(-len(others) // CLOSED_IN_A_ROW)) if n]
    figure = plt.figure(figsize=(11.5, 2.75 * sum(heights)), layout="constrained")
    figure.get_layout_engine().set(hspace=0.08, wspace=0.03)
    parts = list(figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0])
    if shown:
        lines = parts.pop(0).subplots(len(shown), 3, width_ratios=[1, 1, 1.35], squeeze=False)
        for line, (name, (what, facts)) in zip(lines, shown.items(), strict=True):
            draw_pictures(line[:2], facts, cameras[name].window)
            _name(line[0], name)
            staircase(line[2], what)
    if others:
        axes = parts.pop(0).subplots(heights[-1], CLOSED_IN_A_ROW, squeeze=False).ravel()
        for axis, (name, (what, _)) in zip(axes, others.items(), strict=False):
            staircase(axis, what)
            _name(axis, name)
        for axis in axes[len(others) :]:
            axis.set_axis_off()
    figure.savefig(path, dpi=110, facecolor="white")
    plt.close(figure)


def draw_pictures(axes: Sequence[Axes], facts: Mapping[str, Any], window: float) -> None:
    """Draw events of a window [s], measured and simulated, over the scene's light where it is known."""
    grey = facts["grey"]
    top = max(float(np.percentile(grey, 99.5)), 1e-6)
    calm = np.rint(255 * np.clip(grey / top, 0, 1)).astype(np.uint8) if np.ptp(grey) > 0 else None
    for axis, kind in zip(axes, ("measured", "simulated"), strict=True):
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[:].set(color=Colour.QUIET, linewidth=0.5)
        axis.imshow(_large(overlay_events(calm, facts[kind])), interpolation="nearest")
        axis.set_title(f"{kind}, {1e3 * window:g} ms", fontsize=8.5, color=Colour.QUIET, pad=4)


def _name(axis: Axes, name: str) -> None:
    axis.set_title(f"{name}\n", fontsize=10.5, color=Colour.INK, weight="bold", loc="left", pad=2)


def _large(picture: np.ndarray) -> np.ndarray:
    """Return a picture of sensible size: single events stay visible when it is shrunk."""
    size = max(1, round(900 / picture.shape[1]))
    return picture.repeat(size, 0).repeat(size, 1)


def staircase(axis: Axes, found: dict[str, Any]) -> None:
    """Draw the falling error into an axis; what is not announced is dashed."""
    steps, errors, stand_ins = path_of(found)
    n, gate = len(errors), max(found["gate"], 1.0)
    sure, edges = n - stand_ins, np.arange(n + 1) - 0.5
    axis.set_yscale("log")
    axis.axhspan(1e-3, gate, color=Colour.BOTH, alpha=0.10, lw=0)
    axis.axhline(1, color=Colour.BOTH, lw=1.2, ls=(0, (4, 2)))
    axis.stairs(errors, edges, baseline=1e-3, fill=True, color=Colour.INK, alpha=0.07, lw=0)
    axis.stairs(errors[:sure], edges[: sure + 1], baseline=None, color=Colour.INK, lw=2)
    if stand_ins:
        x = np.repeat(edges[sure:], 2)[:-1]
        axis.plot(
            x, [errors[sure - 1], *np.repeat(errors[sure:], 2)], color=Colour.QUIET, lw=1.7, ls=(0, (3, 1.5))
        )
    for k, error in enumerate(errors):
        below = 0.6 < error < 1  # beside the line of the floor, not on it
        axis.annotate(
            format_number(error), (k, error), (0, -12 if below else 4), textcoords="offset points",
            ha="center", weight="bold", fontsize=9, color=Colour.INK if k < sure else Colour.QUIET,
        )  # fmt: skip
    axis.set_ylim(0.5 * min(1.0, *errors), 2.2 * max(*errors, gate))
    axis.set_xlim(-0.5, max(n, 3) - 0.5)
    size = 8.5 if n < 6 else 7
    axis.set_xticks(range(n), [s.replace(" + ", "\n+ ").strip() for s in steps], fontsize=size)
    axis.tick_params(axis="x", length=0)
    axis.tick_params(axis="y", labelsize=8)
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_title(
        "error on held-out pixels and time" + (" (dashed: not announced)" if stand_ins else ""),
        fontsize=8.5, color=Colour.QUIET, pad=4,
    )  # fmt: skip


PAGE = """# Real cameras

`perf/experiments/real_cameras/run.py` writes this page; edit the text there and in
`perf/experiments/real_cameras/report.py`. Each recording is compared with a sensor that has thresholds alone,
and `dase diagnose --auto` looks for what is missing. The error is that of pixels and times that no fit has
seen; 1 is what two repeats of the recording would have.{made}

{table}
{left}
![measured events, simulated events, and the falling error of each recording](real-cameras.png)

Left: measured. Middle: what the announced model makes of the same scene at the same time. Right:
the error with each effect added; the green band is what chance reaches, dashed steps are stand-ins
that are not announced; an announced effect can raise the error as long as what goes with it is missing.
Red is ON, blue is OFF. Of recordings that have no licence for it no events
are shown, only the error.

What is *certain* the events show without any scene; all else is said given the scene. The scene
between two frames of a camera is a guess: only where it can be trusted anything is compared (see
[scenes](scenes.md)), and what it may be blamed for is said beside what stays unexplained.
Thresholds are no claim where more than a tenth of the error is left. [How to read
this](reading-a-diagnosis.md).

What is certain is looked for in all events. In `davis240c_camerashake` that is all that can be seen by eye:
frame coupling, the lamps at 100.15 Hz and rows that are read together. Its first second alone, which was
looked at until c1cbc74, has seven frames, too few for bursts to be seen in step with them.

The frames of `davis240b_evbench1` have no times: they are set as far apart as its bursts are, 50.96 ms. At
whole milliseconds (51 ms) the bursts that are left out drifted by 0.8 ms, and its light at 120 Hz was too
little to tell from chance. Four of its five hot pixels are named; the fifth (27, 70) sends 990 events per
second where edges pass all the time, so none of them is calm.

Rows of `psee_gen31_dot` and columns of `davis346_cuke_cradle` were called grouped until signatures knew
edges that move, which make the same; of either too few events are left beside edges to say anything.

The light of `davis346_cuke_cradle` and `davis240b_evbench1` between their few frames is a guess, and what
fits it best beside what is certain hangs on little: at 5430f9d the same effects were certain, and with
four stand-ins, each *either that or something unknown*, errors of 0.63 and 0.99 were left; at 0da8282 two
of each left 1.2 and 1.8, at a8d1f3c 0.96 and 2.1, here two leave 1.2 and 2.1. The dot of `psee_gen31_dot`
has a blurred lens, *supported*, and one or two poles here and at 0da8282, which leave 2.1 and 1.7 of 95; at
a8d1f3c noise, a pole and a dead time left 8.1 of 56, none of them announced: what light a dot makes that is
in no frame is a guess, too.

Times are of two cores of an AMD EPYC (family 25, model 17) with kernels compiled on the way: {times} s. At
0da8282 they were 30 to 117 s there, at a8d1f3c 78 to 424 s on a core and a half of a slower one (family 23,
model 1), at 2323c88 51 to 706 s on a shared core. Since then pixels and models are fewer far from the floor
and where light between frames is a guess, and a bus is no rival where the stamps say that it was never busy.

`noise_iebcs` has ON events alone in the light, 0.06 Hz at 161 and 0.13 Hz at 3,000 lux, beside 9.7 Hz at 0.1
lux. Two seconds have some 25 of them among the pixels that are compared, and no leak is found. Tried and
not kept: a third kind of shot noise (gone at a tenth of the light of the second: `knee` 0.0022, `bright` 0),
which took away the events that were too many at 161 lux (12.7 times) at the cost of a model more in every
search; with it, and 10 s of events, leak came nearest (error 1.19 to 0.56 beside shot noise, mismatch and
dark current) and was not found.

{parts}

## Again

```sh
python -m perf.experiments.real_cameras.run $DASE_DATA/recordings --again
```
"""
