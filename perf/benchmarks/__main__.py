"""What a user would want to see, in two minutes: kernels, a whole synth run, and what else is installed.

python -m perf.benchmarks [--device cuda:0]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    """Run one benchmark after the other, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    begin = time.perf_counter()
    for title, name, *options in (
        ("Kernels", "kernels", "--device", device, "--samples", "32", "--repeats", "3"),
        ("A whole `dase synth`", "synth", "--device", device, "--sequences", "2"),
        ("Beside others", "peers", "--samples", "50", "--rounds", "1"),
    ):
        print(f"\n## {title}: python -m perf.benchmarks.{name} {' '.join(options)}\n", flush=True)
        done = subprocess.run(
            [sys.executable, "-m", f"perf.benchmarks.{name}", *options], cwd=ROOT, check=False
        )
        if done.returncode:
            raise SystemExit(f"perf.benchmarks.{name} ended with status {done.returncode}")
    print(f"\n{time.perf_counter() - begin:.0f} s in all, with what was compiled for the first time")


if __name__ == "__main__":
    main()
