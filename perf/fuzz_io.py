"""Damage files of every format and read them: no crash, no hang, no error but InputError, little memory.

    python -m perf.fuzz_io                        100 000 files of every format
    python -m perf.fuzz_io --format EVT3 --files 1000 --seed 7
    python -m perf.fuzz_io --format EVT3 --only 4711 --keep .      one file again, and keep it

Files are damaged in memory, lie on a disk in memory, and are read whole and as a stream by turns. Every
format runs in a process of its own that a second one watches: a crash, or a file that takes too long or too
much memory, is counted and kept as `fuzz_FORMAT_N` in the folder named by --keep, and the run goes on with
the next file. Each file has random numbers of its own, so any one can be made again. Prints Markdown.
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
from typing import Any

import cv2
import hdf5plugin
import lz4.frame
import numpy as np

from perf.benchmarks.kernels import commit

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers import avi_files as reference_video
from helpers import sample_files as reference_io

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence

SLOW = 5.0  # [s] of processor for one file
HUNG = 60.0  # [s] of processor without a sign of life
STUCK = 3600.0  # [s] without one, waiting
MEMORY = 200.0  # [MB] over what the process needed before
TOO_MUCH = 4000.0  # [MB] at which a process is ended for the sake of the machine
EVENTS = 200  # in a file

NEXT, WHOLE, NOTED, REFUSED, FAILED, SLOWEST, PEAK, SPENT = range(8)
"""What a process tells about its files: numbers of the next one, of files read without a word, with a report
of what was put right or left out, refused with a sentence, and failed; seconds of the slowest, largest memory
[MB], seconds of processor in all."""


def with_frames(make):
    """Return a maker of a file of events and of three frames, of a small sensor."""

    def made(path: Path, e: Events) -> None:
        rng = np.random.default_rng(1)
        times, grey = np.array([0.001, 0.003, 0.005]), rng.integers(0, 256, (3, H, W), np.uint8)
        make(path, Events(e.t, e.x % np.uint16(W), e.y % np.uint16(H), e.p, W, H), (times, grey))

    return made


def write_full(path: Path, e, frames) -> None:
    """Everything our own layouts can hold."""
    flow, thresholds = np.zeros((3, 2, H, W), np.float32), np.full((2, H, W), 0.2, np.float32)
    exposure = np.full(3, 1e-3)
    io.write(path, Sequence(e, frames[1], frames[0], flow, thresholds, "a = 1\n" * 40, exposure))


def write_aedat4(path: Path, e, frames) -> None:
    spans = np.rint(frames[0] * 1e6).astype(int).tolist()
    frames = [(t, t + 900, grey) for t, grey in zip(spans, frames[1], strict=True)]
    motion = [(1000 * k, (0.0, 0.0, 1.0), (1.0, 2.0, 3.0)) for k in range(5)]
    reference_io.aedat4(path, e, frames=frames, motion=motion, compression=1, compress=lz4.frame.compress)


def video_maker(codec: str):
    """Return a maker of a video of the frames."""

    def make(path: Path, e, frames) -> None:
        out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, (W, H))
        for grey in frames[1]:
            out.write(np.repeat(grey[..., None] // 16, 3, 2))
        out.release()

    return make


def write_plain_avi(path: Path, e, frames) -> None:
    """A video of the frames as they are, with titles before and after them."""
    titles = reference_video.titles()
    path.write_bytes(reference_video.avi(frames[1], first=titles, last=titles))


def write_pictures(path: Path, e, frames) -> None:
    """A folder of text with pictures; each file of it is damaged on its own."""
    path.mkdir()
    rows = zip(e.t.tolist(), e.x.tolist(), e.y.tolist(), e.p.astype(int).tolist(), strict=True)
    (path / "events.txt").write_text("".join(f"{t:.6f} {x} {y} {p}\n" for t, x, y, p in rows))
    names = [f"frame_{k}.png" for k in range(len(frames[0]))]
    lines = (f"{t} {name}\n" for t, name in zip(frames[0], names, strict=True))
    (path / "images.txt").write_text("".join(lines))
    for name, grey in zip(names, frames[1], strict=True):
        cv2.imwrite(str(path / name), grey)


SAMPLES = {
    **{name: reference_io.SAMPLES[name] for name in ("EVT2", "EVT3", "EVT2.1", "EVT2.1 legacy", "DAT")},
    "AEDAT2": reference_io.SAMPLES["AEDAT2"],
    "AEDAT4 packed": (".aedat4", with_frames(write_aedat4)),
    "ECF": (".hdf5", reference_io.ecf),
    "ECF, columns packed": (".hdf5", lambda path, e: reference_io.ecf(path, e, mode=1)),
    "ECF, not packed": (".hdf5", lambda path, e: reference_io.ecf(path, e, mode=0)),
    "DSEC packed": (".h5", lambda path, e: reference_io.dsec(path, e, **hdf5plugin.Blosc(cname="zstd"))),
    "MVSEC with frames": (".hdf5", with_frames(lambda path, e, f: reference_io.mvsec(path, e, frames=f))),
    "v2e with frames": (".h5", with_frames(lambda path, e, f: reference_io.v2e(path, e, frames=f))),
    "HDF5 with frames": (".h5", with_frames(write_full)),
    "NumPy archive with frames": (".npz", with_frames(write_full)),
    "array": reference_io.SAMPLES["array"],
    "array in an archive": reference_io.SAMPLES["array in an archive"],
    "ROS 1 packed": (
        ".bag",
        with_frames(lambda path, e, f: reference_io.bag(path, e, frames=f, compression="LZ4")),
    ),
    "ROS 1": reference_io.SAMPLES["ROS 1"],
    "ROS 2": reference_io.SAMPLES["ROS 2"],
    "MCAP": reference_io.SAMPLES["MCAP"],
    "AVI": (".avi", with_frames(video_maker("MJPG"))),
    "AVI, not compressed": (".avi", with_frames(write_plain_avi)),
    "MP4": (".mp4", with_frames(video_maker("mp4v"))),
    "text with PNG": (".folder", with_frames(write_pictures)),
} | reference_io.SAMPLES
"""Those that hold most first, then what is left of those of the tests; small sensors keep them small."""
W, H = 48, 36


class Memory:
    """The memory of this process [MB]; ru_maxrss would begin with what its parent had."""

    def __init__(self) -> None:
        self._status = os.open("/proc/self/status", os.O_RDONLY)

    def peak(self) -> float:
        """Return the largest so far."""
        text = os.pread(self._status, 4096, 0)
        return int(text[text.index(b"VmHWM:") + 6 :].split(None, 1)[0]) / 1024

    def forget(self) -> None:
        """Begin anew with what there is now."""
        Path("/proc/self/clear_refs").write_text("5")


def read_file(path: Path, turn: int) -> int:
    """Read a file, whole or as a stream by turns; return how that ended: WHOLE, NOTED or REFUSED."""
    notes: list[Any] = []
    try:
        if turn % 2:
            for _ in io.stream(path, chunk=1000, notes=notes):
                pass
        else:
            io.read(path, notes=notes)
        if path.suffix == ".aedat4":
            io.motion(path)
    except InputError as error:
        if "\n" in str(error) or not str(error).startswith(str(path)):
            raise AssertionError(f"not one sentence that names the file: {error}") from error
        return REFUSED
    return NOTED if any(note.kind in ("repaired", "refused") for note in notes) else WHOLE


def prepare_sample(name: str, folder: Path, seed: int) -> tuple[Path, list[tuple[Path, bytes]]]:
    """Write the sample of a format; return its path, and what lies there: paths and contents."""
    rng = np.random.default_rng([seed, *name.encode()])
    suffix, make = SAMPLES[name]
    sample = folder / f"sample{suffix}"
    make(sample, reference_io.events(rng, EVENTS))
    inner = [sample] if sample.is_file() else sorted(p for p in sample.iterdir() if p.is_file())
    return sample, [(path, path.read_bytes()) for path in inner]


def write_damaged(name: str, inner: list[tuple[Path, bytes]], number: int, seed: int) -> Path:
    """Write the damaged file of a number; return its path."""
    rng = np.random.default_rng([seed, number, *name.encode()])
    path, content = inner[int(rng.integers(0, len(inner))) if len(inner) > 1 else 0]
    path.write_bytes(reference_io.mutated(content, rng))
    return path


def run_files(name: str, folder: Path, files: int, seed: int, keep: Path, told, errors) -> None:
    """Damage and read files of one format from number told[NEXT] on, and tell what happens."""
    warnings.simplefilter("error")
    sample, inner = prepare_sample(name, folder, seed)
    for turn in (0, 1):
        if read_file(sample, turn) == REFUSED:
            errors.put("the sample itself is refused")
    memory, begun = Memory(), time.process_time()
    memory.forget()
    before, used = memory.peak(), told[SPENT]
    for number in range(int(told[NEXT]), files):
        path = write_damaged(name, inner, number, seed)
        begin, outcome = time.process_time(), FAILED
        try:
            outcome = read_file(sample, number)
        except BaseException as error:
            errors.put(f"file {number}: {type(error).__name__}: {error}")
        end, grown = time.process_time(), memory.peak() - before
        if end - begin > SLOW or grown > MEMORY:
            errors.put(f"file {number} took {end - begin:.1f} s and {grown:.0f} MB")
            outcome = FAILED
            memory.forget()
        if outcome == FAILED:
            shutil.copy(path, keep / kept_name(name, number, path))
        if len(inner) > 1:
            path.write_bytes(dict(inner)[path])
        told[SLOWEST], told[PEAK] = max(told[SLOWEST], end - begin), max(told[PEAK], grown)
        told[outcome] += 1
        told[SPENT] = used + end - begun
        told[NEXT] = number + 1


def kept_name(name: str, number: int, path: Path) -> str:
    """Return the name of a file that is kept."""
    return f"fuzz_{name.replace(' ', '_').replace(',', '')}_{number}{path.suffix}"


def main() -> int:
    """Run all formats; return how many failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--format", action="append", choices=list(SAMPLES))
    parser.add_argument("--files", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--only", type=int, help="the number of a file that is made, kept and read again")
    options = parser.parse_args()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    failed = 0
    print(f"commit {commit()}, {EVENTS} events in a file, seed {options.seed}\n")
    print("| decoder | files | read | read, with a report | refused | failed | slowest | memory | files/s |")
    print(f"|{'---|' * 9}")
    for name in options.format or SAMPLES:
        folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        try:
            if options.only is None:
                failed += watch_format(name, folder, options.files, options.seed, options.keep)
            else:
                repeat_file(name, folder, options.only, options.seed, options.keep)
        finally:
            shutil.rmtree(folder)
    return failed


def repeat_file(name: str, folder: Path, number: int, seed: int, keep: Path) -> None:
    """Make and keep one file of a format, and read it."""
    sample, inner = prepare_sample(name, folder, seed)
    path = write_damaged(name, inner, number, seed)
    print(shutil.copy(path, keep / kept_name(name, number, path)), flush=True)
    read_file(sample, number)


def process_status(pid: int) -> tuple[float, float]:
    """Return the time of the processor that a process has used [s] and its memory [MB]; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0, 0.0
    pages = int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), pages / 2**20


def watch_format(name: str, folder: Path, files: int, seed: int, keep: Path) -> bool:
    """Read all files of a format in as many processes as it takes; print a row, return whether any failed."""
    context = multiprocessing.get_context("spawn")
    told = context.Array("d", 8, lock=False)
    errors, said = context.SimpleQueue(), []
    while told[NEXT] < files:
        place = Path(tempfile.mkdtemp(dir=folder))
        process = context.Process(target=run_files, args=(name, place, files, seed, keep, told, errors))
        process.start()
        why = wait_for(process, told, errors, said)
        if told[NEXT] < files:
            number = int(told[NEXT])
            said.append(f"file {number}: {why}")
            for path in (path for path in place.rglob("*") if path.is_file()):
                shutil.copy(path, keep / kept_name(name, number, path))
            told[FAILED] += 1
            told[NEXT] += 1
        shutil.rmtree(place)
    counts = " | ".join(f"{int(told[kind]):,}" for kind in (NEXT, WHOLE, NOTED, REFUSED, FAILED))
    speed = told[NEXT] / max(told[SPENT], 1e-9)
    print(f"| {name} | {counts} | {told[SLOWEST]:.2f} s | {told[PEAK]:.0f} MB | {speed:.0f} |", flush=True)
    for sentence in said[:20]:
        print(f"    {sentence}", flush=True)
    return bool(said)


def wait_for(process, told, errors, said: list[str]) -> str:
    """Wait until a process ends, and end it where it hangs or takes too much; return how it ended."""
    number, since, (used, _) = told[NEXT], time.monotonic(), process_status(process.pid)
    why = ""
    while process.is_alive():
        process.join(0.05)
        while not errors.empty():
            said.append(errors.get())
        spent, memory = process_status(process.pid)
        if told[NEXT] != number:
            number, since, used = told[NEXT], time.monotonic(), spent
        elif spent - used > HUNG or time.monotonic() - since > STUCK or memory > TOO_MUCH:
            why = f"was ended after {spent - used:.0f} s with {memory:.0f} MB"
            process.kill()
    process.join()
    while not errors.empty():
        said.append(errors.get())
    return why or f"the process ended with {process.exitcode}"


if __name__ == "__main__":
    sys.exit(main())
