"""Work that does not depend on the processor: how many functions something calls."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


@contextmanager
def counting_calls() -> Iterator[SimpleNamespace]:
    """Count in `.calls` the functions, of Python and C, that this thread calls; not what it counts within."""
    out = SimpleNamespace(calls=0)

    def see(frame: Any, event: str, argument: Any) -> None:
        out.calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(see)
    try:
        yield out
    finally:
        sys.setprofile(before)


def count_calls(act: Callable[[], Any]) -> int:
    """Return how many functions an act calls."""
    with counting_calls() as counted:
        act()
    return int(counted.calls)
