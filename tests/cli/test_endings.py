"""Runs that end early, however: what is left can be resumed, and nobody goes on writing."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from dase import Events, InputError, io
from dase.datasets import generate
from dase.files.atomic_file import replacing
from dase.files.folder_lock import LOCK_FILE, locking_folder
from dase.files.processes import ProcessIdentity
from perf.kills import group_members

JOB = generate.DatasetJob(
    images="builtin", sensor="[threshold]\n", sequences=3, width=16, height=12, duration=0.05, regime="slow"
)
OPTIONS = ("--size", "64x48", "--duration", "0.3", "--sequences", "6", "--regime", "slow")


def started(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from dase.cli import main; main()", *map(str, arguments)]
    return subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )


def wait_for(what, seconds: float = 120.0):
    deadline = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.01)
    return found


def workers_of(pid: int) -> list[int]:
    """Return the processes that a server of workers has forked, which is a child of `pid`."""

    def stands(one: int) -> tuple[int, bool]:
        parent = int(Path(f"/proc/{one}/stat").read_text("latin-1").rpartition(")")[2].split()[1])
        return parent, b"forkserver" in Path(f"/proc/{one}/cmdline").read_bytes()

    return [one for one in group_members(pid) if stands(one)[1] and stands(one)[0] != pid]


def dead_identity() -> ProcessIdentity:
    """Return a process of this machine that has ended."""
    code = "from dase.files.processes import ProcessIdentity as P; print(P.own())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ProcessIdentity.parse(done.stdout.strip())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "data"
    generate.generate_dataset(JOB, out)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("spoil", ["cut", "empty", "garbage", "zeros"])
def test_resume_makes_damaged_sequences_again(whole, tmp_path, spoil):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    path = out / "sequence_00001.h5"
    good = path.read_bytes()
    spoilt = {
        "cut": good[:1000],
        "empty": b"",
        "garbage": b"rubbish" * 100,
        "zeros": good[:600] + bytes(9000),
    }
    path.write_bytes(spoilt[spoil])
    said: list[str] = []
    report = generate.generate_dataset(JOB, out, resume=True, say=said.append)
    assert report.sequences == 1
    assert len(said) == 1
    assert re.search(r"sequence_00001\.h5.*: made again$", said[0])
    assert contents(out) == contents(whole)


def test_resume_of_what_is_whole_makes_nothing(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    for jobs in (1, 2):
        assert generate.generate_dataset(JOB, out, jobs=jobs, resume=True).sequences == 0
    assert contents(out) == contents(whole)


def test_resume_sets_foreign_sequences_aside(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    io.write(out / "sequence_00000.h5", io.Sequence(Events.empty(16, 12)))  # says nothing of a job
    shutil.copy(whole / "sequence_00001.h5", out / "sequence_00002.h5")  # of the job, but another one of it
    foreign = (out / "sequence_00000.h5").read_bytes()
    said: list[str] = []
    assert generate.generate_dataset(JOB, out, resume=True, say=said.append).sequences == 2
    assert ["of another job: set aside as" in line for line in said] == [True, True]
    made = contents(out)
    assert made.pop("sequence_00000.h5.other") == foreign
    assert made.pop("sequence_00002.h5.other") == made["sequence_00001.h5"]
    assert made == contents(whole)


def test_sequences_without_a_record_are_not_taken_for_done(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / "synth.toml").unlink()
    (out / "sequence_00001.h5").write_bytes(b"rubbish")
    with pytest.raises(InputError, match=r"holds 'sequence_00000.h5', but no synth.toml"):
        generate.generate_dataset(JOB, out)
    assert (out / "sequence_00001.h5").read_bytes() == b"rubbish"
    assert generate.generate_dataset(JOB, out, resume=True).sequences == 1
    assert contents(out) == contents(whole)


def test_a_record_that_is_no_text_is_refused(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / "synth.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8 text"):
        generate.generate_dataset(JOB, out, resume=True)


def test_a_folder_has_one_run(tmp_path):
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys, pathlib\nfrom dase.files.folder_lock import locking_folder\n"
            "with locking_folder(pathlib.Path(sys.argv[1])):\n"
            "    print('held', flush=True)\n    sys.stdin.read()",
            str(tmp_path / "out"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=f"is being written by process {holder.pid}: wait for it"):
        generate.generate_dataset(JOB, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [LOCK_FILE]
    holder.kill()
    holder.communicate()
    with locking_folder(tmp_path / "out"), locking_folder(tmp_path / "out"):  # stale, and held twice
        assert str(ProcessIdentity.own()) in (tmp_path / "out" / LOCK_FILE).read_text()
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("text", ["", "abc", "deadbeef-1-2"])
def test_a_lock_that_was_not_written_to_its_end_is_stale(tmp_path, text):
    (tmp_path / LOCK_FILE).write_text(text)
    with locking_folder(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_an_id_that_came_round_again_is_another_process(tmp_path):
    own = ProcessIdentity.own()
    assert own.runs()
    earlier = ProcessIdentity(own.machine, own.pid, own.start + "0")
    assert not earlier.runs()
    (tmp_path / LOCK_FILE).write_text(f"{earlier}\n")
    with locking_folder(tmp_path):
        pass


def test_the_lock_of_another_machine_is_left_to_the_user(tmp_path):
    (tmp_path / LOCK_FILE).write_text("00000000-1-2\n")
    with (
        pytest.raises(
            InputError, match=r"process of another machine.*; if it has ended, remove .*\.dase\.lock"
        ),
        locking_folder(tmp_path),
    ):
        pass


def test_only_temporaries_of_dead_processes_are_removed(tmp_path):
    dead, own = dead_identity(), ProcessIdentity.own()
    names = {
        "dead": f".a.{dead}.0.tmp.h5",
        "own": f".a.{own}.7.tmp.h5",
        "other file": f".b.{dead}.0.tmp.h5",
        "other machine": ".a.00000000-1-2.0.tmp.h5",
        "user": ".a.notes.tmp.h5",
    }
    for name in names.values():
        (tmp_path / name).write_text("x")
    with replacing(tmp_path / "a.h5") as temporary:
        temporary.write_text("new")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"a.h5", *names.values()} - {names["dead"]}
    with locking_folder(tmp_path):
        pass
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"a.h5", *names.values()} - {names["dead"], names["other file"]}
    week_ago = time.time() - 7 * 86400
    os.utime(tmp_path / names["other machine"], (week_ago, week_ago))
    with locking_folder(tmp_path):
        pass
    assert not (tmp_path / names["other machine"]).exists()


def test_content_is_on_the_disk_before_the_name(tmp_path, monkeypatch):
    order: list[str] = []
    fsync, rename = os.fsync, os.replace

    def noted_fsync(handle):
        order.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        fsync(handle)

    def noted_replace(source, target):
        order.append("name")
        rename(source, target)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("asks /proc what is flushed, which only Linux has")
    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    with replacing(tmp_path / "a") as temporary:
        temporary.write_text("x")
    assert order == ["file", "name", "folder"]


def test_threads_may_replace_one_file_at_once(tmp_path):
    def write(n: int) -> None:
        for _ in range(20):
            with replacing(tmp_path / "a") as temporary:
                temporary.write_text(str(n) * 100_000)

    threads = [threading.Thread(target=write, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len((tmp_path / "a").read_text()) == 100_000
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
@pytest.mark.parametrize(
    ("number", "code"),
    [
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
        (signal.SIGKILL, -9),
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_their_parent(tmp_path, number, code):
    out = tmp_path / "out"
    process = started("synth", out, *OPTIONS, "--sequences", 400, "--jobs", 2)
    wait_for(lambda: list(out.glob("sequence_*")))
    os.kill(process.pid, number)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == code
    assert "Traceback" not in said
    wait_for(lambda: not group_members(process.pid), 6)
    left = [
        path.name for path in out.iterdir() if not re.fullmatch(r"synth\.toml|sequence_\d{5}\.h5", path.name)
    ]
    assert left == ([LOCK_FILE] if number == signal.SIGKILL else [])
    for path in out.glob("sequence_*.h5"):
        io.read(path)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
@pytest.mark.parametrize("victims", ["group", "worker"])
def test_a_signal_to_the_workers(tmp_path, victims):
    out = tmp_path / "out"
    process = started("synth", out, *OPTIONS, "--sequences", 400, "--jobs", 2)
    wait_for(lambda: list(out.glob("sequence_*")))
    if victims == "group":
        os.killpg(process.pid, signal.SIGTERM)
    else:
        workers = wait_for(lambda: workers_of(process.pid))
        os.kill(workers[0], signal.SIGKILL)
    said = process.communicate(timeout=60)[1]
    assert "Traceback" not in said
    assert process.returncode == (143 if victims == "group" else 2)
    if victims == "worker":
        assert "worker process was ended from outside" in said
    wait_for(lambda: not group_members(process.pid), 6)
    assert {path.suffix for path in out.iterdir()} == {".toml", ".h5"}


def test_nohup_is_respected():
    script = (
        "import os, signal, sys\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from dase.files.interrupt import raising_signals, defer_interrupt\n"
        "with raising_signals(), defer_interrupt() as interrupt:\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n    interrupt.check()\nprint('goes on')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout == "goes on\n", done.stderr


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
@pytest.mark.parametrize("place", ["callback", "destructor"])
def test_signal_in_a_destructor_is_not_lost(name, code, place):
    script = (
        "import os, signal, sys, time, weakref\n"
        "from dase.files.interrupt import raising_signals\n"
        "def signalled(_=None):\n"
        f"    os.kill(os.getpid(), signal.{name})\n"
        "    for _ in range(1000): pass\n"
        "class Held:\n"
        f"    {'__del__ = signalled' if place == 'destructor' else 'pass'}\n"
        "held = Held()\n"
        f"{'watch = weakref.ref(held, signalled)' if place == 'callback' else ''}\n"
        "with raising_signals():\n"
        "    try:\n"
        "        del held\n"
        "        time.sleep(20)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
        "print('lost')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")
