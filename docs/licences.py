"""Writes docs/licences.md, the licences of what dase depends on: python docs/licences.py.

Names come from pyproject.toml and, from there on, from the metadata of what is installed; run it where all
extras are.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
CUDA = re.compile(r"cuda-|nvidia-|triton")
NAME = re.compile(r"[\w.-]+")
EXTRAS = re.compile(r"[\w.-]+\[([\w,\s.-]+)\]")
SPDX = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "FreeBSD": "BSD-2-Clause",
    "MIT License": "MIT",
    "Python Software Foundation License": "PSF-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "any-OSI": "any licence that the OSI approves",
}
"""What metadata say, and how it is written here."""
SAID_ELSEWHERE = {"hdf5plugin": "MIT", "matplotlib": "PSF-2.0 (Matplotlib's own wording)"}
"""Licences that stand in the package's licence file alone."""
LONGEST = 40
"""Letters of a name; what is longer is the licence itself."""

HEAD = """# Licences of what dase depends on

dase is under the [MIT licence](../LICENSE). This page has the packages that `pip install dase` brings, those
of its extras, and those that only developers need, each with what it says of its own licence;
`docs/licences.py` writes it from the metadata of the installed packages. None that dase imports is under the
GPL.
"""
TAIL = """
## Inside of their wheels

Wheels carry compiled libraries with licences of their own, which lie beside them. Worth knowing:

- `opencv-python-headless` has FFmpeg, LGPL-2.1.
- `numpy`, `scipy` and `opencv-python-headless` have OpenBLAS, BSD-3-Clause, with libgfortran and libquadmath:
  GPL-3.0 with the GCC Runtime Library Exception, and LGPL-2.1.
- `warp-lang` has LLVM, Apache-2.0 with LLVM exception, and NVIDIA's compiler for run time under NVIDIA's own
  terms.
- `hdf5plugin` has one library per filter of HDF5, each under the licence of its authors.
- Where `torch` is a build with CUDA, NVIDIA's libraries come with it, under NVIDIA's own terms
  (`constraints-cuda.txt` has their names), and `triton`, MIT.

Programs that are run if they are there, and are no part of any package: `ffmpeg`.
"""


def canonical(name: str) -> str:
    """Return a package's name as indexes write it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(name: str, extras: set[str]) -> list[str]:
    """Return what a package asks for with some extras on this machine, as its metadata say it."""
    from packaging.requirements import Requirement

    asked = []
    for text in metadata.requires(name) or ():
        marker = Requirement(text).marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras | {""}):
            asked.append(text)
    return asked


def closure(asked: list[str]) -> set[str]:
    """Return the names of what some requirements bring, those of CUDA left out."""
    found: set[str] = set()
    rest = list(asked)
    while rest:
        text = rest.pop()
        name = canonical(NAME.match(text)[0])
        if CUDA.match(name) or name in found:
            continue
        found.add(name)
        extras = EXTRAS.match(text)
        rest += requirements(name, set(extras[1].split(",")) if extras else set())
    return found


def licence(name: str) -> str:
    """Return what a package says of its licence."""
    if name in SAID_ELSEWHERE:
        return SAID_ELSEWHERE[name]
    said = metadata.metadata(name)
    classes = [
        c.rpartition(" :: ")[2] for c in said.get_all("Classifier") or () if c.startswith("License ::")
    ]
    short = said.get("License") or ""
    for text in (
        said.get("License-Expression"),
        short if len(short) <= LONGEST else "",
        " AND ".join(classes),
    ):
        if text:
            return SPDX.get(text, text)
    raise LookupError(f"the metadata of {name} name no licence: read its file, and add it to SAID_ELSEWHERE")


def groups() -> dict[str, list[str]]:
    """Return the requirements of dase: title to what stands in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    extras = project["project"]["optional-dependencies"]
    out = {"Always": project["project"]["dependencies"]}
    out |= {f"`dase[{extra}]`": asked for extra, asked in extras.items() if extra != "dev"}
    return out | {"Developers": extras["dev"] + project["build-system"]["requires"]}


def page() -> str:
    """Return the page."""
    out, known = [HEAD], set()
    for title, asked in groups().items():
        direct = {canonical(NAME.match(text)[0]) for text in asked}
        out.append(f"\n## {title}\n\n| package | licence | asked for by |\n|---|---|---|\n")
        for name in sorted(closure(asked) - known):
            by = "dase" if name in direct else "another"
            out.append(f"| `{name}` | {licence(name)} | {by} |\n")
            known.add(name)
    return "".join(out) + TAIL


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
