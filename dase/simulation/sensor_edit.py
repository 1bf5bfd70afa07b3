"""Sensor files edited as text, so that comments and layout stay as their author made them."""

from __future__ import annotations

import datetime
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tomlkit

from dase.effects import EFFECTS, Effect
from dase.errors import InputError, nearest
from dase.io import replacing
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import effect_table, parse_sensor, read_sensor
from dase.simulation.sensor_history import HistoryEntry
from dase.version import __version__


@dataclass(frozen=True)
class SensorText:
    """A sensor file under edit.

    Args:
        text: TOML.
        where: What the user calls it, for messages.
        effects: Effects it may name.
        folder: In which the text lies; the files of effects are found from there.
    """

    text: str
    where: str
    effects: Mapping[str, type[Effect]] = field(default_factory=lambda: EFFECTS)
    folder: Path = Path()

    def sensor(self) -> Sensor:
        """Return the sensor that the text describes."""
        return parse_sensor(self.text, self.where, self.effects).located(self.folder)

    def with_effect(self, effect: Effect) -> SensorText:
        """Return the text with the table of an effect, placed where it acts.

        Raises:
            InputError: The sensor has the effect already.
        """
        before = self.sensor()
        if effect.name in before:
            raise InputError(f"{self.where} already has effect '{effect.name}': change its values there")
        after = before.with_effect(effect)
        names = [e.name for e in after.effects]
        later = names[names.index(effect.name) + 1 :]
        document = tomlkit.document()
        document.add(effect.name, effect_table(effect))
        block = tomlkit.dumps(document)
        lines = self._lines()
        at = self._span(later[0])[0] if later else self._end(lines)
        head, tail = "".join(lines[:at]).rstrip(), "".join(lines[at:])
        new = "\n\n".join(part for part in (head, block.rstrip(), tail.rstrip()) if part) + "\n"
        return self._checked(new, after)

    def without_effect(self, name: str) -> SensorText:
        """Return the text without the table of an effect and the comment that stands right above it.

        Raises:
            InputError: The sensor does not have the effect, or cannot be without it.
        """
        before = self.sensor()
        if name not in before:
            has = nearest(name, [e.name for e in before.effects])
            raise InputError(f"{self.where} does not have effect '{name}': {has}")
        after = before.without(name)
        begin, end = self._span(name)
        lines = self._lines()
        head, tail = "".join(lines[:begin]).rstrip(), "".join(lines[end:]).lstrip("\n")
        new = "\n\n".join(part for part in (head, tail.rstrip()) if part) + "\n"
        return self._checked(new, after)

    def with_values_of(self, effect: Effect, *, because: str = "fitted") -> SensorText:
        """Return the text with other values of an effect that it has, and `because` as their reason.

        Comments stay. One that is about a value that changes, and not about the parameter or its unit, was
        true of the old one: `on = 0.2 # a guess` becomes `on = 0.23 # fitted (was 0.2: a guess)`.
        """
        document = tomlkit.parse(self.text)
        table: Any = document[effect.name]
        before = self.sensor()
        about: Any = effect_table(effect)
        units = {p.name: f"# {p.unit}" for p in effect.parameters()}
        for name in effect.settings():
            value, old = getattr(effect, name), getattr(before[effect.name], name)
            if value == old:
                continue
            table[name] = value
            comment = table[name].trivia.comment
            known = comment in ("", about[name].trivia.comment, units.get(name))
            if not known and not comment.startswith(f"# {because} (was "):
                table[name].trivia.comment = f"# {because} (was {old}: {comment.lstrip('# ')})"
        return self._checked(tomlkit.dumps(document), before.with_effect(effect))

    def in_folder(self, folder: Path) -> SensorText:
        """Return the text as it stands in another folder: paths of files lead to where they are."""
        sensor = self.sensor()  # which says what is wrong with the text
        document = tomlkit.parse(self.text)
        files = [(e, name) for e in sensor.effects for name in e.assets() if getattr(e, name)]
        if not files or folder.resolve() == self.folder.resolve():
            return self
        for effect, name in files:
            table: Any = document[effect.name]
            table[name] = Path(os.path.relpath(getattr(effect, name), folder.resolve())).as_posix()
        return replace(self, folder=folder)._checked(tomlkit.dumps(document), sensor)

    def describing(self, sensor: Sensor, *, because: str = "fitted") -> SensorText:
        """Return the text that describes another sensor: effects added, removed, or with other values.

        Args:
            sensor: The other one.
            because: Why values are others, for their comments.
        """
        text = self
        for effect in self.sensor().effects:
            if effect.name not in sensor:
                text = text.without_effect(effect.name)
        for effect in sensor.effects:
            if effect.name not in text.sensor():
                text = text.with_effect(effect)
            elif text.sensor()[effect.name] != effect:
                text = text.with_values_of(effect, because=because)
        return text

    def with_history(self, entry: HistoryEntry) -> SensorText:
        """Return the text with one more entry of its history."""
        return self._checked("\n".join([*self._body(), "", entry.text()]), self.sensor())

    def _body(self) -> list[str]:
        return "".join(self._lines()).rstrip().split("\n")

    def _checked(self, text: str, want: Sensor) -> SensorText:
        text = text.replace("\n", "\r\n") if "\r\n" in self.text and "\r\n" not in text else text
        new = replace(self, text=text)
        try:
            right = new.sensor() == want
        except InputError:
            right = False
        if not right:
            raise InputError(f"{self.where} cannot be edited as text: write each effect as a table [name]")
        return new

    def _lines(self) -> list[str]:
        return self.text.replace("\r\n", "\n").splitlines(keepends=True)

    def _end(self, lines: list[str]) -> int:
        """Return the line before which a last effect goes: the end, or the history."""
        history = [i for i, line in enumerate(lines) if re.match(r"\s*\[\[\s*history\s*\]\]", line)]
        return _comment_above(lines, history[0]) if history else len(lines)

    def _span(self, name: str) -> tuple[int, int]:
        """Return the lines of an effect's table, the comment right above it included: begin, end."""
        lines = self._lines()
        header = re.compile(rf"""\s*\[\s*["']?{re.escape(name)}["']?\s*\]""")
        begins = [i for i, line in enumerate(lines) if header.match(line)]
        if len(begins) != 1:
            raise InputError(f"{self.where} cannot be edited as text: write each effect as a table [{name}]")
        begin = begins[0]
        end = next((i for i in range(begin + 1, len(lines)) if re.match(r"\s*\[", lines[i])), len(lines))
        if end < len(lines):
            end = _comment_above(lines, end)
        # what stands apart from the table, behind an empty line, is not about it
        last = max((i for i in range(begin, end) if not re.match(r"\s*(#|$)", lines[i])), default=begin)
        blank = next((i for i in range(last + 1, end) if not lines[i].strip()), end)
        return _comment_above(lines, begin), blank


def _comment_above(lines: list[str], at: int) -> int:
    """Return the first line of the comment that ends right above line `at`, or `at`."""
    while at > 0 and lines[at - 1].lstrip().startswith("#"):
        at -= 1
    return at


def read_sensor_text(spec: str | Path, effects: Mapping[str, type[Effect]] = EFFECTS) -> SensorText:
    """Return the text of a preset or of a sensor file.

    Args:
        spec: Name of a preset, or path of a file.
        effects: Effects it may name.

    Raises:
        InputError: No such preset or file, or it is not text.
    """
    return SensorText(*read_sensor(spec), effects, Path(spec).parent)


def write_sensor_text(sensor: SensorText, path: Path | None) -> None:
    """Write a sensor file, whole or not at all; None prints it."""
    if path is None:
        print(sensor.text, end="")
        return
    with replacing(path) as temporary:
        temporary.write_bytes(sensor.in_folder(path.parent).text.encode())


def history_entry_today(did: str, **facts: Any) -> HistoryEntry:
    """Return a history entry of today."""
    return HistoryEntry(did=did, dase=__version__, date=datetime.date.today(), **facts)


def parse_values(effect: type[Effect], settings: Mapping[str, str]) -> Effect:
    """Return an effect with the values that texts such as `0.2` or `drop` give.

    Raises:
        InputError: An unknown parameter, or a value it cannot have.
    """
    values: dict[str, Any] = {}
    for name, text in settings.items():
        if name in [p.name for p in effect.parameters()]:
            try:
                values[name] = float(text)
            except ValueError:
                raise InputError(f"{effect.name}.{name} must be a number, got '{text}'") from None
        else:
            values[name] = text
    return effect.from_table(values)
