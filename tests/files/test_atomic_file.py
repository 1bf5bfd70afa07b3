"""A file is there whole or not at all, and what dead processes left is removed."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from dase.files.atomic_file import replacing
from dase.files.folder_lock import locking_folder
from dase.files.processes import ProcessIdentity


def dead_identity() -> ProcessIdentity:
    """Return a process of this machine that has ended."""
    code = "from dase.files.processes import ProcessIdentity as P; print(P.own())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ProcessIdentity.parse(done.stdout.strip())


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
