"""Write constraints.txt and constraints-cuda.txt: one version of every dependency, with hashes of its files.

    python .ci/pin.py                      what pyproject.toml asks for now; versions that fit stay
    python .ci/pin.py --upgrade            the newest of all; --upgrade numpy of one
    python .ci/pin.py --also torch=HASH    one more file that may be installed

Needs `uv` on the path (`pipx install uv`), which asks the package index. Every platform is covered, from the
oldest Python that pyproject.toml allows. PyTorch's builds for processors alone lie on an index of their own:
their hashes are given by `--also`, and stay as long as the version does.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = (ROOT / "constraints.txt", ROOT / "constraints-cuda.txt")
OF_CUDA = ("cuda-", "nvidia-", "triton")
"""How names begin that PyTorch asks for where its build has CUDA, and nothing else does."""
HEADS = (
    "# What `make` installs, written by .ci/pin.py: versions, and hashes of their files. Of torch, builds\n"
    "# for processors alone are among them. pyproject.toml allows ranges.\n",
    "# What torch needs besides constraints.txt where its build has CUDA, written by .ci/pin.py.\n",
)
PIN = re.compile(r"^(?P<name>[\w.-]+)==(?P<version>[^\s;]+)(?P<marker> ;[^\\\n]*?)?(?: \\)?$")
HASH = re.compile(r"--hash=(sha256:[0-9a-f]{64})")

Pins = dict[str, tuple[str, str, list[str]]]
"""Name to version, marker, and hashes."""


def read_pins(text: str) -> Pins:
    """Return the pins of a file's text."""
    pins: Pins = {}
    hashes: list[str] = []
    for line in text.splitlines():
        if found := PIN.match(line):
            hashes = []
            pins[found["name"]] = (found["version"], found["marker"] or "", hashes)
        else:
            hashes += HASH.findall(line)
    return pins


def write_pins(pins: Pins, head: str) -> str:
    """Return a file's text."""
    lines = [head]
    for name, (version, marker, hashes) in sorted(pins.items()):
        rows = [f"{name}=={version}{marker}", *(f"    --hash={one}" for one in sorted(hashes))]
        lines.append(" \\\n".join(rows) + "\n")
    return "".join(lines)


def resolve(old: str, upgrade: list[str]) -> str:
    """Return what uv finds for pyproject.toml and what builds it; versions of `old` stay where they fit."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    oldest = project["project"]["requires-python"].removeprefix(">=")
    with tempfile.TemporaryDirectory() as folder:
        out, builders = Path(folder, "out.txt"), Path(folder, "build.in")
        out.write_text(old)
        builders.write_text("\n".join(project["build-system"]["requires"]))
        line = ["uv", "pip", "compile", "--quiet", "--no-config", "--universal", "--generate-hashes"]
        line += ["--no-header", "--no-annotate", "--all-extras", "--python-version", oldest, "--output-file"]
        newer = [f"--upgrade-package={name}" for name in upgrade if name] + ["--upgrade"] * ("" in upgrade)
        line += [str(out), *newer, str(ROOT / "pyproject.toml"), str(builders)]
        # PyPI, whatever this machine has besides
        ours = {key: value for key, value in os.environ.items() if not key.startswith(("UV_", "PIP_"))}
        subprocess.run(line, check=True, env=ours, stdout=subprocess.DEVNULL)
        return out.read_text()


def keep_others(pins: Pins, before: Pins, also: list[tuple[str, str]]) -> None:
    """Add the hashes that are given, and those of a version that stays, which the index does not know."""
    for name, (version, _, hashes) in pins.items():
        if name in before and before[name][0] == version:
            hashes += [one for one in before[name][2] if one not in hashes]
        hashes += [f"sha256:{one}" for whose, one in also if whose == name and f"sha256:{one}" not in hashes]


def main() -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--upgrade", nargs="?", const="", default=[], action="append", metavar="NAME")
    parser.add_argument("--also", default=[], action="append", metavar="NAME=HASH")
    options = parser.parse_args()
    old = "".join(path.read_text() for path in FILES if path.exists())
    pins = read_pins(resolve(old, options.upgrade))
    also = [(name, one) for name, _, one in (text.partition("=") for text in options.also)]
    keep_others(pins, read_pins(old), also)
    cuda = {name: pin for name, pin in pins.items() if name.startswith(OF_CUDA)}
    rest = {name: pin for name, pin in pins.items() if name not in cuda}
    for path, some, head in zip(FILES, (rest, cuda), HEADS, strict=True):
        path.write_text(write_pins(some, head))
        print(f"{path.name}: {len(some)} packages, {sum(len(pin[2]) for pin in some.values())} hashes")


if __name__ == "__main__":
    main()
