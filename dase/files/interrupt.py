"""Signals that are obeyed where files can be put away cleanly, and workers that end with their parent."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from typing import Any

ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""What a batch system or a closed terminal sends; Windows has no SIGHUP."""


class Terminated(SystemExit):
    """A signal asked the process to end.

    Args:
        number: Of the signal.
    """

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.number = number

    def __str__(self) -> str:
        return signal.Signals(self.number).name


class DeferredInterrupt:
    """An interrupt that waits until `check` is called.

    Args:
        is_told: Whether someone else tells to end, such as the process that started this one.
    """

    def __init__(self, is_told: Callable[[], bool] = lambda: False):
        self._is_told = is_told
        self.number: int | None = None

    def receive(self, number: int, frame: Any = None) -> None:
        """Remember a signal; the first one counts. Takes no lock, as a second signal may come meanwhile."""
        if self.number is None:
            self.number = number

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was an interrupt."""
        if self.number is not None or self._is_told():
            raise KeyboardInterrupt


@contextmanager
def raising_signals() -> Iterator[None]:
    """Raise `Terminated` where SIGTERM or SIGHUP would end the process at once: files are put away.

    What is raised inside of a destructor or of a weak reference's callback is dropped by Python. Such a
    signal, and Ctrl-C, is sent again until it is raised where somebody hears it.
    """

    def end(number: int, frame: Any) -> None:
        raise Terminated(number)

    before = sys.unraisablehook

    def send_again(lost: Any) -> None:
        if isinstance(lost.exc_value, Terminated):
            number = lost.exc_value.number
        elif isinstance(lost.exc_value, KeyboardInterrupt):
            number = signal.SIGINT
        else:
            before(lost)
            return
        # from a thread: sent from here, it would be raised here, and dropped once more
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()

    with _handling(ENDING_SIGNALS, end):
        sys.unraisablehook = send_again
        try:
            yield
        finally:
            sys.unraisablehook = before


@contextmanager
def defer_interrupt() -> Iterator[DeferredInterrupt]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back until `check`: elsewhere a destructor could lose them.

    SIGTERM and SIGHUP then have the effect that they would have had before, when all files are put away.
    """
    interrupt = DeferredInterrupt()
    try:
        with _handling((signal.SIGINT, *ENDING_SIGNALS), interrupt.receive):
            yield interrupt
    finally:
        if interrupt.number is not None and interrupt.number in ENDING_SIGNALS:
            signal.raise_signal(interrupt.number)


@contextmanager
def ignore_interrupt() -> Iterator[None]:
    """Ignore Ctrl-C; processes started meanwhile ignore it for good."""
    with _handling((signal.SIGINT,), signal.SIG_IGN):
        yield


@contextmanager
def _handling(numbers: tuple[int, ...], handler: Any) -> Iterator[None]:
    """Handle signals for a while, but those that are ignored, as `nohup` wants it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    before = {number: signal.getsignal(number) for number in numbers}
    taken = [n for n, old in before.items() if old not in (signal.SIG_IGN, None)]
    for number in taken:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])


class WorkerLife:
    """A worker process that ends with its parent, however that ends, and when it is told.

    A task that runs meanwhile ends at its next `interrupt.check`, which puts its files away; one that does
    not come there within `grace` is left behind.

    Args:
        stop: Shared number, not 0 when the workers are to end; read without a lock, as a worker that is
            killed would never release it.
        grace: Time that a task gets to end [s].
        every: Time between looks [s].
    """

    def __init__(self, stop: Any, *, grace: float = 3.0, every: float = 0.1):
        self._stop, self._grace, self._every = stop, grace, every
        self.interrupt = DeferredInterrupt(lambda: bool(self._stop.value))
        self.busy = threading.Lock()
        """Held while a task runs."""
        for number in ENDING_SIGNALS:
            signal.signal(number, self.interrupt.receive)
        threading.Thread(target=self._watch, daemon=True, name="dase-watch-parent").start()

    def _watch(self) -> None:
        while self._is_wanted():
            time.sleep(self._every)
        self.interrupt.receive(signal.SIGTERM)
        self.busy.acquire(timeout=self._grace)
        os._exit(1)  # the main thread may wait for a task for ever: nobody will send one

    def _is_wanted(self) -> bool:
        parent = parent_process()  # who asked for this process, not the server that it was forked from
        return (parent is None or parent.is_alive()) and self.interrupt.number is None
