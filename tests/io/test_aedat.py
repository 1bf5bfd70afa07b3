"""AEDAT 2 and 4: layouts of addresses, packets, frames with exposures, damage."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from helpers.call_counts import counting_calls
from helpers.sample_files import AEDAT4_XML, UNIX_US, H, W, aedat4, events, flatbuffer

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import aedat2 as aedat2_module
from dase.io import packed
from dase.io.flatbuffer import Table
from dase.io.sequence import Sequence
from dase.recordings.recording import open_recording


def aedat2(path, rows, chip="", version="2.0", kind=">u4"):
    line = f"# AEChip: some.package.{chip}\r\n" if chip else ""
    head = f"#!AER-DAT{version}\r\n# This is a raw AE data file\r\n{line}".encode()
    records = b"".join(np.array(a, kind).tobytes() + np.array(t, ">u4").tobytes() for a, t in rows)
    path.write_bytes(head + records)


def davis(x, y, p):
    return y << 22 | x << 12 | p << 11


@pytest.mark.parametrize("chip", ["DAVIS240C", "Davis346blue", ""])
def test_davis_addresses(tmp_path, chip):
    width, height = (346, 260) if "346" in chip else (240, 180)
    rows = [(davis(0, 0, 1), 2**32 - 2), (1 << 31 | 0xC00 | 77, 5), (davis(5, 7, 1) | 1 << 10, 6)]
    rows += [(davis(width - 1, height - 1, 0), 3), (davis(400, 7, 0), 4)]
    aedat2(tmp_path / "a.aedat", rows if chip else rows[:-1], chip)
    notes = []
    got = io.read(tmp_path / "a.aedat", notes=notes).events
    assert (got.width, got.height) == (width, height)
    assert (got.t * 1e6).round().tolist() == [2**32 - 2, 2**32 + 3]
    assert (got.x.tolist(), got.y.tolist()) == ([width - 1, 0], [height - 1, 0])
    assert got.p.tolist() == [True, False]
    assert "1 samples of the motion sensor: skipped" in notes
    assert any(note.startswith("1 special events") for note in notes)
    assert any("1 events lie outside" in note for note in notes) == bool(chip)


@pytest.mark.parametrize(("version", "kind"), [("1.0", ">u2"), ("2.0", ">u4")])
@pytest.mark.parametrize("chip", ["DVS128", ""])
def test_dvs128_addresses_where_zero_is_on(tmp_path, version, kind, chip):
    rows = [(100 << 8 | 30 << 1, 10), (127 << 8 | 127 << 1 | 1, 20), (1 << 15, 30)]
    aedat2(tmp_path / "a.dat", rows[:2] if not chip else rows, chip, version, kind)
    got = io.read(tmp_path / "a.dat").events
    assert (got.x.tolist(), got.y.tolist(), got.p.tolist()) == ([97, 0], [27, 0], [True, False])
    assert (got.width, got.height) == (128, 128)


def test_v2e_at_640x480(tmp_path):
    rows = [(479 << 11 | 639 << 1 | 1, 10), (0, 20), (3 << 11 | 4 << 1, 30)]
    aedat2(tmp_path / "a.aedat2", rows)
    got = io.read(tmp_path / "a.aedat2").events
    assert (got.x.tolist(), got.y.tolist(), got.p.tolist()) == (
        [0, 639, 635],
        [0, 479, 476],
        [True, False, False],
    )


def test_aedat2_headers(tmp_path):
    aedat2(tmp_path / "a.aedat", [], "Cochlea64")
    with pytest.raises(InputError, match="chip 'cochlea64' is not known"):
        io.read(tmp_path / "a.aedat")
    aedat2(tmp_path / "a.aedat", [], version="2.5")
    with pytest.raises(InputError, match=r"AEDAT 2\.5, which is not read"):
        io.read(tmp_path / "a.aedat")
    hash_row = 0x23000000 | davis(3, 0, 1)  # its first byte is that of a hash sign
    aedat2(tmp_path / "a.aedat", [(hash_row, 1), (hash_row, 2)], "DAVIS240C")
    assert len(io.read(tmp_path / "a.aedat").events) == 2


@pytest.mark.parametrize("size", [(240, 180), (346, 260), (128, 128)])
def test_aedat2_is_written_for_known_sensors(tmp_path, rng, size):
    e = events(rng, 2000, *size)
    io.write(tmp_path / "a.aedat2", Sequence(e))
    got = io.read(tmp_path / "a.aedat2").events
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(e, name))
    assert (got.width, got.height) == size


def frames(rng, count=3):
    return [(k * 40_000, k * 40_000 + 20_000, rng.integers(0, 256, (H, W), np.uint8)) for k in range(count)]


@pytest.mark.parametrize("compression", [0, 1, 2, 3, 4])
def test_aedat4_events_and_frames(tmp_path, rng, compression):
    compress = bytes
    if compression in (1, 2):
        compress = pytest.importorskip("lz4.frame").compress
    elif compression:
        compress = pytest.importorskip("backports.zstd").compress
    e, taken = events(rng), frames(rng)
    aedat4(tmp_path / "a.aedat4", e, frames=taken, compression=compression, compress=compress)
    got = io.read(tmp_path / "a.aedat4")
    first = round(e.t[0] * 1e6)
    np.testing.assert_array_equal(np.rint(got.events.t * 1e6), np.rint(e.t * 1e6) - first)
    np.testing.assert_array_equal(got.frames, [grey for *_, grey in taken])
    np.testing.assert_allclose(got.frame_times * 1e6, np.arange(3) * 40_000 + 10_000 - first, atol=1e-6)
    np.testing.assert_allclose(got.frame_exposure, 0.02)


def test_aedat4_frames_alone_and_of_other_kinds(tmp_path, rng):
    grey = frames(rng, 2)
    aedat4(tmp_path / "a.aedat4", Events.empty(W, H), frames=grey)
    got = io.read(tmp_path / "a.aedat4")
    assert len(got.events) == 0
    np.testing.assert_allclose(got.frame_times, [0, 0.04])
    np.testing.assert_allclose(got.frame_exposure, 0.02)
    colour = rng.integers(0, 256, (4, 6, 3), np.uint8)
    wide = rng.integers(0, 65536, (4, 6), np.uint16)
    for kind, pixels, want in ((16, colour, None), (2, wide, wide)):
        numbers = {0: ("q", UNIX_US), 5: ("b", kind), 6: ("h", 6), 7: ("h", 4), 11: ("q", 5000)}
        from dase.io import aedat4 as module

        table = Table.root(flatbuffer(numbers | {10: (pixels.tobytes(), pixels.nbytes)}))
        got, span = module._parse_frame(table)
        assert span == (UNIX_US, UNIX_US + 5000)
        if want is None:
            want = np.rint(pixels @ [0.07, 0.72, 0.21])
        np.testing.assert_array_equal(got, want)
        assert got.dtype == pixels.dtype


def test_aedat4_damage_is_skipped_and_noted(tmp_path, rng):
    e = events(rng, 3000)
    path = tmp_path / "a.aedat4"
    aedat4(path, e, packet=500)
    content = path.read_bytes()
    path.write_bytes(content[:-4000])
    notes = []
    assert len(io.read(path, notes=notes).events) == 2500
    assert any("cut short" in note for note in notes)
    place = content.index(struct.pack("<I", 500))
    path.write_bytes(content[:place] + struct.pack("<I", 1 << 30) + content[place + 4 :])
    notes = []
    assert len(io.read(path, notes=notes).events) == 2500
    assert "1 damaged packets of type EVTS: skipped" in notes


@pytest.mark.parametrize(
    ("xml", "compression", "match"),
    [
        (AEDAT4_XML.format(""), 0, "neither events nor frames"),
        ("<dv", 0, "header is damaged"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><dv>&b;</dv>', 0, "declarations, which are refused"),
        (None, 9, "unknown number 9"),
    ],
)
def test_aedat4_headers(tmp_path, rng, xml, compression, match):
    path = tmp_path / "a.aedat4"
    if xml is None:
        aedat4(path, events(rng, 10), compression=compression)
    else:
        head = flatbuffer({0: ("i", 0), 1: ("q", -1), 2: (xml.encode(), len(xml))})
        path.write_bytes(b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(head)) + head)
    with pytest.raises(InputError, match=match):
        io.read(path)
    path.write_bytes(b"#!AER-DAT4.0\r\n\xff\xff\xff\x7f")
    with pytest.raises(InputError, match="claims 2147483647 bytes"):
        io.read(path)


def test_aedat4_bombs_do_not_unpack(tmp_path):
    lz4 = pytest.importorskip("lz4.frame")

    def bomb(data):
        return lz4.compress(bytes(300 << 20))

    aedat4(tmp_path / "a.aedat4", events(np.random.default_rng(0), 50), compression=1, compress=bomb)
    notes = []
    assert len(io.read(tmp_path / "a.aedat4", notes=notes).events) == 0
    assert "1 damaged packets of type EVTS: skipped" in notes


def test_without_the_library_the_extra_is_named(tmp_path, rng, monkeypatch):
    def missing(name):
        raise ImportError(name)

    aedat4(tmp_path / "a.aedat4", events(rng, 50), compression=1)
    monkeypatch.setattr(packed, "import_module", missing)
    with pytest.raises(InputError, match=r'in the checkout of dase, pip install "\.\[aedat\]"'):
        io.read(tmp_path / "a.aedat4")


def test_aedat4_motion(tmp_path, rng):
    e = events(rng, 1000)
    samples = [(k * 1000, rng.normal(size=3), rng.normal(size=3)) for k in range(20)]
    aedat4(tmp_path / "a.aedat4", e, motion=samples, frames=frames(rng, 1))
    got = io.motion(tmp_path / "a.aedat4")
    first = round(e.t[0] * 1e6)
    np.testing.assert_allclose(got.t * 1e6, np.repeat([t - first for t, *_ in samples], 2), atol=1e-6)
    want = np.repeat([np.concatenate(values) for _, *values in samples], 2, axis=0)
    np.testing.assert_allclose(got.acceleration, 9.80665 * want[:, :3], rtol=1e-6)
    np.testing.assert_allclose(got.rotation, want[:, 3:] * np.pi / 180, rtol=1e-6)
    part = open_recording(tmp_path / "a.aedat4").slice(0.005, 0.01).motion
    assert len(part.t) == np.count_nonzero((got.t >= 0.005) & (got.t < 0.01))
    aedat4(tmp_path / "b.aedat4", e)
    assert io.motion(tmp_path / "b.aedat4") is None
    assert open_recording(tmp_path / "b.aedat4").motion is None


def same_as_library(path):
    """Compare with what the package aedat reads."""
    aedat = pytest.importorskip("aedat", reason="needs aedat, a second reader of AEDAT 4")
    packets = list(aedat.Decoder(path))
    want = np.concatenate([packet["events"] for packet in packets if "events" in packet])
    pictures = [packet["frame"] for packet in packets if "frame" in packet]
    got = io.read(path)
    np.testing.assert_array_equal(np.rint(got.events.t * 1e6), want["t"] - want["t"][0])
    np.testing.assert_array_equal(got.events.x, want["x"])
    np.testing.assert_array_equal(got.events.p, want["on"])
    np.testing.assert_array_equal(got.frames, [picture["pixels"] for picture in pictures])
    exposures = [picture["exposure_end_t"] - picture["exposure_begin_t"] for picture in pictures]
    np.testing.assert_allclose(got.frame_exposure * 1e6, exposures)
    samples = [packet["imus"] for packet in packets if "imus" in packet]
    if samples:
        samples = np.concatenate(samples)
        moved = io.motion(path)
        np.testing.assert_allclose(moved.t * 1e6, samples["t"].astype(float) - float(want["t"][0]), atol=1)
        for k, axis in enumerate("xyz"):
            rotation, acceleration = samples[f"gyroscope_{axis}"], samples[f"accelerometer_{axis}"]
            np.testing.assert_allclose(np.rad2deg(moved.rotation[:, k]), rotation, rtol=1e-5)
            np.testing.assert_allclose(moved.acceleration[:, k], 9.80665 * acceleration, rtol=1e-5)


def test_a_second_library_reads_the_same(tmp_path, rng):
    samples = [(k * 1000, rng.normal(size=3), rng.normal(size=3)) for k in range(20)]
    aedat4(tmp_path / "a.aedat4", events(rng), frames=frames(rng), motion=samples)
    same_as_library(tmp_path / "a.aedat4")


def test_a_second_library_reads_the_same_of_a_camera(shared):
    pytest.importorskip("lz4")
    same_as_library(shared / "recordings/native/davis346_cuke_cradle.aedat4")


def aps(x, y, read, value):
    """A sample of a frame: bit 31, row from below, column from the left, which read, 10 bits."""
    return 1 << 31 | (179 - y) << 22 | x << 12 | read << 10 | value


def frame_rows(grey, begin_us, exposure_us, *, rolling=False):
    """The samples of a frame of a DAVIS240, reset minus signal is its grey; columns from the right."""
    out = []
    first = [(x, y) for x in reversed(range(240)) for y in range(180)]
    resets = [(aps(x, y, 0, 900), begin_us + x % 7) for x, y in first]
    signals = [(aps(x, y, 1, 900 - int(grey[y, x])), begin_us + exposure_us + x % 7) for x, y in first]
    if not rolling:
        return resets + signals
    for k in range(0, len(first), 180):  # column by column, reset and then signal
        out += resets[k : k + 180] + signals[k : k + 180]
    return out


@pytest.mark.parametrize("rolling", [False, True])
def test_frames_of_aedat_2(tmp_path, rng, rolling):
    grey = rng.integers(0, 900, (3, 180, 240))
    rows = [(davis(5, 7, 1), 900), (davis(239, 179, 0), 950)]
    for k, one in enumerate(grey):
        rows += frame_rows(one, 1000 + 50_000 * k, 8000, rolling=rolling)
        rows.insert(len(rows) - 100, (davis(1, 2, 0), 1000 + 50_000 * k))  # between the samples
        rows.insert(len(rows) - 300, (1 << 31 | 0xC00 | 5, 1000 + 50_000 * k))  # of the motion sensor
    rows += frame_rows(grey[0], 200_000, 8000)[:30_000]  # cut off
    aedat2(tmp_path / "a.aedat", rows, "DAVIS240C")
    notes = []
    got = io.read(tmp_path / "a.aedat", notes=notes)
    assert got.frames.dtype == np.uint16
    np.testing.assert_array_equal(got.frames, np.rint(grey * (65535 / 1023)))
    np.testing.assert_allclose(got.frame_times, (1003 + 4000 + 50_000 * np.arange(3)) / 1e6, atol=2e-6)
    np.testing.assert_allclose(got.frame_exposure, 0.008, atol=2e-6)
    assert "1 frames are cut off: left out" in notes
    assert "3 samples of the motion sensor: skipped" in notes
    assert len(got.events) == 5
    assert len(list(io.pictures(tmp_path / "a.aedat"))) == 3


def test_frames_of_aedat_2_lie_on_their_events(tmp_path):
    """An event and a sample of the same pixel: events count columns from the right, frames from the left."""
    grey = np.zeros((180, 240), int)
    grey[20, 30] = 500
    aedat2(tmp_path / "a.aedat", [(davis(239 - 30, 179 - 20, 1), 5), *frame_rows(grey, 10, 100)], "DAVIS240C")
    got = io.read(tmp_path / "a.aedat")
    assert (got.events.x[0], got.events.y[0]) == (30, 20)
    assert np.argwhere(got.frames[0]).tolist() == [[20, 30]]


def test_many_samples_of_one_pixel_are_no_frames(tmp_path):
    aedat2(tmp_path / "a.aedat", [(aps(5, 5, 0, 1), k) for k in range(400_000)], "DAVIS240C")
    with counting_calls() as counted:
        assert list(io.pictures(tmp_path / "a.aedat")) == []
    assert counted.calls < 400_000 * 15


@pytest.mark.parametrize(
    ("largest", "taken", "possible"),
    [
        ((127, 127), "davis128", "davis240, davis346, davis640, davis128, davis208"),
        ((200, 150), "davis208", "davis240, davis346, davis640, davis208"),
        ((239, 179), "davis240", "davis240, davis346, davis640"),
        ((340, 250), "davis346", "davis346, davis640"),
    ],
)
def test_a_davis_without_a_chip_line(tmp_path, rng, largest, taken, possible):
    size = next(size for name, _, size in aedat2_module.CHIPS if name == taken)
    n = 500
    x, y, p = rng.integers(0, largest[0], n), rng.integers(0, largest[1], n), rng.integers(0, 2, n)
    x[0], y[0] = largest
    pixels = zip(x.tolist(), y.tolist(), p.tolist(), strict=True)
    rows = [(davis(*pixel), 10 * k) for k, pixel in enumerate(pixels)]
    # what used to make it a DVS640: an external signal with a number in its low bits
    rows += [(1 << 10 | 3, 10 * n), (1 << 31 | 0xC00 | 77, 10 * n)]
    aedat2(tmp_path / "a.aedat", rows, "")
    notes = []
    got = io.read(tmp_path / "a.aedat", notes=notes).events
    assert (got.width, got.height) == size
    np.testing.assert_array_equal(got.x, size[0] - 1 - x)
    np.testing.assert_array_equal(got.y, size[1] - 1 - y)
    np.testing.assert_array_equal(got.p, p > 0)
    (note,) = (note for note in notes if getattr(note, "rule", "") == "chip")
    assert note.startswith(f"the file names no chip, its addresses fit {possible}: {taken} was taken")
    notes = []
    got = io.read(tmp_path / "a.aedat", chip="davis346", notes=notes).events
    assert (got.width, got.height) == (346, 260)
    np.testing.assert_array_equal(got.x, 345 - x)
    assert not any("names no chip" in note for note in notes)


def test_an_unknown_chip_is_refused(tmp_path):
    aedat2(tmp_path / "a.aedat", [(davis(5, 7, 1), 5)], "")
    with pytest.raises(InputError, match="chip 'davis34' is not known: did you mean 'davis346'"):
        io.read(tmp_path / "a.aedat", chip="davis34")
