"""Scripts of the checkout that are in no package, as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]
"""Folder of the checkout."""


def load_script(path: str) -> ModuleType:
    """Return a script, named from the root of the checkout, as a module; its `main` does not run."""
    file = ROOT / path
    name = "script_" + "_".join(file.relative_to(ROOT).with_suffix("").parts)
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
