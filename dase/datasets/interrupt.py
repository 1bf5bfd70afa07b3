"""Ctrl-C that is obeyed where files can be put away cleanly."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class DeferredInterrupt:
    """An interrupt that waits until `check` is called; also across processes, through their event."""

    def __init__(self, event: Any):
        self._event = event

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was an interrupt."""
        if self._event.is_set():
            raise KeyboardInterrupt


@contextmanager
def defer_interrupt(event: Any = None) -> Iterator[DeferredInterrupt]:
    """Hold Ctrl-C back until `check`; raised anywhere else it could be lost in a destructor.

    Args:
        event: With `set` and `is_set`, such as a multiprocessing.Event; None makes one for this process.
    """
    event = event or threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield DeferredInterrupt(event)  # only the main thread may handle signals
        return
    before: Callable[..., Any] | int | None = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, lambda number, frame: event.set())
    try:
        yield DeferredInterrupt(event)
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ignore_interrupt() -> Iterator[None]:
    """Ignore Ctrl-C; processes started meanwhile ignore it for good."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
