"""Where light jumps, a pixel may send several events at once; where no jump is as large, it sends twice."""

from __future__ import annotations

import numpy as np
import pytest

from dase.diagnosis.doubles_of_jumps import JumpSettings, are_at_small_jumps
from dase.diagnosis.seen_effects import find_seen_effects, without_the_scene
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene
from dase.signatures.kinds import DOUBLE_EVENTS
from dase.simulation.sensor import Sensor

SIZE, FRAMES, GAP = 40, 160, 5e-3
SENSOR = Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.2))


@pytest.fixture(scope="module")
def clip() -> VideoScene:
    """Light that jumps by 0.7 in the right half of the picture from frame to frame, by 0.05 in the left."""
    rng = np.random.default_rng(8)
    steps = 0.05 * rng.choice([-1, 1], (FRAMES, SIZE, SIZE))
    level = np.clip(np.log(0.3) + np.cumsum(steps, 0), np.log(0.1), 0)
    level[:, :, SIZE // 2 :] = np.log(0.3) + 0.35 * (-1.0) ** np.arange(FRAMES)[:, None, None]
    return VideoScene(np.exp(level).astype(np.float32), GAP * np.arange(FRAMES))


@pytest.fixture(scope="module")
def held(clip) -> VideoScene:
    return clip.held(1e-3)


def made(share: float, longest: float = 2e-5) -> Events:
    """Events of jumps, two for each up to `longest` [s] apart, and of slow light, a share of them double."""
    rng = np.random.default_rng(9)
    parts = []
    for frame in range(FRAMES - 1):
        y, x = np.divmod(rng.permutation(SIZE * SIZE), SIZE)
        jumps = x >= SIZE // 2
        sent = jumps | (rng.random(len(x)) < 0.3)
        t = GAP * frame + rng.uniform(1e-6, 4e-4, len(x))
        again = jumps | (sent & (rng.random(len(x)) < share))
        p = np.where(jumps, frame % 2 == 1, rng.random(len(x)) < 0.5)
        parts.append((t[sent], x[sent], y[sent], p[sent]))
        late = rng.uniform(2e-6, np.where(jumps, longest, 2e-5))
        parts.append(((t + late)[again], x[again], y[again], p[again]))
    t, x, y, p = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(t)
    return Events(
        np.round(t[order], 6), x[order].astype(np.uint16), y[order].astype(np.uint16), p[order], SIZE, SIZE
    )


@pytest.mark.parametrize("scene", ["clip", "held"])
@pytest.mark.parametrize(("share", "there"), [(0.0, False), (0.05, True)])
def test_events_of_a_jump_are_not_double_and_those_of_slow_light_are(request, scene, share, there):
    measurement = Measurement(made(share), request.getfixturevalue(scene))
    seen = find_seen_effects(measurement, EFFECTS)
    assert seen.entry_of(DOUBLE_EVENTS) is not None  # without the light nobody can tell
    kept = without_the_scene(seen, measurement, SENSOR, 1).entry_of(DOUBLE_EVENTS)
    assert (kept is not None) == there


def test_double_events_are_seen_that_jumps_hide(held):
    """Those of jumps follow each other as fast, whether they are sent twice or not."""
    measurement = Measurement(made(0.05, longest=3e-4), held)
    seen = find_seen_effects(measurement, EFFECTS)
    assert seen.entry_of(DOUBLE_EVENTS) is None
    left = without_the_scene(seen, measurement, SENSOR, 1)
    assert left.entry_of(DOUBLE_EVENTS) is not None
    assert all(entry.name != DOUBLE_EVENTS for entry in left.absent)


@pytest.mark.parametrize("block", [4_000_000, 5000])
def test_jumps_are_small_in_the_time_before(held, block):
    t = np.concatenate([np.linspace(0.03, 0.7, 50), [-0.1, 0.9]])
    x = np.where(np.arange(52) % 2 == 0, 3, 30).astype(np.uint16)
    events = Events(np.sort(t), x, np.full(52, 7, np.uint16), np.ones(52, bool), SIZE, SIZE)
    small = are_at_small_jumps(events, held, SENSOR, JumpSettings(block=block))
    assert np.array_equal(small, (x == 3) & (events.t > 0) & (events.t < 0.79))
    # a jump counts for as long as a pixel may be late, and no longer
    once = np.full((FRAMES, 1, 2), 0.3, np.float32)
    once[50:, :, 0] = 0.6
    scene = VideoScene(once, GAP * np.arange(FRAMES)).held(1e-3)
    at = 49 * GAP  # a frame is shown from the time of the one before on
    t = np.array([at - 1e-3, at + 1e-4, at + 0.018, at + 0.024])
    for column, want in ((0, [True, False, False, True]), (1, [True] * 4)):
        place = np.full(4, column, np.uint16)
        events = Events(t, place, np.zeros(4, np.uint16), np.ones(4, bool), 2, 1)
        assert are_at_small_jumps(events, scene, SENSOR).tolist() == want
