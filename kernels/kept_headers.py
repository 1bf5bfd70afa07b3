"""Warp's headers as Clang has read them, kept beside the compiled kernels.

Clang reads them before the first kernel that a process compiles, which takes as long as several kernels. Warp
1.19 keeps what was read until the process ends; here the next one takes it over.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

DIGEST = 32
"""Bytes of a SHA-256 at the end of a kept file."""


def keep_headers(runtime: Any) -> None:
    """Give each thread's folder of read headers what earlier processes kept, and keep what is new there.

    Args:
        runtime: Warp's, started.
    """
    folder_of_thread = runtime.get_clang_pch_dir
    folders: set[str] = set()

    def filled_folder() -> str | None:
        # asked before each kernel that is compiled, so headers that the first made Clang read are kept at the
        # second, or at the end
        folder = folder_of_thread()
        if folder is not None:
            if folder not in folders:
                folders.add(folder)
                atexit.register(_exchange, Path(folder))  # now: Warp removes the folder later than this
            _exchange(Path(folder))
        return folder

    runtime.get_clang_pch_dir = filled_folder


def kept_folder() -> Path:
    """Return where headers are kept as this machine may use them: Clang refuses those of another setting."""
    header = Path(wp._src.build.warp_home, "native", "builtin.h")
    is_of = os.stat(header)
    setting = [header, is_of.st_mtime_ns, is_of.st_size, wp._src.context._get_host_cpu_name()]
    setting.append(wp._src.context._get_cpu_target_hash(CPU_FLAGS))
    name = hashlib.sha256(repr(setting).encode()).hexdigest()[:16]
    return Path(wp.config.kernel_cache_dir) / f"wp_headers_{name}"  # Warp clears what begins like this


def _exchange(folder: Path) -> None:
    """Make both folders hold the same headers, where that can be; without them all is as Warp does it."""
    with suppress(OSError):
        kept = kept_folder()
        kept.mkdir(parents=True, exist_ok=True)
        for path in kept.glob("*.pch"):
            if not (folder / path.name).exists():
                _lend(path, folder)
        for path in folder.glob("*.pch"):
            if not (kept / path.name).exists():
                _keep(path, kept)


def _lend(path: Path, folder: Path) -> None:
    sealed = path.read_bytes()
    content, seal = sealed[:-DIGEST], sealed[-DIGEST:]
    if hashlib.sha256(content).digest() == seal:
        (folder / path.name).write_bytes(content)
    else:
        path.unlink()  # with a damaged file Clang would complain before each kernel


def _keep(path: Path, kept: Path) -> None:
    content = path.read_bytes()
    part = kept / f"{path.name}.{os.getpid()}.{threading.get_ident()}"  # others may do the same just now
    part.write_bytes(content + hashlib.sha256(content).digest())
    part.replace(kept / path.name)
