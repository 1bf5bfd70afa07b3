"""Damage files of every format and read them: no crash, no hang, no error but InputError, little memory.

    python -m perf.fuzz_io                        100 000 files of every format
    python -m perf.fuzz_io --format EVT3 --files 1000 --seed 7
    python -m perf.fuzz_io --format EVT3 --only 4711 --keep .      one file again, and keep it
    python -m perf.fuzz_io --jobs 16 --minutes 9 --state out/fuzz.json   call again to go on

Files are damaged in memory, lie on a disk in memory, and are read whole and as a stream by turns. Every
block of files runs in a process of its own that a second one watches: a crash, or a file that takes too long
or too much memory, is counted and kept as `fuzz_FORMAT_N` in the folder named by --keep, and the run goes on
with the next file. Processes are forked from one that has imported everything: importing would take as long
as a block does. Formats are read in the order of --format. Each file has random numbers of its own, so any
one can be made again. Prints Markdown.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from perf.benchmarks.kernels import commit

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers import avi_files as reference_video
from helpers import odd_files
from helpers import sample_files as reference_io
from helpers.watched_files import opens_of

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
    import lz4.frame

    reference_io.aedat4(path, e, frames=frames, motion=motion, compression=1, compress=lz4.frame.compress)


def write_packed_dsec(path: Path, e) -> None:
    import hdf5plugin

    reference_io.dsec(path, e, **hdf5plugin.Blosc(cname="zstd"))


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


def write_aedat3(path: Path, e, frames) -> None:
    """Events, frames and samples of the motion sensor."""
    spans = [(int(t * 1e6), int(t * 1e6) + 900) for t in frames[0]]
    shown = [(*span, grey) for span, grey in zip(spans, frames[1], strict=True)]
    reference_io.aedat3(path, e, frames=shown, motion=[(9, (0.0, 0.0, 1.0), (1.0, 2.0, 3.0))])


def write_weights(path: Path) -> None:
    """Weights of a small network."""
    from dase.networks.threshold_network import NetworkShape, ThresholdNet
    from dase.networks.weights_file import save_net

    save_net(path, ThresholdNet(NetworkShape(channels=2, depth=1)))


SAMPLES = {
    **{name: reference_io.SAMPLES[name] for name in ("EVT2", "EVT3", "EVT2.1", "EVT2.1 legacy", "DAT")},
    "AEDAT2": reference_io.SAMPLES["AEDAT2"],
    "AEDAT4 packed": (".aedat4", with_frames(write_aedat4)),
    "ECF": (".hdf5", reference_io.ecf),
    "ECF, columns packed": (".hdf5", lambda path, e: reference_io.ecf(path, e, mode=1)),
    "ECF, not packed": (".hdf5", lambda path, e: reference_io.ecf(path, e, mode=0)),
    "DSEC packed": (".h5", write_packed_dsec),
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
    "AEDAT3 with frames": (".aedat", with_frames(write_aedat3)),
    "MATLAB, not packed": (
        ".mat",
        lambda path, e: reference_io.matlab(path, e, compress=False, structure=False),
    ),
    **{f"{name}, tangled": reference_io.SAMPLES[name] for name in odd_files.LAYOUTS},
    "TOML": (".toml", lambda path, e: path.write_text(odd_files.TOML)),
    "COCO": (".json", lambda path, e: odd_files.write_coco(path)),
    "safetensors": (".safetensors", lambda path, e: write_weights(path)),
    "AVI": (".avi", with_frames(video_maker("MJPG"))),
    "AVI, not compressed": (".avi", with_frames(write_plain_avi)),
    "MP4": (".mp4", with_frames(video_maker("mp4v"))),
    "text with PNG": (".folder", with_frames(write_pictures)),
} | reference_io.SAMPLES
"""Those that hold most first, then what is left of those of the tests; small sensors keep them small."""
NEEDS = {
    **reference_io.NEEDS,
    "ROS 1 packed": "rosbags",
    "DSEC packed": "hdf5plugin",
    "AEDAT4 packed": "lz4",
    "COCO": "pycocotools",
}
"""Packages without which a sample cannot be made or read."""
BLOCK = 2500
"""Files that a process reads before it ends, where several work side by side."""
IMPORTED = (
    *("perf.benchmarks.kernels", "cv2", "pytest", "dase.scenes.image_sources", "dase.networks.weights_file"),
    *sorted(set(NEEDS.values())),
)
"""What a process finds imported when it begins, where there is such a package."""
W, H = 48, 36


class Memory:
    """The memory of this process [MB]; ru_maxrss would begin with what its parent had."""

    def __init__(self) -> None:
        self._status = os.open("/proc/self/status", os.O_RDONLY)
        self._clear = os.open("/proc/self/clear_refs", os.O_WRONLY)

    def peak(self) -> float:
        """Return the largest so far."""
        text = os.pread(self._status, 4096, 0)
        return int(text[text.index(b"VmHWM:") + 6 :].split(None, 1)[0]) / 1024

    def forget(self) -> None:
        """Begin anew with what there is now."""
        os.pwrite(self._clear, b"5", 0)


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


def read_sensor(path: Path, turn: int) -> int:
    """Read a sensor file, and write it again by turns; return how that ended."""
    from dase import dump_sensor, load_sensor
    from dase.simulation import sensor_edit

    sensor = load_sensor(path)
    if turn % 2:
        dump_sensor(sensor)
        sensor_edit.read_sensor_text(path).sensor()
    return WHOLE


def read_coco(path: Path, turn: int) -> int:
    """Cut out an object of annotations."""
    from dase.scenes.image_sources import open_images

    source = open_images(f"coco:{path},{path.parent / 'pictures'}")
    for seed in range(3):
        source.foreground(np.random.default_rng(seed))
    return WHOLE


def read_weights(path: Path, turn: int) -> int:
    """Read the weights of a network."""
    from dase.networks.weights_file import load_net

    load_net(path)
    return WHOLE


OTHER_READERS = {"TOML": read_sensor, "COCO": read_coco, "safetensors": read_weights}
"""Files that are no recordings: name of the sample to what reads it."""


def read_any(name: str, path: Path, turn: int) -> int:
    """Read a file of a sample; return how that ended: WHOLE, NOTED or REFUSED."""
    if name not in OTHER_READERS:
        return read_file(path, turn)
    try:
        return OTHER_READERS[name](path, turn)
    except InputError as error:
        if not set("\x1b\x9b\0").isdisjoint(str(error)) or path.stem not in str(error):
            raise AssertionError(f"not one sentence that names the file: {error}") from error
        return REFUSED


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
    if "tangled" in name:
        new = odd_files.tangled(content, secret_of(path), rng)
        path.write_bytes(reference_io.mutated(new, rng) if rng.random() < 0.3 else new)
    elif name in OTHER_READERS and rng.random() < 0.7:
        odd = content.decode("utf-8", "replace") if name != "safetensors" else ""
        new = odd_files.odd_weights(content, rng) if not odd else odd_files.odd_text(odd, rng).encode()
        path.write_bytes(new)
    else:
        path.write_bytes(reference_io.mutated(content, rng))
    return path


def secret_of(path: Path) -> Path:
    """Return the file beside a tangled one that must never be opened, and make it where it is missing."""
    secret = path.parent / "secret.h5"
    if not secret.exists():
        with h5py.File(secret, "w") as file:
            file["numbers"] = np.arange(W * H, dtype=np.uint8).reshape(H, W)
    return secret


def run_files(name: str, folder: Path, files: int, seed: int, keep: Path, told, errors) -> None:
    """Damage and read files of one format from number told[NEXT] to `files`, and tell what happens."""
    warnings.simplefilter("error")
    cv2.setNumThreads(1)
    sample, inner = prepare_sample(name, folder, seed)
    opened = opens_of(secret_of(sample)) if "tangled" in name else lambda: False
    for turn in (0, 1):
        if read_any(name, sample, turn) == REFUSED:
            errors.put("the sample itself is refused")
    memory, begun = Memory(), time.process_time()
    memory.forget()
    before, used = memory.peak(), told[SPENT]
    for number in range(int(told[NEXT]), files):
        path = write_damaged(name, inner, number, seed)
        opened()  # by the making
        memory.forget()  # what making it took
        begin = time.process_time()
        try:
            outcome = read_any(name, sample, number)
            if opened():
                raise AssertionError("another file was opened")
            if h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE):
                raise AssertionError("the file was left open")
        except BaseException as error:
            outcome = FAILED
            errors.put(f"file {number}: {type(error).__name__}: {str(error)[:300]}")
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


@dataclass
class Row:
    """What happened to the files of one format.

    Args:
        blocks: First numbers of the blocks that are done.
        files: How many were read.
        whole: Files read without a word.
        noted: Read with a report of what was put right or left out.
        refused: Refused with a sentence.
        failed: All others.
        slowest: Time that one took [s].
        peak: Most memory that one took [MB].
        spent: Time of processor [s].
        said: Sentences about those that failed.
    """

    blocks: list[int] = field(default_factory=list)
    files: int = 0
    whole: int = 0
    noted: int = 0
    refused: int = 0
    failed: int = 0
    slowest: float = 0.0
    peak: float = 0.0
    spent: float = 0.0
    said: list[str] = field(default_factory=list)

    def add(self, first: int, files: int, told, said: list[str]) -> None:
        """Take in a block of files."""
        self.blocks.append(first)
        self.files += files
        self.whole += int(told[WHOLE])
        self.noted += int(told[NOTED])
        self.refused += int(told[REFUSED])
        self.failed += int(told[FAILED])
        self.slowest, self.peak = max(self.slowest, told[SLOWEST]), max(self.peak, told[PEAK])
        self.spent += told[SPENT]
        self.said += said

    def text(self, name: str) -> str:
        """Return a row of the table, and what was said below it."""
        numbers = (self.files, self.whole, self.noted, self.refused, self.failed)
        counts = " | ".join(f"{number:,}" for number in numbers)
        speed = self.files / max(self.spent, 1e-9)
        row = f"| {name} | {counts} | {self.slowest:.2f} s | {self.peak:.0f} MB | {speed:.0f} |"
        return "\n".join([row, *(f"    {sentence}" for sentence in self.said[:20])])


def main() -> int:
    """Run all formats; return how many failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--format", action="append", choices=list(SAMPLES))
    parser.add_argument("--files", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--only", type=int, help="the number of a file that is made, kept and read again")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="after which no block begins")
    parser.add_argument("--state", type=Path, help="a file that keeps what is done, to go on with")
    options = parser.parse_args()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    names = [name for name in options.format or SAMPLES if is_possible(name)]
    if options.only is not None:
        with tempfile.TemporaryDirectory(dir=in_memory()) as folder:
            for name in names:
                repeat_file(name, Path(folder), options.only, options.seed, options.keep)
        return 0
    rows = {name: Row() for name in names}
    if options.state and options.state.exists():
        old = json.loads(options.state.read_text())
        if old["seed"] == options.seed:
            rows |= {name: Row(**row) for name, row in old["rows"].items() if name in rows}
    run_rows(rows, options)
    print(f"commit {commit()}, {EVENTS} events in a file, seed {options.seed}\n")
    print("| decoder | files | read | read, with a report | refused | failed | slowest | memory | files/s |")
    print(f"|{'---|' * 9}")
    print("\n".join(row.text(name) for name, row in rows.items()))
    if left := {name: options.files - row.files for name, row in rows.items() if row.files < options.files}:
        print(f"\nto be read yet: {sum(left.values()):,} files of {', '.join(left)}; call again with --state")
    return sum(bool(row.said) for row in rows.values())


def is_possible(name: str) -> bool:
    """Return whether the packages that a sample needs are there; say it where they are not."""
    need = NEEDS.get(name)
    if need is None or importlib.util.find_spec(need) is not None:
        return True
    print(f"{name} is left out: it needs {need}")
    return False


def in_memory() -> str | None:
    """Return the folder of a disk in memory, None where there is none."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def run_rows(rows: dict[str, Row], options: argparse.Namespace) -> None:
    """Read what is left of all formats, block by block, and keep what is done."""
    end, lock = time.monotonic() + 60 * options.minutes, threading.Lock()

    def run_block(task: tuple[str, int]) -> None:
        if time.monotonic() > end:
            return
        (name, first), folder = task, Path(tempfile.mkdtemp(dir=in_memory()))
        behind = min(first + BLOCK, options.files)
        try:
            told, said = watch_block(name, folder, first, behind, options.seed, options.keep)
        finally:
            shutil.rmtree(folder)
        with lock:
            rows[name].add(first, behind - first, told, said)
            if options.state:
                kept = {"seed": options.seed, "rows": {n: asdict(r) for n, r in rows.items()}}
                options.state.parent.mkdir(parents=True, exist_ok=True)
                part = options.state.with_suffix(".part")
                part.write_text(json.dumps(kept))
                part.replace(options.state)

    tasks = [(name, n) for name in rows for n in range(0, options.files, BLOCK) if n not in rows[name].blocks]
    if not options.format:
        tasks.sort(key=lambda task: "tangled" not in task[0])  # what takes longest first
    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(run_block, tasks))


def repeat_file(name: str, folder: Path, number: int, seed: int, keep: Path) -> None:
    """Make and keep one file of a format, and read it."""
    sample, inner = prepare_sample(name, folder, seed)
    path = write_damaged(name, inner, number, seed)
    print(shutil.copy(path, keep / kept_name(name, number, path)), flush=True)
    read_any(name, sample, number)


def process_status(pid: int) -> tuple[float, float]:
    """Return the time of the processor that a process has used [s] and its memory [MB]; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0, 0.0
    pages = int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), pages / 2**20


def watch_block(name: str, folder: Path, first: int, end: int, seed: int, keep: Path):
    """Read files of a format in as many processes as it takes; return what they told, and said.

    Args:
        name: Of the sample.
        folder: For the files.
        first: Number of the first file.
        end: Behind the last one.
        seed: Of all of them.
        keep: A folder for those that fail.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(IMPORTED))
    told = context.Array("d", 8, lock=False)
    told[NEXT] = first
    errors, said = context.SimpleQueue(), []
    while told[NEXT] < end:
        place = Path(tempfile.mkdtemp(dir=folder))
        process = context.Process(target=run_files, args=(name, place, end, seed, keep, told, errors))
        process.start()
        why = wait_for(process, told, errors, said)
        if told[NEXT] < end:
            number = int(told[NEXT])
            said.append(f"file {number}: {why}")
            for path in (path for path in place.rglob("*") if path.is_file()):
                shutil.copy(path, keep / kept_name(name, number, path))
            told[FAILED] += 1
            told[NEXT] += 1
        shutil.rmtree(place)
    return told, said


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
