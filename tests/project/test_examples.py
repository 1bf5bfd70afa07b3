"""The examples, as a new user runs them."""

from __future__ import annotations

import runpy
from pathlib import Path

import cv2
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Return what runs an example in an empty folder, and gives its names and what it prints."""

    def run(name):
        monkeypatch.chdir(tmp_path)
        found = runpy.run_path(str(EXAMPLES / name))
        out = capsys.readouterr().out
        assert max(map(len, out.splitlines())) <= 100
        return found, out

    return run


def test_a_video(run):
    found, out = run("my_video.py")
    events, rates = found["events"], found["rates"]
    assert f"{len(events)} events as Prophesee" in out
    assert out.count("Events(") == 2
    assert (rates.on[1:] < rates.on[:-1]).all()
    assert all(cv2.imread(name) is not None for name in ("events.png", "rates.png"))


@pytest.mark.slow
def test_a_recording(run):
    found, out = run("my_recording.py")
    assert found["found"].selected == ("bandwidth",)
    assert "missing: bandwidth" in out
    assert found["dase"].load_sensor("fitted.toml")["bandwidth"].cutoff == pytest.approx(30, rel=0.05)
    assert all(cv2.imread(name) is not None for name in ("recording.png", "staircase.png"))


@pytest.mark.slow
def test_an_effect_of_ones_own(run):
    found, out = run("my_effect.py")
    assert found["found"].selected == ("supply_drop",)
    assert found["found"].sensor["supply_drop"].drop == pytest.approx(0.6, rel=0.1)
    assert "supply_drop  drop 0.6" in out


def test_all_of_them_are_named():
    readme = (EXAMPLES.parent / "README.md").read_text("utf-8")
    assert all(f"examples/{path.name}" in readme for path in EXAMPLES.glob("*.py"))
    assert len(list(EXAMPLES.glob("*.py"))) == 3
