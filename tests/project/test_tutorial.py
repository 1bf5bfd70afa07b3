"""The tutorial, command by command, as a new user would go through it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.command_line import dase_here

from dase import InputError, VideoScene, count, load_effects, load_sensor
from dase.simulation.sensor import Sensor

PAGE = (Path(__file__).parents[2] / "docs" / "tutorial-effect.md").read_text("utf-8")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return the folder after the first part of the tutorial."""
    path = tmp_path_factory.mktemp("tutorial")
    first, *_ = blocks("sh")
    done = dase_here(*shlex.split(first)[1:], cwd=path)
    assert done.returncode == 0, done.stderr
    (text,) = blocks("python file=adaptation.py")
    (path / "adaptation.py").write_text(text)
    return path


@pytest.mark.slow
def test_commands(folder):
    lines = [line for block in blocks("sh")[1:] for line in block.splitlines()]
    for line in lines:
        assert line.startswith("dase "), line
        done = dase_here(*shlex.split(line)[1:], cwd=folder)
        assert done.returncode == 0, f"{line}: {done.stderr}"
    assert load_sensor(folder / "camera.toml", load_all(folder))["adaptation"].depth == 0.6
    assert cv2.imread(str(folder / "out" / "sequence_00000.png")) is not None
    assert cv2.imread(str(folder / "powers.png")) is not None
    # what was hidden in the recording is found, and written down
    fitted = load_sensor(folder / "fitted.toml", load_all(folder))
    assert fitted["adaptation"].depth == pytest.approx(0.6, rel=0.2)
    assert [entry.did for entry in fitted.history][-1] == "add adaptation"
    assert fitted.history[-1].error_after < 0.6 * fitted.history[-1].error_before
    assert "Missing: adaptation" in (folder / "report.html").read_text()
    assert cv2.imread(str(folder / "staircase.png")) is not None


def load_all(folder: Path) -> dict:
    from dase.simulation.user_effects import known_effects

    return known_effects([folder / "adaptation.py"])


def test_python(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (code,) = blocks("python")
    exec(compile(code, "tutorial-effect.md", "exec"), {})
    assert cv2.imread("adaptation.png") is not None


def test_the_effect_is_what_the_page_says(folder):
    """After a step up, OFF events come back: as many as the depth takes back; sooner in bright light."""
    effect = load_effects(folder / "adaptation.py")["adaptation"](depth=0.6, speed=5.0)
    times = np.arange(0, 4, 1e-3)
    back, late = [], []
    for bright in (0.4, 0.8):
        light = np.where(times < 0.2, bright / 8, bright)
        scene = VideoScene(np.tile(light[:, None, None], (1, 16, 16)), times)
        counts = count(scene, Sensor().with_effect(effect), [0.25, 0.5, 4.0])[0].mean(-1)
        back.append(counts[:, 0].sum())
        late.append(counts[1, 0] / counts[:, 0].sum())
        np.testing.assert_array_equal(counts[:, 1], 0)  # no further ON events
    # log 8 · 0.6 / 0.2, less what went back before the first window
    assert 3.5 < min(back) <= max(back) < np.log(8) * 0.6 / 0.2 + 1
    assert late[0] > late[1] + 0.1


def test_the_message_is_the_one_of_the_page(folder, tmp_path):
    (said,) = blocks("text")
    text = (folder / "adaptation.py").read_text().replace("intensity: float", "light: float")
    (tmp_path / "adaptation.py").write_text(text)
    with pytest.raises(InputError) as caught:
        load_effects(tmp_path / "adaptation.py")
    start = said.removeprefix("dase: ").strip().removesuffix("...")
    assert str(caught.value).removeprefix(f"{tmp_path}/").startswith(start)


def test_links_lead_somewhere():
    docs = Path(__file__).parents[2] / "docs"
    for target in re.findall(r"\]\(([^)#]+)\)", PAGE):
        assert (docs / target).exists(), target
