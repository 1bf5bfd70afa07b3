"""Tables of the study: means over seeds, and the share of the gap that each sensor closes.

    python -m perf.experiments.downstream.table RESULTS.jsonl [ROTATION.jsonl]

The gap is that between the tuned and the true sensor of the same seed; 100 % is as good as the true one.
Intervals are those of the mean over seeds (Student's t, 95 %), none for one seed; those of shares are
Fieller's, of paired seeds, and there is none where the gap itself may be 0. With what
`perf.experiments.downstream.rotation` prints, networks of flow on real excerpts, too: their cameras are
none of the targets, so there is no gap. `share` is an error over that of no flow. Prints Markdown.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from perf.experiments.downstream.sensors import KINDS, OF_NO_TARGET, TARGETS

MEASURES = (
    ("reconstruction", "l1", "l1_grey", 4), ("reconstruction", "ssim", "", 3), ("flow", "aee", "aee_zero", 2),
    ("flow", "share", "", 3),
)  # fmt: skip
"""Task, column, column of what is to be had without a network, and decimals of each table."""
TURNED = "flow on real rotation"
"""Task of the lines of `turned_rows`."""

Found = dict[tuple[str, str], dict[int, float]]
"""Values by kind and target, and by seed."""


def mean_text(values: list[float], decimals: int) -> str:
    """Return a mean with half of its interval."""
    if not values:
        return "–"
    text = f"{np.mean(values):.{decimals}f}"
    if len(values) < 2:
        return text
    half = student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{text} ± {half:.{decimals}f}"


def paired_gaps(found: Found, kind: str, target: str) -> tuple[list[float], list[float]]:
    """Return how much better than `tuned` a kind is, and `true` is, one number for each seed of all three."""
    mine, tuned, true = (found.get((one, target), {}) for one in (kind, "tuned", "true"))
    seeds = sorted(mine.keys() & tuned.keys() & true.keys())
    return [mine[s] - tuned[s] for s in seeds], [true[s] - tuned[s] for s in seeds]


def share_interval(part: list[float], whole: list[float]) -> tuple[float, float] | None:
    """Return Fieller's interval (95 %) of the mean of `part` over that of `whole`, whose numbers are pairs.

    None for fewer than two pairs, and where the mean of `whole` may be 0.
    """
    if len(part) < 2:
        return None
    times = student.ppf(0.975, len(part) - 1) ** 2 / len(part)
    (vp, cov), (_, vw) = times * np.cov(part, whole)
    p, w = np.mean(part), np.mean(whole)
    # all shares r for which the mean of part - r · whole may be 0
    a, b, c = w * w - vw, p * w - cov, p * p - vp
    if a <= 0:
        return None
    root = np.sqrt(max(b * b - a * c, 0.0))
    return float((b - root) / a), float((b + root) / a)


def share_text(part: list[float], whole: list[float]) -> str:
    """Return the share of a gap that is closed, with its interval [%]."""
    if not part or np.mean(whole) == 0:
        return "–"
    share, interval = 100 * np.mean(part) / np.mean(whole), share_interval(part, whole)
    if len(part) < 2:
        return f"{share:.0f}"
    return f"{share:.0f} (no clear gap)" if interval is None else (
        f"{share:.0f} ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"
    )  # fmt: skip


def values_of(rows: list[dict], task: str, column: str) -> Found:
    """Return the values of a column by kind and target, and by seed."""
    found: Found = {}
    for row in rows:
        if row["task"] == task and column in row:
            found.setdefault((row["kind"], row["target"]), {})[row["seed"]] = row[column]
    return found


def with_shares(rows: list[dict]) -> list[dict]:
    """Return rows, those of flow with their error over that of no flow."""
    return [{**row, "share": row["aee"] / row["aee_zero"]} if "aee_zero" in row else row for row in rows]


def turned_rows(rows: list[dict]) -> list[dict]:
    """Return lines of `rotation` as those of results: an excerpt is a column; of no target is for all."""
    out = []
    for row in rows:
        _, kind, *target, seed = row["network"].split("-")
        for one in TARGETS if kind in OF_NO_TARGET else target:
            found = {"task": TURNED, "kind": kind, "target": one, "seed": int(seed)}
            out.append({**found, row["excerpt"]: row["share"]})
    return out


def tables(rows: list[dict]) -> str:
    """Return all tables in Markdown."""
    out = []
    names = {name for row in rows if row["task"] == TURNED for name in row}
    excerpts = sorted(names - {"task", "kind", "target", "seed"})
    for task, column, without, decimals in (*MEASURES, *((TURNED, one, "", 3) for one in excerpts)):
        found = values_of(rows, task, column)
        if not found:
            continue
        seeds = sorted({seed for values in found.values() for seed in values})
        out += [f"{task}, {column}, seeds {', '.join(map(str, seeds))}", ""]
        out += [f"| trained on | {' | '.join(TARGETS)} |", "|---|" + "---|" * len(TARGETS)]
        for kind in KINDS:
            cells = [mean_text(list(found.get((kind, t), {}).values()), decimals) for t in TARGETS]
            out.append(f"| {kind} | {' | '.join(cells)} |")
        floor = values_of(rows, task, without)
        if floor:
            # the same for all networks
            each = [[v for (_, t), seeds in floor.items() if t == target for v in seeds.values()]
                    for target in TARGETS]  # fmt: skip
            cells = [mean_text(values[:1], decimals) for values in each]
            out.append(f"| nothing ({without}) | {' | '.join(cells)} |")
        if task != TURNED:
            gaps = [paired_gaps(found, "fitted", t) for t in TARGETS]
            out.append(f"| gap closed by fitted [%] | {' | '.join(share_text(*gap) for gap in gaps)} |")
        out.append("")
    return "\n".join(out)


def read_rows(path: str) -> list[dict]:
    """Return the lines of a file."""
    return [json.loads(line) for line in Path(path).read_text("utf-8").splitlines()]


if __name__ == "__main__":
    results, *turned = map(read_rows, sys.argv[1:])
    print(tables([*with_shares(results), *(row for rows in turned for row in turned_rows(rows))]))
