"""Matches of frames come back as they were kept, from memory, from the file, or not at all."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest

from dase.scenes import between_frames
from dase.scenes.between_frames import CameraScene, MatchSettings
from dase.scenes.frame_motion import FrameMatch, match_frames
from dase.scenes.match_store import MatchStore, StoreSettings

SHAPE = (6, 5)
SIZE = 6 * 4 * 6 * 5  # bytes of a match: six numbers of each pixel


def match_of(rng) -> FrameMatch:
    ways = (rng.normal(size=(*SHAPE, 2)).astype(np.float32) for _ in range(2))
    return FrameMatch(*ways, rng.normal(size=(2, *SHAPE)).astype(np.float32))


def assert_equal(got: FrameMatch | None, want: FrameMatch) -> None:
    assert got is not None
    for name in ("ahead", "back", "doubt"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_all_come_back_in_any_order(rng):
    store = MatchStore(StoreSettings(memory=3 * SIZE, fewest=1))
    kept = {interval: match_of(rng) for interval in (7, 0, 3, 12, 4, 1, 9)}
    for interval, match in kept.items():
        assert store.find(interval) is None
        store.keep(interval, match)
    for interval in [*kept, *reversed(kept)]:
        assert_equal(store.find(interval), kept[interval])
    assert store.find(2) is None


@pytest.mark.parametrize("why", ["no room", "no disk", "full disk", "no pwrite", "cut"])
def test_what_cannot_be_filed_is_forgotten(rng, why, monkeypatch):
    store = MatchStore(StoreSettings(memory=0, fewest=2, file=2 * SIZE if why == "no room" else 1 << 20))

    def fail(*_, **__):
        raise OSError("no space left on device")

    if why == "no disk":
        monkeypatch.setattr("tempfile.mkstemp", fail)
    if why == "full disk":
        monkeypatch.setattr(os, "pwrite", fail)
    if why == "no pwrite":
        monkeypatch.delattr(os, "pwrite")
    kept = [match_of(rng) for _ in range(6)]
    for interval, match in enumerate(kept):
        store.keep(interval, match)
    if why == "cut":
        os.ftruncate(store._file, SIZE + 8)
    there = {"no room": [0, 1, 4, 5], "cut": [0, 4, 5]}.get(why, [4, 5])
    for interval in (5, 4, 3, 2, 1, 0):
        found = store.find(interval)
        assert (found is not None) == (interval in there), interval
        if found is not None:
            assert_equal(found, kept[interval])


def test_a_copy_for_another_process_begins_empty(rng):
    store = MatchStore(StoreSettings(memory=0, fewest=1))
    for interval in range(3):
        store.keep(interval, match_of(rng))
    other = pickle.loads(pickle.dumps(store))
    assert other.settings == store.settings
    assert [other.find(interval) for interval in range(3)] == [None] * 3
    assert store.find(0) is not None


def test_a_recording_is_matched_once(rng, monkeypatch):
    frames = rng.integers(0, 255, (6, 24, 32)).astype(np.uint8)
    times = 0.04 * np.arange(6)
    scenes = [
        CameraScene(frames, times, matching=MatchSettings(kept=StoreSettings(memory=0, fewest=2, file=file)))
        for file in (1 << 24, 0)
    ]
    calls = []

    def counted(*args, **more):
        calls.append(0)
        return match_frames(*args, **more)

    monkeypatch.setattr(between_frames, "match_frames", counted)
    found, numbers = [], []
    for scene in scenes:
        calls.clear()
        samples = scene.sample_times()
        found.append((samples, scene.trusted(), scene.frames(samples)))
        numbers.append(len(calls))
    assert numbers[0] == 5 < numbers[1]
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
