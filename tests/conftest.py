"""Fixtures that every test may ask for."""

from __future__ import annotations

import os
import signal
from pathlib import Path

# What a shell starts in the background ignores Ctrl-C, and so would all that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Libraries read these when they are loaded. Tensors of tests are so small that threads of PyTorch only wait
# for each other, ten times as long where something else wants the cores; threads of dase share them fairly.
os.environ.setdefault("OMP_NUM_THREADS", "1")
_PROCESSES = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _PROCESSES > 1:
    os.environ.setdefault("DASE_THREADS", str(max((os.cpu_count() or 1) // _PROCESSES, 1)))

import numpy as np
import pytest
from helpers.scripts import load_script


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the kernels are tested on: cpu or cuda:0")


LONGEST = (
    *("test_examples", "test_diagnose", "test_tutorial", "test_held_frames", "test_distributed"),
    *("test_walk", "test_silent_pixels", "test_commands", "test_training_run", "test_measurement"),
    *("test_trainings", "test_grading", "test_video", "test_pages", "test_find_signatures"),
    *("test_cuda_compiles", "test_descent", "test_detection_limits", "test_endings"),
    *("test_effects_voltage", "test_user_readout_alike", "test_honest_findings", "test_frame_alignment"),
    *("test_burst_strength", "test_sensor_edit", "test_learned_sensor", "test_unequal_thresholds"),
    *("test_uneven_light", "test_code_metrics", "test_recording"),
)
"""Files that take longest, in this order: where processes share the work, these are begun first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes longest; the order of other files, and that inside of files, stays."""
    rank = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """Warp name of the device under test."""
    return str(request.config.getoption("--device"))


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers of their own for every test, the same in every run and wherever its file lies."""
    return np.random.default_rng(list(request.node.name.encode()))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recordings and photographs that are no part of the project; skips where it is absent.

    `DASE_DATA` names it, see perf/data_folder.py.
    """
    path = load_script("perf/data_folder.py").data_folder()
    if path is None or not (path / "photos").is_dir():
        pytest.skip("needs recordings and photographs that are no part of the project: set DASE_DATA")
    return path
