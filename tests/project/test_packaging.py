"""What is installed is what is in the tree, and importing it costs little."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
import tomllib

import pytest
from helpers.scripts import ROOT, load_script
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from PIL import Image

import dase


def declared() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_declared_packages_equal_those_on_disk():
    on_disk = {"dase", "dase.kernels", "dase.cli"}
    on_disk |= {f"dase.{p.parent.name}" for p in (ROOT / "dase").glob("*/__init__.py")}
    assert set(declared()["tool"]["setuptools"]["packages"]) == on_disk


def test_public_names_are_exported_once_and_documented():
    tree = ast.parse((ROOT / "dase" / "__init__.py").read_text())
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    names = {(node.module, alias.asname) for node in typed.body for alias in node.names}
    assert names == {(module, name) for name, module in dase._MODULE_OF.items()}
    for name in dase.__all__:
        assert name == "EFFECTS" or getattr(dase, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = dase.nonsense


def test_help_loads_nothing_heavy():
    script = (
        "import sys; sys.argv = ['dase', '--help']\n"
        "from dase.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'warp', 'torch', 'cv2', 'matplotlib', 'h5py', 'numpy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "synth" in done.stdout


def test_kernels_refuse_a_second_name():
    done = subprocess.run([sys.executable, "-c", "import kernels"], cwd=ROOT, capture_output=True, text=True)
    assert "import dase.kernels, not kernels" in done.stderr


def test_the_page_of_the_architecture_is_that_of_the_code():
    script = load_script("docs/architecture.py")
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    assert page == script.page(), "run python docs/architecture.py"
    with Image.open(ROOT / "docs" / "architecture.png") as picture:
        drawn = json.loads(picture.text["Description"])["packages"]
    assert drawn == sorted(script.find_packages()), "run python docs/architecture.py"
    for steps in script.WAYS.values():
        assert set(dict(steps)) <= set(drawn)


def test_hooks_run_what_make_lint_runs():
    recipe = (ROOT / "Makefile").read_text().split("\nlint: .venv/ready\n")[1].split("\n\n")[0]
    commands = [line.strip().replace("$(BIN)", ".venv/bin") for line in recipe.splitlines()]
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    assert re.findall(r"entry: (.*)", hooks) == commands


def test_contributors_are_told_of_targets_that_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    asked = set(re.findall(r"^make ([a-z-]+)", text, flags=re.MULTILINE))
    assert asked
    assert asked <= targets


def test_every_dependency_is_pinned_with_hashes():
    pin = load_script(".ci/pin.py")
    texts = [path.read_text() for path in pin.FILES]
    pins, of_cuda = map(pin.read_pins, texts)
    project = declared()
    asked = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    asked += [one for extra in project["project"]["optional-dependencies"].values() for one in extra]
    for requirement in map(Requirement, asked):
        version, _, hashes = pins[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), requirement
        assert hashes, requirement
    # hashes of all, or pip would refuse the file; nothing but pins, so that no line can name another index
    for text, some, head in zip(texts, (pins, of_cuda), pin.HEADS, strict=True):
        assert all(hashes for _, _, hashes in some.values())
        assert text == pin.write_pins(some, head)
    assert all(name.startswith(pin.OF_CUDA) for name in of_cuda)
    recipe = (ROOT / "Makefile").read_text().split("\n.venv/ready:")[1].split("\n\n")[0]
    for line in recipe.splitlines():
        assert "install" not in line or "--require-hashes" in line or line.endswith("--editable ."), line


def test_the_page_of_licences_has_every_dependency():
    script, pin = load_script("docs/licences.py"), load_script(".ci/pin.py")
    text = (ROOT / "docs" / "licences.md").read_text("utf-8")
    parts = dict(part.split("\n", 1) for part in text.split("\n## ")[1:])
    rows = {
        title: re.findall(r"^\| `([\w-]+)` \| (.*) \| (\w+) \|$", part, re.M) for title, part in parts.items()
    }
    for title, asked in script.groups().items():
        direct = {name for name, _, by in rows[title] if by == "dase"}
        assert direct <= {canonicalize_name(Requirement(one).name) for one in asked}
    found = {name for part in rows.values() for name, _, _ in part}
    # pins are found by another program, from the index instead of what is installed
    assert found == set(pin.read_pins(pin.FILES[0].read_text())) - {"colorama"}, "run python docs/licences.py"
    for title in rows.keys() - {"Developers"}:
        assert not [name for name, licence, _ in rows[title] if "GPL" in licence or not licence], title


def is_there(name: str) -> bool:
    """Whether a dotted name leads to a module or to something in it."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ImportError:
            continue
        for part in parts[k:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


PAGES = sorted(str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")))


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_what_is_there(page):
    text = (ROOT / page).read_text("utf-8")
    names = re.findall(r"`(dase(?:\.\w+)+)", text)
    assert not [name for name in names if not is_there(name)]
    paths = re.findall(r"`((?:dase|kernels|cli|tests|perf|docs)/[\w/.]*)`", text)
    assert not [path for path in paths if "NAME" not in path and not (ROOT / path).exists()]
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    assert not [to for to in links if not ((ROOT / page).parent / to).exists()]
