"""Convert a large file from format to format: time, peak of memory, and whether the events are the same.

    python -m perf.benchmarks.convert --events 200000000
    python -m perf.benchmarks.convert --events 200000000 --others OTHER_ENVIRONMENT/bin/python

Every conversion is a process of its own; Mev/s are of processor time, which other work on the machine
disturbs least. With --others the libraries a user would otherwise take, evlib (MIT) and expelliarmus (GPL-2,
for this comparison only), do theirs in the same run, from an environment of their own. The events are those
of a dense moving scene, rows in random order, the worst case of EVT3.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dase import io
from dase.events import Events

PART = 1 << 20
WIDTH, HEIGHT = 1280, 720
MOST = 12e9  # [bytes] of memory a process may take before it is ended
PEAK = """
print(next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) / 1024)
"""
DASE = "import sys; from dase import io; io.convert(sys.argv[1], sys.argv[2], format=sys.argv[3])"
OURS = (
    ("EVT3 to EVT2", "a.raw", "b.evt2", "EVT2"),
    ("EVT3 to HDF5", "a.raw", "b.h5", "HDF5"),
    ("HDF5 to EVT2", "a.h5", "b.evt2", "EVT2"),
    ("HDF5 to DAT", "a.h5", "b.dat", "DAT"),
)
EXPELLIARMUS = """
import sys
from expelliarmus import Wizard
Wizard(encoding="evt2").save(sys.argv[2], Wizard(encoding="evt3").read(sys.argv[1]))
"""
EVLIB = """
import sys
import evlib
rows = evlib.load_events(sys.argv[1]).collect()
t = rows["t"].dt.total_microseconds().to_numpy() / 1e6
x, y, p = (rows[name].to_numpy().astype("i8") for name in ("x", "y", "polarity"))
evlib.save_events_to_hdf5(x, y, t, p, sys.argv[2])
"""
H5PY = """
import sys
import h5py, numpy as np
with h5py.File(sys.argv[1]) as file:
    t, x, y, p = (file[f"events/{name}"][:] for name in ("ts", "xs", "ys", "ps"))
out = np.empty((len(t), 2), "<u4")
out[:, 0] = np.rint(t * 1e6)
out[:, 1] = x | y.astype(np.uint32) << 14 | p.astype(np.uint32) << 28
with open(sys.argv[2], "wb") as file:
    file.write(b"% Version 2\\n% Height 720\\n% Width 1280\\n" + bytes((12, 8)))
    out.tofile(file)
"""
OTHERS = (
    ("EVT3 to EVT2", "expelliarmus", EXPELLIARMUS, "a.raw", "c.raw"),
    ("EVT3 to HDF5", "evlib", EVLIB, "a.raw", "c.h5"),
    ("HDF5 to DAT", "h5py and NumPy", H5PY, "a.h5", "c.dat"),
)


def make(folder: Path, count: int) -> None:
    """Write the events as EVT3 and as HDF5."""
    rng = np.random.default_rng(0)
    begin = 0
    with io.create(folder / "a.raw", format="EVT3") as first, io.create(folder / "a.h5") as second:
        for i in tqdm(range(0, count, PART), desc="making", leave=False, disable=None):
            n = min(PART, count - i)
            t = begin + np.cumsum(rng.integers(0, 3, n, np.uint8) * (rng.random(n, np.float32) < 0.7))
            begin = int(t[-1])
            x, y = (rng.integers(0, size, n, np.uint16) for size in (WIDTH, HEIGHT))
            part = Events(t / 1e6, x, y, rng.integers(0, 2, n, np.uint8) > 0, WIDTH, HEIGHT)
            first.events(part)
            second.events(part)


def measure(command: list[str]) -> tuple[float, float, float, str]:
    """Run a process; return seconds, seconds of processor, memory at its peak [MB], and what went wrong."""
    begin = time.perf_counter()
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    ended = ""
    while True:
        pid, status, used = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        if resident(process.pid) > MOST:
            process.kill()
            ended = f"ended at {MOST / 1e9:.0f} GB"
        time.sleep(0.05)
    spent = time.perf_counter() - begin
    assert process.stdout is not None
    assert process.stderr is not None
    said, wrong = process.stdout.read().split(), process.stderr.read().strip().splitlines()
    if status and not ended:
        ended = wrong[-1] if wrong else f"status {status}"
    return spent, used.ru_utime + used.ru_stime, float(said[-1]) if said else MOST / 1e6, ended


def resident(pid: int) -> int:
    """Return the memory of a process [bytes]."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def fingerprint(path: Path) -> tuple[list[int], list[int]]:
    """Return numbers of the events of a file in their order, and such that do not depend on their order."""
    ordered, plain, total = [0] * 4, [0] * 3, 0
    for part in io.stream(path, size=(WIDTH, HEIGHT)):
        t, x, y, p = (a.astype(np.int64) for a in (np.rint(part.t * 1e6), part.x, part.y, part.p))
        place = np.arange(total, total + len(part)) % 9973
        total += len(part)
        for k, column in enumerate((t, x, y, p)):
            ordered[k] += int(np.sum(column * place))
        for k, column in enumerate((np.ones_like(t), t, (x * 720 + y) * 2 + p)):
            plain[k] += int(np.sum(column * (t % 9973)))
    return ordered, plain


def main() -> None:
    """Make the file, convert it, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--others", metavar="PYTHON", help="of an environment with evlib, expelliarmus, h5py")
    parser.add_argument("--folder", type=Path, help="where the files go for a while")
    options = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, {options.events} events")
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        make(folder, options.events)
        want = fingerprint(folder / "a.raw")
        print(f"{'':<16}{'by':<16}{'s':>8}{'cpu s':>8}{'Mev/s':>8}{'peak MB':>9}{'out MB':>8}  same events")
        python = sys.executable
        jobs = [(n, "dase", [python, "-c", DASE + PEAK, a, b, f], b) for n, a, b, f in OURS]
        if options.others:
            jobs += [(n, by, [options.others, "-c", code + PEAK, a, b], b) for n, by, code, a, b in OTHERS]
        for title, by, command, out in sorted(jobs, key=lambda job: job[0]):
            command[3:5] = [str(folder / word) for word in command[3:5]]
            print(f"{title:<16}{by:<16}{row(command, options.events, folder / out, want)}", flush=True)
            (folder / out).unlink(missing_ok=True)


def row(command: list[str], count: int, target: Path, want: tuple[list[int], list[int]]) -> str:
    """Run a conversion and return its line of the table."""
    spent, cpu, peak, wrong = measure(command)
    line = f"{spent:>8.1f}{cpu:>8.1f}{count / cpu / 1e6:>8.1f}{peak:>9.0f}"
    if wrong or not target.exists():
        return f"{line}{'':>8}  {wrong or 'no file'}"
    got = fingerprint(target)
    same = "yes" if got == want else "other order" if got[1] == want[1] else "NO"
    return f"{line}{target.stat().st_size / 1e6:>8.0f}  {same}"


if __name__ == "__main__":
    main()
