"""One HTML page that opens anywhere and needs nothing else: style, verdict, figures, lists, tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from string import Template

from dase.figures.style import Colour, Plate, format_number
from dase.results import Cell
from dase.version import __version__

PAGE_STYLE = Template("""
:root { color-scheme: light; --ink: $INK; --quiet: $PAGE_QUIET; --line: $PAGE_LINE;
  --wash: $PAGE_WASH; --green: $BOTH; }
* { box-sizing: border-box; }
html { background: #fff; color: var(--ink); font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", "DejaVu Sans", sans-serif; -webkit-text-size-adjust: 100%; }
body { max-width: 60rem; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
header { border-bottom: 1px solid var(--line); padding-bottom: 1.25rem; margin-bottom: 2rem; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0.25rem 0 0.75rem; font-weight: 650;
  letter-spacing: -0.01em; }
h2 { font-size: 1.2rem; margin: 2.75rem 0 0.75rem; font-weight: 650; }
p { margin: 0.5rem 0; max-width: 46rem; }
.small, figcaption, footer { color: var(--quiet); font-size: 0.85rem; line-height: 1.5; }
.verdict { font-size: 1.15rem; border-left: 4px solid var(--green); padding: 0.15rem 0 0.15rem 1rem; }
.verdict.wrong { border-color: $ON; }
figure { margin: 1.5rem 0 2.25rem; }
figure img { width: 100%; height: auto; display: block; border: 1px solid var(--line); border-radius: 6px; }
figcaption { margin-top: 0.6rem; max-width: 46rem; }
ol.cells { padding: 0; list-style: none; margin: 0.75rem 0; }
ol.cells li { padding: 0.45rem 0; border-top: 1px solid var(--line); }
ol.cells li:last-child { border-bottom: 1px solid var(--line); }
.bar { height: 3px; background: var(--ink); margin-top: 0.35rem; border-radius: 2px; }
table { border-collapse: collapse; margin: 0.75rem 0; font-variant-numeric: tabular-nums;
  font-size: 0.95rem; }
th, td { text-align: right; padding: 0.35rem 1.25rem 0.35rem 0; border-top: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; color: var(--quiet); border-top: 0; font-size: 0.85rem; }
th:first-child, td:first-child { text-align: left; }
details { margin: 0.75rem 0; }
summary { cursor: pointer; color: var(--quiet); }
pre { background: var(--wash); padding: 1rem; border-radius: 6px; overflow-x: auto; font-size: 0.82rem;
  line-height: 1.45; }
ul.notes { padding-left: 1.1rem; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: 1rem; }
@media print { body { max-width: none; padding: 0; } figure, li { break-inside: avoid; } }
""")
"""Its colours are names of `Colour`."""


def html_document(title: str, kind: str, body: Iterable[str], seconds: float, foot: str = "") -> str:
    """Return a page.

    Args:
        title: Over everything.
        kind: What it is, above the title.
        body: Parts of HTML; empty ones are left out.
        seconds: Time the work took [s].
        foot: Further words at the end.
    """
    took = f" in {format_number(seconds)} s" if seconds else ""
    made = f"Made by dase {escape(__version__)}{took}."
    style = PAGE_STYLE.substitute({colour.name: colour.value for colour in Colour})
    floor = "1 is the noise floor: the error of two repeats of one measurement."
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f'<header><div class="small">dase {escape(kind)}</div>\n<h1>{escape(title)}</h1>\n</header>\n'
        + "\n".join(part for part in body if part)
        + f"\n<footer>{escape(foot)} {made} {floor}</footer>\n</body>\n</html>\n"
    )


def verdict_html(text: str, *, wrong: bool) -> str:
    """Return the sentence that says it all."""
    return f'<p class="verdict{" wrong" if wrong else ""}">{escape(text)}</p>'


def figure_html(plate: Plate) -> str:
    """Return a figure with its caption."""
    alt, words = escape(f"{plate.title}. {plate.caption}", quote=True), escape(plate.caption)
    return f'<figure><img alt="{alt}" src="{plate.data_uri()}"><figcaption>{words}</figcaption></figure>'


def cells_html(found: Sequence[Cell], nothing: str = "", *, first: int = 12) -> str:
    """Return a list of cells, worst first.

    Args:
        found: At least those that are notable.
        nothing: What is said when there is none.
        first: Cells that are listed at once; the others are folded away.
    """
    if not found:
        return f"<p>{escape(nothing)}</p>" if nothing else ""
    most = max(abs(cell.z) for cell in found) or 1.0
    items = [
        f"<li>{escape(cell.sentence[:1].upper() + cell.sentence[1:])}"
        f'<div class="bar" style="width:{100 * abs(cell.z) / most:.1f}%"></div></li>'
        for cell in found
    ]
    listed, rest = "".join(items[:first]), "".join(items[first:])
    more = folded_html(f"{len(items) - first} more", f'<ol class="cells">{rest}</ol>') if rest else ""
    return f'<ol class="cells">{listed}</ol>{more}'


def table_html(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, empty without rows."""
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    if not lines:
        return ""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    return f"<table><tr>{top}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def folded_html(title: str, html: str) -> str:
    """Return HTML that is folded away under a title."""
    return f"<details><summary>{escape(title)}</summary>{html}</details>" if html else ""


def notes_html(found: Sequence[str]) -> str:
    """Return what the user should keep in mind."""
    items = "".join(f"<li>{escape(note)}</li>" for note in found)
    return f'<h2>To be kept in mind</h2><ul class="notes">{items}</ul>' if items else ""
