"""Events per second that every reader decodes and every writer encodes, on one core.

    python -m perf.benchmarks.io_formats [--events 2000000]

The events are those of a dense moving scene: several per microsecond step, rows in random order. Measured is
`stream`, what a user gets: decoding, order, size, conversion to seconds. Where the package `aedat` is
installed, its speed on the same AEDAT 4 file stands below.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers import sample_files as reference_io

from dase import io
from dase.events import Events
from dase.io.sequence import Sequence

WRITERS = ("EVT2", "EVT3", "DAT", "AEDAT2", "text", "zip of text", "HDF5", "NumPy archive")
SLOW = ("ROS 1", "ROS 2", "MCAP")  # their samples are made event by event


def best(act, repeats: int = 5) -> float:
    """Return the shortest time of some runs [s]: of the processor, whatever else the machine does."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        act()
        times.append(time.process_time() - begin)
    return min(times)


def dense_evt3(path: Path, words: int = 300_000) -> None:
    """Write vectors with half of their bits set: a time, a row, a base and three vectors each."""
    rng = np.random.default_rng(0)
    t = np.arange(words) * 3
    row = [8 << 12 | t >> 12 & 4095, 6 << 12 | t & 4095, rng.integers(0, 720, words)]
    row += [3 << 12 | rng.integers(0, 39, words) * 32 | rng.integers(0, 2, words) << 11]
    row += [4 << 12 | rng.integers(0, 4096, words), 4 << 12 | rng.integers(0, 4096, words)]
    row += [5 << 12 | rng.integers(0, 256, words)]
    path.write_bytes(b"% evt 3.0\n% geometry 1280x720\n% end\n" + np.stack(row, 1).astype("<u2").tobytes())


def dense_evt21(path: Path, per_word: int, words: int = 1_000_000) -> None:
    """Write words of one row and polarity with that many events each, in the mean."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.integers(0, 3, words))
    high = np.flatnonzero(np.diff(t >> 6, prepend=-1))
    mask = np.zeros(words, np.uint64)
    for bit in range(32):
        mask |= (rng.random(words) < per_word / 32).astype(np.uint64) << np.uint64(bit)
    place = rng.integers(0, 2, words) << 28 | (t & 63) << 22 | rng.integers(0, 40, words) << 16
    data = (place | rng.integers(0, 720, words)).astype(np.uint64) << np.uint64(32) | mask
    data = np.insert(data, high, (8 << 28 | t[high] >> 6).astype(np.uint64) << np.uint64(32))
    head = b"% evt 2.1\n% format EVT21;height=720;width=1280;endianness=little\n% end\n"
    path.write_bytes(head + data.astype("<u8").tobytes())


def measure(name: str, path: Path, events: Events | None) -> None:
    """Print a line of results."""
    notes: list[str] = []
    count = sum(map(len, io.stream(path, notes=notes)))
    spent = best(lambda: sum(map(len, io.stream(path))))
    size = sum(p.stat().st_size for p in ([path] if path.is_file() else path.iterdir()))
    written = ""
    if name in WRITERS and events is not None:
        out = path.with_name(f"out{path.suffix}")
        sequence = Sequence(events)
        written = f"{count / best(lambda: io.write(out, sequence, format=name), 2) / 1e6:.1f}"
    print(f"{name:<24}{size / count:>8.2f}{count / spent / 1e6:>12.1f}{written:>12}", flush=True)


def main() -> None:
    """Measure all formats."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--events", type=int, default=2_000_000)
    count = parser.parse_args().events
    print(f"{platform.processor() or platform.machine()}, NumPy {np.__version__}, {count} events")
    print(f"{'format':<24}{'B/event':>8}{'read Mev/s':>12}{'write Mev/s':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for name, (suffix, make) in reference_io.SAMPLES.items():
            number = count // 20 if name in SLOW else count
            events = reference_io.events(np.random.default_rng(0), number, step_us=3)
            path = Path(folder) / f"{name.replace(' ', '_')}{suffix}"
            make(path, events)
            measure(name, path, events)
        dense_evt3(Path(folder) / "dense.raw")
        measure("EVT3, full vectors", Path(folder) / "dense.raw", None)
        for per_word in (2, 4, 12):
            dense_evt21(Path(folder) / "dense.raw", per_word)
            measure(f"EVT2.1, {per_word} per word", Path(folder) / "dense.raw", None)
        second_library(Path(folder) / "AEDAT4.aedat4", count)


def second_library(path: Path, count: int) -> None:
    """Print the speed of the package aedat, where it is installed."""
    try:
        import aedat
    except ImportError:
        return
    spent = best(lambda: sum(len(p["events"]) for p in aedat.Decoder(path) if "events" in p))
    print(f"{'AEDAT4, package aedat':<24}{'':>8}{count / spent / 1e6:>12.1f}")


if __name__ == "__main__":
    main()
