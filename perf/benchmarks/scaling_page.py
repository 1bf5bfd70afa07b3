"""The page and the figure of what `scaling.py` measured."""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

Row = dict[str, Any]
FILES = ("scaling_cpu.json", "scaling_cuda.json")
AXES = {"pixels": "pixels", "samples": "samples", "batch": "parameter vectors", "threads": "threads"}
COLOURS = ("#1b6ca8", "#58a4d4", "#e07b39", "#8c3b1f")

TEXT = """# Speed

`python -m perf.benchmarks.scaling --device cpu --out docs` (or `cuda`) measures, writes this page and draws
the figure; edit the text in `perf/benchmarks/scaling_page.py`. Everything is timed in turns beside a copy
of memory, after a run that does not count; times are medians, with the fastest and the slowest round in
brackets. *Share of copy*: bytes of samples read per second over the bytes that the copy reads and writes
per second. `noisy` is `davis346`: mismatch, low-pass, leak, shot noise, refractory period. `counted` keeps
counts per pixel; `events` makes the events, in order of time, in the host's memory. `NumPy` is
`perf/benchmarks/numpy_baseline.py`: the ideal sensor in NumPy and OpenCV, once as it comes to mind and once
tuned. `perf/benchmarks/peers.py` compares with other simulators.

![scaling](scaling.png)
"""


PEERS = """`python -m perf.benchmarks.peers` on one clip, all in turns, each in a process of its own. 8-bit
pictures of a moving photograph go in, events come out, both in memory; esim_py takes files. `photograph
moved` makes the pictures itself, `counted` keeps counts only. The settings are v2e's; `as v2e` is dase with
v2e's `clean`, its lin-log response and its spread of thresholds, for the number of events. OpenEB has no
floor below its logarithm, so black pixels send more events.

`video to HDF5` and `video to DAT` are whole jobs, from an AVI (MJPG) to a file of events. On the AMD EPYC,
clean and noisy, dase is 11.3 and 16.9 times as fast as v2e, both into HDF5, and 140 and 25 times as fast as
OpenEB's sample, both into DAT, because that empties its memory, room for 10^8 events, at every 50,000 events.
With that left out and all events written at the end, dase is 1.7 and 2.9 times as fast as OpenEB. On an Intel
Xeon (family 6, model 167), at 0c92321, others at work: 7 and 15 times v2e (8 and 10 in a second, busier run),
57 and 25 times OpenEB's sample; with its events at the end OpenEB takes 0.6 times as long as dase for the
ideal pixel and 1.3 times for the noisy one.

In memory on the AMD EPYC, one run: the ideal pixel from pictures is 4.9 times as fast as OpenEB and 5.2 times
as the NumPy pipeline (the photograph moved and counted: 1.31 times as the tuned one), the noisy pixel 5.0
times as OpenEB, whose rounds were from 29 to 48 (3.4 times the fastest), and 25 times as v2e. At 4d8d46f it
was 4.5, 3.5, 1.18, 3.3 and 23 times, at 07707fe 5.2, 4.1, 1.25, 3.2 and 23 times, and in two runs
before that, with other programs about, the noisy pixel was at 2.98 and 3.03 times OpenEB, where 3 is the
goal, and the ideal one at 3.6 and 4.5.

On an AMD EPYC without AVX-512 (family 25, model 1), at 13dc7e6, one run, a few other programs about: the
ideal pixel from pictures is 4.8 times as fast as OpenEB and 3.8 times as the NumPy pipeline (moved and
counted: 1.6 times as the tuned one), the noisy pixel 4.4 times as OpenEB; from a video to DAT 109 and 14
times as OpenEB's sample, 1.7 and 3.4 times with its events at the end. v2e was not run there.

To run it: check out prophesee-ai/openeb (5.1 here; Numba is all it needs) and SensorsINI/v2e (cac6384 here),
give their folders as `--openeb` and `--v2e`, and `--processor-time` on a machine that others use, too."""

WHOLE_JOB = """\
`python -m perf.benchmarks.synth --images FOLDER --jobs 2`, 200 photographs, 20 sequences of 1 s, 640x480,
`mixed`, frames and flow at 60 Hz, HDF5. Two quiet cores of an AMD EPYC (family 25, model 17), by the
clock: the present `davis346` takes 35 s at 56c6730 (88,096,752 events; 47 and 45 s at d01e7e2 in the same
run), that of 3859195 takes 33 s (163,618,642 events; 59 s at 3859195 in the same run). In a later run, at
2f4580b, these were 38 and 33 s, and 61 s at 3859195; the first was 36 and 35 s at 12886e8. At fdab943,
two rounds in turns with 3859195: 34.9 and 33.2 s, and 32.1 and 31.7 s for 63.2 and 58.9 (0.51 and 0.54).
At d30e30f they were 34.2 and 33.9 s for 68.3 and 61.9 (0.50 and 0.55), the present `davis346` 39.5 and
38.2 s (a few other programs about), at 2882307 31.6 and 31.4 s for 59.8 and 59.9 (0.53 and 0.52). All
have 163,618,642 events; in the first two sequences every pixel has as many of each polarity in the same
order as at 3859195, and frames and flow are the same to the bit. Times of 2 to 3 % of the events differ
by up to 79 µs, as the law of shot noise, which knows a knee since, rounds otherwise. The goal of 25 s is
missed. On an H100 with 16 cores of an Intel Xeon, at 12886e8 and a5feef4, each time with 3859195 in one
run, the sensor of 3859195 and 163,618,663 events: 15.5 and 14.5 s with one process for 27.5 and 26.7, 8.3
and 7.7 s with eight for 10.6 and 9.5; the present `davis346`, whose bus the processor reads out, 15.3 and
12.7 s, and 9.2 and 8.3 s. At 3bf798f, again with 3859195 in one run, two rounds: 11.5 and 10.2 s with one
process for 32.2 and 27.7, 7.7 and 7.0 s with eight for 9.9 and 9.7; the present `davis346` 13.1 and 10.9
s, and 9.6 and 8.8 s. At 5637f1a 10.9 s for 29.4 with one process (0.37), 7.3 for 11.7 with eight (0.63),
the present `davis346` 13.3 and 9.2 s. On an H200, at c6f74ed, 13.2 and 12.8 s for 34.3 with one process
(0.38), 8.4 and 8.7 for 11.1 and 11.6 with eight (0.75), again in one run; at d30e30f 12.2 and 11.8, 7.7
and 7.8, at c71d701 11.4 and 8.9, 7.2 and 7.3. To import dase and begin with the GPU takes 1.9 s of each.
The goals of 6 and 3 s are missed. `dase.simulate` of the noisy `davis346` (346x260) alone takes 7.6 times
as long there (7.3 to 8.1, 270 ms for 36, 5637f1a; the same at 3bf798f; 7.0 at a8001e3, 254 ms for 37 on
an H200, and 0.71 with the sensor of 3859195; 6.8 at d30e30f, 270 ms for 40) as at 3859195, which had no
bus; the goal was 1.3. `perf/RESULTS.md` has the stages, and why the bus is no work for a GPU as it is."""


def powers(most: int) -> list[int]:
    """Return 1, 2, 4 and so on up to `most`, which is always among them."""
    return sorted({*(2**n for n in range(most.bit_length())), most})


def middle(row: Row) -> float:
    """Return the median time of a row [s]."""
    return statistics.median(row["seconds"])


def chosen(rows: list[Row], axis: str, case: str | None = None) -> list[Row]:
    """Return the rows of an axis, or of one curve of it."""
    return [row for row in rows if row["axis"] == axis and case in (None, row["case"])]


def slope(rows: list[Row]) -> float:
    """Return d log(time) / d log(x) over the upper half of a curve, where fixed costs matter least."""
    upper = rows[len(rows) // 2 if len(rows) > 3 else 0 :]
    x = np.log([row["x"] for row in upper])
    return float(np.polyfit(x, np.log([middle(row) for row in upper]), 1)[0])


def quantities(row: Row, copy: float) -> str:
    """Return time, rates and share of copy of a row, as cells of a table."""
    took, events = middle(row), row["events"]
    spread = f"{1e3 * took:.3g} ({1e3 * min(row['seconds']):.3g} to {1e3 * max(row['seconds']):.3g})"
    share = f"{4 * row['samples'] / took / copy:.1%}" if row["read"] else "-"
    return f"{spread} | {row['samples'] / took / 1e9:.3g} | {events / took / 1e6:.3g} | {share}"


def goal_lines(found: Row) -> list[str]:
    """Return the table of what has a goal."""
    rows, copy = found["rows"], found["copy"]
    lines = ["| what | measured | goal | met |", "|---|---|---|---|"]

    def add(what: str, measured: str, goal: str, met: bool) -> None:
        lines.append(f"| {what} | {measured} | {goal} | {'yes' if met else 'no'} |")

    def rate(case: str, x: float = 0) -> float:
        (row,) = (row for row in chosen(rows, "goal", case) if row["x"] == x)
        return float(row["samples"] / middle(row) / 1e9)

    (training,) = chosen(rows, "goal", "stored log, training kernel")
    speed = training["samples"] / middle(training) / 1e9
    share = 4e9 * speed / copy
    shown = f"{speed:.3g} Gsample/s, {share:.0%} of copy"
    if found["kind"] == "cuda":
        add("counting stored log samples", shown, "90 % of copy", share > 0.9)
        noisy = rate("noisy, stored, counted")
        add("noisy sensor, stored samples, counted", f"{noisy:.3g} Gsample/s", "50 Gsample/s", noisy >= 50)
        clean = rate("ideal, picture warped, counted")
        add("fused clean pixel", f"{clean:.3g} Gsample/s", "200 Gsample/s", clean >= 200)
        return lines
    add("counting stored log samples", shown, "1.2 Gsample/s or 35 % of copy", speed >= 1.2 or share >= 0.35)
    for threads in powers(found["threads"]):
        ours, tuned = (rate(c, threads) for c in ("ideal, picture warped, counted", "NumPy tuned"))
        what = f"fused clean pixel, {threads} thread{'s' if threads > 1 else ''}"
        shown = f"{ours:.3g} Gsample/s, {ours / tuned:.2f} × tuned NumPy ({tuned:.3g})"
        add(what, shown, "1.5 × NumPy", ours >= 1.5 * tuned)
    ours, plain = rate("ideal, picture warped, counted", 1), rate("NumPy plain", 1)
    add("same beside plain NumPy, 1 thread", f"{ours / plain:.2f} × ({plain:.3g})", "-", ours > plain)
    noisy = 1e3 * rate("noisy, stored, events", 1)
    add("noisy sensor with events, 346x260, 1 thread", f"{noisy:.3g} Msample/s", "60 Msample/s", noisy >= 60)
    (busy,) = chosen(rows, "goal", "busy, stored, events")
    events = busy["events"] / middle(busy) / 1e6
    density = f"{busy['events'] / busy['samples']:.2f} events per sample"
    add(f"events in order, 1 thread, {density}", f"{events:.3g} Mevents/s", "40 Mevents/s", events >= 40)
    return lines


def effect_lines(found: Row) -> list[str]:
    """Return the table of what each effect costs."""
    rows, copy = found["rows"], found["copy"]
    (none,) = chosen(rows, "effect", "none")
    lines = ["| effect | alone: ns per sample more | together with all above: ms | Gsample/s | Mevents/s |"]
    lines += ["|---|---|---|---|---|", f"| none | | {quantities(none, copy).rsplit(' | ', 1)[0]} |"]
    for alone, together in zip(*(chosen(rows, "effect", c) for c in ("alone", "together")), strict=True):
        more = 1e9 * (middle(alone) - middle(none)) / none["samples"]
        lines.append(f"| {alone['x']} | {more:.3g} | {quantities(together, copy).rsplit(' | ', 1)[0]} |")
    return lines


def axis_lines(found: Row) -> list[str]:
    """Return the table of all curves."""
    rows = found["rows"]
    lines = [
        "| grows | case | at | ms | Gsample/s | Mevents/s | share of copy |",
        "|---|---|---|---|---|---|---|",
    ]
    for axis in AXES:
        for row in chosen(rows, axis):
            lines.append(f"| {axis} | {row['case']} | {row['x']:,} | {quantities(row, found['copy'])} |")
    return lines


def slope_lines(found: Row) -> list[str]:
    """Return how steep each curve is."""
    lines = ["| grows | case | slope of log time over log x | linear is |", "|---|---|---|---|"]
    for axis in AXES:
        for case in dict.fromkeys(row["case"] for row in chosen(found["rows"], axis)):
            curve = chosen(found["rows"], axis, case)
            if len(curve) > 1:
                lines.append(f"| {axis} | {case} | {slope(curve):.2f} | {-1 if axis == 'threads' else 1} |")
    return lines


def draw_curves(axis: Any, found: Row, name: str) -> None:
    """Draw the curves of one axis, median and spread, with their slopes at their ends."""
    rows, ends = chosen(found["rows"], name), []
    for case, colour in palette(rows).items():
        curve = chosen(rows, name, case)
        x = [row["x"] for row in curve]
        y = np.array([[f(row["seconds"]) for f in (min, statistics.median, max)] for row in curve]) * 1e3
        axis.plot(x, y[:, 1], "o-", color=colour, markersize=4, linewidth=1.6, label=case)
        axis.fill_between(x, y[:, 0], y[:, 2], color=colour, alpha=0.16, linewidth=0)
        ends.append((y[-1, 1], f"{slope(curve):.2f}", colour))
    guide(axis, rows, -1 if name == "threads" else 1)
    axis.set(xscale="log", yscale="log", xlabel=AXES[name], ylabel="time [ms]")
    if name == "threads":
        ticks = [row["x"] for row in rows if row["case"] == rows[0]["case"]]
        axis.set_xticks(ticks, [str(t) for t in ticks])
        axis.minorticks_off()
    write_slopes(axis, ends)


def write_slopes(axis: Any, ends: list[tuple[float, str, str]]) -> None:
    """Write a number right of the end of each curve, none over another."""
    axis.set_ylim(axis.get_ylim())
    least = -1.0
    for y, text, colour in sorted(ends):
        level = axis.transAxes.inverted().transform(axis.transData.transform((axis.get_xlim()[1], y)))[1]
        least = max(level, least + 0.065)
        axis.text(1.01, least, text, transform=axis.transAxes, color=colour, fontsize=9, va="center")


def palette(rows: list[Row]) -> dict[str, str]:
    """Return the cases of some rows, each with its colour, the same in every panel."""
    order = ("ideal, picture warped", "ideal, stored", "noisy, stored, counted", "noisy, stored, events")
    cases = dict.fromkeys(row["case"] for row in rows)
    return {
        case: colour
        for case in cases
        for start, colour in zip(order, COLOURS, strict=True)
        if case.startswith(start)
    }


def guide(axis: Any, rows: list[Row], power: int) -> None:
    """Draw a line of the slope that linear scaling has, below the curves; above those that fall."""
    x = np.array([min(row["x"] for row in rows), max(row["x"] for row in rows)], float)
    at = [1e3 * middle(row) / row["x"] ** power for row in rows]
    level = 0.6 * min(at) if power > 0 else 1.3 * max(at)
    axis.plot(x, level * x**power, ":", color="0.5", linewidth=1, label="linear")


def draw_effects(axis: Any, found: Row) -> None:
    """Draw the cost of every effect alone, and the sum beside the cost of all together."""
    rows = found["rows"]
    (none,) = chosen(rows, "effect", "none")
    base, per = middle(none), 1e9 / none["samples"]
    alone, together = (chosen(rows, "effect", c) for c in ("alone", "together"))
    names = [row["x"] for row in alone]
    place = np.arange(len(names))
    axis.barh(place, [per * max(middle(r) - base, 0) for r in alone], 0.7, color=COLOURS[1], label="alone")
    axis.plot(
        [per * middle(r) for r in together], place, "o-", color=COLOURS[3], markersize=3, linewidth=1.2,
        label="sensor with all above",
    )  # fmt: skip
    sums = per * (base + np.cumsum([max(middle(r) - base, 0) for r in alone]))
    axis.plot(sums, place, ":", color="0.4", linewidth=1, label="their sum")
    axis.set_yticks(place, names, fontsize=9)
    axis.set_ylim(len(names) - 0.4, -2.6)  # the first is at the top, below what the legend takes
    axis.set(xlabel="ns per sample")
    axis.legend(fontsize=9, frameon=False, loc="upper right", borderaxespad=0.1)


def draw(every: list[Row], path: Path) -> None:
    """Draw the panels of each device."""
    figure = plt.figure(figsize=(13, 7.2 * len(every)), layout="constrained")
    parts = figure.subfigures(len(every), 1, squeeze=False, hspace=0.04)[:, 0]
    for part, found in zip(parts, every, strict=True):
        part.suptitle(f"{found['device']}, commit {found['commit']}", fontsize=13, weight="bold")
        names = [name for name in AXES if chosen(found["rows"], name)]
        grid = part.add_gridspec(2, 3)
        # without threads the curve over samples takes the place of two
        spots = [grid[0, 0], grid[0, 1], grid[1, 0], grid[1, 1]] if len(names) == 4 else [
            grid[0, 0], grid[0, 1], grid[1, :2]
        ]  # fmt: skip
        panels = [part.add_subplot(spot) for spot in [*spots, grid[:, 2]]]
        for axis, name in zip(panels, names, strict=False):
            draw_curves(axis, found, name)
        draw_effects(panels[-1], found)
        for axis in panels:
            axis.spines[["top", "right"]].set_visible(False)
            axis.grid(alpha=0.25, linewidth=0.5)
        # colours mean the same in every panel; at the ends of the curves stand their slopes
        lines, cases = panels[0].get_legend_handles_labels()
        part.legend(
            lines, cases, ncols=len(cases), loc="outside lower center", fontsize=9.5, frameon=False,
            title="At the right of a curve: slope of its upper half", title_fontsize=9.5,
        )  # fmt: skip
    figure.savefig(path, dpi=130)
    plt.close(figure)


def section(found: Row) -> str:
    """Return the text about one device."""
    copy = f"copy {found['copy'] / 1e9:.3g} GB/s read plus written"
    threads = f", {found['threads']} threads" if chosen(found["rows"], "threads") else ""
    head = f"## {found['device']}{threads}, commit {found['commit']}, {copy}"
    rows = found["rows"]
    parts = [head]
    if chosen(rows, "goal"):
        parts.append("\n".join(goal_lines(found)))
    if chosen(rows, "effect"):
        parts += ["### What an effect costs", "Stored samples, events made.", "\n".join(effect_lines(found))]
    if chosen(rows, "pixels"):
        parts += ["### How time grows", "\n".join(slope_lines(found)), "\n".join(axis_lines(found))]
    return "\n\n".join(parts)


def beside(folder: Path) -> list[str]:
    """Return what `peers.py` found on each machine, and `memory.py`, if their results are in the folder."""
    parts = []
    memory = folder / "memory.json"
    for place, peers in enumerate(sorted(folder.glob("peers*.json"))):
        found = json.loads(peers.read_text())
        parts += [] if place else ["## Beside other simulators", PEERS]
        names = ("simulator", "setting", "threads", "Mpx-samples/s", "Mevents/s", "events", "peak MiB")
        lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
        for row in found["rows"]:
            cells = [f"{row[n]:.3g}" if isinstance(row[n], float) else str(row[n]) for n in names]
            lines.append(f"| {' | '.join(cells)} |")
        parts += [found["about"] + ":", "\n".join(lines)]
    if memory.exists():
        found = json.loads(memory.read_text())
        last = found["rows"][-1]
        parts += [
            "## All effects on, in flat memory",
            f"`python -m perf.benchmarks.memory`, commit {found['commit']}: {found['effects']} effects, "
            f"{found['size']}, {last['second']:.0f} s in {found['samples']} samples, {last['events']:,} "
            f"events.\nPeak {found['peak'] / 2**20:.0f} MiB; the resident memory grows by "
            f"{found['slope'] / 2**20:.2f} MiB per simulated second.",
        ]
    return parts


def write(folder: Path) -> None:
    """Write `speed.md` and `scaling.png` from what was measured."""
    every = [json.loads((folder / name).read_text()) for name in FILES if (folder / name).exists()]
    whole = ("## A whole job", WHOLE_JOB)
    text = "\n\n".join([TEXT.rstrip(), *map(section, every), *whole, *beside(folder)]) + "\n"
    (folder / "speed.md").write_text(text)
    drawn = [found for found in every if all(chosen(found["rows"], axis) for axis in ("pixels", "effect"))]
    if drawn:
        draw(drawn, folder / "scaling.png")
    for found in every:
        goals = goal_lines(found) if chosen(found["rows"], "goal") else []
        print("\n".join([found["device"], *goals, "", *slope_lines(found), ""]))
