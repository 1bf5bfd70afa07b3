"""What cannot work is refused before the work, and what does nothing is not taken in silence."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from dase import Events, InputError, io
from dase.cli import dase_group
from dase.simulation.sensor_edit import SensorText


def refusal(*arguments: object) -> str:
    done = CliRunner().invoke(dase_group, [str(a) for a in arguments])
    assert done.exit_code != 0
    assert isinstance(done.exception, (InputError, SystemExit)), done.exception
    return done.output + (str(done.exception) if isinstance(done.exception, InputError) else "")


@pytest.fixture
def clip(tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    for n in range(4):
        cv2.imwrite(str(folder / f"{n}.png"), np.full((6, 8), 50 * n + 20, np.uint8))
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "ideal", "{file}", "-o", "{missing}/a.toml"),
        ("diagnose", "ideal", "{file}", "-o", "{missing}/a.toml"),
        ("diagnose", "ideal", "{file}", "--json", "{missing}/a.json"),
        ("diagnose", "ideal", "{file}", "--draw", "{missing}/a.png"),
        ("compare", "ideal", "{file}", "-o", "{missing}/a.html"),
        ("add", "ideal", "leak", "-o", "{missing}/a.toml"),
        ("remove", "davis346", "leak", "-o", "{missing}/a.toml"),
        ("show", "{file}", "-o", "{missing}/a.png"),
        ("convert", "{file}", "{missing}/a.npz"),
        ("distinguish", "ideal", "davis346", "-o", "{missing}/a.png"),
        ("effects", "new", "my_effect", "-o", "{missing}/a.py"),
        ("synth", "{missing}/a.h5", "--video", "{clip}", "--fps", "100"),
    ],
)
def test_a_missing_folder_is_refused_before_the_work(tmp_path, clip, command, monkeypatch):
    io.write(tmp_path / "a.h5", io.Sequence(Events.empty(8, 6)))
    for work in ("read", "stream", "convert"):
        monkeypatch.setattr(io, work, lambda *a, **k: pytest.fail("work began"))
    monkeypatch.setattr("dase.scenes.video.open_video", lambda *a, **k: pytest.fail("work began"))
    places = {"missing": tmp_path / "none", "file": tmp_path / "a.h5", "clip": clip}
    said = " ".join(refusal(*(part.format(**places) for part in command)).split())
    assert "does not exist" in said.replace("doesnot", "does not")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    "options",
    [
        ("--format", "npz"),
        ("--regime", "slow"),
        ("--jobs", "1"),
        ("--resume",),
        ("--sequences", "10"),
        ("--duration", "2"),
        ("--images", "builtin"),
    ],
)
def test_options_without_a_meaning_beside_a_video_are_refused(tmp_path, clip, options):
    said = refusal("synth", tmp_path / "a.npz", "--video", clip, "--fps", "100", *options)
    assert f"{options[0]} has no meaning beside --video" in said
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--duration", "1e9"), "duration must be at most 36000 s, got 1e+09: make more sequences"),
        (("--frame-rate", "1e12"), "frame rate must give at most 10,000,000 frames in 1 s, got 1e+12"),
    ],
)
def test_times_beyond_any_memory_are_a_sentence(tmp_path, options, message):
    assert message in refusal("synth", tmp_path / "out", "--size", "8x6", *options)
    assert not (tmp_path / "out").exists()


def test_comments_of_a_fitted_file_are_about_its_values():
    text = SensorText(
        "# A camera.\n\n[threshold]\n# ON first\non = 0.2 # measured in May\noff = 0.2 # stays\n"
        "\n[leak]\nrate = 0.1 # leak rate [Hz]\n",
        "here",
    )
    sensor = text.sensor()
    fitted = text.describing(sensor.with_effect(type(sensor["threshold"])(on=0.25, off=0.2)))
    assert "# ON first\non = 0.25 # fitted (was 0.2: measured in May)\n" in fitted.text
    assert "off = 0.2 # stays" in fitted.text
    again = fitted.describing(sensor.with_effect(type(sensor["threshold"])(on=0.3, off=0.2)))
    assert again.text == fitted.text.replace("on = 0.25", "on = 0.3")


def test_comments_about_a_parameter_stay_as_they_are():
    from dase.simulation.sensor_file import dump_sensor, load_sensor

    sensor = load_sensor("davis346")
    text = SensorText(dump_sensor(sensor), "here")
    fitted = text.describing(sensor.with_effect(type(sensor["threshold"])(on=0.25, off=0.3)))
    assert "(was " not in fitted.text


def started(script: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a shell script in which "$@" is the command dase."""
    command = ["sh", "-c", script, "sh", sys.executable, "-c", "from dase.cli import main; main()"]
    return subprocess.run(
        [*command, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | environment,
    )


@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing(tmp_path, closed):
    options = ("--size", "8x6", "--sequences", "1", "--duration", "0.05", "--jobs", "1")
    done = started(f'"$@" {closed}', "synth", tmp_path / "out", *options)
    assert done.returncode == 0, done.stderr
    assert len(io.read(tmp_path / "out" / "sequence_00000.h5").frames) == 3
    assert started(f'"$@" {closed}', "info", tmp_path / "none").returncode == 2


def test_a_kernel_cache_that_cannot_be_written_names_its_variable(tmp_path):
    (tmp_path / "file").touch()
    options = ("--size", "8x6", "--sequences", "1", "--duration", "0.05", "--jobs", "1")
    done = started('"$@"', "synth", tmp_path / "out", *options, WARP_CACHE_PATH=str(tmp_path / "file" / "x"))
    assert done.returncode == 2
    assert "WARP_CACHE_PATH names another folder" in done.stderr
    assert len(done.stderr.splitlines()) == 1
