"""Batches of files: those of streams, windows from frame to frame, slots that take turns."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import dase
from dase import io

WINDOW = 1 / 60


def stored(path, seed: int, seconds: float = 0.1, size: tuple[int, int] = (20, 16)) -> dase.Events:
    """Write random events with a frame every 20 ms, whose grey is its number; return the events."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, round(seconds * 1e6), 800)) * 1e-6
    width, height = size
    p = rng.random(800) < 0.5
    events = dase.Events(t, rng.integers(0, width, 800), rng.integers(0, height, 800), p, width, height)
    times = np.arange(0, seconds, 0.02)
    frames = np.arange(len(times), dtype=np.uint8)[:, None, None] + np.zeros((height, width), np.uint8)
    io.write(path, io.Sequence(events, frames, times))
    return events


def test_a_stored_scene_gives_the_batch_of_its_stream(tmp_path, device):
    """The whole way round: a slot of a stream, simulated, written, and read as a recording."""
    stream = dase.torch.Stream(
        "builtin",
        "davis240c",
        batch=1,
        steps=4,
        size=(32, 24),
        backgrounds=3,
        objects=6,
        seed=2,
        device=device,
    )
    made = stream.scene(0, 0)
    events = dase.simulate(made.scene, made.sensor, seed=made.seed)
    assert np.array_equal(made.times[:: stream.samples], WINDOW * np.arange(5))
    times = WINDOW * np.arange(5)
    frames = np.round(255 * made.scene.frames(times)).astype(np.uint8)
    thresholds = np.stack([np.full((24, 32), 0.3), np.full((24, 32), 0.25)]).astype(np.float32)
    sequence = io.Sequence(events, frames, times, made.scene.flow(times), thresholds)
    io.write(tmp_path / "scene.h5", sequence)
    online = next(iter(stream))
    (offline,) = dase.torch.Recordings(tmp_path / "scene.h5", steps=4, window=WINDOW, device=device)
    assert offline.valid.all()
    assert torch.equal(offline.reset, online.reset)
    assert offline.thresholds.tolist() == [[pytest.approx(0.3), pytest.approx(0.25)]]
    torch.testing.assert_close(offline.frames, online.frames, atol=0.003, rtol=0)
    far = (offline.flow - online.flow).abs() > 1e-3 * online.flow.abs().max()
    assert far.float().mean() < 5e-3
    # dase.simulate chose samples of its own, as the scene asks for, so noise is the same in kind alone
    shown = [one.inputs.sum(2).flatten().cpu().numpy() for one in (online, offline)]
    assert np.corrcoef(*shown)[0, 1] > 0.8
    assert np.abs(shown[0]).sum() > 500


def test_windows_go_from_frame_to_frame(tmp_path):
    events = stored(tmp_path / "a.npz", 1)
    batches = list(
        dase.torch.Recordings(tmp_path / "a.npz", steps=3, represent=dase.CountImage(), device="cpu")
    )
    assert [batch.valid[:, 0].tolist() for batch in batches] == [[True] * 3, [True, False, False]]
    counts = torch.cat([batch.inputs[:, 0] for batch in batches])[:4]
    np.testing.assert_array_equal(counts.numpy(), events.counts([0, 0.02, 0.04, 0.06, 0.08]))
    shown = torch.cat([batch.frames[:, 0, 0, 0, 0] for batch in batches])[:4]
    np.testing.assert_allclose(shown.numpy(), np.arange(1, 5) / 255)
    assert batches[0].reset[:, 0].tolist() == [True, False, False]
    assert batches[1].reset[:, 0].tolist() == [False, True, True]
    assert torch.isnan(batches[0].flow).all()
    assert torch.isnan(batches[0].thresholds).all()
    assert not batches[1].inputs[1:].any()


def test_frames_are_labels_of_the_windows_they_are_near(tmp_path):
    stored(tmp_path / "a.npz", 1)
    (batch,) = dase.torch.Recordings(tmp_path / "a.npz", steps=16, window=0.006, device="cpu")
    # ends at 6, 12, 18, 24, 30, ... ms and frames at 20, 40, 60, 80 ms; no window is left behind 98 ms
    valid = [n for n in range(16) if abs(0.006 * (n + 1) - 0.02 * round(0.3 * (n + 1))) < 0.003]
    assert np.flatnonzero(batch.valid[:, 0]).tolist() == [n for n in valid if n > 0]
    assert batch.frames[2:5, 0, 0, 0, 0].mul(255).round().tolist() == [1, 1, 1]


def test_slots_take_turns_and_memories_end_with_files(tmp_path):
    files = [tmp_path / f"{n}.npz" for n in range(3)]
    events = [stored(path, n, 0.1 + 0.02 * n) for n, path in enumerate(files)]
    surface = dase.TimeSurface(0.05)
    recordings = dase.torch.Recordings(files, batch=2, steps=4, represent=surface, device="cpu")
    batches = list(recordings)
    got = torch.cat([batch.inputs for batch in batches])
    reset = torch.cat([batch.reset for batch in batches])
    # 4, 5 and 6 windows: the first slot is free first, and goes on with the third file
    want = [surface(e, edges=0.02 * np.arange(n)) for e, n in zip(events, (5, 6, 7), strict=True)]
    np.testing.assert_allclose(got[:4, 0], want[0], atol=2e-4)
    np.testing.assert_allclose(got[:5, 1], want[1], atol=2e-4)
    np.testing.assert_allclose(got[4:10, 0], want[2], atol=2e-4)
    assert np.flatnonzero(reset[:10, 0]).tolist() == [0, 4]
    again = list(dase.torch.Recordings(files, batch=2, steps=4, represent=surface, device="cpu"))
    assert all(torch.equal(a.inputs, b.inputs) for a, b in zip(batches, again, strict=True))
    endless = dase.torch.Recordings(files, batch=2, steps=4, passes=None, shuffle=True, device="cpu")
    assert sum(1 for _ in zip(endless, range(9), strict=False)) == 9


def test_parts_of_the_sensor(tmp_path):
    events = stored(tmp_path / "a.h5", 1)
    found = set()
    for seed in range(4):
        recordings = dase.torch.Recordings(
            tmp_path / "a.h5", steps=4, size=(8, 6), represent=dase.CountImage(), seed=seed, device="cpu"
        )
        (batch,) = recordings
        total = batch.inputs.sum((0, 1)).numpy()
        whole = events.counts([0, 0.08])[0]
        places = [
            (x, y) for x in range(13) for y in range(11)
            if np.array_equal(whole[:, y : y + 6, x : x + 8], total)
        ]  # fmt: skip
        assert len(places) == 1
        found |= set(places)
    assert len(found) > 1


def test_a_real_recording(shared):
    path = shared / "recordings" / "davis240c_camerashake.npz"
    recordings = dase.torch.Recordings(path, steps=5, represent=dase.CountImage(), device="cpu")
    batch = next(iter(recordings))
    sequence = io.read(path)
    times = sequence.frame_times[:6]
    assert batch.inputs.shape == (5, 1, 2, 180, 240)
    np.testing.assert_array_equal(batch.inputs[:, 0].numpy(), sequence.events.counts(times))
    np.testing.assert_allclose(batch.frames[:, 0, 0].numpy(), sequence.frames[1:6] / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"files": []}, "at least one file, got none"),
        ({"window": -1.0}, "window must be a number > 0 s"),
        ({"size": (30, 4)}, "size must lie on the 20x16 sensor, got 30x4"),
        ({"files": "bare"}, "has no frames with times for windows to end at"),
        ({"files": "two"}, "must have one size, got 10x10, 20x16"),
        ({"passes": 0}, "passes must be a whole number >= 1"),
    ],
)
def test_refusals(tmp_path, changes, sentence):
    stored(tmp_path / "a.npz", 1)
    stored(tmp_path / "b.npz", 1, size=(10, 10))
    io.write(tmp_path / "bare.npz", io.Sequence(stored(tmp_path / "c.npz", 2)))
    files = {"bare": [tmp_path / "bare.npz"], "two": [tmp_path / "a.npz", tmp_path / "b.npz"]}
    given = changes.pop("files", [tmp_path / "a.npz"])
    chosen = files[given] if isinstance(given, str) else given
    with pytest.raises(dase.InputError, match=sentence):
        next(iter(dase.torch.Recordings(chosen, batch=max(len(chosen), 1), device="cpu", **changes)))
