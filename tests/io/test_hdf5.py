"""The layouts in HDF5: which one it is, frames and flow, filters, ECF, and what is missing."""

from __future__ import annotations

import os
import struct
import time
import zlib

import h5py
import numpy as np
import pytest
from helpers.ecf_files import ecf_buffer
from helpers.sample_files import H, W, dsec, ecf, events, measured, mvsec, v2e, written
from isal import isal_zlib

from dase import io
from dase.errors import InputError
from dase.io import columns
from dase.io import ecf as ecf_module
from dase.io.sequence import Sequence

READ = """
import sys
from dase import io
from dase.errors import InputError
try:
    io.read(sys.argv[1])
except InputError as error:
    print(error)
"""
"""Script that reads a file and prints why it cannot be read."""


def test_dsec_with_blosc(tmp_path, rng):
    plugin = pytest.importorskip("hdf5plugin")
    e = events(rng, 5000, 640, 480)
    dsec(tmp_path / "events.h5", e, **plugin.Blosc(cname="zstd"))
    notes = []
    got = io.read(tmp_path / "events.h5", notes=notes).events
    np.testing.assert_array_equal(got.t, e.t)
    assert (got.width, got.height) == (640, 480)
    assert "t_offset: add 49599.300523 s for the clock of the frames" in notes


@pytest.mark.parametrize("shuffle", [True, False])
@pytest.mark.parametrize("kind", [np.float64, np.int16, np.uint8, np.bool_])
def test_chunks_are_unpacked_as_by_hdf5(tmp_path, rng, kind, shuffle):
    values = (200 * rng.random(2500)).astype(kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, chunks=(1000,), compression="gzip", shuffle=shuffle)
    with h5py.File(tmp_path / "a.h5", "r") as file:
        for begin, end in ((0, 2500), (0, 1), (999, 2001), (1000, 2000), (2400, 2500), (7, 7)):
            got = columns.unpack_chunks(file["a"], begin, end)
            assert got.dtype == values.dtype
            np.testing.assert_array_equal(got, values[begin:end])
        np.testing.assert_array_equal(columns.read_slice(file["a"], 2000, 5000), values[2000:])
        np.testing.assert_array_equal(columns.read_slice(file["a"]), values)


@pytest.mark.parametrize("kind", [">i2", "<i4"])
def test_other_packings_are_left_to_hdf5(tmp_path, rng, kind):
    values = rng.integers(0, 200, 2500).astype(kind)
    options = {"compression": "gzip" if kind == ">i2" else "lzf", "shuffle": True, "chunks": (1000,)}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, **options)
    with h5py.File(tmp_path / "a.h5", "r") as file:
        assert columns.unpack_chunks(file["a"], 0, 2500) is None
        np.testing.assert_array_equal(columns.read_slice(file["a"], 5, 1200), values[5:1200])


@pytest.mark.parametrize("damage", ["checksum", "long", "short"])
def test_damaged_chunks_are_left_to_hdf5(tmp_path, rng, damage):
    values = rng.integers(0, 200, 1000).astype(np.int16)
    packed = zlib.compress(values.tobytes()[: {"short": 1998}.get(damage)])
    packed = zlib.compress(values.tobytes() + b"more") if damage == "long" else packed
    packed = packed[:-1] + bytes([packed[-1] ^ 1]) if damage == "checksum" else packed
    with h5py.File(tmp_path / "a.h5", "w") as file:
        found = file.create_dataset("a", (1000,), np.int16, chunks=(1000,), compression="gzip")
        found.id.write_direct_chunk((0,), packed)
    with h5py.File(tmp_path / "a.h5", "r") as file:

        def by_hdf5():
            try:
                return file["a"][:]
            except OSError as error:
                return str(error)

        def by_us():
            try:
                return columns.read_slice(file["a"])
            except OSError as error:
                return str(error)

        if damage == "checksum":
            with pytest.raises(isal_zlib.error):
                columns.unpack_chunks(file["a"], 0, 1000)
        else:
            assert columns.unpack_chunks(file["a"], 0, 1000) is None
        if damage != "short":  # of which HDF5 leaves the rest as it is in memory
            np.testing.assert_array_equal(by_us(), by_hdf5())


def test_without_the_filter_the_extra_is_named(tmp_path, rng, monkeypatch):
    plugin = pytest.importorskip("hdf5plugin")
    dsec(tmp_path / "a.h5", events(rng, 100), **plugin.Blosc())
    monkeypatch.setattr(columns.h5py.h5z, "filter_avail", lambda number: False)
    with pytest.raises(InputError, match=r'in the checkout of dase, pip install "\.\[hdf5\]"'):
        io.read(tmp_path / "a.h5")


def test_m3ed_tells_its_size(tmp_path, rng):
    e = events(rng, 500)
    dsec(tmp_path / "a.h5", e)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["prophesee/left"] = file.pop("events") if hasattr(file, "pop") else file["events"]
        file["prophesee/left/calib/resolution"] = np.array([1280, 720])
    got = io.read(tmp_path / "a.h5").events
    assert (len(got), got.width, got.height) == (500, 1280, 720)


@pytest.mark.parametrize("truth", [False, True])
def test_mvsec_with_frames_and_flow(tmp_path, rng, truth):
    origin = 1_504_645_177.0
    e = events(rng, 2000, 346, 260)
    grey = rng.integers(0, 256, (4, 260, 346), np.uint8)
    times = np.array([0.01, 0.05, 0.09, 0.13])
    mvsec(tmp_path / "x_data.hdf5", e, frames=(times, grey), origin=origin)
    flow = rng.normal(size=(3, 2, 260, 346)).astype(np.float32)
    if truth:
        with h5py.File(tmp_path / "x_gt.hdf5", "w") as file:
            file["davis/left/flow_dist"] = flow
            file["davis/left/flow_dist_ts"] = np.array([0.04, 0.08, 0.12]) + origin
    got = io.read(tmp_path / "x_data.hdf5")
    np.testing.assert_array_equal(got.frames, grey)
    np.testing.assert_allclose(got.frame_times, times - e.t[0], atol=1e-6)
    np.testing.assert_array_equal(got.events.p, e.p)
    if not truth:
        assert got.flow is None
        return
    assert np.isnan(got.flow[[0, 3]]).all()
    np.testing.assert_allclose(got.flow[1], flow[0] / 0.04, rtol=1e-4)
    np.testing.assert_allclose(got.flow[2], flow[1] / 0.04, rtol=1e-4)


def test_v2e_with_frames(tmp_path, rng):
    e, grey = events(rng, 500), rng.integers(0, 256, (3, H, W), np.uint8)
    v2e(tmp_path / "a.h5", e, frames=(np.array([0.0, 0.01, 0.02]), grey))
    got = io.read(tmp_path / "a.h5")
    np.testing.assert_array_equal(got.frames, grey)
    np.testing.assert_allclose(got.frame_times, [0, 0.01, 0.02])
    assert got.frame_exposure is None


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_ecf_buffers(rng, mode):
    for trial in range(60):
        n = int(rng.integers(1, 2000))
        steps = rng.choice([0, 0, 0, 1, 14, 15, 16, 300, 10**6, 10**10], n)
        t = 10**12 + np.cumsum(steps if trial % 3 else np.zeros(n, np.int64))
        x = rng.integers(0, 1280, n) if trial % 2 else np.cumsum(rng.integers(0, 3, n)) % 1280
        y = np.sort(rng.integers(0, 5, n)) if trial % 2 else rng.integers(0, 720, n)
        p = (rng.random(n) < 0.5).astype(np.uint8) if trial % 5 else np.arange(n, dtype=np.uint8) // 150 % 2
        buffer = ecf_buffer(t, x, y, p, mode)
        got = ecf_module.unpack_buffer(buffer)
        for a, b in zip(got[:4], (t, x, y, p), strict=True):
            np.testing.assert_array_equal(a, b)
        for length in rng.integers(0, len(buffer), 20):
            if mode == 2 or length < len(buffer) - 8:
                with pytest.raises(InputError):
                    ecf_module.unpack_buffer(buffer[:length])


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_ecf_files(tmp_path, rng, mode):
    e = events(rng, 5000)
    ecf(tmp_path / "a.hdf5", e, mode=mode)
    got = io.read(tmp_path / "a.hdf5").events
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(e, name))
    assert (got.width, got.height) == (W, H)


def test_metavision_without_ecf(tmp_path):
    kind = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["CD/events"] = np.array([(1, 2, 1, 5), (3, 4, 0, 6)], kind)
        file.attrs["format"] = "EVT3;height=720;width=1280"
    got = io.read(tmp_path / "a.hdf5").events
    assert (got.t * 1e6).round().tolist() == [5, 6]
    assert (got.width, got.height) == (1280, 720)


@pytest.mark.parametrize("make", [ecf, written("HDF5")])
def test_a_heap_of_texts_with_an_empty_hole_is_no_endless_loop(tmp_path, rng, make):
    """HDF5 2.0 itself never returns from such a file."""
    path = tmp_path / "a.h5"
    make(path, events(rng, 50))
    if make is not ecf:
        with h5py.File(path, "r+") as file:
            file.require_group("dase").attrs["configuration"] = "a = 1\n"
    content = path.read_bytes()
    place = (
        content.index(columns.HeapMark.TEXTS.value) + 16
    )  # the first object: its length now leads into the hole
    path.write_bytes(content[: place + 8] + b"\x2f" + content[place + 9 :])
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match="heap of texts is damaged"):
            act(path)


@pytest.mark.parametrize("ring", [1, 2], ids=["to itself", "to and fro"])
def test_a_heap_of_names_whose_holes_go_round_is_no_endless_loop(tmp_path, rng, ring):
    """HDF5 2.0 takes memory until there is none."""
    path = tmp_path / "a.h5"
    written("HDF5")(path, events(rng, 50))
    content = bytearray(path.read_bytes())
    heap = content.index(columns.HeapMark.NAMES.value)
    size, hole, data = (int.from_bytes(content[heap + n : heap + n + 8], "little") for n in (8, 16, 24))
    assert hole + 16 * ring <= size
    for n in range(ring):
        place = data + hole + 16 * n
        content[place : place + 8] = (hole + 16 * ((n + 1) % ring)).to_bytes(8, "little")
    path.write_bytes(content)
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match="heap of names is damaged"):
            act(path)


def test_heaps_are_checked_once_until_the_file_changes(tmp_path, rng, monkeypatch):
    path, searched = tmp_path / "a.h5", []
    written("HDF5")(path, events(rng, 50))
    heaps = columns._find_heaps
    monkeypatch.setattr(columns, "_find_heaps", lambda file: searched.append(file.name) or heaps(file))
    io.read(path)
    assert len(searched) > 1  # just written: its time may stay when it changes
    searched.clear()
    with monkeypatch.context() as later:
        now = time.time_ns
        later.setattr(time, "time_ns", lambda: now() + 2 * columns.CHECKS.settled)
        for _ in range(3):
            io.read(path)
    assert len(searched) == 1
    io.read(path)
    assert len(searched) == 1
    content, state = bytearray(path.read_bytes()), path.stat()
    heap = content.index(columns.HeapMark.NAMES.value)
    hole, data = (int.from_bytes(content[heap + n : heap + n + 8], "little") for n in (16, 24))
    content[data + hole : data + hole + 8] = hole.to_bytes(8, "little")
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))  # the same length at the same time
    with pytest.raises(InputError, match="heap of names is damaged"):
        io.read(path)


def test_names_in_a_file_cannot_break_the_sentence(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["two\nlines and \x1b[31mred"] = np.zeros(3)
    with pytest.raises(InputError, match=r"holds two lines and \\x1b\[31mred$"):
        io.read(tmp_path / "a.h5")


def test_layouts_nobody_knows(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["something/else"] = np.zeros(3)
    with pytest.raises(InputError, match=r"of no known layout .*: holds something, something/else"):
        io.read(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w"):
        pass
    with pytest.raises(InputError, match="holds nothing"):
        list(io.stream(tmp_path / "b.h5"))


@pytest.mark.parametrize(
    "act", [io.read, lambda path: list(io.stream(path)), lambda path: list(io.pictures(path))]
)
def test_a_refused_file_is_let_go_of(tmp_path, rng, act):
    """Not when the error, which holds the frames of all functions, is forgotten."""
    frames = np.array([0.1, 0.2]), np.zeros((2, H, W), np.uint8)
    mvsec(tmp_path / "a.hdf5", events(rng, 500), frames=frames)
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["davis/left/events"][490, 2] = np.nan
    with pytest.raises(InputError, match="a time is not a finite number") as held:
        act(tmp_path / "a.hdf5")
    assert held.value.__traceback__ is not None
    assert h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) == 0


@pytest.mark.parametrize(
    ("make", "change", "match"),
    [
        (dsec, ("events/x", np.zeros(7, np.uint16)), "'events/x' has 7 entries"),
        (dsec, ("events/x", np.full(500, -1, np.int32)), "must lie in 0..65535"),
        (dsec, ("events/x", np.full(500, 1.5)), r"must be whole numbers, got 1\.5"),
        (dsec, ("events/t", np.zeros((500, 2))), "must have 1 axes"),
        (dsec, ("events/p", np.array([b"a"] * 500)), "must hold numbers"),
        (mvsec, ("davis/left/events", np.zeros((5, 3))), r"shape \(N, 4\)"),
        (mvsec, ("davis/left/events", np.full((5, 4), np.nan)), "must be whole numbers, got nan"),
        (v2e, ("events", np.zeros((5, 4))), "whole numbers of shape"),
        (v2e, ("events", np.zeros((5, 3), np.uint32)), r"shape \(N, 4\)"),
        (ecf, ("CD/events", np.zeros(5)), "must have the fields"),
        (written("HDF5"), ("events/xs", np.zeros(7, np.int16)), "has 7 entries|common shape"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_columns_that_do_not_fit(tmp_path, rng, make, change, match):
    path = tmp_path / "a.hdf5"
    make(path, events(rng, 500))
    with h5py.File(path, "r+") as file:
        del file[change[0]]
        file[change[0]] = change[1]
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match=match):
            act(path)


@pytest.mark.parametrize(
    "name", ["events/t", "events/xs", "davis/left/events", "events", "CD/events", "images/image000000000"]
)
def test_bombs(tmp_path, rng, name):
    """A small file whose dataset is declared as large as a disk."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        shape = (10**9, 4) if name in ("davis/left/events", "events") else (10**10,)
        if name.startswith("images"):
            shape = (8000, 8000 * 100)
        kind = [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")] if name == "CD/events" else "u2"
        file.create_dataset(name, shape, kind, chunks=True, compression="gzip")
        for other in ("t", "x", "y", "p") if name == "events/t" else ("xs", "ys", "ts", "ps"):
            if name.startswith("events/") and f"events/{other}" not in file:
                file[f"events/{other}"] = np.zeros(3, np.uint16)
        file.attrs["sensor_resolution"] = np.array([H, W])
    assert path.stat().st_size < 1 << 20
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match="more than 100 times is refused"):
            act(path)


def test_s2r_streams_with_the_size_either_way_round(tmp_path, rng):
    e = events(rng, 1000)
    io.write(tmp_path / "a.h5", Sequence(e))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file.attrs["sensor_resolution"] = np.array([W, H])
    got = next(io.stream(tmp_path / "a.h5"))
    assert (got.width, got.height) == (W, H)
    frames = np.zeros((1, H, W), np.uint8)
    io.write(tmp_path / "b.h5", Sequence(e, frames, np.zeros(1)))
    with h5py.File(tmp_path / "b.h5", "r+") as file:
        del file.attrs["sensor_resolution"]
    assert next(io.stream(tmp_path / "b.h5")).width == W
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file.attrs["sensor_resolution"]
    with pytest.raises(InputError, match="how large"):
        list(io.stream(tmp_path / "a.h5"))


def test_a_text_that_claims_to_be_large_takes_no_memory(tmp_path, rng):
    """HDF5 takes what the length of a text says before it looks for the text."""
    path = tmp_path / "a.hdf5"
    ecf(path, events(rng, 50))
    content = path.read_bytes()
    where = content.index(struct.pack("<IQ", len(f"{W}x{H}"), content.index(columns.HeapMark.TEXTS.value)))
    path.write_bytes(content[:where] + struct.pack("<I", 0xF0000000) + content[where + 4 :])
    script = """
import sys
from dase import io
from dase.errors import InputError
before = peak()
for act in (io.read, lambda path: list(io.stream(path))):
    try:
        act(sys.argv[1])
    except InputError as error:
        print(error)
print(peak() - before)
"""
    *said, grown = measured(script, path)
    assert len(said) == 2
    assert all("cannot be read as Prophesee HDF5" in sentence for sentence in said)
    assert float(grown) < 100


def test_blosc_without_its_parameters_is_no_crash(tmp_path, rng):
    plugin = pytest.importorskip("hdf5plugin")
    path = tmp_path / "a.h5"
    dsec(path, events(rng, 300), **plugin.Blosc(cname="zstd"))
    content = bytearray(path.read_bytes())
    where = content.index(b"blosc\0")
    assert struct.unpack_from("<HHHH", content, where - 8)[::3] == (32001, 7)
    content[where - 2 : where] = b"\0\0"  # how many there are
    path.write_bytes(content)
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match="is damaged: its filter has 0 parameters"):
            act(path)


def test_a_list_of_unknown_kind_is_no_crash(tmp_path, rng):
    """In a process of its own, which HDF5 2.0 would end."""
    ecf(tmp_path / "a.hdf5", events(rng))
    data = bytearray((tmp_path / "a.hdf5").read_bytes())
    place = data.index(b"\x19\x01\x01\x00\x10\x00\x00\x00")  # a text of any length; nearly
    data[place + 1] = 9
    (tmp_path / "a.hdf5").write_bytes(data)
    (line,) = measured(READ, tmp_path / "a.hdf5")
    assert line.endswith("its attribute 'geometry' holds neither numbers nor a text")


def test_a_file_that_says_it_is_several_takes_no_memory(tmp_path, rng):
    ecf(tmp_path / "a.hdf5", events(rng))
    data = bytearray((tmp_path / "a.hdf5").read_bytes())
    assert data[48:56] == b"\xff" * 8
    data[48:56] = struct.pack("<Q", 4096)
    data[4096:4112] = struct.pack("<IQ4x", 0, 1 << 30)
    (tmp_path / "a.hdf5").write_bytes(data)
    (line,) = measured(READ, tmp_path / "a.hdf5")
    assert line.endswith("is HDF5 in several files, which is not read, or damaged")
    for size in (0, 8, 40):
        (tmp_path / "a.hdf5").write_bytes(data[:size])
        with pytest.raises(InputError, match=r"a\.hdf5: "):
            io.read(tmp_path / "a.hdf5")


@pytest.mark.parametrize("number", [6, 305])
def test_filters_nobody_uses_for_events_are_refused(tmp_path, rng, number):
    dsec(tmp_path / "a.h5", events(rng, 50))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["events/t"]
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((50,))
        properties.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (1,) * 20)
        space = h5py.h5s.create_simple((50,))
        made = h5py.h5d.create(file["events"].id, b"t", h5py.h5t.NATIVE_UINT32, space, properties)
        made.write_direct_chunk((0,), bytes(200))
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(InputError, match=f"with HDF5 filter {number}, which is not known"):
            act(tmp_path / "a.h5")


def test_what_is_not_there_or_lies_elsewhere_is_refused(tmp_path, rng):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(200)))
    layout = h5py.VirtualLayout((50,), np.uint32)
    layout[:] = h5py.VirtualSource(secret, "t", (50,))
    makers = {
        r"has 1 of its 20 chunks": lambda group: group.create_dataset(
            "t", (50,), np.uint32, chunks=(50,), maxshape=(None,), compression="gzip"
        ),
        r"lies in another file": lambda group: group.create_dataset(
            "t", (50,), np.uint32, external=[(secret, 0, 200)]
        ),
        r"lies in another file, which": lambda group: group.create_virtual_dataset("t", layout),
        r"has 0 of its 200 bytes": lambda group: group.create_dataset("t", (50,), np.uint32),
    }
    for match, make in makers.items():
        dsec(tmp_path / "a.h5", events(rng, 50))
        with h5py.File(tmp_path / "a.h5", "r+") as file:
            del file["events/t"]
            made = make(file["events"])
            if "chunks" in match:
                made[:] = 1
                made.resize((1000,))
        for act in (io.read, lambda path: list(io.stream(path))):
            with pytest.raises(InputError, match=match):
                act(tmp_path / "a.h5")
