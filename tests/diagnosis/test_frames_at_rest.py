"""Between a camera's frames pairs of opposite events count where frames rest."""

from __future__ import annotations

import numpy as np
import pytest

from dase.diagnosis.frames_at_rest import FRAMES_AT_REST, events_where_frames_rest
from dase.diagnosis.seen_effects import SeenEffects, without_the_scene
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.scenes.between_frames import CameraScene
from dase.signatures.find import find_signatures
from dase.simulation.sensor import Sensor

SIDE, GAP, FRAMES = 48, 0.04, 50


def drifting_half() -> np.ndarray:
    """Return frames whose left half drifts, a column a frame, for the second of their two seconds."""
    rng = np.random.default_rng(3)
    light = rng.uniform(40, 200, (SIDE, SIDE)).repeat(2, 1)[:, :SIDE].round()
    frames = np.tile(light, (FRAMES, 1, 1)).astype(np.uint8)
    for k in range(FRAMES // 2, FRAMES):
        frames[k, :, : SIDE // 2] = np.roll(light[:, : SIDE // 2], k, axis=1)
    return frames


@pytest.fixture(scope="module")
def half_at_rest() -> CameraScene:
    return CameraScene(drifting_half(), GAP * np.arange(FRAMES))


def pairs_at(columns: np.ndarray, seconds: tuple[float, float], rng: np.random.Generator) -> Events:
    """Return an ON event and an OFF event 3 ms later, 600 times, at places and times drawn at random."""
    t = np.sort(rng.uniform(*seconds, 600))
    x, y = rng.choice(columns, 600), rng.integers(4, SIDE - 4, 600)
    order = np.argsort(np.concatenate((t, t + 3e-3)), kind="stable")
    joined = [np.tile(part, 2)[order].astype(np.uint16) for part in (x, y)]
    return Events(
        np.concatenate((t, t + 3e-3))[order], *joined, np.repeat([True, False], 600)[order], SIDE, SIDE
    )


@pytest.mark.parametrize(("columns", "seconds", "rest"), [
    (np.arange(4, 18), (1.1, 1.9), False),
    (np.arange(4, 18), (0.1, 0.85), True),
    (np.arange(30, 44), (1.1, 1.9), True),
])  # fmt: skip
def test_pairs_count_where_frames_rest(half_at_rest, columns, seconds, rest, rng):
    events = pairs_at(columns, seconds, rng)
    kept = events_where_frames_rest(events, half_at_rest)
    assert len(kept) == (len(events) if rest else 0)
    entry = find_signatures(events)["opposite pairs"]
    assert entry.found
    seen = SeenEffects((entry,))
    left = without_the_scene(seen, Measurement(events, half_at_rest), Sensor(), 1)
    assert left.entries == ((entry,) if rest else ())


def test_a_place_rests_only_some_time_after_it_moved(half_at_rest):
    """What a slow pixel sends late is of what passed before."""
    moved = GAP * (FRAMES // 2 - 1)  # the last frame before the drift
    t = np.array([moved - GAP - 1e-3, moved + 1e-3])
    there = Events(t, *np.full((2, 2), 10, np.uint16), np.ones(2, bool), SIDE, SIDE)
    assert len(events_where_frames_rest(there, half_at_rest)) == 1
    comes_to_rest = CameraScene(drifting_half()[::-1], half_at_rest.times)
    came = comes_to_rest.times[FRAMES // 2]  # the first frame that rests
    t = came + np.array([1e-3, FRAMES_AT_REST.before - 1e-3, FRAMES_AT_REST.before + GAP])
    after = Events(t, *np.full((2, 3), 10, np.uint16), np.ones(3, bool), SIDE, SIDE)
    assert list(events_where_frames_rest(after, comes_to_rest).t) == [t[2]]


def test_events_outside_the_frames_count_nowhere(half_at_rest):
    t = np.array([-0.01, 0.5, 3.0])
    events = Events(t, *np.full((2, 3), 30, np.uint16), np.ones(3, bool), SIDE, SIDE)
    assert list(events_where_frames_rest(events, half_at_rest).t) == [0.5]
