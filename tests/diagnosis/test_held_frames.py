"""Clips whose frames a simulator held: its pixels' habit is no effect, and what they have beside is found."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import HEIGHT, WIDTH, shaken_texture
from helpers.held_pixels import held_with_low_pass

import dase
from dase.diagnosis.held_frames import _sentence_of_memory, fewest_frames
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import as_measurement
from dase.results import Grade
from dase.scenes.video import VideoScene

GAP = 4e-3
TRIED = {name: EFFECTS[name] for name in ("bandwidth", "latency", "refractory", "mismatch", "leak", "shot")}
PIXELS = 200
"""In each part: errors go with their root, and that of another memory is many times what counts as right."""


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return shaken_texture(gap=GAP)


@pytest.mark.slow
def test_a_pixel_that_forgets_the_rest_of_a_frame_lacks_nothing(scene):
    events = held_with_low_pass(scene)
    assert fewest_frames(as_measurement(events, scene)) == (1,)
    found = dase.diagnose(
        events, "ideal", scene=scene, effects=TRIED, most=2, pixels=PIXELS, settings=NO_LIMITS
    )
    assert found.findings == ()
    assert found.unexplained is None
    assert found.errors[-1] < 0.5
    assert found.parameters["threshold.on"].value == pytest.approx(0.2, rel=0.01)


@pytest.mark.slow
def test_a_pixel_that_goes_on_within_a_frame_lacks_nothing(scene):
    """Several events of a jump: with a memory of the frame the error was 10, and the answer mute."""
    few = VideoScene(scene.frames(scene.sample_times()[::2]), scene.sample_times()[::2])
    events = held_with_low_pass(few, cutoff=5e4, goes_on=True, threshold=0.15)
    measured = as_measurement(events, few)
    assert measured.held == pytest.approx(2 * GAP)
    found = dase.diagnose(
        events, "ideal", scene=few, effects=TRIED, most=2, pixels=PIXELS, settings=NO_LIMITS
    )
    assert found.findings == ()
    assert found.unexplained is None
    assert found.errors[-1] < 0.8
    assert found.parameters["threshold.on"].value == pytest.approx(0.15, rel=0.01)
    assert not [note for note in found.notes if "missing" in note]  # frames are held between jumps


@pytest.mark.slow
def test_a_dead_time_of_several_frames_is_certain(scene):
    events = held_with_low_pass(scene, dead=0.01)
    found = dase.diagnose(
        events, "ideal", scene=scene, effects=TRIED, most=2, pixels=PIXELS, settings=NO_LIMITS
    )
    assert [(one.effect, one.grade) for one in found.findings] == [("refractory", "certain")]
    period = found.parameters["refractory.period"]
    assert period.low <= 0.01 <= period.high
    assert found.selected == ("refractory",)
    assert len(found.errors) == 2


@pytest.mark.parametrize(
    ("dead", "threshold", "frames"),
    [(0.0, 0.2, (3, 1)), (5e-3, 0.2, (8, 6)), (5e-3, 0.3, (9, 6)), (8.6e-3, 0.2, (11, 9))],
)
def test_thresholds_tell_which_frame_is_the_memory_where_light_is_slow(dead, threshold, frames):
    """No pixel sends at the first frame that it could: it had waited for 3 to 13 in place of 1 to 9."""
    slow = shaken_texture(gap=1e-3, length=0.4)
    events = held_with_low_pass(slow, dead=dead, threshold=threshold)
    assert fewest_frames(as_measurement(events, slow)) == frames


@pytest.mark.parametrize(("dead", "frames", "told"), [(5e-3, 6, True), (5e-3, 4, False), (0.0, 1, False)])
def test_thresholds_that_are_alike_tell_of_a_dead_time(dead, frames, told):
    """It changes little where light is slow: one of IEBCS of 2 ms, of frames each 1.25 ms."""
    slow = shaken_texture(gap=1e-3, length=0.4)
    measurement = as_measurement(held_with_low_pass(slow, dead=dead), slow)
    assert bool(_sentence_of_memory(measurement, frames)) is told


@pytest.mark.slow
def test_what_waits_for_late_events_has_no_dead_time(scene):
    events = held_with_low_pass(scene, late=6.3e-3)
    # half as many are too few here
    found = dase.diagnose(events, "ideal", scene=scene, effects=TRIED, most=2, pixels=400, settings=NO_LIMITS)
    assert [one.effect for one in found.findings] == ["latency"]
    assert found.parameters["latency.delay"].value == pytest.approx(6.3e-3, rel=0.1)


@pytest.mark.slow
def test_a_slow_low_pass_hides_no_held_frame(scene):
    """Events come at any time then, and light that goes straight explains them worse."""
    events = held_with_low_pass(scene, cutoff=60.0)
    assert not as_measurement(events, scene).held
    tried = {name: EFFECTS[name] for name in ("bandwidth", "latency", "mismatch")}
    found = dase.diagnose(events, "ideal", scene=scene, effects=tried, most=1, pixels=250, settings=NO_LIMITS)
    (one,) = found.findings
    assert one.effect == "bandwidth"
    # a jump takes a millisecond in the model: what that leaves is about what chance may, and the grade open
    assert one.grade in (Grade.SUPPORTED, Grade.EITHER)
    assert one.error_with < 0.1 * one.error_without
    assert one.parameters["bandwidth.cutoff"].value == pytest.approx(60, rel=0.05)
    assert any("held" in note for note in found.notes)


def filtered_at_frames(scene: VideoScene, *, cutoff: float, spread: float, threshold: float = 0.2) -> Events:
    """Return events of two low-passes in a row from frame to frame, straight between them, as Metavision's.

    Args:
        scene: Frames of light.
        cutoff: Of each low-pass at full light; it goes with (light + 0.08) / 1.08 [Hz].
        spread: Of the thresholds, which are those of a pixel for good, relative.
        threshold: ON and OFF, their mean [log intensity].
    """
    times = scene.sample_times()
    light = scene.frames(times).astype(np.float64)
    rng = np.random.default_rng(1)
    on, off = (threshold * (1 + spread * rng.standard_normal(light.shape[1:])) for _ in "+-")
    first = second = np.log(light[0] + 1e-3)
    memory, out = second.copy(), []
    for begin, end, now in zip(times[:-1], times[1:], light[1:], strict=True):
        share = np.minimum(2 * np.pi * cutoff * (now + 0.08) / 1.08 * (end - begin), 1.0)
        first = first + share * (np.log(now + 1e-3) - first)
        then = second + share * (first - second)
        for sign, size in ((1, on), (-1, off)):
            count = np.floor(np.maximum(sign * (then - memory), 0) / size).astype(int)
            for n in range(count.max(initial=0)):
                y, x = np.nonzero(count > n)
                level = memory[y, x] + sign * (n + 1) * size[y, x]
                t = begin + (end - begin) * (level - second[y, x]) / (then - second)[y, x]
                out.append((t, x, y, np.full(len(x), sign > 0)))
            memory = memory + sign * count * size
        second = then
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    order = np.argsort(t, kind="stable")
    return Events(np.round(1e6 * t[order]) / 1e6, x[order], y[order], p[order], WIDTH, HEIGHT)


@pytest.mark.slow
def test_a_low_pass_from_frame_to_frame_is_asked_for_where_another_leaves_too_much():
    scene = shaken_texture(gap=6e-3, length=0.5)
    events = filtered_at_frames(scene, cutoff=60.0, spread=0.0)
    tried = {name: EFFECTS[name] for name in ("bandwidth", "second_order", "leak")}
    found = dase.diagnose(events, "ideal", scene=scene, effects=tried, most=1, pixels=120, settings=NO_LIMITS)
    assert found.selected == ("second_order",)
    assert found.errors[-1] < 1
    slow = found.sensor["second_order"]
    assert slow.poles == "steps"
    assert any("from frame to frame" in note for note in found.notes)
    assert not any("come in step" in note for note in found.notes)
    assert slow.cutoff == pytest.approx(60, rel=0.1)
