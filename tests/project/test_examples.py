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


@pytest.mark.slow
def test_a_network_for_reconstruction(run):
    pytest.importorskip("torch")
    found, out = run("train_reconstruction.py")
    assert found["fitted"].sensor["threshold"].on == pytest.approx(0.3, rel=0.1)
    assert "recording.h5: reconstruction, 74 judged" in out
    # better than any one grey: 0.25 and 0.2 are the swings of the two waves
    assert found["found"].metrics["mse_affine"] < 0.7 * (0.25**2 + 0.2**2) / 2
    assert found["found"].metrics["ssim"] > 0.3
    assert cv2.imread("reconstruction/recording.h5.png").shape == (6 * 48, 2 * 64, 3)
    assert Path("reconstruction/recording.h5.mp4").stat().st_size > 0


@pytest.mark.slow
def test_a_network_for_flow(run):
    pytest.importorskip("torch")
    found, out = run("train_flow.py")
    assert "recording.h5: flow" in out
    assert found["found"].metrics["aee_zero"] == pytest.approx(2.0, rel=1e-3)  # 240 px/s in 1/120 s
    assert found["found"].metrics["aee"] < 0.8 * found["found"].metrics["aee_zero"]


def test_all_of_them_are_named():
    readme = (EXAMPLES.parent / "README.md").read_text("utf-8")
    assert all(f"examples/{path.name}" in readme for path in EXAMPLES.glob("*.py"))
    assert len(list(EXAMPLES.glob("*.py"))) == 5
