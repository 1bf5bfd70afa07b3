"""Recordings: what is checked, and that no part of them is lost or counted twice."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sample_files import UNIX_US, aedat4

import dase
from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence
from dase.recordings.recording import Recording, open_recording

W, H = 20, 15


def some(rng, count=3000, duration=2.0):
    return Events(
        np.sort(rng.uniform(0.5, 0.5 + duration, count)),
        rng.integers(0, W, count, np.uint16),
        rng.integers(0, H, count, np.uint16),
        rng.random(count) < 0.4,
        W,
        H,
    )


@pytest.fixture
def recording(rng):
    grey = rng.integers(0, 256, (5, H, W), np.uint8)
    times = 0.6 + 0.4 * np.arange(5)
    return Recording.of(Sequence(some(rng), grey, times, frame_exposure=np.full(5, 0.1)))


def test_of_a_sequence(recording):
    e = recording.events
    assert recording.begin <= e.t[0]
    assert e.t[-1] < recording.end
    assert recording.duration == pytest.approx(2.0, abs=0.01)
    assert recording.mask.all()
    assert recording.mask.shape == (H, W)
    assert not recording.hot.any()
    np.testing.assert_allclose(recording.exposures, 0.6 + 0.4 * np.arange(5)[:, None] + [[-0.05, 0.05]])
    assert recording.report.statistics.events == len(e)
    assert dase.Recording is Recording


def test_slices_join_to_the_whole(recording):
    edges = np.linspace(recording.begin, recording.end, 8)
    parts = [recording.slice(a, b) for a, b in itertools.pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate([part.events.t for part in parts]), recording.events.t)
    for part in parts:
        assert part.begin <= part.events.t[0]
        assert part.events.t[-1] < part.end
    part = recording.slice(0.9, 1.9)
    assert part.frame_times.tolist() == pytest.approx([1.0, 1.4, 1.8])
    np.testing.assert_array_equal(part.frames, recording.frames[1:4])
    assert recording.slice(0.96, 1.9).frames.shape == (2, H, W)  # its exposure begins before
    for span in ((3.0, 4.0), (2.0, 1.0)):
        with pytest.raises(InputError, match="slice: must overlap"):
            recording.slice(*span)


def test_crops_keep_what_is_inside(recording):
    part = recording.crop(3, 2, 10, 8)
    e = recording.events
    kept = (e.x >= 3) & (e.x < 13) & (e.y >= 2) & (e.y < 10)
    np.testing.assert_array_equal(part.events.t, e.t[kept])
    np.testing.assert_array_equal(part.events.x + 3, e.x[kept])
    np.testing.assert_array_equal(part.events.y + 2, e.y[kept])
    assert (part.width, part.height) == (10, 8)
    np.testing.assert_array_equal(part.frames, recording.frames[:, 2:10, 3:13])
    assert part.mask.shape == part.hot.shape == (8, 10)
    for place in ((-1, 0, 5, 5), (0, 0, W + 1, 5), (0, 0, 0, 5), (15, 0, 6, 5)):
        with pytest.raises(InputError, match="must lie on the 20x15 sensor"):
            recording.crop(*place)


def test_masks_take_away_for_good(recording, rng):
    first, second = rng.random((2, H, W)) < 0.7
    part = recording.masked(first).masked(second)
    np.testing.assert_array_equal(part.mask, first & second)
    e = recording.events
    kept = (first & second)[e.y, e.x]
    np.testing.assert_array_equal(part.events.t, e.t[kept])
    np.testing.assert_array_equal(part.pixels, np.flatnonzero(first & second))
    np.testing.assert_array_equal(part.at_pixels(np.arange(W * H)).t, part.events.t)
    with pytest.raises(InputError, match="mask: must be bool of shape"):
        recording.masked(np.ones((W, H), bool))
    with pytest.raises(InputError, match="mask: must be bool of shape"):
        recording.masked(np.ones((H, W)))


def test_pixels_are_split_in_two_and_the_seed_decides(recording):
    trusted = recording.masked(np.arange(H * W).reshape(H, W) % 3 > 0)
    fit, held = trusted.split_pixels(0.25, seed=3)
    assert len(held) == round(0.25 * len(trusted.pixels))
    np.testing.assert_array_equal(np.sort(np.concatenate([fit, held])), trusted.pixels)
    assert len(trusted.at_pixels(fit)) + len(trusted.at_pixels(held)) == len(trusted.events)
    np.testing.assert_array_equal(trusted.split_pixels(0.25, seed=3)[1], held)
    assert not np.array_equal(trusted.split_pixels(0.25, seed=4)[1], held)
    chosen = trusted.subsample(50, seed=1)
    assert len(np.unique(chosen)) == 50
    assert np.isin(chosen, trusted.pixels).all()
    for wrong in (0, len(trusted.pixels) + 1):
        with pytest.raises(InputError, match="subsample: must take 1 to"):
            trusted.subsample(wrong, seed=1)
    for share in (0.0, 1.0, -1.0):
        with pytest.raises(InputError, match="share must lie between 0 and 1"):
            trusted.split_pixels(share, seed=1)
    with pytest.raises(InputError, match="at least 2 trusted pixels"):
        trusted.masked(np.zeros((H, W), bool)).split_pixels(0.5, seed=1)


@pytest.mark.parametrize(
    ("blocks", "share", "count"), [(10, 0.3, 3), (2, 0.5, 1), (7, 0.5, 4), (10, 0.9, 9), (5, 0.01, 1)]
)
def test_time_is_split_in_two(recording, blocks, share, count):
    train, held = recording.split_time(blocks, share)
    assert (len(train), len(held)) == (blocks - count, count)
    both = np.concatenate([train, held])
    both = both[np.argsort(both[:, 0])]
    assert (both[0, 0], both[-1, 1]) == (recording.begin, recording.end)
    np.testing.assert_array_equal(both[1:, 0], both[:-1, 1])
    np.testing.assert_allclose(np.diff(both, axis=1), recording.duration / blocks)
    assert train[0, 0] == recording.begin
    assert len(recording.in_blocks(train)) + len(recording.in_blocks(held)) == len(recording.events)
    t = recording.events.t
    inside = ((t[:, None] >= held[:, 0]) & (t[:, None] < held[:, 1])).any(1)
    np.testing.assert_array_equal(recording.in_blocks(held).t, t[inside])
    if count == 3:
        np.testing.assert_array_equal(
            np.rint((held[:, 0] - recording.begin) / recording.duration * 10), [2, 5, 8]
        )


def test_blocks_that_cannot_be(recording):
    for wrong in ([[1.0, 0.5]], [[0.0, 1.0], [0.5, 2.0]], [0.0, 1.0]):
        with pytest.raises(InputError, match="blocks: must be spans"):
            recording.in_blocks(wrong)
    assert len(recording.in_blocks(np.empty((0, 2)))) == 0
    with pytest.raises(InputError, match="blocks must be at least 2"):
        recording.split_time(1, 0.5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"mask": np.ones((W, H), bool)}, "mask must be bool of shape"),
        ({"hot": np.ones((H, W))}, "hot must be bool of shape"),
        ({"begin": 1.0}, "events must lie in 1"),
        ({"end": 1.0}, "events must lie in"),
        ({"begin": float("nan")}, "events must lie in"),
        ({"frames": np.zeros((5, W, H), np.uint8)}, "frames must have shape"),
        ({"frame_times": np.zeros(4)}, "frame_times must be 5 times"),
        ({"frame_times": np.arange(5)[::-1] * 1.0}, "do not go back"),
        ({"frame_end": None}, "go together"),
        ({"frame_end": np.zeros(5)}, "must not end before it begins"),
    ],
)
def test_what_does_not_fit_is_refused(recording, change, match):
    with pytest.raises(InputError, match=match):
        replace(recording, **change)


def test_events_that_do_not_fit_are_refused(recording):
    e = recording.events
    with pytest.raises(InputError, match="times must be finite and sorted"):
        replace(recording, events=replace(e, t=np.concatenate([e.t[:1], e.t[1:-1][::-1], e.t[-1:]])))
    with pytest.raises(InputError, match="must lie on the 20x15 sensor"):
        replace(recording, events=replace(e, x=e.x + np.uint16(1)))


def test_wide_frames_and_frames_without_times(rng):
    wide = Recording.of(Sequence(some(rng)))
    wide = replace(wide, frames=np.zeros((2, H, W), np.uint16))
    assert wide.crop(0, 0, 5, 5).frames.dtype == np.uint16
    assert wide.exposures is None
    assert wide.slice(0.5, 1.0).frames is None


def test_a_broken_file_opens_with_a_report(tmp_path, rng):
    """Unsorted, over the end of a 32-bit clock, coded -1 and 1, with an event outside and a hot pixel."""
    n = 4000
    t = (1 << 32) - 1_000_000 + np.sort(rng.integers(0, 2_000_000, n))
    x, y, p = rng.integers(0, W, n), rng.integers(0, H, n), rng.choice([-1, 1], n)
    x[::7], y[::7] = 4, 6
    x[100] = W + 5
    t[[2000, 2001]] = t[[2001, 2000]] + [5, 0]
    np.savez(tmp_path / "a.npz", t_us=t % (1 << 32), x=x, y=y, p=p, wh=[W, H])
    got = open_recording(tmp_path / "a.npz")
    assert {note.rule for note in got.report.repaired} == {"order", "wrap"}
    assert [(note.rule, note.number) for note in got.report.refused] == [("bounds", 1)]
    assert "hot" in {note.rule for note in got.report.odd}
    assert len(got.events) == n - 1
    np.testing.assert_array_equal(np.rint(got.events.t * 1e6), np.sort(np.delete(t, 100)))
    assert np.argwhere(got.hot).tolist() == [[6, 4]]
    left = got.masked(~got.hot)
    assert not left.hot.any()
    assert len(left.events) < len(got.events) - n // 8


def test_exposures_reach_the_recording(tmp_path, rng):
    e = some(rng)
    e = Events(np.rint(e.t * 1e6) / 1e6, e.x, e.y, e.p, W, H)
    frames = [(k * 400_000, k * 400_000 + 20_000, rng.integers(0, 256, (H, W), np.uint8)) for k in range(6)]
    aedat4(tmp_path / "a.aedat4", e, frames=frames)
    got = open_recording(tmp_path / "a.aedat4")
    first = round(e.t[0] * 1e6)
    want = np.array([frame[:2] for frame in frames]) - first
    np.testing.assert_allclose(got.exposures * 1e6, want, atol=1e-3)
    assert got.begin == pytest.approx(-first / 1e6)  # the first exposure begins before the first event
    assert f"{(UNIX_US + first) / 1e6:.6f}" in got.report.notes[0]


def test_frames_alone_and_nothing_at_all(tmp_path, rng):
    np.savez(tmp_path / "a.npz", frames=rng.integers(0, 256, (3, H, W), np.uint8), frame_us=[0, 100, 200])
    got = open_recording(tmp_path / "a.npz")
    assert [note.rule for note in got.report.odd] == ["empty"]
    assert got.frames.shape == (3, H, W)
    io.write(tmp_path / "b.h5", Sequence(Events.empty(W, H)))
    got = open_recording(tmp_path / "b.h5")
    assert (len(got.events), len(got.split_pixels(0.5, 1)[0])) == (0, W * H // 2)


def test_a_recording_never_unpickles(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "unpickled",))

    trap = np.array([Trap()] * 4, object)
    columns = {name: np.ones(4, int) for name in ("t_us", "x", "y", "p")}
    for name in columns:
        np.savez(tmp_path / "a.npz", **(columns | {name: trap}), wh=[4, 4])
        with pytest.raises(InputError, match="never unpickled"):
            open_recording(tmp_path / "a.npz")
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    with pytest.raises(InputError, match="never unpickled"):
        open_recording(tmp_path / "a.npy")
    (tmp_path / "a.pkl").write_bytes(trap.dumps())
    with pytest.raises(InputError, match="unknown format"):
        open_recording(tmp_path / "a.pkl")
    assert not (tmp_path / "unpickled").exists()


@pytest.mark.slow
def test_every_shared_recording_opens(shared):
    paths = sorted(p for p in (shared / "recordings").rglob("*.*") if p.stem != "noise_iebcs")
    assert len(paths) >= 14
    for path in paths:
        if path.suffix == ".aedat4":
            pytest.importorskip("lz4")
        got = open_recording(path)
        assert len(got.events) >= 20_000
        assert 0.01 < got.duration < 13
        assert not got.report.repaired
        assert not got.report.refused
        train, held = got.split_time(4, 0.5)
        assert len(got.in_blocks(train)) + len(got.in_blocks(held)) == len(got.events)
