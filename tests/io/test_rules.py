"""The rules that events of every file go through, and frames that come one by one."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from helpers.sample_files import FRAMES, H, W, aedat4, bag, events, measured, mvsec, table, v2e

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.figures import event_images
from dase.io import arrays, rules
from dase.io.sequence import Sequence

COLUMNS = {"x": np.arange(6) % 3, "y": np.zeros(6, int), "p": np.ones(6, int), "wh": [3, 3]}


def archive(path, t_us, **others):
    np.savez(path, t_us=np.array(t_us, np.int64), **(COLUMNS | others))


def both(path, **options):
    """What `read` and `stream` give, with their notes."""
    out = []
    for act in (lambda **o: io.read(path, **o).events, lambda **o: Events.concatenate(io.stream(path, **o))):
        notes = []
        out.append((act(notes=notes, **options), notes))
    return out


@pytest.mark.parametrize(
    ("least", "span"), [(0, 1 << 31), (0, 1 << 32), (-(1 << 31), 1 << 32)], ids=["31", "32", "signed"]
)
@pytest.mark.parametrize("part", [1, 2, 1 << 18])
def test_clocks_of_32_bits_go_on(tmp_path, monkeypatch, least, span, part):
    monkeypatch.setattr(arrays, "PART", part)
    true = least + span + np.array([-90, -50, 10, 20, 30, 40])
    late = true[[0, 2, 1, 3, 4, 5]]  # one event is written after the clock started over
    for want, order in ((true, np.arange(6)), (late, np.array([0, 2, 1, 3, 4, 5]))):
        archive(tmp_path / "a.npz", np.where(want >= least + span, want - span, want))
        for got, notes in both(tmp_path / "a.npz"):
            np.testing.assert_array_equal(np.rint(got.t * 1e6), np.sort(true))
            np.testing.assert_array_equal(got.x, COLUMNS["x"][np.argsort(order, kind="stable")])
            (note,) = (note for note in notes if note.rule == "wrap")
            assert (note.kind, note.number) == ("repaired", 1 if want is true else 2)
            assert {note.rule for note in notes} == {"wrap"} | ({"order"} if want is late else set())


def test_a_clock_may_start_over_twice_and_seconds_do_it_too(tmp_path, rng):
    true = np.sort(rng.integers(0, 3 << 32, 4000))
    rows = zip((true % (1 << 32)).tolist(), strict=True)
    (tmp_path / "a.txt").write_text("".join(f"{t / 1e6:.6f} 1 1 1\n" for (t,) in rows))
    for got, notes in both(tmp_path / "a.txt", size=(2, 2)):
        np.testing.assert_allclose(got.t * 1e6, true, atol=0.01)
        assert [note.number for note in notes] == [2]


def test_times_that_only_go_back_are_sorted_not_unwrapped(tmp_path):
    archive(tmp_path / "a.npz", [0, 1_500_000_000, 1, 2, 1_600_000_000, 3])
    notes = []
    got = io.read(tmp_path / "a.npz", notes=notes).events
    assert np.rint(got.t * 1e6).tolist() == [0, 1, 2, 3, 1_500_000_000, 1_600_000_000]
    assert [(note.rule, note.kind, note.number) for note in notes] == [("order", "repaired", 2)]


@pytest.mark.parametrize(
    ("codes", "noted"),
    [
        ([0, 1] * 3, False),
        ([-1, 1] * 3, False),
        ([True, False] * 3, False),
        ([0, 255] * 3, True),
        ([1, 2] * 3, True),
    ],
)
def test_polarity_codes(tmp_path, codes, noted):
    archive(tmp_path / "a.npz", np.arange(6), p=np.array(codes))
    for got, notes in both(tmp_path / "a.npz"):
        np.testing.assert_array_equal(got.p, np.array(codes) > 0)
        assert [note.rule for note in notes] == ["polarity"] * noted


def test_few_events_outside_are_left_out_and_a_wrong_size_is_refused(tmp_path):
    archive(tmp_path / "a.npz", np.arange(6), x=[0, 1, 2, 3, 1, 0])
    for got, notes in both(tmp_path / "a.npz"):
        assert got.x.tolist() == [0, 1, 2, 1, 0]
        assert [(str(note), note.kind, note.number) for note in notes] == [
            ("1 events lie outside the 3x3 sensor: skipped", "refused", 1)
        ]
    archive(tmp_path / "a.npz", np.arange(6), x=[9, 9, 9, 9, 1, 0])
    for act in (io.read, lambda path: list(io.stream(path))):
        with pytest.raises(
            InputError, match=r"4 of 6 events lie outside the 3x3 it claims: the size is wrong"
        ):
            act(tmp_path / "a.npz")
    for got, _ in both(tmp_path / "a.npz", size=(20, 3)):
        assert (got.width, got.height, len(got)) == (20, 3, 6)


def test_a_size_the_wrong_way_round_is_noted(tmp_path):
    archive(tmp_path / "a.npz", np.arange(6), wh=[2, 9], x=[0, 8, 3, 4, 1, 0])
    for got, notes in both(tmp_path / "a.npz"):
        assert (got.width, got.height) == (9, 2)
        assert [(note.rule, note.kind) for note in notes] == [("size", "repaired")]


def test_a_note_is_a_sentence_with_fields():
    note = io.Note("3 events: skipped", "refused", "bounds", 3)
    assert note == "3 events: skipped"
    assert json.loads(json.dumps(note.fields())) == {
        "kind": "refused",
        "rule": "bounds",
        "number": 3,
        "text": "3 events: skipped",
    }


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_labels_stream(tmp_path, rng, suffix):
    e = events(rng, 5000)
    e = Events(e.t, e.x, e.y, e.p, W, H, rng.integers(0, 4, len(e), np.int8))
    io.write(tmp_path / f"a.{suffix}", Sequence(e))
    parts = list(io.stream(tmp_path / f"a.{suffix}", chunk=777))
    np.testing.assert_array_equal(Events.concatenate(parts).label, e.label)
    io.convert(tmp_path / f"a.{suffix}", tmp_path / "b.h5")
    np.testing.assert_array_equal(io.read(tmp_path / "b.h5").events.label, e.label)


def with_frames(tmp_path, rng, name):
    """A file of events and frames; MVSEC's flow lies beside it."""
    e = events(rng, 3000, begin_us=1000)
    times = np.array([0.01, 0.03, 0.05])
    grey = rng.integers(0, 256, (FRAMES, H, W), np.uint8)
    path = tmp_path / name
    if name.endswith("aedat4"):
        spans = np.rint(times * 1e6).astype(int)
        aedat4(
            path, e, frames=[(t - 4000, t + 4000, one) for t, one in zip(spans.tolist(), grey, strict=True)]
        )
    elif name.endswith(".bag"):
        pytest.importorskip("rosbags")
        bag(path, e, frames=(times, grey))
    elif "mvsec" in name:
        mvsec(path, e, frames=(times, grey))
    elif "v2e" in name:
        v2e(path, e, frames=(times, grey))
    else:
        flow = rng.normal(size=(3, 2, H, W)).astype(np.float32)
        thresholds = rng.uniform(0.1, 0.5, (2, H, W)).astype(np.float32)
        io.write(path, Sequence(e, grey, times, flow, thresholds, "a = 1\n", np.full(3, 0.008)))
    return path


@pytest.mark.parametrize("name", ["a.aedat4", "a.bag", "mvsec_data.hdf5", "v2e.h5", "a.h5", "a.npz"])
def test_frames_come_one_by_one_as_they_are_read(tmp_path, rng, name):
    path = with_frames(tmp_path, rng, name)
    want = io.read(path)
    got = list(io.pictures(path))
    np.testing.assert_array_equal([one.grey for one in got], want.frames)
    np.testing.assert_array_equal([one.t for one in got], want.frame_times)
    np.testing.assert_array_equal(
        [one.exposure for one in got], np.zeros(3) if want.frame_exposure is None else want.frame_exposure
    )
    assert all((one.flow is None) == (want.flow is None) for one in got)
    if want.flow is not None:
        np.testing.assert_array_equal([one.flow for one in got], want.flow)
    io.convert(path, tmp_path / "out.h5")
    whole = io.read(tmp_path / "out.h5")
    for column in ("frames", "frame_times", "flow", "thresholds", "configuration", "frame_exposure"):
        a, b = getattr(whole, column), getattr(want, column)
        assert (a is None) == (b is None), column
        if b is not None:
            np.testing.assert_array_equal(a, b, column)
    np.testing.assert_array_equal(whole.events.t, want.events.t)


def test_converting_sorts_what_a_stream_cannot(tmp_path, rng, monkeypatch):
    e = events(rng, 3000, step_us=1000)
    rolled = Events(np.roll(e.t, 1000), e.x, e.y, e.p, W, H)
    table(tmp_path / "a.npy", rolled)
    monkeypatch.setattr(arrays, "PART", 100)
    with pytest.raises(rules.TooLateError, match="too far to sort"):
        list(io.stream(tmp_path / "a.npy"))
    notes = []
    assert io.convert(tmp_path / "a.npy", tmp_path / "b.h5", notes=notes) == 3000
    np.testing.assert_array_equal(io.read(tmp_path / "b.h5").events.t, e.t)
    assert any(note.rule == "order" for note in notes)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "b.h5"]


def test_frames_without_times_are_left_out_with_a_note(tmp_path, rng):
    grey = rng.integers(0, 256, (2, 3, 3), np.uint8)
    archive(tmp_path / "a.npz", np.arange(6), frames=grey)
    notes = []
    assert io.convert(tmp_path / "a.npz", tmp_path / "b.h5", notes=notes) == 6
    assert io.read(tmp_path / "b.h5").frames is None
    assert notes == ["frames without times cannot be converted: left out"]


def test_converting_frames_needs_no_memory_for_all_of_them(tmp_path):
    """120 MB of frames go from file to file in a process that may use little more than at its start."""
    script = """
import sys
import numpy as np
from dase import io
from dase.events import Events
n = np.arange(1000)
def make(path, count):
    with io.create(path) as writer:
        x, y = (n % 640).astype(np.uint16), (n % 480).astype(np.uint16)
        writer.events(Events(n / 1e3, x, y, n % 2 > 0, 640, 480))
        for k in range(count):
            writer.frame(k / 1e3, np.full((480, 640), k % 256, np.uint8))
make(sys.argv[1], 400)
io.convert(sys.argv[1], sys.argv[2])
before = peak()
assert len(io.read(sys.argv[2]).frames) == 400
print(before, peak() - before)
"""
    (line,) = measured(script, tmp_path / "a.h5", tmp_path / "b.h5")
    peak, grown = map(float, line.split())
    assert grown > 50  # what it would have been
    assert peak < 180


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_frames_of_16_bits_stay_so(tmp_path, rng, suffix):
    e, times = events(rng, 100), np.array([0.0, 0.001])
    grey = rng.integers(0, 4096, (2, H, W), np.uint16)
    io.write(tmp_path / f"a.{suffix}", Sequence(e, grey, times))
    for got in (
        io.read(tmp_path / f"a.{suffix}").frames,
        [one.grey for one in io.pictures(tmp_path / f"a.{suffix}")],
    ):
        np.testing.assert_array_equal(got, grey)
        assert got[0].dtype == np.uint16
    grey[0], grey[0, 0, 0] = 2048, 4095  # 12 bits are in use
    picture = event_images.moment_picture(Sequence(Events.empty(W, H), grey[:1], times[:1]), 0.0, 1e-3)
    assert picture[0, 0].min() > 230
    assert 100 < np.median(picture) < 180
    with io.create(tmp_path / f"b.{suffix}") as writer:
        writer.frame(0.0, grey[0])
        with pytest.raises(InputError, match="must be uint16 of shape"):
            writer.frame(0.1, (grey[1] >> 4).astype(np.uint8))


def test_pictures_of_16_bits_beside_a_text(tmp_path, rng):
    folder = tmp_path / "shapes"
    (folder / "images").mkdir(parents=True)
    grey = rng.integers(0, 65536, (2, H, W), np.uint16)
    io.write(folder / "events.txt", Sequence(events(rng, 100)))
    for k, one in enumerate(grey):
        cv2.imwrite(str(folder / f"images/{k}.png"), one)
    (folder / "images.txt").write_text("".join(f"0.00{k} images/{k}.png\n" for k in range(2)))
    np.testing.assert_array_equal(io.read(folder).frames, grey)
