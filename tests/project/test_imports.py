"""Imports go one way, from cli down to the kernels; the floors are those of perf/code_metrics.py."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache

import pytest
from helpers.scripts import ROOT, load_script

metrics = load_script("perf/code_metrics.py")
GRAPH = metrics.import_graph(ROOT)

HEAVY = {
    "cv2",
    "hdf5plugin",
    "lz4",
    "matplotlib",
    "pycocotools",
    "rosbags",
    "safetensors",
    "skimage",
    "torch",
    "warp",
}
"""Packages that are optional or slow to load: for their sake an import may wait until it is needed."""

OF_TORCH = r"dase\.(learning|networks|tasks|torch)\b|dase\.kernels\.autograd_|dase\.figures\.training_figure"
"""Modules that may need PyTorch to be imported at all."""


def file_of(module: str):
    parts = module.split(".")
    parts = parts[1:] if parts[1:2] in (["kernels"], ["cli"]) else parts
    path = ROOT.joinpath(*parts)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def outside(module: str) -> set[str]:
    """Return the packages other than dase that a module imports at its top."""
    found = set()
    for node in ast.parse(file_of(module).read_text("utf-8")).body:
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").partition(".")[0])
    return found


def loads(module: str) -> set[str]:
    """Return all packages other than dase that are loaded when a module is imported."""
    seen, todo, found = set(), [module], set()
    while todo:
        one = todo.pop()
        if one not in seen:
            seen.add(one)
            found |= outside(one)
            todo += [i.module for i in GRAPH[one] if not i.late]
            todo += [one.rpartition(".")[0]] if "." in one else []
    return found


def test_every_package_has_a_floor():
    packages = {name.split(".")[1] for name in GRAPH if "." in name}
    assert packages == {name for names, _ in metrics.FLOORS for name in names}


@pytest.mark.parametrize("module", GRAPH)
def test_imports_go_down(module):
    """Also those inside of functions: what is put off still goes one way."""
    part, floor = module.split(".")[:2], metrics.floor_of(module)
    for one in GRAPH[module]:
        inside = one.module.split(".")[:2] == part
        assert inside or metrics.floor_of(one.module) > floor, (
            f"{module} imports {one.module}, line {one.line}"
        )


def test_no_circle():
    assert metrics.find_circles(metrics.module_edges(GRAPH)) == []


def said_why(module: str, line: int) -> bool:
    """Whether a comment stands at the import, or above it and the imports that stand with it."""
    lines = file_of(module).read_text("utf-8").splitlines()
    at = line - 1
    if "  # " in lines[at]:
        return True
    while re.match(r"\s*(from|import) ", lines[at]):
        at -= 1
    return lines[at].lstrip().startswith("#")


@pytest.mark.parametrize("module", [m for m, found in GRAPH.items() if any(i.late for i in found)])
def test_imports_are_put_off_for_a_reason(module):
    """Commands load what they need when they run; elsewhere only heavy packages wait, the code says why."""
    for one in GRAPH[module]:
        if one.late and not module.startswith("dase.cli"):
            heavy = HEAVY & (loads(one.module) - loads(module))
            assert heavy, f"{module} line {one.line}: {one.module} loads nothing heavy, import it at the top"
            assert said_why(module, one.line), f"{module} line {one.line}: say why {one.module} is put off"


def other_packages_put_off(module: str) -> list[tuple[str, int]]:
    """Return what functions of a module import of others than dase, but for extras that may be missing."""
    tree = ast.parse(file_of(module).read_text("utf-8"))
    tried = {
        id(node)
        for one in ast.walk(tree)
        if isinstance(one, ast.Try) and any("ImportError" in ast.dump(h) for h in one.handlers)
        for node in ast.walk(one)
    }
    functions = [n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    inside = {id(node): node for one in functions for node in ast.walk(one)}
    found = []
    for node in inside.values():
        if id(node) in tried:
            continue
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append((node.module or "", node.lineno))
    return [(name, line) for name, line in found if name.split(".")[0] not in ("dase", "__future__")]


@pytest.mark.parametrize(
    "module", [m for m in GRAPH if not m.startswith("dase.cli") and other_packages_put_off(m)]
)
def test_other_packages_are_put_off_for_a_reason(module):
    for name, line in other_packages_put_off(module):
        assert said_why(module, line), f"{module} line {line}: say why {name} is put off"


def test_pytorch_is_asked_for_where_networks_are_trained():
    for module in GRAPH:
        if not re.match(OF_TORCH, module):
            assert "torch" not in loads(module), module


def test_kernels_know_nothing_of_dase():
    for module, found in GRAPH.items():
        if module.startswith("dase.kernels"):
            assert all(one.module.startswith("dase.kernels") for one in found), module


@pytest.mark.slow
def test_no_import_starts_warp():
    """With Warp starts CUDA: a process that forks or chooses its GPU after an import would be too late."""
    pytest.importorskip("torch")
    said = subprocess.run(
        [sys.executable, "-c", STARTS_WARP], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert said.stdout.split() == []


STARTS_WARP = """
import importlib, pkgutil, dase
import warp._src.context as context
for found in pkgutil.walk_packages(dase.__path__, "dase."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
        if context.runtime is not None:
            print(found.name)
            break
"""
