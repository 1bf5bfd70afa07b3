"""Runs a program as two processes that meet on this machine."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def run_as_two_processes(*words: str) -> None:
    """Run a program, given as torchrun takes it, as two processes; fail with what they said last.

    The place to meet is given, as another launcher may hold the usual port, and the name of a machine need
    not lead to it. A port that somebody took meanwhile is no failure of the program: another is tried.
    """
    # a test file that is its own program imports what tests share
    places = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    told = {"OMP_NUM_THREADS": "1", "DASE_THREADS": "1", "PYTHONPATH": os.pathsep.join(places)}
    for _ in range(3):
        place = ["--master-addr", "127.0.0.1", "--master-port", str(free_port())]
        command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", *place, *words]
        done = subprocess.run(command, env=os.environ | told, capture_output=True, text=True, timeout=600)
        if done.returncode == 0 or "EADDRINUSE" not in done.stderr:
            break
    assert done.returncode == 0, done.stderr[-5000:]
