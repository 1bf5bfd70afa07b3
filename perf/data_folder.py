"""Where recordings and photographs lie that are no part of the project."""

from __future__ import annotations

import os
from pathlib import Path


def data_folder() -> Path | None:
    """Return the folder that DASE_DATA names, or `shared` beside the checkout; None where there is neither.

    It holds `photos`, a folder of pictures; `recordings`, of cameras; and `hidden`, of a simulator with
    effects that its `truth.json` names.
    """
    path = Path(os.environ.get("DASE_DATA", Path(__file__).resolve().parents[2] / "shared"))
    return path if path.is_dir() else None


def default_images() -> str:
    """Return the folder of photographs, or the pictures that come with dase: what `--images` takes."""
    folder = data_folder()
    return str(folder / "photos") if folder is not None and (folder / "photos").is_dir() else "builtin"
