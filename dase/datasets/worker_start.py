"""How worker processes start: forked from a server that has imported everything while its caller did.

Each would need most of a second for its own imports, beside those of its caller and of the others. The server
only imports: it starts neither Warp nor a GPU. Its environment is that of the moment at which it starts, so a
command asks for it; a program that calls dase as a library has workers that import for themselves.
"""

from __future__ import annotations

import sys
from multiprocessing import forkserver, get_all_start_methods, get_context
from typing import Any

from dase.files.interrupt import ignore_interrupt

WORK = "dase.datasets.generate"
"""Module of what workers do."""

_importing = False


def worker_context() -> Any:
    """Return the context of `multiprocessing` for workers: forked where `start_importing` has a server."""
    return get_context("forkserver" if _importing else "spawn")


def start_importing() -> None:
    """Have a server import while the caller does, from which workers are forked.

    There is none on Windows, which has no forks, and on macOS, whose own libraries do not stand them, nor
    where the folder of temporary files has too long a name for its socket.
    """
    global _importing
    if sys.platform == "darwin" or "forkserver" not in get_all_start_methods():
        return
    get_context("forkserver").set_forkserver_preload([WORK])
    try:
        with ignore_interrupt():  # Ctrl-C is the caller's to obey, who tells the workers
            forkserver.ensure_running()
    except OSError:
        return
    _importing = True
