"""The streams in HDF5 files: right, and the same wherever they are made."""

from __future__ import annotations

import threading
import time
import zlib
from collections.abc import Callable

import numpy as np
import pytest

from dase import io
from dase.events import Events
from dase.io import h5
from dase.io.h5 import deflate_bytes, shuffle_bytes
from dase.kernels.threads import keep_thread_count, thread_count


def on_stacks(act: Callable[[], bytes], count: int) -> set[bytes]:
    """What `act` returns in threads that live at the same time, so that each has a stack of its own."""
    found: set[bytes] = set()
    all_done = threading.Barrier(count, timeout=60)

    def work() -> None:
        found.add(act())
        all_done.wait()

    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


@pytest.mark.parametrize("size", [0, 1, 3, 4, 5, 16, 20, 21, 32, 1000, 100_000])
def test_streams_are_right(rng, size):
    for levels in (1, 4, 256):
        data = rng.integers(0, levels, size).astype(np.uint8)
        assert zlib.decompress(deflate_bytes(data)) == data.tobytes()


def test_streams_do_not_depend_on_the_stack(rng):
    """ISA-L alone lets the address of the stack decide which of these matches are found, once in 128."""
    for _ in range(5):
        head = rng.integers(0, 256, 8)
        data = np.concatenate([head, rng.integers(0, 4, 8), head, head]).astype(np.uint8)
        assert len(on_stacks(lambda data=data: deflate_bytes(data), 400)) == 1


def write_sequence(path, rng, threads):
    """Write events and frames in turns; the arrays are overwritten after each call."""
    before = thread_count()
    keep_thread_count(threads)
    try:
        with io.create(path) as writer:
            writer.configuration("x = 1\n")
            thresholds = rng.random((2, 30, 40), np.float32)
            writer.thresholds(thresholds)
            thresholds[:] = 0
            for k, count in enumerate((0, 300_000, 10, 70_000, 600_000, 5)):
                grey = rng.integers(0, 256, (30, 40), dtype=np.uint8)
                flow = rng.normal(size=(2, 30, 40)).astype(np.float32)
                writer.frame(float(k), grey, flow)
                t = k + np.sort(rng.random(count))
                x, y = rng.integers(0, 30, (2, count)).astype(np.uint16)
                writer.events(Events(t, x, y, rng.random(count) < 0.5, 40, 30))
                for array in (grey, flow, t, x, y):
                    array[:] = 0
    finally:
        keep_thread_count(before)
    return path.read_bytes()


def test_files_do_not_depend_on_how_many_threads_pack_them(tmp_path):
    one, four = (write_sequence(tmp_path / f"{n}.h5", np.random.default_rng(5), n) for n in (1, 4))
    assert one == four
    sequence = io.read(tmp_path / "4.h5")
    assert len(sequence.events) == 970_015
    assert sequence.frames.shape == (6, 30, 40)
    assert np.all(np.diff(sequence.events.t) >= 0)
    rng = np.random.default_rng(5)
    np.testing.assert_array_equal(sequence.thresholds, rng.random((2, 30, 40), np.float32))
    np.testing.assert_array_equal(sequence.frames[0], rng.integers(0, 256, (30, 40), dtype=np.uint8))


def test_nothing_of_an_abandoned_file_is_packed_any_more(tmp_path, monkeypatch):
    packed, pack = [], h5.pack_chunk

    def slowly(chunk):
        packed.append(len(chunk))
        time.sleep(0.05)
        return pack(chunk)

    monkeypatch.setattr(h5, "pack_chunk", slowly)
    before = thread_count()
    keep_thread_count(3)
    try:
        with pytest.raises(RuntimeError, match="enough"):
            begin_and_fail(tmp_path / "a.h5")
        count = len(packed)
        # the threads of all files take chunks in turn: what was left of the first would come before these
        write_sequence(tmp_path / "b.h5", np.random.default_rng(5), 3)
    finally:
        keep_thread_count(before)
    assert not (tmp_path / "a.h5").exists()
    of_flow = 2  # first axis of a chunk of flow; chunks of events have one axis of thousands
    assert packed[:count].count(of_flow) < 12
    assert packed[count:].count(of_flow) == 6


def begin_and_fail(path):
    with io.create(path) as writer:
        for k in range(12):
            writer.frame(float(k), np.zeros((30, 40), np.uint8), np.zeros((2, 30, 40), np.float32))
        raise RuntimeError("enough")


@pytest.mark.parametrize("kind", [np.float64, np.int16, np.float32, np.bool_, np.int8])
@pytest.mark.parametrize("shape", [(1,), (7,), (2, 5, 3), (4096,)])
def test_shuffled_bytes_are_the_first_of_all_then_the_second(rng, kind, shape):
    values = rng.integers(-100, 100, shape).astype(kind)
    want = [values.tobytes()[n :: values.itemsize] for n in range(values.itemsize)]
    assert shuffle_bytes(values).tobytes() == b"".join(want)
