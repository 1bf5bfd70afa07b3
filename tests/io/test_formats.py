"""What holds for every camera's file: the same events, chunk by chunk, in order, with the size found."""

from __future__ import annotations

import zipfile

import cv2
import h5py
import numpy as np
import pytest
from helpers.sample_files import NEEDS, SAMPLES, H, W, events, microseconds, sample, table

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import arrays, binary, evt2, evt3, evt21, source, text
from dase.io.sequence import Sequence

WRITTEN = ("EVT2", "EVT3", "DAT", "AEDAT2", "text", "zip of text", "HDF5", "NumPy archive")


def assert_same(got, want, *, shifted=True):
    """Equal; times may count from the first event."""
    assert len(got) == len(want)
    begin = want.t[0] if shifted and len(want) and got.t[0] == 0 else 0.0
    np.testing.assert_array_equal(np.rint((got.t + begin) * 1e6), microseconds(want))
    for name in "xyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))
        assert getattr(got, name).dtype == getattr(want, name).dtype
    assert (got.width, got.height) == (want.width, want.height)


@pytest.mark.parametrize("name", SAMPLES)
def test_every_format_gives_the_events_back(tmp_path, rng, name):
    width, height = (346, 260) if name == "MVSEC" else (W, H)
    e = events(rng, width=width, height=height)
    path = sample(tmp_path, name, e)
    notes = []
    assert_same(io.read(path, notes=notes).events, e)
    known = ("size", "sensor", "t_offset", "date", "columns")
    assert all(any(word in note for word in known) for note in notes)


@pytest.mark.parametrize("name", SAMPLES)
def test_chunks_are_of_the_length_asked_for_whatever_is_read_at_once(tmp_path, rng, name, monkeypatch):
    path = sample(tmp_path, name, events(rng))
    want = io.read(path, size=(W, H)).events
    for chunk, block in ((1 << 20, 1 << 22), (1000, 4096), (7, 333)):
        monkeypatch.setattr(binary, "BLOCK", block)
        monkeypatch.setattr(text, "LIMITS", text.TextLimits(block=block))
        for module in (evt2, evt3, evt21, arrays, io.ros.ros_messages.evt3):
            monkeypatch.setattr(module, "PART", block // 8)
        parts = list(io.stream(path, chunk=chunk, size=(W, H)))
        assert {len(part) for part in parts[:-1]} <= {chunk}
        assert 0 < len(parts[-1]) <= chunk
        got = Events.concatenate(parts)
        for column in "txyp":
            np.testing.assert_array_equal(getattr(got, column), getattr(want, column))


@pytest.mark.parametrize("name", WRITTEN)
def test_writing_loses_nothing(tmp_path, rng, name):
    suffix, make = SAMPLES[name]
    for begin in (0, 3_000_000, 1_000_000_000):
        e = events(rng, 5000, begin_us=begin, step_us=5000)
        make(tmp_path / f"a{suffix}", e)
        assert_same(io.read(tmp_path / f"a{suffix}").events, e, shifted=False)
    parts = [e.slice(a, b) for a, b in ((0, 1004), (1004, 1004), (1004, 1007), (1007, 9999))]
    with io.create(tmp_path / f"b{suffix}", format=name) as writer:
        for part in parts:
            writer.events(part)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes() or suffix == ".h5"
    assert_same(io.read(tmp_path / f"b{suffix}").events, e, shifted=False)


@pytest.mark.parametrize("name", WRITTEN)
def test_nothing_but_a_size(tmp_path, name):
    suffix, make = SAMPLES[name]
    make(tmp_path / f"a{suffix}", Events.empty(W, H))
    for got in (io.read(tmp_path / f"a{suffix}").events, *io.stream(tmp_path / f"a{suffix}")):
        assert (len(got), got.width, got.height) == (0, W, H)


@pytest.mark.parametrize("name", WRITTEN[:6])
def test_writers_of_cameras_refuse_frames_and_leave_nothing(tmp_path, rng, name):
    suffix, _ = SAMPLES[name]
    sequence = Sequence(events(rng, 10), np.zeros((1, H, W), np.uint8), np.zeros(1))
    with pytest.raises(InputError, match="events only, no frames"):
        io.write(tmp_path / f"a{suffix}", sequence, format=name)
    with pytest.raises(InputError, match="nothing was written"), io.create(tmp_path / f"a{suffix}"):
        pass
    io.write(tmp_path / f"a{suffix}", Sequence(events(rng, 10), configuration="a = 1"), format=name)
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


@pytest.mark.parametrize(
    ("name", "seconds", "width"),
    [
        ("EVT2", -1, W),
        ("EVT3", -1, W),
        ("EVT3", 1e8, W),
        ("DAT", 4295, W),
        ("AEDAT2", 2148, W),
        ("EVT2", 0, 2049),
        ("EVT3", 0, 2049),
        ("DAT", 0, 16385),
        ("AEDAT2", 0, 333),
    ],
)
def test_writers_of_cameras_refuse_what_does_not_fit(tmp_path, name, seconds, width):
    e = Events(
        np.array([seconds]) * 1.0, *(np.zeros(1, kind) for kind in (np.uint16, np.uint16, bool)), width, H
    )
    with pytest.raises(InputError, match=name):
        io.write(tmp_path / "a", Sequence(e), format=name)
    assert list(tmp_path.iterdir()) == []


def test_the_format_is_told_by_content_then_by_suffix_then_by_name(tmp_path, rng):
    e = events(rng, 100)
    for name, (_, make) in SAMPLES.items():
        if name not in NEEDS:
            make(tmp_path / "recording.xyz.npy", e)
            found = io.find_format(tmp_path / "recording.xyz.npy").name
            assert found.split()[0] in (name.split()[0], "Prophesee", "structured"), name
    assert [
        io.find_writable_format(f"a{suffix}").name for suffix in (".raw", ".evt2", ".h5", ".dat", ".csv")
    ] == [
        "EVT3",
        "EVT2",
        "HDF5",
        "DAT",
        "text",
    ]
    with pytest.raises(InputError, match="cannot be written, did you mean 'EVT2'"):
        io.create(tmp_path / "a.raw", format="EVT22")
    with pytest.raises(InputError, match=r"known: \.h5, \.hdf5, \.npz, \.zip, \.raw"):
        io.create(tmp_path / "a.mp4")
    for suffix in (".raw", ".dat", ".aedat", ".aedat4", ".txt", ".npy", ".zip", ".h5", ".bag", ".mp4"):
        (tmp_path / f"rubbish{suffix}").write_bytes(b"\x01\x02 rubbish")
        with pytest.raises(InputError, match=f"rubbish{suffix}"):
            io.read(tmp_path / f"rubbish{suffix}")
        with pytest.raises(InputError, match=f"rubbish{suffix}"):
            list(io.stream(tmp_path / f"rubbish{suffix}"))
    with pytest.raises(InputError, match="folder with neither"):
        io.read(tmp_path)


def test_a_size_the_user_gives_wins_and_what_lies_outside_is_noted(tmp_path, rng):
    e = events(rng, 1000)
    io.write(tmp_path / "a.txt", Sequence(e))
    assert io.read(tmp_path / "a.txt", size=(500, 400)).events.width == 500
    notes = []
    got = io.read(tmp_path / "a.txt", size=(100, 90), notes=notes).events
    kept = (e.x < 100) & (e.y < 90)
    assert_same(got, Events(e.t[kept], e.x[kept], e.y[kept], e.p[kept], 100, 90), shifted=False)
    assert notes == [f"{1000 - kept.sum()} events lie outside the 100x90 sensor: skipped"]
    for size in ((0, 5), (9000, 5)):
        with pytest.raises(InputError, match="a sensor must be"):
            io.read(tmp_path / "a.txt", size=size)


@pytest.mark.parametrize(
    "largest", [(127, 127), (200, 100), (345, 200), (300, 250), (639, 300), (700, 700), (1500, 900)]
)
def test_the_smallest_sensor_that_holds_all_events_is_guessed(tmp_path, largest):
    (tmp_path / "a.txt").write_text(f"0.1 0 0 1\n0.2 {largest[0]} {largest[1]} 0\n")
    got = io.read(tmp_path / "a.txt").events
    assert (got.width, got.height) in (*source.SIZES, (largest[0] + 1, largest[1] + 1))
    assert got.width > largest[0]
    assert got.height > largest[1]
    assert next(io.stream(tmp_path / "a.txt")).width == got.width


def test_late_events_are_put_in_place_and_very_late_ones_need_the_whole_file(tmp_path, rng, monkeypatch):
    e = events(rng, 5000, step_us=1000)
    late = np.rint(e.t * 1e6 - rng.integers(0, 90_000, len(e)) * (rng.random(len(e)) < 0.1)) + 100_000
    rows = np.zeros(len(e), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
    rows["t"], rows["x"], rows["y"], rows["p"] = late, e.x, e.y, e.p
    np.save(tmp_path / "a.npy", rows)
    notes = []
    whole = io.read(tmp_path / "a.npy", notes=notes).events
    assert np.all(np.diff(whole.t) >= 0)
    assert any("times go back" in note and "sorted" in note for note in notes)
    for part in (50, 5000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(arrays, "PART", part)
            got = Events.concatenate(io.stream(tmp_path / "a.npy", chunk=77))
        for name in "txyp":
            np.testing.assert_array_equal(getattr(got, name), getattr(whole, name))
    rows["t"][4000:] -= 900_000
    np.save(tmp_path / "b.npy", rows)
    assert len(io.read(tmp_path / "b.npy").events) == 5000
    monkeypatch.setattr(arrays, "PART", 50)
    with pytest.raises(InputError, match="too far to sort"):
        list(io.stream(tmp_path / "b.npy"))


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_structured_arrays_by_other_names(tmp_path, rng, suffix):
    e = events(rng, 500)
    kinds = [("timestamp", "<f8"), ("X", "<i4"), ("y", "<i8"), ("polarity", "i1")]
    rows = np.zeros(len(e), kinds)
    rows["timestamp"], rows["X"], rows["y"], rows["polarity"] = e.t, e.x, e.y, np.where(e.p, 1, -1)
    np.save(tmp_path / "a.npy", rows) if suffix == ".npy" else np.savez(tmp_path / "a.npz", e=rows)
    assert_same(io.read(tmp_path / f"a{suffix}").events, e, shifted=False)


def test_frames_of_a_video_and_of_a_folder(tmp_path, rng):
    grey = rng.integers(0, 256, (4, 64, 96), np.uint8)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k, frame in enumerate(grey):
        cv2.imwrite(str(folder / f"frame_{k:03d}.png"), frame)
    notes = []
    got = io.read(folder, notes=notes)
    np.testing.assert_array_equal(got.frames, grey)
    assert got.frame_times is None
    assert notes == ["nothing tells the times of the frames"]
    (folder / "timestamps.txt").write_text("".join(f"frame_{k:03d}.png {k * 0.04}\n" for k in range(4)))
    np.testing.assert_allclose(io.read(folder).frame_times, np.arange(4) * 0.04)
    (folder / "timestamps.txt").write_text("0\n1\n")
    with pytest.raises(InputError, match="one increasing time for each of the 4 pictures"):
        io.read(folder)
    out = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (96, 64))
    for frame in np.full_like(grey, 90):
        out.write(np.repeat(frame[..., None], 3, 2))
    out.release()
    got = io.read(tmp_path / "a.avi")
    assert np.abs(got.frames.astype(int) - 90).max() < 4
    np.testing.assert_allclose(got.frame_times, np.arange(4) / 25)
    (part,) = io.stream(tmp_path / "a.avi")
    assert (len(part), part.width, part.height) == (0, 96, 64)


def test_native_and_archived_recordings_agree(shared):
    folder = shared / "recordings"
    pairs = {
        "psee_hd_evt3.raw": "psee_hd_ros_trigger",
        "psee_gen3_evt2.raw": "psee_gen31_dot",
        "davis346_cuke_cradle.aedat4": "davis346_cuke_cradle",
        "ijrr_boxes_events.txt": "davis240c_ijrr_boxes",
    }
    for native, archived in pairs.items():
        if native.endswith("aedat4"):
            pytest.importorskip("lz4")
        a, b = io.read(folder / "native" / native), io.read(folder / f"{archived}.npz")
        np.testing.assert_allclose(a.events.t - a.events.t[0], b.events.t - b.events.t[0], atol=2e-9)
        for name in "xyp":
            np.testing.assert_array_equal(getattr(a.events, name), getattr(b.events, name))
        assert (a.events.width, a.events.height) == (b.events.width, b.events.height)
        if b.frames is not None:
            np.testing.assert_array_equal(a.frames, b.frames)
            np.testing.assert_allclose(a.frame_times, b.frame_times, atol=1e-9)
            np.testing.assert_allclose(a.frame_exposure, b.frame_exposure, atol=1e-9)
        parts = list(io.stream(folder / "native" / native, chunk=9999))
        assert sum(map(len, parts)) == len(a.events)
        np.testing.assert_array_equal(Events.concatenate(parts).t, a.events.t)


def test_archives_stream_as_they_read(shared, tmp_path):
    for path in sorted((shared / "recordings").glob("*.npz")):
        if path.stem in ("noise_iebcs", "davis240c_camerashake"):
            continue
        want = io.read(path).events
        got = Events.concatenate(io.stream(path, chunk=50_000))
        for name in "txyp":
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name), path.stem)
        assert (got.width, got.height) == (want.width, want.height)
    table(tmp_path / "a.npy", want)
    np.testing.assert_array_equal(io.read(tmp_path / "a.npy").events.t, want.t)


@pytest.mark.parametrize("name", ["davis346_cuke_cradle", "psee_hd_ros_trigger"])
def test_every_writer_keeps_the_events_of_real_recordings(shared, tmp_path, name):
    want = io.read(shared / "recordings" / f"{name}.npz").events
    for format in WRITTEN:
        if format == "AEDAT2" and want.width > 346:
            continue  # no such chip
        path = tmp_path / f"a{SAMPLES[format][0]}"
        assert io.convert(shared / "recordings" / f"{name}.npz", path, format=format) == len(want)
        assert_same(io.read(path).events, want, shifted=False)


def test_second_libraries_read_what_is_written(tmp_path, rng):
    """NumPy reads texts and archives, h5py HDF5; evlib and aedat are asked where their formats are tested."""
    e = events(rng, 2000)
    for name in ("a.txt", "a.zip", "a.h5", "a.npz"):
        io.write(tmp_path / name, Sequence(e))
    rows = [np.loadtxt(tmp_path / "a.txt")]
    with zipfile.ZipFile(tmp_path / "a.zip") as archive, archive.open("events.txt") as file:
        assert file.readline() == b"240 180\n"
        rows.append(np.loadtxt(file))
    with h5py.File(tmp_path / "a.h5") as file:
        rows.append(np.stack([file[f"events/{key}"][:].astype(float) for key in ("ts", "xs", "ys", "ps")], 1))
    with np.load(tmp_path / "a.npz") as archive:
        rows.append(np.stack([archive["t_us"] / 1e6, archive["x"], archive["y"], archive["p"]], 1))
    for got in rows:
        np.testing.assert_array_equal(got, np.stack([e.t, e.x, e.y, e.p], 1))
