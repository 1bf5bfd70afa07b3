"""Fixtures that every test may ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the kernels are tested on: cpu or cuda:0")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """Warp name of the device under test."""
    return str(request.config.getoption("--device"))


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers of their own for every test, the same in every run."""
    return np.random.default_rng(list(request.node.nodeid.encode()))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recordings and photographs beside the checkout; skips where it is absent."""
    path = Path(__file__).parents[2] / "shared"
    if not (path / "photos").is_dir():
        pytest.skip("needs the recordings and photographs of ../shared, which are not part of the project")
    return path
