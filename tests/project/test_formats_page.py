"""Every command and line of Python of docs/formats.md and of the README's "Your camera", word for word."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import sample_files as reference_io

from dase import io
from dase.cli import dase_group
from dase.io.format import Format

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/formats.md").read_text("utf-8")
README = (ROOT / "README.md").read_text("utf-8")
CAMERA = README.split("## Your camera\n")[1].split("\n## ")[0]

NAMES = {
    "recording.aedat4": "AEDAT4",
    "recording.aedat": "AEDAT2",
    "recording.raw": "EVT3",
    "recording.hdf5": "Prophesee HDF5",
    "recording_td.dat": "DAT",
    "recording.bag": "ROS bag",
    "recording.mcap": "ROS bag",
    "events.h5": "DSEC HDF5",
    "outdoor_day1_data.hdf5": "MVSEC HDF5",
    "shapes_rotation.zip": "zip of text",
    "events.csv": "text",
    "recording.npz": "NumPy archive",
    "v2e.h5": "v2e HDF5",
    "sequence_00000.h5": "HDF5",
    "clip.avi": "frames",
    "recording.h5": "HDF5",
}
"""File of the page to the format it must be found to have."""

MAKERS = {
    "DSEC HDF5": "DSEC",
    "Prophesee HDF5": "ECF",
    "MVSEC HDF5": "MVSEC",
    "v2e HDF5": "v2e",
    "ROS bag": "ROS 1",
}


def frames(rng):
    return [(k * 10_000, k * 10_000 + 4000, rng.integers(0, 256, (260, 346), np.uint8)) for k in range(3)]


def make(path, rng):
    """Make a small file for a name of the page."""
    name = NAMES[path.name]
    wide = name in ("AEDAT4", "MVSEC HDF5") or path.suffix == ".csv"
    e = reference_io.events(rng, 20_000, *((346, 260) if wide else (240, 180)))
    if name == "AEDAT4":
        reference_io.aedat4(path, e, frames=frames(rng))
    elif path.suffix == ".mcap":
        reference_io.mcap(path, e)
    elif name == "frames":
        out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (96, 64))
        for _ in range(3):
            out.write(rng.integers(0, 256, (64, 96, 3), np.uint8))
        out.release()
    else:
        reference_io.SAMPLES[MAKERS.get(name, name)][1](path, e)


def commands():
    out = re.findall(r"\| `(dase [^`]*)` \|", PAGE)
    for text in (PAGE, CAMERA):
        for block in re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL):
            out += [line.split("#")[0].strip() for line in block.splitlines()]
    return sorted(set(out))


@pytest.mark.parametrize("line", commands())
def test_command(tmp_path, rng, monkeypatch, line):
    words = shlex.split(line)
    assert words[0] == "dase"
    path = tmp_path / words[2]
    if NAMES[path.name] == "ROS bag":
        pytest.importorskip("rosbags")
    make(path, rng)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(dase_group, words[1:])
    assert done.exit_code == 0, done.output
    assert io.find_format(path).name == NAMES[path.name]
    if words[1] == "info":
        assert f"format            {NAMES[path.name]}" in done.output
        if "--size" in words:
            assert words[-1].replace("x", " x ") in done.output
    elif words[1] == "show":
        assert path.with_suffix(".png").stat().st_size > 20_000
    else:
        assert "20,000 events written" in done.output
        assert len(io.read(words[3]).events) == 20_000


def test_all_vendors_have_a_command():
    used = {NAMES[shlex.split(line)[2]] for line in re.findall(r"\| `(dase info [^`]*)` \|", PAGE)}
    assert used >= {one.name for one in io.FORMATS} - {"EVT2", "EVT2.1", "structured NumPy array"}
    for word in ("EVT2", "EVT2.1", "structured array"):
        assert word in PAGE


def test_what_can_be_written_is_what_is_written_there():
    table = PAGE.split("## What can be written")[1]
    rows = re.findall(r"^\| ([^|]+) \| (`[^|]+`) \|", table, flags=re.MULTILINE)
    written: dict[str, Format] = {one.name: one for one in io.FORMATS if one.create is not None}
    assert {name.replace("HDF5 (S2R)", "HDF5") for name, _ in rows} == set(written)
    for name, suffixes in rows:
        known = written[name.replace("HDF5 (S2R)", "HDF5")]
        for suffix in re.findall(r"`(\.\w+)`", suffixes):
            assert io.find_writable_format(f"a{suffix}").name == known.name, suffix


def test_python(tmp_path, rng, monkeypatch):
    make(tmp_path / "recording.aedat4", rng)
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL):
        exec(compile(code, "formats.md", "exec"), scope)
    assert len(scope["train"]) == 7
    assert len(scope["held_out"]) == 3
    assert scope["spans"].shape == (3, 2)
    assert os.listdir(tmp_path) == ["recording.aedat4"]


@pytest.mark.parametrize("name", reference_io.SAMPLES)
def test_every_format_can_be_drawn(tmp_path, rng, name):
    from dase.figures import event_images

    if name in ("ROS 1", "ROS 2", "MCAP"):
        pytest.importorskip("rosbags")
    suffix, maker = reference_io.SAMPLES[name]
    wide = (346, 260) if name == "MVSEC" else (240, 180)
    maker(tmp_path / f"a{suffix}", reference_io.events(rng, 500, *wide))
    sequence = io.read(tmp_path / f"a{suffix}")
    middle = sum(sequence.span) / 2
    picture = event_images.moment_picture(sequence, middle, sequence.span[1] - sequence.span[0] + 1)
    assert np.count_nonzero((picture != 255).any(-1)) > 450  # nearly every event has a pixel of its own
