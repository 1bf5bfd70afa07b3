"""What dase raises when its input is wrong.

ValueError
└── InputError          the sentence is meant for the user, as it stands
"""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable
from typing import Any
from unicodedata import category

SEEDS = 1 << 31
"""Seeds of simulations lie below: a key of random numbers has 31 bits."""


class InputError(ValueError):
    """A file, option or value that dase cannot work with.

    The message names the thing, the rule and the value. The command line prints it and exits with 2. What it
    takes from files and their names cannot steer a terminal, see `printable`.

    Args:
        message: One sentence for the user.
        argument: The argument that cures it, where there is one; a command names its option of that name.
    """

    def __init__(self, message: str = "", *, argument: str | None = None):
        super().__init__(message)
        self.argument = argument

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """Return a text whose every character is shown: others, as those that steer a terminal, become `\\x1b`.

    Ends of lines and tabs stay. What turns the direction of writing, or cannot be encoded, is shown, too.
    """
    if text.isascii() and text.isprintable():
        return text
    hidden = {c for c in set(text) if c not in "\n\t" and category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    for c in hidden:
        text = text.replace(c, c.encode("unicode_escape", "surrogatepass").decode("ascii"))
    return text


def how_to_install(extra: str) -> str:
    """Return how optional dependencies are installed: no package index has dase, its checkout has."""
    return f'in the checkout of dase, pip install ".[{extra}]"'


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint for a misspelt `name`: the nearest known name, or the list of all of them."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known: {', '.join(known)}"


def checked_integer(name: str, value: Any, least: int, end: int | None = None) -> int:
    """Return a whole number; raises InputError where `value` is none, below `least`, or `end` or more.

    Numbers with a fraction are refused, never cut; so are those that stand for a whole one, as 2.0.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if number < least or (end is not None and number >= end) or isinstance(value, bool):
        span = f">= {least}" if end is None else f"in {least}..{end - 1}"
        raise InputError(f"{name} must be a whole number {span}, got {value!r}")
    return number


def checked_seed(seed: Any, end: int = SEEDS) -> int:
    """Return a seed; raises InputError where it is no whole number in 0..end - 1.

    It is never taken modulo anything: two seeds are two sets of random numbers.
    """
    return checked_integer("seed", seed, 0, end)
