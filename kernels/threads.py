"""How many threads of the CPU work at a time; apart from `launch`, so that who asks need not start Warp."""

from __future__ import annotations

import os

_count = int(os.environ.get("DASE_THREADS", "0")) or os.cpu_count() or 1


def thread_count() -> int:
    """Return the number of CPU threads that kernels use, and what packs files."""
    return _count


def keep_thread_count(count: int) -> None:
    """Remember a number of threads; `dase.kernels.launch.set_threads` also ends those that there are."""
    global _count
    if count < 1:
        raise ValueError(f"threads must be >= 1, got {count}")
    _count = count
