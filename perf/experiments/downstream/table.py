"""Tables of the study: means over seeds, and the share of the gap that each sensor closes.

    python -m perf.experiments.downstream.table RESULTS.jsonl

The gap is that between the tuned and the true sensor of the same seed; 100 % is as good as the true one.
Intervals are those of the mean over seeds (Student's t, 95 %), none for one seed. Prints Markdown.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from perf.experiments.downstream.sensors import KINDS, TARGETS

MEASURES = (("reconstruction", "l1", 4), ("reconstruction", "ssim", 3), ("flow", "aee", 3))
"""Task, column and decimals of each table."""


def mean_text(values: list[float], decimals: int) -> str:
    """Return a mean with half of its interval."""
    if not values:
        return "–"
    text = f"{np.mean(values):.{decimals}f}"
    if len(values) < 2:
        return text
    half = student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{text} ± {half:.{decimals}f}"


def closed_gaps(found: dict[tuple[str, str], dict[int, float]], kind: str, target: str) -> list[float]:
    """Return the share of the gap between `tuned` and `true` that a kind closes [%], one for each seed."""
    mine, tuned, true = (found.get((one, target), {}) for one in (kind, "tuned", "true"))
    seeds = sorted(mine.keys() & tuned.keys() & true.keys())
    return [100 * (mine[s] - tuned[s]) / (true[s] - tuned[s]) for s in seeds if true[s] != tuned[s]]


def tables(rows: list[dict]) -> str:
    """Return all tables in Markdown."""
    out = []
    for task, column, decimals in MEASURES:
        found: dict[tuple[str, str], dict[int, float]] = {}
        for row in rows:
            if row["task"] == task:
                found.setdefault((row["kind"], row["target"]), {})[row["seed"]] = row[column]
        if not found:
            continue
        seeds = sorted({seed for values in found.values() for seed in values})
        out += [f"{task}, {column}, seeds {', '.join(map(str, seeds))}", ""]
        out += [f"| trained on | {' | '.join(TARGETS)} |", "|---|" + "---|" * len(TARGETS)]
        for kind in KINDS:
            cells = [mean_text(list(found.get((kind, t), {}).values()), decimals) for t in TARGETS]
            out.append(f"| {kind} | {' | '.join(cells)} |")
        cells = [mean_text(closed_gaps(found, "fitted", t), 0) for t in TARGETS]
        out += [f"| gap closed by fitted [%] | {' | '.join(cells)} |", ""]
    return "\n".join(out)


if __name__ == "__main__":
    print(tables([json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]))
