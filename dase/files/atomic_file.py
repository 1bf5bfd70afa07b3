"""Files that appear whole or not at all, also when the process is killed or the machine loses its power."""

from __future__ import annotations

import itertools
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dase.errors import InputError
from dase.files.processes import ProcessIdentity

_TEMPORARY = re.compile(
    r"\.(?P<stem>.+)\.(?P<owner>[0-9a-f]{8}-\d+-\w*)\.\d+\.tmp(?P<suffix>(\.[^.]*)?)", re.DOTALL
)
_numbers = itertools.count()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` that becomes `path` when the block ends well, else is removed.

    Content and name are on the disk before this returns. What killed processes left of the same file is
    removed; several processes may replace one file at once, of which the last wins.

    Raises:
        InputError: The folder does not exist, or `path` is a folder.
    """
    refuse_unwritable(path)
    remove_stale_temporaries(path.parent, path)
    owner = ProcessIdentity.own()
    temporary = path.with_name(f".{path.stem}.{owner}.{next(_numbers)}.tmp{path.suffix}")
    try:
        yield temporary
        _flush_to_disk(temporary)  # else a loss of power could leave the name without the content
        os.replace(temporary, path)
        with suppress(OSError):  # some file systems cannot flush a folder
            _flush_to_disk(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def refuse_unwritable(path: Path) -> None:
    """Raise InputError where a file of this name cannot be made; to be asked before the work, too."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder '{path.parent}' does not exist")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a file")


def remove_stale_temporaries(
    folder: Path, path: Path | None = None, *, foreign_after: float = 86400.0
) -> None:
    """Remove temporary files in `folder` whose process has ended.

    Args:
        folder: Where to look, not below.
        path: Only those of this file; None for all.
        foreign_after: Age [s] from which those of other machines go, of whose processes nobody can tell.
    """
    for entry in _entries(folder):
        found = _TEMPORARY.fullmatch(entry.name)
        if found is None:
            continue
        if path is not None and (found["stem"], found["suffix"]) != (path.stem, path.suffix):
            continue
        owner = ProcessIdentity.parse(found["owner"])
        with suppress(FileNotFoundError):  # another process was faster
            if owner.is_local:
                stale = not owner.runs()
            else:
                stale = time.time() - entry.stat().st_mtime > foreign_after
            if stale:
                os.unlink(entry.path)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    with os.scandir(folder) as entries:
        return [entry for entry in entries if entry.name.startswith(".")]


def _flush_to_disk(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
