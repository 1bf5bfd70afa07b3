"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dase.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` that becomes `path` when the block ends well, else is removed.

    Raises:
        InputError: The folder does not exist, or `path` is a folder.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder '{path.parent}' does not exist")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a file")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
