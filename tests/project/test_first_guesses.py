"""What a new user types in a notebook: it works, or one sentence helps."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import dase
from dase.io.sequence import Sequence

FRAMES = (np.random.default_rng(0).random((20, 8, 10)) ** 2).astype(np.float32)


@pytest.fixture(scope="module")
def events():
    return dase.simulate(FRAMES, "ideal", fps=1000)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("dase.read('a.h5')", "dase.open_recording(path)"),
        ("dase.convert('a', 'b')", "dase.io.convert(source, target)"),
        ("dase.save(events, 'a.h5')", "dase.io.write(path, events)"),
        ("dase.show(events)", "dase.plot(what)"),
        ("dase.PRESETS", "dase.load_sensor(name)"),
        ("dase.simulat", "dase.simulate"),
        ("dase.qqq", "no attribute 'qqq'"),
        ("events[:10]", "events.select(index)"),
        ("list(events)", "events.select(index)"),
        ("dase.plot(3)", "got int"),
        ("dase.simulate('clip.mp4', 'ideal', fps=1000)", "dase.open_video(path)"),
        ("dase.simulate(FRAMES, 'ideal', fps=1000, device='gpu')", "device 'gpu' does not exist"),
        ("dase.load_sensor('DAVIS364')", "davis346"),
        ("dase.load_sensor('davis346')['thresh']", "it has threshold, mismatch, "),
        ("dase.load_sensor('davis346').with_effect('leak')", "got 'leak'"),
        ("dase.compare(events, 'ideal')", "give the scene"),
        ("dase.compare(events, 'ideal', scene=FRAMES)", "dase.VideoScene(frames, times)"),
        ("dase.compare(events, 'ideal', scene='static', pixels=0)", "got 0 of 10x8"),
    ],
)
def test_a_wrong_guess_is_told_the_way(code, said, events):
    with pytest.raises((dase.InputError, AttributeError, KeyError, TypeError)) as caught:
        eval(code, {"dase": dase, "events": events, "FRAMES": FRAMES})
    assert said in str(caught.value)
    assert len(str(caught.value)) < 250


def test_packages_are_there_without_an_import_of_their_own():
    code = "import dase; print(dase.io.convert.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "convert\n"


def test_everything_prints_on_a_screen(events):
    scene = dase.VideoScene(FRAMES, np.arange(len(FRAMES)) / 1000)
    sweep = dase.sweep(scene, "ideal", "threshold.on", np.linspace(0.1, 0.9, 200))
    for shown in (events, dase.load_sensor("v2e-noisy"), dase.Sensor(), dase.find_signatures(events), sweep):
        lines = repr(shown).splitlines()
        assert len(lines) <= 30
        assert max(map(len, lines)) <= 100
    assert "leak" in repr(dase.load_sensor("davis346"))


def test_events_are_written_and_drawn_as_they_are(tmp_path, events):
    dase.io.write(tmp_path / "a.h5", events)
    np.testing.assert_array_equal(dase.io.read(tmp_path / "a.h5").events.t, events.t)
    recording = dase.open_recording(tmp_path / "a.h5")
    swept = dase.sweep(FRAMES, "ideal", "threshold.on", [0.1, 0.3], fps=1000)
    for shown in (events, recording, Sequence(events, FRAMES, np.arange(20) / 1000), swept):
        figure = dase.plot(shown)
        assert figure._repr_png_().startswith(b"\x89PNG")  # what a notebook asks for
    (axes,) = figure.axes
    np.testing.assert_array_equal([line.get_ydata() for line in axes.lines], [swept.on, swept.off])


@pytest.mark.parametrize("package", ["torch", "tasks"])
def test_without_pytorch_the_extra_is_named(package):
    code = f"import sys; sys.modules['torch'] = None; import dase; dase.{package}.Stream"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.splitlines()[-1].startswith(f"ImportError: dase.{package} needs PyTorch: ")
    assert "[learn]" in done.stderr
