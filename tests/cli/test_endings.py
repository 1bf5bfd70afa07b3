"""Runs that end early, however: what is left can be resumed, and nobody goes on writing."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dase import io
from dase.files.folder_lock import LOCK_FILE
from perf.kills import group_members

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
@pytest.mark.parametrize("victims", ["group", pytest.param("worker", marks=pytest.mark.slow)])
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
