"""Kill small runs at random moments and resume them: the same bytes, no process and no temporary left.

    python perf/kills.py --kills 20 --starts 20              of synth, stereo, convert and train each
    python perf/kills.py --kills 100 --starts 60 --jobs 6 --minutes 9    six at once; says how to go on
    python perf/kills.py --only train --first 17 --kills 1   one round again

Each round starts a command, sends SIGKILL, SIGTERM or SIGHUP at a random moment of its life, waits until all
its processes are gone, and lets it run again, with `--resume` where there is such. A start is two `synth`
into one folder at once. Rounds have random numbers of their own, by seed and number. All runs compute on the
processor, where the same seed gives the same bytes. Linux only: processes are found in /proc.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
EXITS = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGHUP: 129}
GRACE = 8.0
"""Time in which all processes of a killed run must be gone [s]."""


@dataclass(frozen=True)
class Subject:
    """A command under test.

    Args:
        arguments: Of `dase`; `{out}` is the folder it writes to, `{source}` a recording.
        resume: Arguments that make it go on.
        compared: Names of files whose bytes must be those of a run that nobody disturbed; empty for all.
    """

    arguments: tuple[str, ...]
    resume: tuple[str, ...] = ()
    compared: tuple[str, ...] = ()


SYNTH = ("synth", "{out}", "--size", "64x48", "--duration", "0.3", "--regime", "slow")
SUBJECTS = {
    "synth": Subject((*SYNTH, "--sequences", "6", "--jobs", "2"), ("--resume",)),
    "stereo": Subject((*SYNTH, "--sequences", "4", "--jobs", "2", "--stereo", "0.1"), ("--resume",)),
    "convert": Subject(("convert", "{source}", "{out}/events.npz")),
    "train": Subject(
        ("train", "davis346", "-o", "{out}", "--preset", "tiny", "--steps", "12", "--size", "48x36",
         "--sequences", "5"),
        ("--resume",),
        ("sensor.toml", "learned.safetensors", "job.json", "recipe.json"),
    ),
}  # fmt: skip


def command(arguments: tuple[str, ...], out: Path, source: Path) -> list[str]:
    """Return a command line."""
    filled = [part.format(out=out, source=source) for part in arguments]
    return [sys.executable, "-c", "from dase.cli import main; main()", *filled]


def start(line: list[str]) -> subprocess.Popen[str]:
    """Start a command in a group of its own."""
    return subprocess.Popen(
        line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def group_members(group: int) -> list[int]:
    """Return the processes of a group that run; Linux only."""
    out = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text("latin-1").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] not in "ZX":
            out.append(int(stat.parent.name))
    return out


def orphans(group: int) -> list[int]:
    """Return what still runs of a group after `GRACE`, and end it."""
    deadline = time.monotonic() + GRACE
    while (left := group_members(group)) and time.monotonic() < deadline:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return left


def contents(folder: Path, names: tuple[str, ...] = ()) -> dict[str, bytes]:
    """Return the files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not names or path.name in names}


def differing_names(got: dict[str, bytes], want: dict[str, bytes]) -> list[str]:
    """Return the files that differ, are missing, or should not be there."""
    return sorted(name for name in got.keys() | want.keys() if got.get(name) != want.get(name))


def hidden_files(folder: Path) -> list[str]:
    """Return temporaries and locks."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".") or ".tmp" in path.name]


def undisturbed(subject: Subject, place: Path, source: Path) -> tuple[dict[str, bytes], float]:
    """Return what a command writes, and how long it takes [s]."""
    out = fresh_folder(place / "whole", subject)
    begin = time.monotonic()
    subprocess.run(command(subject.arguments, out, source), check=True, stdout=subprocess.DEVNULL)
    return contents(out, subject.compared), time.monotonic() - begin


def fresh_folder(parent: Path, subject: Subject) -> Path:
    """Return a folder that is not there, or empty where the command wants one."""
    out = parent / "out"  # sensors are called by it
    out.mkdir(parents=True)
    if subject.resume:
        out.rmdir()
    return out


def kill_once(
    subject: Subject, place: Path, source: Path, want: dict[str, bytes], span: float, rng: random.Random
) -> tuple[str, list[str]]:
    """Kill a run, resume it, and return how it was killed and what is wrong."""
    out = fresh_folder(place, subject)
    number, delay, wrong = rng.choice(SIGNALS), rng.uniform(0, 1.1 * span), []
    process = start(command(subject.arguments, out, source))
    try:
        said = process.communicate(timeout=delay)[1]
        ended = "before the signal"
        # nobody killed this one: what is wrong here is not the resuming's fault
        if process.returncode:
            wrong.append(f"exit code {process.returncode}: {said[-300:]}")
        elif changed := differing_names(contents(out, subject.compared), want):
            wrong.append(f"other bytes without a kill: {', '.join(changed)}")
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        said = process.communicate(timeout=60)[1]
        ended = f"{signal.Signals(number).name} at {delay:.2f} s"
        # before Python and dase are up, the signal has its plain effect
        if process.returncode not in (0, EXITS[number], -number):
            wrong.append(f"exit code {process.returncode}: {said[-300:]}")
    if "Traceback" in said and process.returncode not in (-number,):
        wrong.append(f"traceback: {said[-300:]}")
    if left := orphans(process.pid):
        wrong.append(f"{len(left)} processes left")
    begun = (out / "synth.toml").exists() or (out / "job.json").exists()
    again = subprocess.run(
        command(subject.arguments + (subject.resume if begun else ()), out, source),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if again.returncode:
        wrong.append(f"not resumed: {again.stderr[-300:]}")
        return ended, wrong
    got = contents(out, subject.compared)
    if changed := differing_names(got, want):
        wrong.append(f"other bytes: {', '.join(changed)}")
    if hidden := hidden_files(out):
        wrong.append(f"left: {', '.join(hidden)}")
    return ended, wrong


def start_two(place: Path, source: Path, want: dict[str, bytes], rng: random.Random) -> tuple[str, list[str]]:
    """Start two runs into one folder; return how they ended and what is wrong."""
    subject = SUBJECTS["synth"]
    out, wrong = fresh_folder(place, subject), []
    line = command(subject.arguments + subject.resume, out, source)
    one = start(line)
    time.sleep(rng.uniform(0, 0.5))
    other = start(line)
    said = [process.communicate(timeout=300)[1] for process in (one, other)]
    codes = [one.returncode, other.returncode]
    for code, text in zip(codes, said, strict=True):
        if code not in (0, 2) or (code == 2 and "is being written by process" not in text):
            wrong.append(f"exit code {code}: {text[-300:]}")
    if 0 not in codes:
        wrong.append("none finished")
    if contents(out) != want:
        wrong.append(f"other files: {sorted(contents(out))}")
    return f"exit codes {codes}", wrong


@dataclass
class Rounds:
    """All rounds of one subject.

    Args:
        name: Of the subject, or `starts`.
        want: What an undisturbed run writes.
        span: How long it takes among as many others as there will be [s].
        done: Rounds that were made, in whatever order.
        bad: Of these, those where something was wrong.
    """

    name: str
    want: dict[str, bytes]
    span: float
    done: int = 0
    bad: int = 0

    def run(self, number: int, seed: int, base: Path, source: Path, keep: Path | None) -> None:
        """Make one round; print and keep what is wrong."""
        rng, place = random.Random(f"{seed} {self.name} {number}"), base / self.name / str(number)
        if self.name == "starts":
            how, wrong = start_two(place, source, self.want, rng)
        else:
            how, wrong = kill_once(SUBJECTS[self.name], place, source, self.want, self.span, rng)
        if wrong:
            print(f"{self.name} {number}, seed {seed}: {how}: {'; '.join(wrong)}", flush=True)
            if keep is not None:
                shutil.copytree(place, keep / f"{self.name}_{seed}_{number}", dirs_exist_ok=True)
        shutil.rmtree(place)
        self.done += 1
        self.bad += bool(wrong)


def prepare_rounds(name: str, jobs: int, base: Path, source: Path) -> Rounds:
    """Return a subject's rounds with what an undisturbed run writes, once it has compiled its kernels."""
    subject = SUBJECTS.get(name, SUBJECTS["synth"])
    want, span = undisturbed(subject, base / name, source)
    with ThreadPoolExecutor(jobs) as pool:  # many at once take longer, and kills must hit all of their life
        again = list(
            pool.map(lambda n: undisturbed(subject, base / name / f"at once {n}", source), range(jobs))
        )
    if others := [n for n, (got, _) in enumerate(again) if differing_names(got, want)]:
        print(
            f"{name}: {len(others)} of {jobs} undisturbed runs wrote other bytes than the first", flush=True
        )
    return Rounds(name, want, max(taken for _, taken in again) if jobs > 1 else span)


def main() -> None:
    """Run all, print what is wrong, and exit with 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--only", choices=[*SUBJECTS, "starts"], action="append")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the number of the first round")
    parser.add_argument("--jobs", type=int, default=1, help="rounds at once")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="after which no round begins")
    parser.add_argument("--keep", type=Path, help="a folder for what a failed round left")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    os.environ.setdefault("OMP_NUM_THREADS", str(max((os.cpu_count() or 1) // options.jobs, 1)))
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        source = base / "source" / "sequence_00000.h5"
        made = ("synth", str(source.parent), "--sequences", "1", "--jobs", "1", "--duration", "1")
        subprocess.run(command(made, base, base), check=True, stdout=subprocess.DEVNULL)
        for name in options.only or [*SUBJECTS, "starts"]:
            if time.monotonic() > end:
                print(f"{name}: not begun; go on with --only {name} --first {options.first}", flush=True)
                continue
            rounds = prepare_rounds(name, options.jobs, base, source)

            def one(number: int, rounds: Rounds = rounds) -> bool:
                if time.monotonic() > end:
                    return False
                rounds.run(number, options.seed, base, source, options.keep)
                return True

            count = options.starts if name == "starts" else options.kills
            with ThreadPoolExecutor(options.jobs) as pool:
                made_all = list(pool.map(one, range(options.first, options.first + count)))
            print(f"{name}: {rounds.done} rounds of {rounds.span:.1f} s, {rounds.bad} wrong", flush=True)
            if not all(made_all):
                print(f"    go on with --only {name} --first {options.first + sum(made_all)}", flush=True)
            failures += rounds.bad
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
