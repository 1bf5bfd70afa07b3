"""Writes docs/presets.md from the preset files: python docs/presets.py."""

from __future__ import annotations

from pathlib import Path

from dase.simulation.preset_sources import preset_sources
from dase.simulation.sensor_file import read_presets

HEAD = """# Presets

Built-in sensors: every value with its unit, and where it comes from. `docs/presets.py` writes this page from
the files in `dase/presets`, which `dase presets show NAME` prints, too; edit them. What no source
is given for beside a value is said in the text above its table. How close presets come to recordings is in
[effects.md](effects.md). A preset is where to begin: `dase fit` fits it to a recording of your own camera.
"""


def page() -> str:
    """Return the page."""
    parts = [HEAD]
    for name in sorted(read_presets()):
        found = preset_sources(name)
        parts.append(f"\n## {name}\n\n{found.about}\n\n| | value | source |\n|---|---|---|\n")
        for one in found.values:
            parts.append(f"| `{one.name}` | {one.value} {one.unit}".rstrip() + f" | {one.source} |\n")
    return "".join(parts)


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
