"""Formats that users have: tables without names, Event Stream, N-MNIST, MATLAB, AEDAT 3.1."""

from __future__ import annotations

import struct
from itertools import permutations

import numpy as np
import pytest
from helpers import sample_files as reference_io
from helpers.call_counts import count_calls
from helpers.sample_files import H, W, events, measured, microseconds
from isal import isal_zlib

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import column_order, event_stream


def same(got, e):
    np.testing.assert_array_equal(np.rint(got.t * 1e6), microseconds(e))
    for name in "xyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(e, name))
    assert (got.width, got.height) == (e.width, e.height)


ORDERS = ["".join(order) for order in permutations("txyp") if order.index("x") < order.index("y")]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("suffix", [".npy", ".txt"])
def test_the_order_of_columns_is_recognised_and_said(tmp_path, rng, order, suffix):
    e, path, notes = events(rng), tmp_path / f"a{suffix}", []
    reference_io.plain(tmp_path / "a.npy", e, order=order)
    if suffix == ".txt":
        np.savetxt(path, np.load(tmp_path / "a.npy"), fmt="%d")
    same(io.read(path, notes=notes).events, e)
    said = [note for note in notes if getattr(note, "rule", "") == "columns"]
    assert len(said) == (suffix == ".npy" or order not in ("txyp", "xypt"))
    names = {"t": "time", "x": "column", "y": "row", "p": "polarity"}
    assert all(", ".join(names[letter] for letter in order) in note for note in said)


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
def test_the_order_of_columns_can_be_given(tmp_path, rng, suffix):
    e, path, notes = events(rng), tmp_path / f"a{suffix}", []
    reference_io.plain(tmp_path / "a.npy", e, order="tyxp")  # which no values tell
    if suffix == ".csv":
        np.savetxt(path, np.load(tmp_path / "a.npy"), fmt="%d", delimiter=",")
    same(io.read(path, columns="t,y,x,p", size=(W, H), notes=notes).events, e)
    assert not notes
    turned = Events(e.t, e.y, e.x, e.p, W, W)
    same(io.read(path, size=(W, W)).events, turned)
    with pytest.raises(InputError, match="columns must be an order of the letters"):
        io.read(path, columns="txy")


@pytest.mark.parametrize("line", ["timestamp,x,y,polarity", "pol ts y x", "x y t p"])
def test_a_line_of_names_tells_the_order(tmp_path, rng, line):
    e, notes = events(rng), []
    order = column_order.named_order(line.replace(",", " ").split())
    reference_io.plain(tmp_path / "a.npy", e, order=order)
    np.savetxt(tmp_path / "a.csv", np.load(tmp_path / "a.npy"), fmt="%d", header=line, comments="")
    same(io.read(tmp_path / "a.csv", size=(W, H), notes=notes).events, e)
    assert not notes


@pytest.mark.parametrize(
    "made",
    [
        lambda table: table.astype(np.float64),
        lambda table: np.asfortranarray(table),
        lambda table: np.ascontiguousarray(table.T),
        lambda table: (table * [1, 1, 1e-6, 1]).astype(np.float64),  # seconds
        lambda table: (table * [1, 1, 1, 2] - [0, 0, 0, 1]).astype(np.float32),
        lambda table: table.astype(np.uint32),
    ],
)
def test_tables_of_other_types(tmp_path, rng, monkeypatch, made):
    e = events(rng)
    reference_io.plain(tmp_path / "a.npy", e)
    np.save(tmp_path / "b.npy", made(np.load(tmp_path / "a.npy")))
    same(io.read(tmp_path / "b.npy").events, e)


def test_tables_that_are_no_events(tmp_path, rng):
    for name, table, match in (
        ("random", rng.random((50, 4)), "the values do not tell which is time"),
        ("five", np.zeros((50, 5)), "must be a structured array"),
        ("fraction", np.array([[0, 1.5, 2.5, 1], [1, 2, 3.5, 0]]), "the values do not tell"),
        ("text", np.full((50, 4), "a"), "must be a structured array"),
    ):
        np.save(tmp_path / f"{name}.npy", table)
        with pytest.raises(InputError, match=match):
            io.read(tmp_path / f"{name}.npy")
    np.save(tmp_path / "cut.npy", np.array([[0, 1.5, 2, 1], [1, 2, 3, 0]]))
    with pytest.raises(InputError, match=r"must be whole numbers, got 1\.5"):
        io.read(tmp_path / "cut.npy", columns="txyp")


def es_twin(data, kind):
    """Events of an Event Stream, one byte after the other."""
    place, t, out = 20, 0, []
    while place < len(data):
        byte = data[place]
        if kind == 1 and byte >= 0xFE:
            t += 127 * (byte == 0xFF)
        elif kind == 2 and byte >= 0xFC:
            t += 63 * (byte & 3)
        elif place + 5 > len(data):
            break
        else:
            t += byte >> kind
            x, y = struct.unpack_from("<HH", data, place + 1)
            if kind == 1 or not byte & 1:
                out.append((t, x, y, bool(byte & 1 if kind == 1 else byte & 2)))
            place += 4
        place += 1
    return out


@pytest.mark.parametrize("kind", [1, 2])
def test_random_bytes_of_an_event_stream_equal_a_twin(tmp_path, rng, kind):
    body = rng.integers(0, 256, 200_000, np.uint8)
    body[rng.random(len(body)) < 0.3] = 0xFF  # runs of steps, over the edges of what is read at once
    data = b"Event Stream" + bytes((2, 0, 1, kind)) + struct.pack("<HH", 65535, 65535) + body.tobytes()
    (tmp_path / "a.es").write_bytes(data)
    pieces = list(event_stream.read_pieces(io.Source(tmp_path / "a.es")))
    got = [row for piece in pieces for row in zip(*(column.tolist() for column in piece[:4]), strict=True)]
    assert got == es_twin(data, kind)


def test_exposures_of_an_atis_are_no_events(tmp_path, rng):
    e, notes = events(rng, 500), []
    reference_io.event_stream(tmp_path / "a.es", e, kind=2, exposures=(3, 4, 77))
    same(io.read(tmp_path / "a.es", notes=notes).events, e.select(np.delete(np.arange(500), [3, 4, 77])))
    assert any(note.startswith("3 events of exposure") for note in notes)


@pytest.mark.parametrize(
    ("place", "value", "match"), [(12, 1, "version 2 is read"), (15, 4, "have no polarity")]
)
def test_event_streams_that_are_refused(tmp_path, rng, place, value, match):
    reference_io.event_stream(tmp_path / "a.es", events(rng, 50))
    data = bytearray((tmp_path / "a.es").read_bytes())
    data[place] = value
    (tmp_path / "a.es").write_bytes(data)
    with pytest.raises(InputError, match=match):
        io.read(tmp_path / "a.es")


def test_n_mnist(tmp_path, rng):
    e = events(rng, 4000, 34, 34)
    reference_io.nmnist(tmp_path / "00001.bin", e)
    same(io.read(tmp_path / "00001.bin").events, e)
    assert io.find_format(tmp_path / "00001.bin").name == "N-MNIST"
    (tmp_path / "b.bin").write_bytes(rng.bytes(5000))
    with pytest.raises(InputError):
        io.read(tmp_path / "b.bin")


@pytest.mark.parametrize("structure", [True, False])
@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("shift", [0, 1])
def test_matlab(tmp_path, rng, structure, compress, shift):
    e, notes = events(rng), []
    e = Events(e.t, e.x % np.uint16(W), e.y % np.uint16(H), e.p, W, H)
    e.x[5] = e.y[6] = 0
    reference_io.matlab(tmp_path / "a.mat", e, compress=compress, structure=structure, shift=shift)
    same(io.read(tmp_path / "a.mat", notes=notes).events, e)
    assert any("count from 1" in note for note in notes) == bool(shift)
    assert any("2 was taken for ON" in note for note in notes) == bool(shift)


def test_matlab_of_seconds_and_other_types(tmp_path, rng):
    from scipy.io import savemat

    e = events(rng)
    savemat(tmp_path / "a.mat", {"t": e.t, "x": e.x, "y": e.y.astype(np.int32)[:, None], "pol": e.p})
    same(io.read(tmp_path / "a.mat").events, e)


def test_matlab_files_that_are_refused(tmp_path, rng):
    from scipy.io import savemat

    for content, match in (
        ({"a": 1.0}, "has no variables"),
        ({"x": np.zeros(5), "y": np.zeros(5), "t": np.zeros(4), "p": np.zeros(5)}, "has 5 values, 't' 4"),
        (
            {"x": np.full(2, 0.5), "y": np.zeros(2), "t": np.arange(2), "p": np.zeros(2)},
            r"numbers, got 0\.5",
        ),
    ):
        savemat(tmp_path / "a.mat", content)
        with pytest.raises(InputError, match=match):
            io.read(tmp_path / "a.mat")


@pytest.mark.slow
def test_a_matlab_file_that_unpacks_to_too_much_takes_no_memory(tmp_path):
    packed = isal_zlib.compress(bytes(1 << 30))  # in a fiftieth of the time of zlib
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    (tmp_path / "a.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    script = """
import sys
from dase import io
from dase.errors import InputError
before = peak()
try:
    io.read(sys.argv[1])
except InputError as error:
    print(error)
print(peak() - before)
"""
    sentence, grown = measured(script, tmp_path / "a.mat")
    assert "unpacks from" in sentence
    assert float(grown) < 450


def test_aedat_3_with_frames_and_motion(tmp_path, rng):
    e, notes = events(rng), []
    grey = rng.integers(0, 65536, (2, H, W), np.uint16)
    motion = [(1000 * k, (0.0, 0.0, 1.0), (180.0, 0.0, 0.0)) for k in range(3)]
    frames = [(2000, 6000, grey[0]), (12_000, 16_000, grey[1])]
    reference_io.aedat3(tmp_path / "a.aedat", e, frames=frames, motion=motion)
    got = io.read(tmp_path / "a.aedat", notes=notes)
    same(got.events, e)
    assert not notes
    np.testing.assert_array_equal(got.frames, grey)
    np.testing.assert_allclose(got.frame_times, [0.004, 0.014])
    np.testing.assert_allclose(got.frame_exposure, 0.004)
    moved = io.motion(tmp_path / "a.aedat")
    np.testing.assert_allclose(moved.t, [0, 0.001, 0.002])
    np.testing.assert_allclose(moved.acceleration[:, 2], 9.80665)
    np.testing.assert_allclose(moved.rotation[:, 0], np.pi)


def test_aedat_3_whose_clock_overflowed(tmp_path, rng):
    e = events(rng)
    reference_io.aedat3(tmp_path / "a.aedat", e, overflows=2)
    got = io.read(tmp_path / "a.aedat").events
    np.testing.assert_array_equal(np.rint(got.t * 1e6).astype(np.int64), microseconds(e) + 2 * 2**31)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"DAT3.1", b"DAT3.0", "of which only 3.1 is read"),
        (b"Format: RAW", b"Format: SerializedTS", "is packed"),
        (b"#!END-HEADER", b"#!END-HEADEX", "does not end"),
    ],
)
def test_aedat_3_that_is_refused(tmp_path, rng, old, new, match):
    reference_io.aedat3(tmp_path / "a.aedat", events(rng, 50))
    (tmp_path / "a.aedat").write_bytes((tmp_path / "a.aedat").read_bytes().replace(old, new))
    with pytest.raises(InputError, match=match):
        io.read(tmp_path / "a.aedat")


def test_aedat_3_cut_short(tmp_path, rng):
    e, notes = events(rng), []
    reference_io.aedat3(tmp_path / "a.aedat", e)
    (tmp_path / "a.aedat").write_bytes((tmp_path / "a.aedat").read_bytes()[:-100])
    assert len(io.read(tmp_path / "a.aedat", notes=notes).events) == 2500
    assert any("cut short" in note for note in notes)


def test_each_of_many_small_packets_costs_the_same(tmp_path):
    head = reference_io.AEDAT3_HEAD.replace(b"{}", b"DAVIS240C")
    empty = struct.pack("<hh6i", 1, 1, 8, 4, 0, 0, 0, 0)

    def calls(packets):
        (tmp_path / "a.aedat").write_bytes(head + empty * packets)
        return count_calls(lambda: io.read(tmp_path / "a.aedat"))

    few, many = calls(1000), calls(10_000)
    assert many < 10.5 * few
    assert many < 10_000 * 40
