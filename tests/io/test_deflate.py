"""The streams in HDF5 files: right, and the same wherever they are made."""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable

import numpy as np
import pytest

from dase.io.h5 import deflate_bytes


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
