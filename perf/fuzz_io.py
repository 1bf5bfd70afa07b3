"""Damage files of every format and read them: no crash, no hang, no error but InputError, little memory.

    python perf/fuzz_io.py                        100 000 files of every format
    python perf/fuzz_io.py --format EVT3 --files 1000 --seed 7

Files are read whole and as a stream by turns. Every format runs in a process of its own, so that a crash of
a library is seen and named. A file that fails is kept as `fuzz_FORMAT_N` in the folder named by --keep.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
import warnings
from pathlib import Path

import cv2
import hdf5plugin
import lz4.frame
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import reference_io

from dase import io
from dase.errors import InputError
from dase.io.sequence import Sequence

SLOW = 5.0  # [s] of processor for one file
HUNG = 60.0  # [s] of processor without a sign of life
STUCK = 3600.0  # [s] without one, waiting
STEP = 100  # files between two signs of life
MEMORY = 200.0  # [MB] over what the process needed before


def with_frames(make):
    """Return a maker of a file of events and of three frames."""

    def made(path: Path, e) -> None:
        rng = np.random.default_rng(1)
        times, grey = np.array([0.001, 0.003, 0.005]), rng.integers(0, 256, (3, H, W), np.uint8)
        make(path, e, (times, grey))

    return made


def full(path: Path, e, frames) -> None:
    """Everything our own layouts can hold."""
    flow, thresholds = np.zeros((3, 2, H, W), np.float32), np.full((2, H, W), 0.2, np.float32)
    exposure = np.full(3, 1e-3)
    io.write(path, Sequence(e, frames[1], frames[0], flow, thresholds, "a = 1\n" * 40, exposure))


def aedat4(path: Path, e, frames) -> None:
    spans = np.rint(frames[0] * 1e6).astype(int).tolist()
    frames = [(t, t + 900, grey) for t, grey in zip(spans, frames[1], strict=True)]
    motion = [(1000 * k, (0.0, 0.0, 1.0), (1.0, 2.0, 3.0)) for k in range(5)]
    reference_io.aedat4(path, e, frames=frames, motion=motion, compression=1, compress=lz4.frame.compress)


def avi(path: Path, e, frames) -> None:
    out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (W, H))
    for grey in frames[1]:
        out.write(np.repeat(grey[..., None] // 16, 3, 2))
    out.release()


SAMPLES = reference_io.SAMPLES | {
    "HDF5 with frames": (".h5", with_frames(full)),
    "NumPy archive with frames": (".npz", with_frames(full)),
    "AEDAT4 packed": (".aedat4", with_frames(aedat4)),
    "MVSEC with frames": (".hdf5", with_frames(lambda path, e, f: reference_io.mvsec(path, e, frames=f))),
    "v2e with frames": (".h5", with_frames(lambda path, e, f: reference_io.v2e(path, e, frames=f))),
    "DSEC packed": (".h5", lambda path, e: reference_io.dsec(path, e, **hdf5plugin.Blosc(cname="zstd"))),
    "ROS 1 packed": (
        ".bag",
        with_frames(lambda path, e, f: reference_io.bag(path, e, frames=f, compression="LZ4")),
    ),
    "AVI": (".avi", with_frames(avi)),
}
"""Those of the tests, and files that hold more; small sensors keep them small."""
W, H = 48, 36


def peak() -> float:
    """Return the largest memory this process has had [MB]; ru_maxrss would begin with what its parent had."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def read(path: Path, turn: int) -> bool:
    """Read a file, whole or as a stream by turns; return whether that gave events."""
    try:
        if turn % 2:
            for _ in io.stream(path, chunk=1000):
                pass
        else:
            io.read(path)
        if path.suffix == ".aedat4":
            io.motion(path)
    except InputError as error:
        if "\n" in str(error) or not str(error).startswith(str(path)):
            raise AssertionError(f"not one sentence that names the file: {error}") from error
        return False
    return True


def run(name: str, files: int, seed: int, keep: Path, results) -> None:
    """Damage and read files of one format; put what happened into `results` after every file in a while."""
    warnings.simplefilter("error")
    rng = np.random.default_rng([seed, *name.encode()])
    suffix, make = SAMPLES[name]
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        sample = folder / f"sample{suffix}"
        wide = name in reference_io.SAMPLES and not name.startswith("MVSEC")
        make(sample, reference_io.events(rng, 300, *((reference_io.W, reference_io.H) if wide else (W, H))))
        read(sample, 0)
        read(sample, 1)
        before, good, slowest = peak(), 0, 0.0
        inner = [sample] if sample.is_file() else sorted(p for p in sample.iterdir() if p.is_file())
        contents = [path.read_bytes() for path in inner]
        results.put((name, "files", inner))
        for k in range(files):
            which = int(rng.integers(0, len(inner)))
            inner[which].write_bytes(reference_io.mutated(contents[which], rng))
            begin = time.process_time()
            try:
                good += read(sample, k)
            except BaseException as error:
                shutil.copy(inner[which], keep / f"fuzz_{name.replace(' ', '_')}_{k}{inner[which].suffix}")
                results.put((name, "error", f"file {k}: {type(error).__name__}: {error}"))
            finally:
                inner[which].write_bytes(contents[which])
            spent = time.process_time() - begin
            if spent > max(slowest, SLOW):
                results.put((name, "error", f"file {k} took {spent:.1f} s"))
            slowest = max(slowest, spent)
            if k % STEP == STEP - 1 or k == files - 1:
                results.put((name, "done", (k + 1, good, slowest, peak() - before)))
    finally:
        shutil.rmtree(folder)


def main() -> int:
    """Run all formats; return how many failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--format", action="append", choices=list(SAMPLES))
    parser.add_argument("--files", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()))
    options = parser.parse_args()
    failed = 0
    print(f"{'format':<27}{'files':>8}{'readable':>10}{'slowest':>10}{'memory':>10}")
    for name in options.format or SAMPLES:
        context = multiprocessing.get_context("spawn")
        results = context.SimpleQueue()
        arguments = (name, options.files, options.seed, options.keep, results)
        process = context.Process(target=run, args=arguments)
        failed += watch(process, name, options.files, options.keep, results)
    return failed


def processor(pid: int) -> float:
    """Return the time of the processor that a process has used [s]; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def watch(process, name: str, files: int, keep: Path, results) -> int:
    """Start a process, print its outcome, return 1 where it failed."""
    process.start()
    errors, last, inner, alive, used = [], (0, 0, 0.0, 0.0), [], time.monotonic(), 0.0
    while process.is_alive() or not results.empty():
        if results.empty():
            time.sleep(0.05)
            if processor(process.pid) - used > HUNG or time.monotonic() - alive > STUCK:
                for path in inner:
                    shutil.copy(path, keep / f"fuzz_{name.replace(' ', '_')}_hung_{path.name}")
                process.kill()
                process.join()
                shutil.rmtree(inner[0].parent, ignore_errors=True)
            continue
        _, kind, value = results.get()
        alive, used = time.monotonic(), processor(process.pid)
        if kind == "error":
            errors.append(value)
        elif kind == "files":
            inner = value
        else:
            last = value
    process.join()
    if process.exitcode:
        errors.append(f"the process ended with {process.exitcode} after about {last[0]} files")
    if last[3] > MEMORY:
        errors.append(f"took {last[3]:.0f} MB")
    print(f"{name:<27}{last[0]:>8}{last[1]:>10}{last[2]:>9.2f}s{last[3]:>8.0f} MB", flush=True)
    for error in errors[:5]:
        print(f"    {error}", flush=True)
    return int(bool(errors) or last[0] != files)


if __name__ == "__main__":
    sys.exit(main())
