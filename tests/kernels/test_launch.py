"""Where kernels run: threads, processes that fork, and a first call by many threads at once."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SIMULATED = """
import os, sys, threading
import numpy as np
import dase
from dase.kernels import launch

launch.set_threads(2)
frames = np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.2, (9, 40, 50)), 0) - 1.5)
scene = dase.VideoScene(np.minimum(frames, 1.0), np.linspace(0, 0.05, 9))

def events():
    return len(dase.simulate(scene, dase.load_sensor("ideal"), seed=1))
"""


def output_of(script: str, **more: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", SIMULATED + script], capture_output=True, text=True, timeout=300,
        env={**os.environ, **more},
    )  # fmt: skip


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_simulates_what_its_parent_does():
    """The child of a fork, as a DataLoader's worker, has none of the threads of its parent's pool."""
    done = output_of("""
mine = events()
reader, writer = os.pipe()
if os.fork() == 0:
    os.write(writer, str(events()).encode())
    os._exit(0)
os.close(writer)
print(mine, os.read(reader, 100).decode())
""")
    assert done.returncode == 0, done.stderr
    mine, childs = map(int, done.stdout.split())
    assert mine == childs > 100


def test_a_first_call_by_many_threads_keeps_standard_error():
    done = output_of("""
found = []
threads = [threading.Thread(target=lambda: found.append(launch.find_device("cpu").alias)) for _ in range(8)]
[t.start() for t in threads]
[t.join() for t in threads]
print("still here", file=sys.stderr)
print(len(found))
""")
    assert done.stdout.split() == ["8"]
    assert "still here" in done.stderr
