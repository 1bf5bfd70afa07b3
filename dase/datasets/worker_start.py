"""How worker processes start: forked from a server that has imported everything while its caller did.

Each would need most of a second for its own imports, beside those of its caller and of the others. The server
does nothing but import: it has no kernels, no GPU and no thread that could hold a lock.
"""

from __future__ import annotations

from multiprocessing import forkserver, get_all_start_methods, get_context
from typing import Any

from dase.datasets.interrupt import ignore_interrupt

WORK = "dase.datasets.generate"
"""Module of what workers do."""


def worker_context() -> Any:
    """Return the context of `multiprocessing` for workers; on Windows, without forks, each imports itself."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload([WORK])
    return context


def start_importing() -> None:
    """Have the server import while the caller does; without it, it starts with the first worker."""
    if worker_context().get_start_method() == "forkserver":
        with ignore_interrupt():  # Ctrl-C is the caller's to obey, who tells the workers
            forkserver.ensure_running()
