"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

SCALES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))


def format_count(count: int) -> str:
    """Return a count with its thousands set apart."""
    return f"{count:,}".replace(",", "\N{NO-BREAK SPACE}")


def format_seconds(value: float) -> str:
    """Return a time with three digits in a unit that fits: 12.1 s, 3.25 ms, 75 µs."""
    return format_metric(value, "s")


def format_metric(value: float, unit: str) -> str:
    """Return a quantity with three digits and a prefix that fits; "unknown" where it is not a number."""
    if not math.isfinite(value):
        return "unknown"
    scale, prefix = next((pair for pair in SCALES if abs(value) >= 0.9995 * pair[0]), SCALES[-1])
    digits = max(0, 2 - math.floor(math.log10(abs(value) / scale * 1.0005))) if value else 0
    text = f"{value / scale:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} {prefix}{unit}"


def format_percent(share: float) -> str:
    """Return a share with two or three digits: 0.013 %, 4.2 %, 97 %."""
    if not math.isfinite(share):
        return "unknown"
    value = 100 * share
    digits = 0 if value >= 99.95 or not value else max(0, 1 - math.floor(math.log10(value)))
    return f"{value:.{min(digits, 4)}f} %"


def align_columns(rows: Iterable[Sequence[str]], *, right: Collection[int] = ()) -> list[str]:
    """Return rows of a table as lines, cells two spaces apart.

    Args:
        rows: Cells, as many in every row.
        right: Columns whose cells end below each other, such as numbers.
    """
    table = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if n in right else cell.ljust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    ]


def fit_to_screen(lines: Iterable[str], *, rows: int = 30, columns: int = 100) -> str:
    """Return lines as a text of at most some rows and columns; what is left out is marked by `…`."""
    cut = [line if len(line) <= columns else line[: columns - 1] + "…" for line in lines]
    return "\n".join(cut if len(cut) <= rows else [*cut[: rows - 1], "…"])
