"""A whole `dase synth` run, timed from outside: sequences, events, samples, seconds, peak memory.

python -m perf.benchmarks.synth --images FOLDER --backend cpu --jobs 2
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", default="builtin")
    parser.add_argument("--backend", default="cpu")
    parser.add_argument("--jobs", default="2")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--sequences", default="20")
    parser.add_argument("--duration", default="1")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-c", "from dase.cli import main; main()", "synth", str(out)]
        for name, value in vars(options).items():
            command += [f"--{name}", value]
        begin = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True)
        took = time.perf_counter() - begin
        print(done.stdout + (done.stderr if done.returncode else ""))
        size = sum(f.stat().st_size for f in out.iterdir())
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(f"whole process {took:.1f} s, largest process {peak / 1024:.0f} MiB, {size / 1e6:.0f} MB written")


if __name__ == "__main__":
    main()
