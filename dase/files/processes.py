"""Which process wrote something, and whether it still runs: ids come round again, start times do not."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path


@dataclass(frozen=True)
class ProcessIdentity:
    """A process, told from every other one, also after its id was given away again.

    Args:
        machine: Hash of the machine and of the name space of its process ids.
        pid: Process id.
        start: Boot of the machine and when the process started; empty where the system tells neither.
    """

    machine: str
    pid: int
    start: str

    def __str__(self) -> str:
        return f"{self.machine}-{self.pid}-{self.start}"

    @classmethod
    def parse(cls, text: str) -> ProcessIdentity:
        """Return the identity that `str` gave; raises ValueError where it is none."""
        machine, pid, start = text.split("-")
        return cls(machine, int(pid), start)

    @classmethod
    def own(cls) -> ProcessIdentity:
        """Return that of this process."""
        return _identity(os.getpid())

    @property
    def is_local(self) -> bool:
        """Whether it is of this machine, so that `runs` can tell."""
        return self.machine == _machine()

    def runs(self) -> bool:
        """Whether it still runs; one of another machine, of which nobody can tell, counts as running."""
        return not self.is_local or (_exists(self.pid) and _start_time(self.pid) == self.start)


@lru_cache(maxsize=1)  # of this process alone: a fork asks with another id
def _identity(pid: int) -> ProcessIdentity:
    return ProcessIdentity(_machine(), pid, _start_time(pid))


@lru_cache(maxsize=1)
def _machine() -> str:
    spaces = ""
    with suppress(OSError):  # only Linux has them
        spaces = os.readlink("/proc/self/ns/pid")
    return sha256(f"{socket.gethostname()}\n{spaces}".encode()).hexdigest()[:8]


@lru_cache(maxsize=1)
def _boot() -> str:
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text()[:8]
    return ""


def _exists(pid: int) -> bool:
    if sys.platform == "win32":
        return True  # asking with signal 0 would end it
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass  # another user's
    return True


def _start_time(pid: int) -> str:
    """Return when a process started; empty where it is gone, has ended, or the system does not tell."""
    try:
        # the name in brackets may hold anything; state is the first field after it, start the twentieth
        fields = Path(f"/proc/{pid}/stat").read_text("latin-1").rpartition(")")[2].split()
        return "" if fields[0] in "ZX" else _boot() + fields[19]
    except OSError:
        pass
    if sys.platform in ("linux", "win32"):
        return ""
    told = subprocess.run(
        ["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
    )
    return sha256(told.stdout.encode()).hexdigest()[:8] if told.stdout.strip() else ""
