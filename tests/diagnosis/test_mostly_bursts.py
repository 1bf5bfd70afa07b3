"""A camera that hardly moves, whose frames disturb the pixels: its bursts are what there is to compare."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import shaken_texture

import dase
from dase.effects import EFFECTS
from dase.results import Grade
from dase.scenes.video import VideoScene

TRIED = {name: EFFECTS[name] for name in ("exposure", "bandwidth", "leak", "mismatch")}


@pytest.mark.slow
def test_bursts_that_are_nearly_all_events_are_compared():
    moving = shaken_texture()
    times = moving.sample_times()
    light = moving.frames(times)
    # a fiftieth of the way
    faint = light[:1] + 0.02 * (light - light[:1])
    scene = VideoScene(np.clip(faint, 0.02, 1).astype(np.float32), times)
    threshold = EFFECTS["threshold"](on=0.15, off=0.15)
    coupling = EFFECTS["exposure"](amplitude=0.2, spread=0.3, period=0.04, exposure=0.01, begin=0.005)
    camera = dase.Sensor((threshold, coupling))
    events = dase.simulate(scene, camera, seed=1)
    found = dase.diagnose(
        events, dase.Sensor((threshold,)), scene=scene, effects=TRIED, most=1, pixels=300, settings=NO_LIMITS
    )
    assert [(one.effect, one.grade) for one in found.findings] == [("exposure", Grade.CERTAIN)]
    assert found.selected == ("exposure",)
    amplitude = found.findings[0].parameters["exposure.amplitude"]
    assert amplitude.value == pytest.approx(0.2, rel=0.15)
    assert found.sensor["exposure"].amplitude == pytest.approx(0.2, rel=0.15)
    assert found.errors[-1] < 1.15
    assert any("nearly all events" in note for note in found.notes)
    # without the bursts there was nothing to compare
    between = dase.compare(events, camera, scene=scene, pixels=300)
    assert between.error < 1.15
