"""Sequence files: what is written is read back, and a bad file is one sentence."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from dase.errors import InputError
from dase.events import Events, read_only
from dase.io import create, h5, npz, read, write
from dase.io.sequence import Sequence

SUFFIXES = (".h5", ".npz")
H, W = 6, 9


def events(rng, count=1000, begin=0.0, end=1.0):
    """Events with times in whole microseconds."""
    return Events(
        np.sort(rng.integers(int(begin * 1e6), int(end * 1e6), count)) / 1e6,
        rng.integers(0, W, count, np.uint16),
        rng.integers(0, H, count, np.uint16),
        rng.random(count) < 0.5,
        W,
        H,
    )


def everything(rng, frames=4):
    times = np.linspace(0.1, 0.9, frames).round(6)  # the archive keeps whole microseconds
    return Sequence(
        events(rng),
        rng.integers(0, 256, (frames, H, W), np.uint8),
        times,
        rng.normal(size=(frames, 2, H, W)).astype(np.float32),
        rng.uniform(0.1, 0.5, (2, H, W)).astype(np.float32),
        'name = "µ"\n' * 20_000,  # longer than the 64 KiB that HDF5 keeps in an object's header
        np.full(frames, 0.02),
    )


def assert_same(got, want):
    for name in ("t", "x", "y", "p"):
        a, b = getattr(got.events, name), getattr(want.events, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b, name)
    assert (got.events.width, got.events.height) == (want.events.width, want.events.height)
    assert got.configuration == want.configuration
    for name in ("frames", "flow", "thresholds"):
        a, b = getattr(got, name), getattr(want, name)
        assert (a is None) == (b is None), name
        if b is not None:
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b, name)
    for name in ("frame_times", "frame_exposure"):
        a, b = getattr(got, name), getattr(want, name)
        assert (a is None) == (b is None), name
        if b is not None:
            np.testing.assert_allclose(a, b, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("left_out", [(), ("flow",), ("thresholds", "configuration"), ("frame_exposure",)])
def test_round_trip(tmp_path, rng, suffix, left_out):
    full = everything(rng)
    want = Sequence(**{k: v for k, v in vars(full).items() if k not in left_out})
    write(tmp_path / f"a{suffix}", want)
    assert_same(read(tmp_path / f"a{suffix}"), want)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip_of_events_alone_and_of_nothing_but_a_size(tmp_path, rng, suffix):
    for want in (Sequence(events(rng)), Sequence(Events.empty(W, H))):
        write(tmp_path / f"a{suffix}", want)
        assert_same(read(tmp_path / f"a{suffix}"), want)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_frames_alone(tmp_path, rng, suffix):
    with create(tmp_path / f"a{suffix}") as writer:
        writer.frame(0.5, np.zeros((H, W), np.uint8))
    got = read(tmp_path / f"a{suffix}")
    assert len(got.events) == 0
    assert got.events.width == W
    assert got.span == (0.5, 0.5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_two_writes_are_equal_byte_for_byte_and_parts_add_up(tmp_path, rng, monkeypatch, suffix):
    monkeypatch.setattr(h5, "CHUNK", 64)
    monkeypatch.setattr(h5, "BLOCK", 256)
    want = everything(rng)
    first, second, third = (tmp_path / f"{name}{suffix}" for name in "abc")
    write(first, want)
    time.sleep(1.1 if suffix == ".h5" else 0)  # HDF5's time stamps count seconds
    write(second, want)
    assert first.read_bytes() == second.read_bytes()
    with create(third) as writer:
        for begin, end in itertools.pairwise((0, 1, 1, 63, 64, 500, 1000)):
            part = (getattr(want.events, name)[begin:end] for name in ("t", "x", "y", "p"))
            writer.events(Events(*part, W, H))
        for k in range(4):
            writer.frame(want.frame_times[k], want.frames[k], want.flow[k], exposure=0.02)
        writer.configuration(want.configuration)
        writer.thresholds(want.thresholds)
    assert_same(read(third), want)


def test_the_caller_may_reuse_its_arrays(tmp_path, rng):
    want = everything(rng)
    for suffix in SUFFIXES:
        copies = [getattr(want.events, name).copy() for name in ("t", "x", "y", "p")]
        grey = want.frames[0].copy()
        with create(tmp_path / f"a{suffix}") as writer:
            writer.events(Events(*copies, W, H))
            writer.frame(0.0, grey)
            for array in (*copies, grey):
                array[...] = 0
        got = read(tmp_path / f"a{suffix}")
        assert_same(got, Sequence(want.events, want.frames[:1], np.zeros(1)))


@pytest.mark.parametrize("threads", [1, 3])
def test_what_nobody_can_change_is_packed_where_it_lies(tmp_path, rng, monkeypatch, threads):
    monkeypatch.setattr(h5, "CHUNK", 64)
    monkeypatch.setattr(h5, "BLOCK", 256)
    monkeypatch.setattr(h5, "thread_count", lambda: threads)
    want, packed = everything(rng), []
    pack = h5.pack_chunk
    monkeypatch.setattr(h5, "pack_chunk", lambda values: (packed.append(values), pack(values))[1])
    files = []
    for fixed in (False, True):
        packed.clear()
        stream, flow = want.events, want.flow
        if fixed:
            stream, flow = stream.read_only(), read_only(flow)
        files.append(tmp_path / f"{fixed}.h5")
        with create(files[-1]) as writer:
            for begin, end in itertools.pairwise((0, 320, 500, 1000)):
                writer.events(stream.select(slice(begin, end)))
            for k in range(4):
                writer.frame(want.frame_times[k], want.frames[k], flow[k])
        there = [a for a in (*(getattr(want.events, name) for name in "txyp"), want.flow)]
        shared = sum(any(np.shares_memory(chunk, a) for a in there) for chunk in packed)
        # 4 columns of 15 chunks, of which one has events of two parts, and 4 fields of flow
        assert shared == (4 * 14 + 4 if fixed else 4 * (threads == 1))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_s2r_layout(tmp_path, rng):
    want = everything(rng)
    write(tmp_path / "a.h5", want)
    with h5py.File(tmp_path / "a.h5") as file:
        kinds = {name: file[f"events/{name}"].dtype for name in ("xs", "ys", "ts", "ps")}
        assert kinds == {"xs": np.int16, "ys": np.int16, "ts": np.float64, "ps": np.bool_}
        assert file["events/xs"].maxshape == (None,)
        t = file["events/ts"][:]
        assert list(file["images"]) == [f"image{k:09d}" for k in range(4)]
        assert list(file["flow"]) == [f"flow{k:09d}" for k in range(4)]
        for k, at in enumerate(want.frame_times):
            image, flow = file[f"images/image{k:09d}"], file[f"flow/flow{k:09d}"]
            assert image.dtype == np.uint8
            assert image.attrs["type"] == "greyscale"
            assert tuple(image.attrs["size"]) == image.shape == (H, W)
            assert tuple(flow.attrs["size"]) == flow.shape == (2, H, W)
            assert image.attrs["timestamp"] == flow.attrs["timestamp"] == at
            index = image.attrs["event_idx"]
            assert index == flow.attrs["event_idx"]
            assert t[index] < at <= t[index + 1]
        on = int(want.events.p.sum())
        assert dict(file.attrs) | {"sensor_resolution": None} == {
            "num_events": 1000,
            "num_pos": on,
            "num_neg": 1000 - on,
            "duration": t[-1] - t[0],
            "t0": t[0],
            "tk": t[-1],
            "num_imgs": 4,
            "num_flow": 4,
            "sensor_resolution": None,
        }
        assert tuple(file.attrs["sensor_resolution"][0:2]) == (H, W)
        assert file["dase"].attrs["configuration"] == want.configuration
        np.testing.assert_array_equal(file["dase/thresholds"], want.thresholds)


@pytest.mark.parametrize("order", ["frames first", "events first", "mixed"])
def test_event_index_whatever_comes_first(tmp_path, rng, monkeypatch, order):
    monkeypatch.setattr(h5, "CHUNK", 64)
    monkeypatch.setattr(h5, "BLOCK", 256)
    stream, times = events(rng, 2000, 1.0, 2.0), np.linspace(0.9, 2.1, 25)
    parts = [stream.slice(begin, begin + 0.1) for begin in np.arange(10, 20) / 10]
    with create(tmp_path / "a.h5") as writer:
        jobs = [("frame", time, time) for time in times] + [("events", part.t[0], part) for part in parts]
        keys = {"frames first": lambda job: job[0] == "events", "events first": lambda job: job[0] == "frame"}
        for kind, time, part in sorted(jobs, key=keys.get(order, lambda job: job[1])):
            writer.events(part) if kind == "events" else writer.frame(time, np.zeros((H, W), np.uint8))
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["events/ts"], stream.t)
        got = [image.attrs["event_idx"] for image in file["images"].values()]
    np.testing.assert_array_equal(got, np.maximum(np.searchsorted(stream.t, times) - 1, 0))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_nothing_is_left_when_the_block_raises(tmp_path, rng, suffix, error):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"what was there before")

    def interrupted():
        with create(path) as writer:
            writer.events(events(rng))
            raise error

    with pytest.raises(error):
        interrupted()
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == b"what was there before"


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("room", [0, 100, 5_000, 20_000])
def test_nothing_is_left_when_the_disk_is_full(tmp_path, rng, suffix, room):
    """A limit on the size of files is as good as a full disk; HDF5 by itself crashes on either."""
    resource = pytest.importorskip("resource")
    want = Sequence(events(rng, 10_000), *list(vars(everything(rng, 40)).values())[1:4])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)):
            write(tmp_path / f"a{suffix}", want)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_nothing_is_left_when_a_write_fails(tmp_path, rng, monkeypatch, suffix, error):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(h5py.Dataset, "__setitem__", fail)
    monkeypatch.setattr(npz, "_store_member", fail)
    with pytest.raises(type(error)):
        write(tmp_path / f"a{suffix}", everything(rng))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "suffix", [pytest.param(s, marks=pytest.mark.slow) if s == ".h5" else s for s in SUFFIXES]
)
def test_damaged_files_are_one_sentence(tmp_path, rng, suffix):
    """Cut anywhere: InputError. Flipped anywhere: InputError or a sequence, never another error."""
    path = tmp_path / f"a{suffix}"
    want = Sequence(**{k: v for k, v in vars(everything(rng)).items() if k != "configuration"})
    write(path, want)
    content = path.read_bytes()
    for length in {0, 1, 4, 8, len(content) - 1, *np.linspace(9, len(content) - 2, 120, dtype=int)}:
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=path.name) as caught:
            read(path)
        assert "\n" not in str(caught.value)
    for k in rng.integers(0, len(content), 400):
        path.write_bytes(content[:k] + bytes([content[k] ^ 255]) + content[k + 1 :])
        with contextlib.suppress(InputError):
            read(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rubbish_and_missing_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for act in (read, lambda path: create(path.with_suffix(".avi"))):
        with pytest.raises(InputError, match=r"cannot be read|known: \.h5"):
            act(path)
    path.write_bytes(b"t x y p\n")
    with pytest.raises(InputError, match="cannot be read as"):
        read(path)
    with pytest.raises(InputError, match=r"known: \.h5, \.hdf5, \.npz"):
        read(Path(__file__))
    with pytest.raises(InputError):
        read(tmp_path)


def test_content_decides_over_the_suffix(tmp_path, rng):
    want = everything(rng)
    for suffix, other in itertools.permutations(SUFFIXES):
        write(tmp_path / f"a{suffix}", want)
        (tmp_path / f"a{suffix}").rename(tmp_path / f"b{other}")
        assert_same(read(tmp_path / f"b{other}"), want)


@pytest.mark.parametrize("name", ["t_us", "x", "y", "p", "wh"])
def test_npz_without_an_array(tmp_path, name):
    content = {"t_us": [1], "x": [1], "y": [1], "p": [1], "wh": [W, H]}
    np.savez(tmp_path / "a.npz", **{k: v for k, v in content.items() if k != name})
    with pytest.raises(InputError, match=name if name != "wh" else "how large"):
        read(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["events/ts", "events/xs", "images/image000000001"])
def test_h5_without_a_dataset_or_attribute(tmp_path, rng, name):
    write(tmp_path / "a.h5", everything(rng))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        parent, key = (file[name].attrs, "timestamp") if name.startswith("images") else (file, name)
        del parent[key]
    with pytest.raises(InputError, match=name):
        read(tmp_path / "a.h5")


def test_npz_sizes_stored_either_way_round(tmp_path):
    columns = {"t_us": np.arange(3), "x": [0, 5, W - 1], "y": [0, 1, H - 1], "p": [0, 1, 1]}
    frames = np.zeros((1, H, W), np.uint8)
    for extra in ({"wh": [W, H]}, {"wh": [H, W]}, {"wh": [1, 1], "frames": frames}, {"frames": frames}):
        np.savez(tmp_path / "a.npz", **columns, **extra)
        got = read(tmp_path / "a.npz").events
        assert (got.width, got.height) == (W, H)
    np.savez(tmp_path / "a.npz", **columns, wh=[5, 5])
    with pytest.raises(InputError, match="2 of 3 events lie outside the 5x5 it claims"):
        read(tmp_path / "a.npz")


def test_unsorted_times_are_sorted_stably(tmp_path):
    np.savez(tmp_path / "a.npz", t_us=[5, 1, 5, 1], x=[0, 1, 2, 3], y=[0, 0, 0, 0], p=[1, 0, 1, 0], wh=[4, 1])
    got = read(tmp_path / "a.npz").events
    np.testing.assert_array_equal(got.x, [1, 3, 0, 2])
    np.testing.assert_array_equal(got.p, [False, False, True, True])


def test_npz_of_other_kinds(tmp_path, rng):
    frames = rng.integers(0, 256, (3, H, W), np.uint8)
    np.savez(tmp_path / "a.npz", frames=frames, frame_us=[0, 500, 1500])
    got = read(tmp_path / "a.npz")
    assert len(got.events) == 0
    np.testing.assert_allclose(got.frame_times, [0, 500e-6, 1500e-6])
    columns = {"t_us": [0, 500_000], "x": [0, 1], "y": [0, 1], "p": [0, 1], "wh": [W, H]}
    np.savez(tmp_path / "a.npz", **columns, flow=np.ones((1, 2, H, W), np.float32))
    np.testing.assert_allclose(read(tmp_path / "a.npz").flow, 2.0)  # 1 px over half a second
    np.savez(tmp_path / "a.npz", **columns, frames=frames)
    assert read(tmp_path / "a.npz").frame_times is None
    np.savez(tmp_path / "a.npz", a=np.array([{}], object), **columns)
    assert len(read(tmp_path / "a.npz").events) == 2
    np.savez(tmp_path / "a.npz", **columns | {"t_us": np.array([{}, 1], object)})
    with pytest.raises(InputError, match="allow_pickle"):
        read(tmp_path / "a.npz")


def test_npz_refuses_long_times(tmp_path):
    late = Events(np.array([2147.5]), *(np.zeros(1, kind) for kind in (np.uint16, np.uint16, bool)), W, H)
    with pytest.raises(InputError, match="2147"):
        write(tmp_path / "a.npz", Sequence(late))
    write(tmp_path / "a.h5", Sequence(late))
    assert read(tmp_path / "a.h5").events.t[0] == 2147.5


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("match", "act"),
    [
        ("before", lambda w, part: [w.events(part), w.events(part)]),
        ("inside", lambda w, part: w.events(Events(part.t, part.x + np.uint16(9), part.y, part.p, W, H))),
        ("sorted", lambda w, part: w.events(Events(part.t[::-1], part.x, part.y, part.p, W, H))),
        ("sensor is", lambda w, part: [w.events(part), w.frame(0.0, np.zeros((W, H), np.uint8))]),
        ("uint8", lambda w, part: w.frame(0.0, np.zeros((H, W)))),
        ("time", lambda w, part: w.frame(float("nan"), np.zeros((H, W), np.uint8))),
        ("exposure", lambda w, part: w.frame(0.0, np.zeros((H, W), np.uint8), exposure=-1.0)),
        ("flow", lambda w, part: w.frame(0.0, np.zeros((H, W), np.uint8), np.zeros((2, W, H)))),
        ("thresholds", lambda w, part: w.thresholds(np.zeros((H, W)))),
        ("already", lambda w, part: [w.configuration("a"), w.configuration("b")]),
        ("nothing", lambda w, part: w.configuration("a")),
        (
            "all frames",
            lambda w, part: [
                w.frame(0.0, np.zeros((H, W), np.uint8), np.zeros((2, H, W))),
                w.frame(0.0, np.zeros((H, W), np.uint8)),
            ],
        ),
    ],
)
def test_writers_refuse(tmp_path, rng, suffix, match, act):
    def attempt():
        with create(tmp_path / f"a{suffix}") as writer:
            act(writer, events(rng))

    with pytest.raises(InputError, match=match):
        attempt()
    assert list(tmp_path.iterdir()) == []


def test_sequence_refuses_shapes_that_disagree(rng):
    with pytest.raises(InputError, match=r"frame_times must have shape \(2\)"):
        Sequence(events(rng), np.zeros((2, H, W), np.uint8), np.zeros(3))
    with pytest.raises(InputError, match="thresholds"):
        Sequence(events(rng), thresholds=np.zeros((H, W), np.float32))


def test_missing_folder(tmp_path, rng):
    with pytest.raises(InputError, match="does not exist"):
        write(tmp_path / "no" / "a.h5", Sequence(events(rng)))


def test_shared_archives_read(shared):
    paths = sorted(p for folder in ("recordings", "hidden") for p in (shared / folder).glob("*.npz"))
    assert len(paths) >= 20
    for path in paths:
        if path.stem == "noise_iebcs":  # histograms, not events
            with pytest.raises(InputError, match="neither events"):
                read(path)
            continue
        got = read(path)
        size = (got.events.width, got.events.height)
        known = {(240, 180), (346, 260), (640, 480), (1280, 720), (128, 128), (176, 132), (176, 260)}
        assert size in known, path
        assert len(got.events) > 0 or got.frames is not None
        begin, end = got.span
        assert 0.01 < end - begin < 13
        if path.stem == "davis346_cuke_cradle":
            np.testing.assert_allclose(got.frame_exposure, 0.02)
            np.testing.assert_allclose(np.diff(got.frame_times), 0.04)
        if path.stem == "clip_a":
            assert got.frames.shape == (1001, 132, 176)
            np.testing.assert_allclose(got.frame_times, np.arange(1001) / 1000)
