"""Which column of a table without names is the time, the column, the row and the polarity of an event.

A user may say it: txyp, xytp and so on. Else it is told from the values: polarities are 0 and 1 or -1 and 1,
times never go back and are the most different ones, columns and rows are whole numbers, columns before rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io.source import Source

LETTERS = {
    "t": "t", "ts": "t", "time": "t", "times": "t", "timestamp": "t", "timestamps": "t",
    "x": "x", "xs": "x", "col": "x", "column": "x",
    "y": "y", "ys": "y", "row": "y",
    "p": "p", "ps": "p", "pol": "p", "polarity": "p", "polarities": "p", "on": "p",
}  # fmt: skip
"""Names of columns, in small letters, to what they hold."""


def checked_order(columns: str) -> str:
    """Return an order that a user gives; raises InputError where it is none."""
    order = columns.lower().replace(",", "").replace(" ", "")
    if sorted(order) != sorted("txyp"):
        raise InputError(
            f"columns must be an order of the letters t, x, y and p, such as txyp, got '{columns}'"
        )
    return order


def named_order(names: Sequence[str]) -> str | None:
    """Return the order of the first four columns of these names, None where they do not tell it."""
    order = "".join(LETTERS.get(name.strip().lower(), "?") for name in names[:4])
    return order if sorted(order) == sorted("txyp") else None


def recognised_order(table: NDArray[Any]) -> str | None:
    """Return the order of the columns of some rows, shape (N, 4), None where no order fits them."""
    rows = np.asarray(table, np.float64)
    if not len(rows):
        return None
    at = range(4)
    binary = [bool(np.all(np.isin(rows[:, k], (-1, 0, 1)))) for k in at]
    sorted_ = [bool(np.all(rows[1:, k] >= rows[:-1, k])) for k in at]
    places = [
        bool(np.all((rows[:, k] == np.floor(rows[:, k])) & (rows[:, k] >= 0) & (rows[:, k] < 1 << 16)))
        for k in at
    ]
    different = [len(np.unique(rows[:, k])) for k in at]
    fitting = []
    # those that tools write come first, so that of two that fit the likelier one is taken
    orders = ("txyp", "xypt", "xytp", *("".join(order) for order in permutations("txyp")))
    for order in dict.fromkeys(orders):
        t, x, y, p = (order.index(letter) for letter in "txyp")
        if binary[p] and sorted_[t] and places[x] and places[y] and x < y:
            fitting.append((-different[t], order))
    # sort is stable: of orders whose times are equally different the likelier one stays first
    return min(fitting, key=lambda one: one[0])[1] if fitting else None


def order_of(source: Source, table: NDArray[Any]) -> str:
    """Return the order of the columns: as the user says, else as these rows (N, 4) tell, which is noted.

    Raises:
        InputError: The rows tell none.
    """
    if source.columns is not None:
        return checked_order(source.columns)
    found = recognised_order(table)
    if found is None:
        raise InputError(
            "its columns have no names, and the values do not tell which is time, column, row and polarity: "
            "columns says it, as txyp"
        )
    note_order(source, found)
    return found


def note_order(source: Source, order: str) -> None:
    """Note an order that was recognised."""
    names = ", ".join({"t": "time", "x": "column", "y": "row", "p": "polarity"}[letter] for letter in order)
    source.note(f"its columns were taken for {names}; columns decides", "assumed", "columns")


def is_micro(times: NDArray[Any]) -> bool:
    """Whether times (N,) are microseconds: whole numbers, of whatever type."""
    return times.dtype.kind in "iu" or bool(np.all(times == np.floor(times)) and np.any(times > 1))
