"""Fixtures that every test may ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.scripts import load_script


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the kernels are tested on: cpu or cuda:0")


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
