"""Texts that users or strangers wrote: read with limits, parsed without surprises."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from dase.errors import InputError


def read_text_file(path: Path, what: str, largest: int = 1 << 18) -> str:
    """Return the text of a file; ends of lines stay as they are.

    Args:
        path: The file.
        what: What it is, for messages, as "sensor file".
        largest: Bytes that it may have. A sensor with every effect and a long history has some 20 000.

    Raises:
        InputError: It cannot be read, is no UTF-8, or larger than such a file can be.
    """
    try:
        with path.open("rb") as file:
            content = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"{what} {path}: cannot be read ({error.strerror})") from error
    if len(content) > largest:
        raise InputError(f"{what} {path} is larger than {largest >> 10} KiB")
    pointer = stands_for(content)
    if pointer:
        raise InputError(f"{what} {path} {pointer}")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{what} {path} is not UTF-8 text") from error


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Return the tables of a TOML text; raises InputError where it is none, or nested too deeply.

    Whole numbers have 64 bits, as TOML says; Python's have no end, and no real number stands for the largest.
    """
    # a name of 100 000 parts, as in `a.b.c = 1`, takes tomllib minutes, and each part nests one table more
    most = 100
    if any(line.count(".") > most for line in text.splitlines()):
        raise InputError(f"{where} is not TOML that can be read: a line has more than {most} points")
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{where} is not TOML that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{where} is not TOML: {error}") from error
    left: list[Any] = [table]
    while left:
        value = left.pop()
        if isinstance(value, dict | list):
            left += value.values() if isinstance(value, dict) else value
        elif type(value) is int and not -(1 << 63) <= value < 1 << 63:
            raise InputError(f"{where} is not TOML: a whole number of {value.bit_length()} bits, 64 at most")
    return table


def parse_json(text: str | bytes, where: str) -> Any:
    """Return what a JSON text says; raises InputError where it is none, or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise InputError(f"{where} is not JSON that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{where} must be JSON: {error}") from error


def stands_for(head: bytes) -> str:
    """Return what a file is that only stands for another one, as a sentence begun; empty for any other.

    Args:
        head: The first bytes of the file, at least 200 where it has so many.
    """
    if head.startswith(b"version https://git-lfs.github.com/spec/"):
        size = next((line[5:] for line in head.splitlines() if line.startswith(b"size ")), b"")
        told = f" of {int(size):,} bytes" if size[:19].isdigit() else ""
        return f"is a Git LFS pointer, not the file{told} it stands for: `git lfs pull` fetches that"
    if head.startswith((b"/annex/objects/", b"../.git/annex/", b".git/annex/")):
        return "is a git-annex pointer, not the file it stands for: `git annex get` fetches that"
    if head[:64].lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return "is a web page, not the file it was to be: a download that needed more than its address"
    return ""
