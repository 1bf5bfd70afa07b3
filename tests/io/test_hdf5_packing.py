"""Threads that pack the chunks of all HDF5 files of a process."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest

import dase
from dase import io
from dase.io import h5


def many(rng: np.random.Generator, count: int = 4 * h5.CHUNK) -> dase.Events:
    t = np.sort(rng.random(count))
    x, y = rng.integers(0, 64, (2, count)).astype(np.uint16)
    return dase.Events(t, x, y, rng.random(count) < 0.5, 64, 64)


@pytest.fixture(autouse=True)
def three_threads(monkeypatch):
    monkeypatch.setattr(h5, "thread_count", lambda: 3)
    h5._packing_threads.cache_clear()
    yield
    h5._packing_threads.cache_clear()


def write(path, events: dase.Events) -> None:
    with io.create(path) as writer:
        writer.events(events)


def test_files_share_their_threads_and_one_that_fails_leaves_the_others_whole(tmp_path, rng):
    events = many(rng)
    write(tmp_path / "alone.h5", events)
    lost_file = io.create(tmp_path / "lost.h5")
    lost = lost_file.__enter__()
    with io.create(tmp_path / "kept.h5") as kept:
        assert lost._line._pool is kept._line._pool
        lost.events(events)
        kept.events(events)
        error = KeyError("of the caller")
        assert not lost_file.__exit__(KeyError, error, None)
    assert (tmp_path / "kept.h5").read_bytes() == (tmp_path / "alone.h5").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alone.h5", "kept.h5"]


def test_a_forked_process_packs_on_threads_of_its_own(tmp_path, rng):
    events = many(rng)
    write(tmp_path / "before.h5", events)
    child = multiprocessing.get_context("fork").Process(target=write, args=(tmp_path / "child.h5", events))
    child.start()
    child.join(60)
    ended = child.exitcode
    child.kill()
    assert ended == 0
    assert (tmp_path / "child.h5").read_bytes() == (tmp_path / "before.h5").read_bytes()
