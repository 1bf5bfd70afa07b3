"""ROS bags: every message and encoding of event cameras, frames, compression, damage."""

from __future__ import annotations

import contextlib
import re
import sqlite3
import struct

import numpy as np
import pytest
from helpers.sample_files import H, W, bag, events, mcap, measured, microseconds

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import evt3, packed, ros_messages
from dase.io.sequence import Sequence

pytest.importorskip("rosbags")


def assert_same(got, e):
    np.testing.assert_array_equal(np.rint(got.t * 1e6), microseconds(e) - microseconds(e)[0])
    for name in "xyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(e, name))
    assert (got.width, got.height) == (W, H)


def encoded_evt3(tmp_path):
    """EVT3 as one camera sends it: the state runs on over packets."""

    def encode(e, k):
        path = tmp_path / "whole.raw"
        if not path.exists():
            io.write(path, Sequence(e))
        words = np.frombuffer(path.read_bytes().partition(b"% end\n")[2], "<u2")
        ends = np.flatnonzero(words >> 12 == evt3.Word.ADDR_X) + 1
        begin = ends[k.start - 1] if k.start else 0
        return words[begin : ends[min(k.stop, len(e)) - 1]].tobytes(), 0

    return encode


def encoded_mono(e, k):
    t = microseconds(e)[k] * 1000
    words = (t - t[0]) | e.x[k].astype(np.int64) << 32 | e.y[k].astype(np.int64) << 48
    return (words.astype(np.uint64) | e.p[k].astype(np.uint64) << 63).astype("<u8").tobytes(), int(t[0])


def encoded_libcaer(e, k):
    t = microseconds(e)[k]
    out = np.empty((len(t), 2), "<u4")
    out[:, 0] = (
        1 | e.p[k].astype(np.uint32) << 1 | e.y[k].astype(np.uint32) << 2 | e.x[k].astype(np.uint32) << 17
    )
    out[:, 1] = t - t[0]
    return out.tobytes(), int(t[0]) * 1000


def encoded_libcaer_cmp(e, k):
    t = microseconds(e)[k]
    return libcaer_cmp_words(t - t[0], e.x[k], e.y[k], e.p[k]), int(t[0]) * 1000


def libcaer_cmp_words(dt, x, y, p):
    """A packet as libcaer_driver writes it: words only where something changes, up to eight rows in a mask.

    The twin of its `convert_polarity_packet_compressed`, but for the row of a single event in a mask, which
    the driver takes from the first event of those eight rows.
    """
    out, mask, block, on = [2 << 12 | int(x[0])], 0, None, None

    def flush():
        nonlocal mask
        rows = [block + bit for bit in range(8) if mask >> bit & 1]
        if len(rows) == 1:
            out.append(3 << 12 | on << 11 | rows[0])
        elif rows:
            out.extend([4 << 12 | on << 11 | block, 5 << 12 | mask])
        mask = 0

    high, low, column = 0, 0, int(x[0])
    for time, i, j, polarity in zip(dt.tolist(), x.tolist(), y.tolist(), p.astype(int).tolist(), strict=True):
        if time >> 12 != high:
            flush()
            high = time >> 12
            out.append(0 << 12 | high)
        if time & 4095 != low:
            flush()
            low = time & 4095
            out.append(1 << 12 | low)
        if i != column:
            flush()
            column = i
            out.append(2 << 12 | i)
        if polarity != on or j & ~7 != block or mask >> (j & 7) & 1:
            flush()
            on, block = polarity, j & ~7
        mask |= 1 << (j & 7)
    flush()
    return np.array(out, "<u2").tobytes()


def test_libcaer_cmp_counts_microseconds_from_nanoseconds(tmp_path, rng):
    # many events at one time and column, in every row; times whose low bits stay while the high ones change
    count = 40_000
    t = np.sort(rng.integers(0, 900, count)) * 512 + 1_702_669_729_864_452
    x, y = rng.integers(0, 3, count, np.uint16), rng.integers(0, H, count, np.uint16)
    x[-1], y[-1] = W - 1, H - 1
    order = np.lexsort((y, x, t))
    e = Events((t - t[0])[order] / 1e6, x[order], y[order], (rng.random(count) < 0.37)[order], W, H)
    bag(tmp_path / "a", e, ros=2, kind=("libcaer_cmp", encoded_libcaer_cmp), packet=1700)
    notes = []
    got = io.read(tmp_path / "a", notes=notes).events
    assert not any("damaged" in note for note in notes)
    assert (len(got), np.count_nonzero(got.p)) == (count, np.count_nonzero(e.p))
    # rows of a mask come in their order: compare what does not depend on it
    for a, b in zip(sorted_rows(got), sorted_rows(e), strict=True):
        np.testing.assert_array_equal(a, b)


def sorted_rows(e):
    t = microseconds(e)
    order = np.lexsort((e.p, e.y, e.x, t))
    return t[order], e.x[order], e.y[order], e.p[order]


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("line", ["", "storage_identifier: ''", "storage_identifier: unheard-of"])
def test_a_folder_whose_metadata_name_no_storage_plugin(tmp_path, rng, plugin, line):
    from rosbags.rosbag2 import StoragePlugin

    e = events(rng, 700)
    bag(tmp_path / "a", e, ros=2, storage_plugin=StoragePlugin[plugin])
    metadata = tmp_path / "a" / "metadata.yaml"
    text, count = re.subn(
        r"\n( *)storage_identifier: .*", rf"\n\1{line}" if line else "", metadata.read_text()
    )
    assert count == 1
    metadata.write_text(text)
    notes = []
    assert_same(io.read(tmp_path / "a", notes=notes).events, e)
    assert any("metadata.yaml is of no use" in note for note in notes)


def test_a_folder_without_its_files_is_refused(tmp_path, rng):
    bag(tmp_path / "a", events(rng, 700), ros=2)
    (tmp_path / "a" / "a.db3").rename(tmp_path / "a" / "b.db3")
    with pytest.raises(InputError, match="missing"):
        io.read(tmp_path / "a")


@pytest.mark.parametrize("make", [1, 2])
@pytest.mark.parametrize("encoding", ["array", "evt3", "mono", "libcaer", "libcaer_cmp"])
def test_events_and_images(tmp_path, rng, make, encoding):
    e, grey = events(rng, 1501), rng.integers(0, 256, (3, H, W), np.uint8)
    kinds = {"evt3": encoded_evt3(tmp_path), "mono": encoded_mono, "libcaer": encoded_libcaer}
    kinds["libcaer_cmp"] = encoded_libcaer_cmp
    kind = "array" if encoding == "array" else (encoding, kinds[encoding])
    times = np.array([0.001, 0.01, 0.02])
    path = tmp_path / ("a.bag" if make == 1 else "a")
    bag(path, e, ros=make, kind=kind, frames=(times, grey))
    notes = []
    got = io.read(path, notes=notes)
    assert_same(got.events, e)
    np.testing.assert_array_equal(got.frames, grey)
    np.testing.assert_allclose(got.frame_times, times - e.t[0], atol=1e-6)
    assert len(notes) == 1
    if make == 2:
        (single,) = path.glob("*.db3")
        assert_same(io.read(single).events, e)


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_packed_bags_of_ros_1(tmp_path, rng, compression):
    e = events(rng, 700)
    bag(tmp_path / "a.bag", e, compression=compression)
    assert_same(io.read(tmp_path / "a.bag").events, e)


def test_mcap(tmp_path, rng):
    from rosbags.rosbag2 import StoragePlugin

    e = events(rng, 700)
    bag(tmp_path / "a", e, ros=2, storage_plugin=StoragePlugin.MCAP)
    (single,) = (tmp_path / "a").glob("*.mcap")
    assert io.find_format(single).name == "ROS bag"
    assert_same(io.read(single).events, e)
    assert_same(io.read(tmp_path / "a").events, e)


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_packed_bags_of_ros_2(tmp_path, rng, mode):
    e = events(rng, 700)
    bag(tmp_path / "a", e, ros=2, mode=mode)
    assert_same(io.read(tmp_path / "a").events, e)


@pytest.mark.parametrize("kind", ["BZ2", "LZ4", "MESSAGE", "STORAGE"])
def test_what_unpacks_to_too_much_is_not_unpacked(tmp_path, rng, monkeypatch, kind):
    path, e = tmp_path / "a", events(rng, 700)
    if kind == "STORAGE":
        path = tmp_path / "a.mcap"
        mcap(path, e)
    else:
        bag(path, e, **({"ros": 2, "mode": kind} if kind == "MESSAGE" else {"compression": kind}))
    assert_same(io.read(path).events, e)
    monkeypatch.setattr(packed, "LARGEST", 1000)
    notes = []
    got = io.read(path, size=(W, H), notes=notes).events
    assert len(got) == 0
    assert any("larger than it may be" in note and note.kind == "refused" for note in notes)


def bomb(zstd, count):
    """Zeros packed to almost nothing."""
    packer = zstd.ZstdCompressor()
    out = [packer.compress(bytes(1 << 20)) for _ in range(count)]
    return b"".join(out) + packer.flush()


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE", "STORAGE"])
def test_bombs_of_ros_2_take_little_memory_and_disk(tmp_path, rng, mode):
    """400 MB of zeros in 40 KB, in every place where ROS 2 packs."""
    zstd = pytest.importorskip("backports.zstd")
    path, e = tmp_path / "a", events(rng, 700)
    if mode == "STORAGE":
        path = tmp_path / "a.mcap"
        mcap(path, e)
        content = path.read_bytes()
        packed_at = content.index(zstd.compress(b"")[:4])  # of the chunk: its sizes stand before it
        (size,) = struct.unpack_from("<Q", content, packed_at - 8)
        data = bomb(zstd, 400)
        record = content.rindex(b"\x06", 0, packed_at)
        head = content[record + 9 : packed_at - 8]
        head = head[:16] + struct.pack("<Q", 400 << 20) + bytes(4) + head[28:]  # without a check sum
        body = head + struct.pack("<Q", len(data)) + data
        whole = content[:record] + b"\x06" + struct.pack("<Q", len(body)) + body
        path.write_bytes(whole + b"\x02" + struct.pack("<Q", 20) + bytes(20) + content[-8:])
        assert size < 1 << 20
    elif mode == "FILE":
        bag(path, e, ros=2, mode=mode)
        (single,) = path.glob("*.zstd")
        single.write_bytes(bomb(zstd, 400))
    else:
        bag(path, e, ros=2, mode=mode)
        (single,) = path.glob("*.db3")
        with contextlib.closing(sqlite3.connect(single)) as database:
            database.execute("UPDATE messages SET data = ?", (bomb(zstd, 400),))
            database.commit()
    script = """
import sys
from dase import io
from dase.errors import InputError
from dase.events import Events
import rosbags.rosbag1, rosbags.rosbag2
before = peak()
notes = []
try:
    print(len(io.read(sys.argv[1], size=(240, 180), notes=notes).events), *notes)
except InputError as error:
    print(error)
print(peak() - before)
"""
    said, memory = measured(script, path)
    assert "larger than it may be" in said or "more than 100 times is refused" in said
    assert float(memory) < 150


def test_rosbags_is_left_as_it_was(tmp_path, rng):
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    def state():
        return dict(first.decompressors), dict(storage_mcap.DECOMPRESSORS), second.zstd

    before = state()
    bag(tmp_path / "a.bag", events(rng, 2000, step_us=2000))  # longer than events may come late
    one, two = io.stream(tmp_path / "a.bag", chunk=100), io.stream(tmp_path / "a.bag", chunk=100)
    next(one)
    next(two)
    assert state() != before
    one.close()
    assert state() != before
    two.close()
    assert state() == before


def test_bags_without_events(tmp_path, rng):
    bag(tmp_path / "a.bag", events(rng, 0), frames=(np.zeros(1), np.zeros((1, H, W), np.uint8)))
    with pytest.raises(InputError, match=r"no topic of events, only /dvs/events .*, /dvs/image_raw"):
        io.read(tmp_path / "a.bag")


def test_without_the_library_the_extra_is_named(tmp_path, rng, monkeypatch):
    import sys

    bag(tmp_path / "a.bag", events(rng, 50))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for name in ("rosbags.rosbag1", "rosbags.rosbag2"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(InputError, match=r'in the checkout of dase, pip install "\.\[ros\]"'):
        io.read(tmp_path / "a.bag")


def test_messages_that_are_too_short():
    whole = struct.pack("<IIII", 1, 2, 3, 0) + struct.pack("<II", H, W) + struct.pack("<I", 1) + bytes(13)
    assert len(ros_messages.event_array(whole, False).t) == 1
    for length in range(len(whole)):
        with pytest.raises((InputError, struct.error)):
            ros_messages.event_array(whole[:length], False)
    with pytest.raises(InputError, match="claims 4294967295 events"):
        ros_messages.event_array(whole[:-17] + b"\xff" * 17, False)
    with pytest.raises(InputError, match="little-endian CDR"):
        ros_messages.event_array(b"\0\0\0\0", True)


@pytest.mark.parametrize(
    ("encoding", "channels", "size", "swapped"),
    [("mono8", 1, 1, 0), ("rgb8", 3, 1, 0), ("16UC1", 1, 2, 0), ("mono16", 1, 2, 1)],
)
def test_images(rng, encoding, channels, size, swapped):
    pixels = rng.integers(0, 256, (4, 6 * channels * size + 2), np.uint8)  # rows end with two bytes more
    name = encoding.encode()
    head = struct.pack("<IIII", 1, 2, 3, 0) + struct.pack("<II", 4, 6)
    head += struct.pack("<I", len(name)) + name + struct.pack("<BII", swapped, pixels.shape[1], pixels.size)
    time, got = ros_messages.decode_image(head + pixels.tobytes(), False, False)
    assert time == 2_000_000_003
    rows = pixels[:, :-2]
    if size == 2:
        low, high = (rows[:, k::2].astype(np.uint16) for k in ((1, 0) if swapped else (0, 1)))
        rows = low + 256 * high
    if channels == 3:
        rows = np.rint(rows.reshape(4, 6, 3) @ [0.21, 0.72, 0.07])
    np.testing.assert_array_equal(got, rows)
    assert got.dtype == (np.uint16 if size == 2 else np.uint8)
