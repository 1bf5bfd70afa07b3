"""Writes docs/effects.md, the table of all effects: python docs/effects.py."""

from __future__ import annotations

from pathlib import Path

import dase
from dase.effects import Effect, SceneEffect, StreamEffect

HEAD = """# Effects

All physical effects of the sensor model, in the order in which they act. `docs/effects.py` writes this page
from the code; edit the text there. `dase effects show NAME` says more about one.

A parameter stands with its default, its unit and where real cameras lie; *off* is the value at which the
effect changes nothing, bit for bit.

| effect | what it is | stage | parameters | source |
|---|---|---|---|---|
"""


def parameters(effect: type[Effect]) -> str:
    """Return the parameters of an effect, one per line."""
    lines = []
    for p in effect.parameters():
        unit = "" if p.unit == "1" else f" {p.unit}"
        off = "" if p.off is None else f", off at {p.off:g}"
        low, high = p.plausible
        lines.append(f"`{p.name}` = {p.default:g}{unit} ({low:g} to {high:g}{off}): {p.about}")
    lines += [f"`{name}`: {' or '.join(among)}" for name, among in effect.choices().items()]
    return "<br>".join(lines)


def stage(effect: type[Effect]) -> str:
    """Return where an effect acts."""
    if issubclass(effect, SceneEffect | StreamEffect):
        return "optics" if issubclass(effect, SceneEffect) else "readout"
    return ", ".join(effect.stages) or "count"


def page() -> str:
    """Return the page."""
    rows = []
    for name, effect in dase.EFFECTS.items():
        what = effect.about().splitlines()[0]
        rows.append(f"| `{name}` | {what} | {stage(effect)} | {parameters(effect)} | {effect.source} |")
    return HEAD + "\n".join(rows) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
