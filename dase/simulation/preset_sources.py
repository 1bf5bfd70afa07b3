"""Where the numbers of a preset come from, read from its own file."""

from __future__ import annotations

import re
from dataclasses import dataclass

from dase.effects import EFFECTS
from dase.errors import InputError, nearest
from dase.simulation.sensor_file import read_presets


@dataclass(frozen=True)
class PresetValue:
    """One value of a preset.

    Args:
        name: `effect.parameter`, or a setting of the sensor.
        value: As the file has it.
        unit: Of it; empty for none.
        source: Where it comes from, as the file says; empty where it says nothing of this value alone.
    """

    name: str
    value: str
    unit: str
    source: str


@dataclass(frozen=True)
class PresetSources:
    """What the file of a preset says of its numbers.

    Args:
        name: Of the preset.
        about: What camera it is of, and what was measured or published, one paragraph.
        values: In the order of the file.
    """

    name: str
    about: str
    values: tuple[PresetValue, ...]


def preset_sources(name: str) -> PresetSources:
    """Return where the numbers of a preset come from.

    Comments at the head of its file are of the whole camera. One behind a value, or on lines of its own
    before it, is of that value.

    Raises:
        InputError: There is no such preset.
    """
    known = read_presets()
    if name not in known:
        raise InputError(f"there is no preset '{name}': {nearest(name, known)}")
    about, before = list[str](), list[str]()
    values, table, begun = list[PresetValue](), "", False
    for line in known[name].splitlines():
        if line.startswith("#"):
            (before if begun else about).append(line.lstrip("# "))
        elif line.startswith("["):
            table, before = line.strip("[]"), []
        elif found := re.match(r"(\w+) = ((?:\"[^\"]*\"|[^#\"])*)(?:#\s*(.*))?$", line):
            begun = True
            key, value, said = found[1], found[2].strip(), found[3] or ""
            if table or key == "size":
                source = " ".join([*before, said]).strip()
                values.append(
                    PresetValue(f"{table}.{key}" if table else key, value, _unit_of(table, key), source)
                )
            before = []
    return PresetSources(name, " ".join(about), tuple(values))


def _unit_of(table: str, key: str) -> str:
    """Return the unit of a parameter; empty where it has none or is a word."""
    if not table:
        return "px"
    units = [p.unit for p in EFFECTS[table].parameters() if p.name == key]
    return units[0] if units and units[0] != "1" else ""
