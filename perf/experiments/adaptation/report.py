"""Tables and pictures of docs/adaptation.md from what perf/experiments/adaptation/run.py left behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perf.experiments.adaptation import figures as run_figures
from perf.experiments.adaptation.rows import SAME, rows

GROUPS = {
    "Target N(0.2, 0.05), endless real data": ("moments", "full", "paper", "surrogate", "anchor"),
    "Global critic, no re-weighting (Table 4)": ("table4",),
    "Attributes of the hash (Table 5)": ("table5",),
    "Without the KL term (Fig. 3)": ("fig3",),
    "Sizes of patches (Fig. 5)": ("fig5",),
    "Finite, disjoint real data": ("finite",),
    "Targets whose thresholds differ from pixel to pixel": ("maps",),
    "A real camera": ("real",),
}

BEGIN, END = "<!-- tables -->", "<!-- end of tables -->"
"""What lies between these is written, the rest of the page is kept."""

JUDGED = {
    "esim": "ESIM's thresholds",
    "rate": "tuned by the event rate (S2R)",
    "random": "broad randomisation",
    "adapted": "learned",
}


def cell(value: Any, digits: int = 2) -> str:
    """Return a number for a table."""
    return "-" if value is None else f"{value:.{digits}g}"


def table(lines: list[dict[str, Any]]) -> list[str]:
    """Return the rows of one group."""
    out = [
        "| row | device, commit | steps | s | KL | raw | active | idle | Δμ | Δσ | s to .01 | slope | corr |",
        "|" + "---|" * 13,
    ]
    for line in sorted(lines, key=lambda line: line["row"]):
        end, jobs = line["last"], line.get("jobs", 6)
        names = ("kl", "raw_kl", "kl_active", "kl_idle", "mu_diff", "sigma_diff")
        numbers = [end.get(k) for k in names]
        where = f"{line['device']}, {line['commit']}" + (f", {jobs} at a time" if jobs > 1 else "")
        figures = [cell(v) for v in (*numbers, line.get("at_001"), end.get("slope"), end.get("correlation"))]
        name = line.get("shown", line["row"])
        out.append(f"| {name} | {where} | {end['step']} | {end['seconds']:.0f} | {' | '.join(figures)} |")
    return out


def judged(lines: list[dict[str, Any]]) -> list[str]:
    """Return how sensors do on the part of a recording that came later, each row's and the baselines."""
    out = [
        "| row | sensor | probes: error | moments | rate | counts | sums of 8x8 | spreads in 8x8 |",
        "|" + "---|" * 8,
    ]
    every = rows()
    for line in lines:
        for key in every[line["row"]].judged:
            found = line["real"][key]
            names = ("probes", "score", "rate", "counts", "patch_sums", "patch_spreads")
            figures = " | ".join(cell(found.get(name), 3) for name in names)
            out.append(f"| {line['row']} | {JUDGED[key]} | {figures} |")
    return out


def read(out: Path) -> dict[str, dict[str, Any]]:
    """Return the last line of every row that came to its end, those of another name too."""
    text = (out / "rows.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines() if line.strip()]
    found = {line["row"]: line for line in lines if "last" in line}
    for name, other in SAME.items():
        if name not in found and other in found:
            found[name] = {**found[other], "row": name, "shown": f"{name} = {other}"}
    return found


def write(out: Path, page: Path) -> None:
    """Write the page from OUT/rows.jsonl, and the pictures beside it."""
    found = read(out)
    parts = []
    for title, starts in GROUPS.items():
        mine = [line for line in found.values() if line["row"].startswith(starts)]
        if mine:
            parts += [f"## {title}", "", *table(mine), ""]
        real = [line for line in mine if line.get("real")]
        if real:
            parts += [*judged(real), ""]
    head, _, rest = page.read_text().partition(BEGIN)
    tail = rest.partition(END)[2]
    shown = run_figures.draw(out, found, page.parent)
    pictures = [f"![{title}]({path.name})\n" for path, title in shown]
    page.write_text(f"{head}{BEGIN}\n\n" + "\n".join([*pictures, *parts]) + f"\n{END}{tail}")
