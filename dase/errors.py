"""What dase raises when its input is wrong.

ValueError
└── InputError          the sentence is meant for the user, as it stands
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """A file, option or value that dase cannot work with.

    The message names the thing, the rule and the value. The command line prints it and exits with 2.

    Args:
        message: One sentence for the user.
        argument: The argument that cures it, where there is one; a command names its option of that name.
    """

    def __init__(self, message: str = "", *, argument: str | None = None):
        super().__init__(message)
        self.argument = argument


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
