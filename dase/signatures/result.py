"""What looking for signatures returns: frozen, with plain fields, a short table as repr."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

from dase.formatting import format_count, format_seconds


class Answer(StrEnum):
    """What can be said of an effect."""

    FOUND = "found"
    NOT_SEEN = "not seen"
    CANNOT_SAY = "cannot say"


@dataclass(frozen=True, kw_only=True)
class Signature:
    """What all events of a recording say of one effect.

    Args:
        name: Of the signature, such as `frame coupling`.
        answer: Whether it is there. "cannot say" where data are too few, or where something else that was
            found looks alike; `sentence` gives the reason.
        p: Chance of as much without the effect, not corrected for the number of signatures; not a number
            where nothing was tested.
        size: How large the effect is, in `unit`; not a number where nothing was measured.
        low: Lower end of the 90 % confidence interval of `size`.
        high: Upper end of it.
        unit: Of `size`, in words.
        least: The least size that is announced.
        sentence: The finding, for people.
        details: Numbers beside the size, SI units: frequencies, periods, places.
    """

    name: str
    answer: Answer
    p: float = math.nan
    size: float = math.nan
    low: float = math.nan
    high: float = math.nan
    unit: str = ""
    least: float = math.nan
    sentence: str = ""
    details: dict[str, Any] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        """Compare all fields; numbers that are not known are alike, which no NaN is to itself."""
        if not isinstance(other, Signature):
            return NotImplemented
        mine, theirs = _as_plain(asdict(self)), _as_plain(asdict(other))
        return bool(mine == theirs)

    @property
    def found(self) -> bool:
        """Whether the effect is there."""
        return self.answer is Answer.FOUND


@dataclass(frozen=True)
class Signatures:
    """All signatures of a recording, in the order in which they were looked for.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        events: How many events were looked at.
        duration: From the first to the last [s].
        level: p below which a signature counts, corrected for their number.
        entries: The signatures.
    """

    width: int
    height: int
    events: int
    duration: float
    level: float
    entries: tuple[Signature, ...]

    def __getitem__(self, name: str) -> Signature:
        """Return the signature of a name; raises KeyError for an unknown one."""
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise KeyError(f"{name}: known are {', '.join(entry.name for entry in self.entries)}")

    @property
    def found(self) -> tuple[Signature, ...]:
        """The signatures that are there."""
        return tuple(entry for entry in self.entries if entry.found)

    def lines(self) -> list[str]:
        """Return a table: a line for each signature, below one that says what was looked at."""
        events = f"{format_count(self.events)} events in {format_seconds(self.duration)}"
        size = f"{self.width}x{self.height}, {events}"
        rows = [f"{entry.name:<15} {entry.answer:<10} {entry.sentence}" for entry in self.entries]
        return [f"{'signatures':<15} {size}; false alarms below {self.level:.1g}", *rows]

    def __repr__(self) -> str:
        # a screen has some 100 columns; `lines` has all of it
        return "\n".join(line if len(line) <= 100 else f"{line[:99]}…" for line in self.lines())

    def to_json(self) -> dict[str, Any]:
        """Return what is to be written for machines to read: None where a number is not known."""
        out: dict[str, Any] = _as_plain(asdict(self))
        return out


def _as_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _as_plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_as_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Answer) else value


def without_answer(name: str, reason: str, **known: Any) -> Signature:
    """Return a signature of which nothing can be said, for a reason."""
    return Signature(name=name, answer=Answer.CANNOT_SAY, sentence=reason, **known)


def judge_signature(entry: Signature, level: float, unseen: str) -> Signature:
    """Return a measured signature with its answer.

    One that is large, and rare by chance but not rare enough, is no answer.

    Args:
        entry: Its sentence is for an effect that is there.
        level: Its p must be below.
        unseen: The sentence for one that is not.
    """
    if entry.size >= entry.least and entry.p < 0.01:
        if entry.p < level:
            return replace(entry, answer=Answer.FOUND)
        reason = f"{unseen}; too little to tell it from chance (p {entry.p:.1g})"
        return replace(entry, answer=Answer.CANNOT_SAY, sentence=reason)
    return replace(entry, answer=Answer.NOT_SEEN, sentence=unseen)
