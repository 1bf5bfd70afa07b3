"""One run per folder: a lock with its owner in it, which is stale as soon as the owner has ended."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from dase.errors import InputError
from dase.files.atomic_file import remove_stale_temporaries
from dase.files.processes import ProcessIdentity

LOCK_FILE = ".dase.lock"
_held: set[Path] = set()


@contextmanager
def locking_folder(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, made if missing; a process may hold it several times.

    At begin and end what killed processes left is removed.

    Raises:
        InputError: Another process that still runs holds it; or one of another machine does.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} must be a folder, but it is a file")
    folder.mkdir(parents=True, exist_ok=True)
    place = folder.resolve()
    if place in _held:
        yield
        return
    _take(folder)
    _held.add(place)
    try:
        remove_stale_temporaries(folder)
        yield
    finally:
        _held.discard(place)
        with suppress(OSError):
            remove_stale_temporaries(folder)
            _release(folder)


def _take(folder: Path) -> None:
    """Write this process into the lock."""
    with _exclusive(folder / LOCK_FILE) as file:
        text = os.pread(file, 4096, 0).decode("ascii", "replace")
        owner = _parse_owner(text)
        if owner is not None and owner.runs():
            who = f"process {owner.pid}" if owner.is_local else "a process of another machine"
            cure = "" if owner.is_local else f"; if it has ended, remove {folder / LOCK_FILE}"
            raise InputError(
                f"{folder} is being written by {who}: wait for it, or choose another folder{cure}"
            )
        os.ftruncate(file, 0)
        os.pwrite(file, f"{ProcessIdentity.own()}\n".encode(), 0)
        os.fsync(file)


def _release(folder: Path) -> None:
    with _exclusive(folder / LOCK_FILE) as file:
        if _parse_owner(os.pread(file, 4096, 0).decode("ascii", "replace")) == ProcessIdentity.own():
            (folder / LOCK_FILE).unlink()


def _parse_owner(text: str) -> ProcessIdentity | None:
    """Return the owner; None where a process ended before it had written itself down."""
    if not text.endswith("\n"):
        return None
    try:
        return ProcessIdentity.parse(text.strip())
    except ValueError:
        return None


@contextmanager
def _exclusive(path: Path) -> Iterator[Any]:
    """Open a lock for a moment, alone: of two processes that find it stale only one may take it over."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if fcntl is not None:
                with suppress(OSError):  # file systems without locks: the moment is short
                    fcntl.flock(file, fcntl.LOCK_EX)
            # the file may have been removed while this process waited for it
            if _is_at(file, path):
                yield file
                return
        finally:
            os.close(file)
        time.sleep(0.01)


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
