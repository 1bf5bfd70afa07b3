"""Where pixels forget, light that comes back again and again leaves a pattern, too, and it is no camera's."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.diagnosis.seen_effects import find_seen_effects, is_beat_of_bursts, without_the_scene
from dase.effects import EFFECTS
from dase.effects.high_pass import HighPass
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene
from dase.signatures.kinds import FIXED_PATTERN, FLICKER
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

SENSOR = Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.2))
SIZE, TIMES = 64, np.arange(0.0, 2.0, 2e-3)


def light(phase: np.ndarray) -> VideoScene:
    """Return light of which each pixel sees steps of its own sizes, fast up and slowly down.

    Args:
        phase: How far it has gone in turns, shape (T,).
    """
    rng = np.random.default_rng(4)
    begin = rng.uniform(0, 1, (SIZE, SIZE))
    fast = rng.uniform(0.02, 0.4, (SIZE, SIZE))
    turn = (phase[:, None, None] + begin) % 1
    level = np.where(turn < fast, turn / fast, (1 - turn) / (1 - fast))
    return VideoScene(np.exp(1.5 * level - 1.5).astype(np.float32), TIMES)


@pytest.fixture(scope="module")
def turning() -> VideoScene:
    return light(4 * TIMES)


@pytest.mark.parametrize("cutoff", [3.0, 5.0])
def test_a_pattern_of_pixels_that_forget_is_the_scenes(turning, cutoff):
    events = dase.simulate(turning, SENSOR.with_effect(HighPass(cutoff=cutoff, at="memory")), seed=1)
    measurement = Measurement(events, turning)
    seen = find_seen_effects(measurement, EFFECTS)
    assert seen.entry_of(FIXED_PATTERN) is not None
    assert without_the_scene(seen, measurement, SENSOR, 1).entry_of(FIXED_PATTERN) is None


def test_a_pattern_of_thresholds_is_the_cameras():
    scene = light(np.cumsum(np.random.default_rng(5).normal(0, 0.02, len(TIMES))))
    events = dase.simulate(scene, SENSOR.with_effect(EFFECTS["mismatch"](spread=0.3)), seed=1)
    measurement = Measurement(events, scene)
    seen = find_seen_effects(measurement, EFFECTS)
    assert seen.entry_of(FIXED_PATTERN) is not None
    assert without_the_scene(seen, measurement, SENSOR, 1).entry_of(FIXED_PATTERN) is not None


@pytest.mark.parametrize(
    ("frequency", "swing", "step", "beats"),
    [
        (49.95, 0.04, 2e-3, True),  # three bursts are 50 frames, and 5 turns
        (45.0, 0.04, 2e-3, False),  # two bursts are 33.3 frames
        (100.0, 0.3, 2e-3, False),  # ten turns of three bursts, and a strong lamp
        (100.0, 0.04, 0.0, False),  # a camera's
        (117.0, 0.04, 2e-3, False),
    ],
)
def test_a_weak_tone_in_step_with_bursts_and_frames_is_no_lamp(frequency, swing, step, beats):
    entry = Signature(
        name=FLICKER, answer=Answer.FOUND, sentence="light", size=swing, details={"frequency": frequency}
    )
    assert is_beat_of_bursts(entry, 0.03332, step) is beats
