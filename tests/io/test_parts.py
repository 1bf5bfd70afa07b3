"""A part of a recording, of time or of the sensor, is what one would cut out of the whole."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import sample_files as reference_io

import dase
from dase import io
from dase.cli import dase_group
from dase.errors import InputError
from dase.io.sequence import Sequence

PART = io.Part(0.004, 0.012, (60, 40, 100, 90))


def cut(e, part):
    """The events of a part, chosen one by one."""
    x, y, width, height = part.region
    inside = (e.t >= part.begin) & (e.t < part.end)
    inside &= (e.x >= x) & (e.x < x + width) & (e.y >= y) & (e.y < y + height)
    return e.t[inside], e.x[inside] - x, e.y[inside] - y, e.p[inside]


def same(got, want):
    for a, b in zip((got.t, got.x, got.y, got.p), want, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", reference_io.SAMPLES)
def test_a_part_of_every_format(tmp_path, rng, name):
    if name in ("ROS 1", "ROS 2", "MCAP"):
        pytest.importorskip("rosbags")
    suffix, make = reference_io.SAMPLES[name]
    path = tmp_path / f"a{suffix}"
    make(path, reference_io.events(rng, 3000, *((346, 260) if name == "MVSEC" else (240, 180))))
    begin = io.read(path).events.t[0]
    part = io.Part(begin + 0.004, begin + 0.012, PART.region)
    want = cut(io.read(path).events, part)
    assert 50 < len(want[0]) < 1000
    notes = []
    got = io.read(path, part=part, notes=notes).events
    same(got, want)
    assert (got.width, got.height) == (100, 90)
    assert any("read was a part only: from" in note for note in notes)
    chunks = list(io.stream(path, part=part, chunk=64))
    assert {len(one) for one in chunks[:-1]} <= {64}
    same(dase.Events.concatenate(chunks), want)
    assert io.convert(path, tmp_path / "b.h5", part=part) == len(want[0])
    same(io.read(tmp_path / "b.h5").events, want)


def sequence(rng, frames=True):
    e = reference_io.events(rng, 3000)
    grey = rng.integers(0, 256, (5, e.height, e.width), np.uint8)
    flow, thresholds = (rng.random((*n, 2, *grey.shape[1:]), np.float32) for n in ((5,), ()))
    times, exposure = np.array([0.002, 0.0045, 0.006, 0.0115, 0.014]), np.full(5, 0.002)
    return Sequence(e, grey, times, flow, thresholds, "a = 1", exposure)


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_frames_whose_whole_exposure_lies_in_it_and_maps_of_the_region(tmp_path, rng, suffix):
    whole, path = sequence(rng), tmp_path / f"a{suffix}"
    io.write(path, whole)
    window = (..., slice(40, 130), slice(60, 160))
    for target in (None, tmp_path / "b.h5"):
        if target is None:
            got = io.read(path, part=PART)
        else:
            io.convert(path, target, part=PART)
            got = io.read(target)
        np.testing.assert_array_equal(got.frames, whole.frames[2:3][window])  # the others reach over an end
        np.testing.assert_allclose(got.frame_times, [0.006], atol=1e-6)
        np.testing.assert_array_equal(got.flow, whole.flow[2:3][window])
        np.testing.assert_array_equal(got.thresholds, whole.thresholds[window])
        assert got.configuration == "a = 1"
    (picture,) = io.pictures(path, part=PART)
    np.testing.assert_array_equal(picture.grey, whole.frames[2][window])


def test_a_part_without_events_or_frames_is_empty(tmp_path, rng):
    io.write(tmp_path / "a.h5", sequence(rng))
    late = io.Part(5.0)
    got = io.read(tmp_path / "a.h5", part=late)
    assert len(got.events) == 0
    assert got.frames is None
    (only,) = io.stream(tmp_path / "a.h5", part=late)
    assert (len(only), only.width) == (0, 240)


def test_nothing_is_decoded_beyond_the_end(tmp_path, rng):
    e = reference_io.events(rng, 3_000_000)
    io.write(tmp_path / "a.raw", Sequence(e))
    data = bytearray((tmp_path / "a.raw").read_bytes())
    data[-500_000:] = b"\0\x90" * 250_000  # words of unknown type
    (tmp_path / "a.raw").write_bytes(data)
    whole, part = [], []
    list(io.stream(tmp_path / "a.raw", notes=whole))
    list(io.stream(tmp_path / "a.raw", part=io.Part(end=0.01), notes=part))
    assert any("unknown type" in note for note in whole)
    assert not any("unknown type" in note for note in part)


@pytest.mark.parametrize("region", [(200, 0, 41, 10), (0, 171, 5, 10), (240, 0, 1, 1)])
def test_a_region_lies_on_the_sensor(tmp_path, rng, region):
    io.write(tmp_path / "a.h5", sequence(rng))
    for act in (io.read, lambda path, part: list(io.stream(path, part=part))):
        with pytest.raises(InputError, match=r"a\.h5: the region must lie on the 240x180 sensor"):
            act(tmp_path / "a.h5", part=io.Part(region=region))


@pytest.mark.parametrize(
    "fields",
    [
        {"begin": 1.0, "end": 1.0},
        {"begin": 2.0, "end": 1.0},
        {"begin": float("nan")},
        {"region": (-1, 0, 5, 5)},
        {"region": (0, 0, 0, 5)},
        {"region": (0, 0, 5.5, 5)},
        {"region": (0, 0, 5)},
    ],
)
def test_a_part_has_time_and_pixels(fields):
    with pytest.raises(InputError):
        io.Part(**fields)


def test_open_recording_takes_a_part(tmp_path, rng):
    whole = sequence(rng)
    io.write(tmp_path / "a.h5", whole)
    recording = dase.open_recording(tmp_path / "a.h5", part=PART)
    same(recording.events, cut(whole.events, PART))


def test_commands(tmp_path, rng):
    whole, path = sequence(rng), tmp_path / "a.h5"
    io.write(path, whole)
    wanted = len(cut(whole.events, PART)[0])
    part = ["--from", "0.004", "--to", "0.012", "--region", "60,40,100,90"]
    done = CliRunner().invoke(dase_group, ["convert", str(path), str(tmp_path / "b.raw"), *part])
    assert f"{wanted:,} events written" in done.output, done.output
    assert "read was a part only: from 0.004 s to 0.012 s, 100x90 pixels at (60, 40)" in done.output
    done = CliRunner().invoke(dase_group, ["info", str(path), "--json", "-", *part])
    said = json.loads(done.output)
    assert (said["events"], said["width"], said["height"]) == (wanted, 100, 90)
    done = CliRunner().invoke(dase_group, ["show", str(path), "-o", str(tmp_path / "a.png"), *part])
    assert "100 x 90" in done.output, done.output
    done = CliRunner().invoke(dase_group, ["info", str(path), "--region", "1,2,3"])
    assert "not of the form x,y,w,h" in done.output
    done = CliRunner().invoke(dase_group, ["info", str(path), "--chip", "davis240"])
    assert "takes no chip" in str(done.exception)


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_flow_that_nobody_wants_is_not_read(tmp_path, rng, suffix):
    whole, path = sequence(rng), tmp_path / f"a{suffix}"
    io.write(path, whole)
    read, less = io.read(path), io.read(path, flow=False)
    assert read.flow is not None
    assert less.flow is None
    for name in "txyp":
        np.testing.assert_array_equal(getattr(less.events, name), getattr(read.events, name))
    for name in ("frames", "frame_times", "frame_exposure", "thresholds"):
        np.testing.assert_array_equal(getattr(less, name), getattr(read, name))
    assert io.read(path, flow=False, part=PART).flow is None
