"""How a sensor file came to be: the `[[history]]` entries at its end."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import tomlkit

from dase.errors import InputError, nearest


@dataclass(frozen=True, kw_only=True)
class HistoryEntry:
    """One change of a sensor.

    Errors are those of a comparison with a recording, 1 being what two repeats of one measurement give.
    """

    did: str
    """What was done, such as `add leak`."""
    recording: str | None = None
    """Name of the recording it was measured with, without its folder."""
    error_before: float | None = None
    """Error on held-out data before the change."""
    error_after: float | None = None
    """Error after it."""
    floor: float | None = None
    """Error that chance alone would give."""
    dase: str | None = None
    """Version."""
    date: datetime.date | None = None
    """Day."""

    def text(self) -> str:
        """Return the entry as it stands in a sensor file."""
        lines = ["[[history]]"]
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if value is not None:
                lines.append(f"{f.name} = {tomlkit.item(value).as_string()}")
        return "\n".join(lines) + "\n"


def read_history(value: Any) -> tuple[HistoryEntry, ...]:
    """Return the entries of a sensor file; raises InputError where one is not as `HistoryEntry` says."""
    if not isinstance(value, list) or not all(isinstance(entry, Mapping) for entry in value):
        raise InputError(f"history must be tables [[history]], got {value!r}")
    return tuple(_read_entry(entry) for entry in value)


def _read_entry(table: Mapping[str, Any]) -> HistoryEntry:
    numbers = ("error_before", "error_after", "floor")
    known = [f.name for f in dataclasses.fields(HistoryEntry)]
    for name, value in table.items():
        if name not in known:
            raise InputError(f"history has no entry '{name}': {nearest(name, known)}")
        kind: Any = (int, float) if name in numbers else datetime.date if name == "date" else str
        if not isinstance(value, kind) or isinstance(value, bool):
            what = "a number" if name in numbers else "a date" if name == "date" else "a text"
            raise InputError(f"history.{name} must be {what}, got {value!r}")
    if "did" not in table:
        raise InputError("history: every entry must say what was done, did = '...'")
    return HistoryEntry(**table)
