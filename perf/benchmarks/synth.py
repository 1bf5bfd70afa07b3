"""A whole `dase synth` run, timed from outside: sequences, events, samples, seconds, peak memory.

python -m perf.benchmarks.synth --images FOLDER --device cpu --jobs 2
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from perf.kills import group_members


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", default="builtin")
    parser.add_argument("--device", default="cpu")
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
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        peak, work = 0, {}
        while process.poll() is None:
            for pid in group_members(process.pid):
                if (found := used_by(pid)) is not None:
                    peak, work[pid] = max(peak, found[0]), found[1]
            time.sleep(0.1)
        took = time.perf_counter() - begin
        said, complaint = (text.decode() for text in process.communicate())
        print(said + (complaint if process.returncode else ""))
        size = sum(f.stat().st_size for f in out.iterdir())
    print(
        f"whole process {took:.1f} s, processors {sum(work.values()):.1f} s in all of them, "
        f"largest process {peak / 2**20:.0f} MiB, {size / 1e6:.0f} MB written"
    )


def used_by(pid: int) -> tuple[int, float] | None:
    """Return the greatest memory [bytes] and the processor time [s] of a process; None where it has gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        fields = Path(f"/proc/{pid}/stat").read_text("latin-1").rpartition(")")[2].split()
        peak = 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        return None
    return peak, (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
