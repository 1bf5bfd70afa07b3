"""One run writes to a folder at a time, and what ended without a word does not hold it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.tiny_datasets import JOB

from dase.datasets import generate
from dase.errors import InputError
from dase.files.folder_lock import LOCK_FILE, locking_folder
from dase.files.processes import ProcessIdentity


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
