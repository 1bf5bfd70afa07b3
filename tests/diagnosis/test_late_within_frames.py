"""What is late by less than a frame may be something else beside a scan, a clock or a lens."""

from __future__ import annotations

import numpy as np
import pytest

from dase.diagnosis.late_within_frames import doubt_delays_within_frames
from dase.effects import EFFECTS
from dase.results import Finding, Grade
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

SCAN = {"row_scan": EFFECTS["row_scan"](line=1e-6)}


def graded(gap: float, grade: Grade = Grade.SUPPORTED, **effects) -> Grade:
    """Return the grade of the first of some effects, found in a clip with frames so far apart [s]."""
    scene = VideoScene(np.zeros((5, 4, 6), np.uint8), gap * np.arange(5))
    sensor = Sensor()
    for one in effects.values():
        sensor = sensor.with_effect(one)
    name = next(iter(effects))
    return doubt_delays_within_frames({name: Finding(name, grade)}, sensor, scene)[name].grade


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("latency", {"delay": 1e-3}),
        ("bandwidth", {"cutoff": 159.0}),
        ("second_order", {"cutoff": 200.0, "damping": 0.7}),
    ],
)
def test_delays_within_a_frame_are_doubted_beside_a_scan_or_a_lens(name, values):
    late = {name: EFFECTS[name](**values)}
    assert graded(2e-3, **late, **SCAN) is Grade.EITHER
    assert graded(2e-3, **late, optics_blur=EFFECTS["optics_blur"](sigma=1.0)) is Grade.EITHER
    assert graded(0.5e-3, **late, **SCAN) is Grade.SUPPORTED
    assert graded(2e-3, **late) is Grade.SUPPORTED
    assert graded(2e-3, Grade.CERTAIN, **late, **SCAN) is Grade.CERTAIN


def test_delays_within_a_frame_are_doubted_beside_a_coarse_clock():
    """DVSModel and v2e with stamps of 1 and 0.5 ms had a low-pass of 480 Hz and a latency of 0.45 ms."""
    late = {"latency": EFFECTS["latency"](delay=1e-3)}
    for step, grade in ((1e-3, Grade.EITHER), (5e-4, Grade.EITHER), (1e-6, Grade.SUPPORTED)):
        assert graded(2e-3, **late, timestamp=EFFECTS["timestamp"](jitter=0.0, step=step)) is grade


def test_what_makes_nothing_late_is_not_doubted():
    assert graded(2e-3, leak=EFFECTS["leak"](rate=1.0), **SCAN) is Grade.SUPPORTED


def test_delays_within_a_tick_are_doubted_whatever_the_frames():
    """A clip of v2e at 333 Hz with stamps of 1 ms had a latency of 0.47 ms that was not there."""
    clock = {"timestamp": EFFECTS["timestamp"](jitter=0.0, step=5e-4)}
    for delay, grade in ((4.7e-4, Grade.EITHER), (8e-4, Grade.SUPPORTED)):
        assert graded(3e-3, latency=EFFECTS["latency"](delay=delay), **clock) is grade
