"""The command line as a user meets it: what is wrong is one sentence, and nothing is left half-written."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.command_line import SMALL, dase, dase_here, one_sentence, refusal

from dase import Events, InputError, io
from dase.cli import dase_group


def toml(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "sensor.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--images", "nowhere"), "folder 'nowhere' is missing"),
        (("--size", "0x24"), "0x24"),
        (("--size", "big"), "WxH"),
        (("--sequences", "-3"), "sequences must be >= 1, got -3"),
        (("--duration", "nan"), "duration must be a number > 0, got nan"),
        (("--duration", "0"), "duration must be a number > 0, got 0"),
        (("--travel", "0"), "travel must be 0.01 to 1 px, got 0"),
        (("--frame-rate", "-1"), "frame rate must be a number > 0, got -1"),
        (("--seed", "-1"), "seed must be a whole number >= 0, got -1"),
        (("--jobs", "0"), "jobs must be >= 1, got 0"),
        (("--regime", "fats"), "did you mean 'fast'?"),
        (("--sensor", "davis345"), "did you mean 'davis346'?"),
        (("--sensor", "missing.toml"), "missing.toml does not exist"),
        (("--backend", "gpu"), "device 'gpu' does not exist"),
        (("--fps", "30"), "--fps goes with --video"),
    ],
)
def test_wrong_option(options, message, tmp_path):
    out = tmp_path / "out"
    assert message in refusal("synth", out, *SMALL, *options)
    assert not out.exists() or not list(out.glob("*"))


def test_cuda_without_a_gpu(tmp_path):
    import warp as wp

    if wp.is_cuda_available():
        pytest.skip("needs a machine without a GPU")
    assert "needs an NVIDIA GPU" in refusal("synth", tmp_path / "out", *SMALL, "--device", "cuda")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[threshold]\non = 0.0", "threshold.on must lie in [0.01, 10] log intensity, got 0"),
        ("[threshold]\non = -0.2", "threshold.on must lie in [0.01, 10] log intensity, got -0.2"),
        ("[threshold]\nonn = 0.2", "no parameter 'onn': did you mean 'on'?"),
        ("[threshold]\n[leek]\nrate = 1.0", "no effect 'leek': did you mean 'leak'?"),
        ("[threshold]\n[leak]\nrate = nan", "leak.rate must lie in [0, 100000] Hz, got nan"),
        (
            "[threshold]\n[refractory]\nmode = 'lose'",
            "refractory.mode must be one of reset, drop, delay, got 'lose'",
        ),
        ("[leak]\nrate = 1.0", "needs the effect 'threshold'"),
        ("size = [0, 3]\n[threshold]", "size must lie between 1x1 and 16384x16384, got 0x3"),
        ("not toml at all", "is not TOML"),
    ],
)
def test_wrong_sensor(text, message, tmp_path):
    said = refusal("synth", tmp_path / "out", *SMALL, "--sensor", toml(tmp_path, text))
    assert message in said
    assert "sensor.toml" in said


def test_wrong_pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    assert "found none" in refusal("synth", tmp_path / "out", *SMALL, "--images", folder)
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n but no picture")
    said = refusal("synth", tmp_path / "out", *SMALL, "--images", folder)
    assert "broken.png" in said
    assert not list((tmp_path / "out").glob("*sequence*"))


def test_synth_then_show(tmp_path):
    out = tmp_path / "out"
    done = dase("synth", out, *SMALL)
    assert done.returncode == 0, done.stderr
    assert re.search(r"[\d,]+ events in 1 sequence, ", done.stdout)
    assert "time samples rendered" in done.stdout
    sequence = io.read(out / "sequence_00000.h5")
    assert sequence.frames is not None
    assert len(sequence.frames) == 6
    assert sequence.configuration is not None
    assert 'regime = "slow"' in sequence.configuration
    shown = dase_here("show", out / "sequence_00000.h5")
    assert shown.returncode == 0, shown.stderr
    assert cv2.imread(str(out / "sequence_00000.png")) is not None
    # a second run must not overwrite the first
    assert "resume it" in refusal("synth", out, *SMALL)
    assert "other options" in refusal("synth", out, *SMALL, "--resume", "--seed", "9")


def test_video(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(20):
        picture = np.full((24, 32), 60, np.uint8)
        picture[:, i : i + 8] = 220
        cv2.imwrite(str(folder / f"{i:03d}.png"), picture)
    said = refusal("synth", tmp_path / "v.npz", "--video", "nowhere.mp4")
    assert "nowhere.mp4 does not exist" in said
    assert "give its frame rate" in refusal("synth", tmp_path / "v.npz", "--video", folder)
    done = dase(
        "synth", tmp_path / "v.npz", "--video", folder, "--fps", "1000", "--sensor", "ideal", "--gamma", "1"
    )
    assert done.returncode == 0, done.stderr
    events = io.read(tmp_path / "v.npz").events
    assert (events.width, events.height) == (32, 24)
    # the leading edge of the bar is an ON edge in front of it, the trailing edge OFF
    steps = np.floor(np.log((220 / 255 + 1e-3) / (60 / 255 + 1e-3)) / 0.2)
    assert np.count_nonzero(events.p) == 24 * steps * 19
    assert np.count_nonzero(~events.p) == 24 * steps * 19


def test_full_disk(tmp_path):
    def small_disk():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    done = dase("synth", tmp_path / "out", *SMALL, "--images", "builtin", preexec_fn=small_disk)
    assert one_sentence(done)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["synth.toml"]


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_interrupt_then_resume(jobs, tmp_path):
    out, whole = tmp_path / "out", tmp_path / "whole"
    options = ("--size", "64x48", "--duration", "0.3", "--sequences", "6", "--jobs", jobs, "--regime", "slow")
    command = [
        sys.executable,
        "-c",
        "from dase.cli import main; main()",
        "synth",
        str(out),
        *map(str, options),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    deadline = time.monotonic() + 120
    while not list(out.glob("sequence_*")) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=120)
    left = sorted(p.name for p in out.iterdir())
    assert process.returncode in (0, 130), said  # it may just have finished
    assert "Traceback" not in said
    assert all(name == "synth.toml" or re.fullmatch(r"sequence_\d{5}\.h5", name) for name in left)
    done = dase("synth", out, *options, "--resume")
    assert done.returncode == 0, done.stderr
    assert dase("synth", whole, *options[:-4], "--jobs", 3 - jobs, "--regime", "slow").returncode == 0
    for path in sorted(whole.iterdir()):
        assert (out / path.name).read_bytes() == path.read_bytes(), path.name


def test_effects():
    listed = dase_here("effects", "list")
    assert listed.returncode == 0
    assert len(listed.stdout.splitlines()) >= 6
    shown = dase_here("effects", "show", "leak")
    assert "Hz" in shown.stdout
    assert "plausible" in shown.stdout
    assert "Source: " in shown.stdout
    assert "did you mean 'leak'?" in refusal("effects", "show", "leek")


@pytest.mark.parametrize("suffix", [".npz", ".raw", ".txt"])
def test_convert_and_info(suffix, tmp_path, rng):
    n = 500
    t = np.sort(rng.integers(0, 10**6, n)) * 1e-6
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (64, 48))
    x[0], y[0] = 63, 47
    events = Events(t, x, y, rng.random(n) < 0.5, 64, 48)
    io.write(tmp_path / "a.h5", io.Sequence(events))
    target = tmp_path / f"b{suffix}"
    done = dase_here("convert", tmp_path / "a.h5", target)
    assert done.returncode == 0, done.stderr
    assert "500 events written" in done.stdout
    back = io.read(target).events
    for name in "xyp":
        np.testing.assert_array_equal(getattr(back, name), getattr(events, name))
    np.testing.assert_allclose(back.t - back.t[0], events.t - events.t[0], atol=1e-9)
    told = dase_here("info", target)
    assert told.returncode == 0, told.stderr
    assert "64 x 48" in told.stdout
    assert "unknown format '.xyz'" in refusal("convert", tmp_path / "a.h5", tmp_path / "b.xyz")


BROKEN = [
    ("a.raw", b"", "does not name its encoding"),
    ("a.raw", b"% evt 3.0\n% geometry 99999x7\n" + bytes(64), "1x1 to 8192x8192, got 99999x7"),
    ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(200), "cannot be read as HDF5, damaged or cut short"),
    ("a.npz", b"PK\x03\x04" + bytes(200), "cannot be read as NumPy archive, damaged or cut short"),
    ("a.aedat4", b"#!AER-DAT4.0\r\n\xff\xff\xff\x7f", "claims 2147483647 bytes"),
    ("a.txt", b"0.1 1 1 1\n0.2 1 1 rubbish\n", "line 2 is not 't x y p'"),
    ("a.xyz", b"something else", "unknown format '.xyz'"),
    ("missing.raw", None, "No such file"),
]


@pytest.mark.parametrize(("name", "content", "message"), BROKEN)
def test_broken_files(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    path = str(tmp_path / name)
    for command in (["info", path], ["show", path], ["convert", path, str(tmp_path / "b.evt2")]):
        done = CliRunner().invoke(dase_group, command)
        assert isinstance(done.exception, InputError)
        assert message in str(done.exception)
        assert path in str(done.exception)
        assert "\n" not in str(done.exception)
    assert sorted(p.name for p in tmp_path.iterdir()) == [name] * (content is not None)


def test_a_broken_file_is_one_sentence_and_exit_code_2(tmp_path):
    (tmp_path / "a.txt").write_bytes(BROKEN[5][1])
    assert BROKEN[5][2] in one_sentence(dase("info", tmp_path / "a.txt"))


def test_help_shows_one_spelling_of_the_device():
    for name in ("synth", "train", "demo"):
        text = CliRunner().invoke(dase_group, [name, "--help"]).output
        assert "--device" in text
        assert "--backend" not in text
