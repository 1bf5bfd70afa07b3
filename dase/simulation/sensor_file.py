"""Sensors in TOML files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Table

from dase.effects import EFFECTS, Effect, find_effect
from dase.errors import InputError, nearest
from dase.files.text_files import parse_toml, read_text_file
from dase.scenes.video import LOG_EPS
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_history import read_history


def read_presets() -> dict[str, str]:
    """Return the built-in sensors: name to TOML text."""
    folder = resources.files("dase.presets")
    files = (f for f in folder.iterdir() if f.name.endswith(".toml"))
    return {f.name.removesuffix(".toml"): f.read_text("utf-8") for f in sorted(files, key=lambda f: f.name)}


def load_sensor(spec: str | Path, effects: Mapping[str, type[Effect]] = EFFECTS) -> Sensor:
    """Return the sensor of a preset or of a TOML file.

    Args:
        spec: Name of a preset, or path of a file.
        effects: Effects the file may name.

    Raises:
        InputError: No such preset or file, not TOML, or a name or value that does not exist.
    """
    return parse_sensor(*read_sensor(spec), effects).located(Path(spec).parent)


def as_sensor(sensor: Sensor | str | PathLike[str]) -> Sensor:
    """Return a sensor however it is given: as it is, or loaded.

    Every function that users call takes its sensor through this one.

    Args:
        sensor: A `Sensor`, the name of a preset, or the path of a sensor file.

    Raises:
        InputError: As `load_sensor`.
        TypeError: It is none of these.
    """
    if isinstance(sensor, Sensor):
        return sensor
    if isinstance(sensor, str | PathLike):
        return load_sensor(fspath(sensor))
    raise TypeError(f"sensor: expected a Sensor, a preset's name or a path, got {type(sensor).__name__}")


def read_sensor(spec: str | Path) -> tuple[str, str]:
    """Return the TOML text of a preset or of a file, and what to call it in messages.

    Raises:
        InputError: No such preset or file, or it is not text.
    """
    path = Path(spec)
    known = read_presets()
    if str(spec) in known:
        return known[str(spec)], f"preset '{spec}'"
    if not path.is_file():
        if path.suffix == ".toml":
            raise InputError(f"sensor file {path} does not exist")
        raise InputError(f"sensor '{spec}' is neither a preset nor a file: {nearest(str(spec), known)}")
    return read_text_file(path, "sensor file"), str(path)


def parse_sensor(text: str, where: str, effects: Mapping[str, type[Effect]] = EFFECTS) -> Sensor:
    """Return the sensor that a TOML text describes.

    Args:
        text: `name`, `size`, `log_eps`, a table for each effect, and the history.
        where: What the user calls the text, for messages.
        effects: Effects the text may name.
    """
    table = parse_toml(text, where)
    try:
        return _sensor_of_table(table, effects)
    except InputError as error:
        raise InputError(f"{where}: {error}", argument=error.argument) from error


def _sensor_of_table(table: dict[str, Any], effects: Mapping[str, type[Effect]]) -> Sensor:
    found: list[Effect] = []
    plain: dict[str, Any] = {}
    for name, value in table.items():
        if name in effects:
            if not isinstance(value, dict):
                raise InputError(f"'{name}' must be a table [{name}], got {value!r}")
            found.append(effects[name].from_table(value))
        elif name == "history":
            plain[name] = read_history(value)
        elif isinstance(value, dict):
            find_effect(name, effects)  # says what there is instead
        elif name in ("name", "size", "log_eps"):
            plain[name] = value
        else:
            known = ("name", "size", "log_eps", "history", *effects)
            raise InputError(f"there is no entry '{name}': {nearest(name, known)}")
    if "size" in plain:
        size = plain["size"]
        if not isinstance(size, list) or len(size) != 2 or not all(type(n) is int for n in size):
            raise InputError(f"size must be two whole numbers [columns, rows], got {size!r}")
        plain["size"] = (size[0], size[1])
    if not isinstance(plain.get("name", ""), str):
        raise InputError(f"name must be a text, got {plain['name']!r}")
    eps = plain.get("log_eps", LOG_EPS)
    if isinstance(eps, bool) or not isinstance(eps, int | float):
        raise InputError(f"log_eps must be a number, got {eps!r}")
    return Sensor(effects=tuple(found), **{"name": "unnamed", **plain})


def dump_sensor(sensor: Sensor) -> str:
    """Return a sensor as TOML text, every parameter with its unit and meaning."""
    document = tomlkit.document()
    for name, value in sensor.to_table().items():
        if isinstance(value, dict):
            break
        document.add(name, value)
    for effect in sensor.effects:
        document.add(tomlkit.nl())
        document.add(effect.name, effect_table(effect, beside=sensor.effects))
    return tomlkit.dumps(document) + "".join(f"\n{entry.text()}" for entry in sensor.history)


def effect_table(effect: Effect, *, beside: Sequence[Effect] = ()) -> Table:
    """Return the table of an effect as it stands in a sensor file, with comments.

    Args:
        effect: To write.
        beside: The effects of the same sensor, to say of what it has that it changes nothing beside them.
    """
    table = tomlkit.table()
    about = {p.name: f"{p.about} [{p.unit}]" for p in effect.parameters()}
    about |= {name: " or ".join(among) for name, among in effect.choices().items()}
    about |= effect.assets()
    about |= {name: f"changes nothing here: {about[name]}" for name in effect.idle(beside) if beside}
    for name in effect.settings():
        table.add(name, tomlkit.item(getattr(effect, name)).comment(about[name]))
    return table
