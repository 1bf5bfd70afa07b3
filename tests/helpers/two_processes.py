"""Runs a program as two processes that meet on this machine."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryFile


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def surroundings() -> dict[str, str]:
    """Return the environment of each process."""
    # a test file that is its own program imports what tests share
    places = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    told = {"OMP_NUM_THREADS": "1", "DASE_THREADS": "1", "PYTHONPATH": os.pathsep.join(places)}
    return os.environ | told


def torchrun_two_processes(*words: str) -> None:
    """Run a program, given as torchrun takes it, as two processes; fail with what they said last.

    The place to meet is given, as another launcher may hold the usual port, and the name of a machine need
    not lead to it. A port that somebody took meanwhile is no failure of the program: another is tried.
    """
    for _ in range(3):
        place = ["--master-addr", "127.0.0.1", "--master-port", str(free_port())]
        command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", *place, *words]
        done = subprocess.run(command, env=surroundings(), capture_output=True, text=True, timeout=600)
        if done.returncode == 0 or "EADDRINUSE" not in done.stderr:
            break
    assert done.returncode == 0, done.stderr[-5000:]


def run_as_two_processes(*words: str) -> None:
    """Run a script with its arguments as the two processes that torchrun would start; fail as that does.

    torchrun itself takes some seconds: PyTorch is loaded by it, too.
    """
    for _ in range(3):
        place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "WORLD_SIZE": "2"}
        told = [surroundings() | place | {"RANK": rank, "LOCAL_RANK": rank} for rank in "01"]
        with TemporaryFile("w+") as said:
            both = [
                subprocess.Popen([sys.executable, *words], env=one, stdout=said, stderr=said) for one in told
            ]
            try:
                # where one has failed the other would wait for it; 600 s are for both that wait for ever
                end = time.monotonic() + 600
                while (
                    time.monotonic() < end
                    and None in (codes := [process.poll() for process in both])
                    and not any(codes)
                ):
                    time.sleep(0.02)
            finally:
                for process in both:
                    process.kill()
                    process.wait()
            said.seek(0)
            text = said.read()
        if codes == [0, 0] or "EADDRINUSE" not in text:
            break
    assert codes == [0, 0], text[-5000:]
