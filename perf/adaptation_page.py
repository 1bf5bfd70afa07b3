"""The tables of docs/adaptation.md from the lines of perf/adaptation.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

GROUPS = {
    "Target N(0.2, 0.05), endless real data": (
        "moments",
        "full",
        "paper",
        "table4",
        "fig3",
        "surrogate",
        "anchor",
    ),
    "Attributes of the hash (Table 5)": ("table5",),
    "Sizes of patches (Fig. 5)": ("fig5",),
    "Finite, disjoint real data": ("finite",),
    "Targets whose thresholds differ from pixel to pixel": ("maps",),
    "A real camera": ("real", "camera"),
}

BEGIN, END = "<!-- tables -->", "<!-- end of tables -->"
"""What lies between these is written, the rest of the page is kept."""


def cell(value: Any, digits: int = 4) -> str:
    """Return a number for a table."""
    return "-" if value is None else f"{value:.{digits}g}"


def table(lines: list[dict[str, Any]], jobs: str) -> list[str]:
    """Return the rows of one group."""
    out = [
        "| row | device, commit | steps | s | KL | raw | active | Δμ | Δσ | s to KL 0.01 | slope | corr. |",
        "|" + "---|" * 12,
    ]
    for line in sorted(lines, key=lambda line: line["row"]):
        end = line["last"]
        numbers = [end.get(k) for k in ("kl", "raw_kl", "kl_active", "mu_diff", "sigma_diff")]
        where = f"{line['device']}, {line['commit']}{jobs}"
        figures = [
            cell(v, 2) for v in (*numbers, line.get("at_001"), end.get("slope"), end.get("correlation"))
        ]
        out.append(
            f"| {line['row']} | {where} | {end['step']} | {end['seconds']:.0f} | {' | '.join(figures)} |"
        )
    return out


def write(out: Path, page: Path, jobs: int) -> None:
    """Write the page from OUT/rows.jsonl."""
    lines = [json.loads(text) for text in (out / "rows.jsonl").read_text().splitlines() if text.strip()]
    parts = []
    for title, starts in GROUPS.items():
        mine = [line for line in lines if line["row"].startswith(starts)]
        if mine:
            parts += [f"## {title}", "", *table(mine, f", {jobs} jobs"), ""]
    head, _, rest = page.read_text().partition(BEGIN)
    tail = rest.partition(END)[2]
    page.write_text(f"{head}{BEGIN}\n\n" + "\n".join(parts) + f"\n{END}{tail}")
