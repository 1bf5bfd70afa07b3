"""Delays and thresholds of events of held frames are those of the pixels that sent them, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.frame_simulator import counted_between_frames, shaken_texture
from helpers.held_pixels import held_with_low_pass

from dase.fitting.delays_after_frames import delays_after_frames
from dase.fitting.held_clips import holds_frames
from dase.fitting.held_events import HeldEvents
from dase.fitting.measurement import as_measurement
from dase.fitting.thresholds_of_frames import thresholds_of_frames
from dase.scenes.video import VideoScene

GAP = 2e-3


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return shaken_texture(gap=GAP)


@pytest.mark.parametrize("late", [0.2e-3, 0.7e-3])
@pytest.mark.parametrize("cutoff", [3e3, 4e4])
def test_latency_and_low_pass_are_read_off_delays(scene, late, cutoff):
    events = held_with_low_pass(scene, cutoff=cutoff, late=late)
    found = delays_after_frames(events, scene)
    assert found.slope_in_errors() > 5
    begin, slope = found.brighter_half().line()
    assert begin == pytest.approx(late, rel=0.08)
    assert slope == pytest.approx(1 / (2 * np.pi * cutoff), rel=0.15)
    assert found.width() < 0.1


def test_a_held_clip_tells_the_same_once_it_is_taken_for_one(scene):
    events = held_with_low_pass(scene, cutoff=1e4, late=0.3e-3)
    held = as_measurement(events, scene)
    assert held.held == pytest.approx(GAP)
    lines = [delays_after_frames(events, one).line() for one in (scene, held.scene)]
    np.testing.assert_allclose(lines[1], lines[0], atol=1e-7)


def test_light_that_goes_straight_shows_no_delay(scene):
    events = counted_between_frames(scene, 0.02)
    found = delays_after_frames(events, scene)
    assert found.width() > 0.3 or abs(found.slope_in_errors()) < 5
    assert not holds_frames(events, scene)


def test_stamps_that_are_off_leave_a_clip_held(scene):
    """Within a third of a frame they come at no time together, but by how far a pixel has to go."""
    events = held_with_low_pass(scene, cutoff=4e3, late=0.5e-3, stamps=0.16e-3)
    assert holds_frames(events, scene)
    found = delays_after_frames(events, scene)
    _, late = found.quantiles((0.16, 0.5))
    assert np.mean(late[:4, 1] - late[:4, 0]) == pytest.approx(0.16e-3, rel=0.1)
    assert found.line()[0] == pytest.approx(0.5e-3, rel=0.05)


@pytest.mark.parametrize("spread", [0.02, 0.2])
@pytest.mark.parametrize("own", [False, True])
def test_thresholds_are_told_event_by_event(scene, spread, own):
    events = held_with_low_pass(scene, spread=spread, own=own)
    found = thresholds_of_frames(HeldEvents.of(events, scene))
    assert set(found) == {1, -1}
    for one in found.values():
        # pixels of lower thresholds send more events
        assert one.mean == pytest.approx(0.2, rel=0.06)
        assert one.spread == pytest.approx(spread, rel=0.15)
        if spread == 0.2:
            assert one.own > 0.5 if own else abs(one.own) < 0.1


def test_what_is_too_little_to_know_is_not_told(scene):
    events = held_with_low_pass(scene)
    seen = HeldEvents.of(events.select(np.arange(1000)), scene)
    assert thresholds_of_frames(seen) == {}
    assert delays_after_frames(events.select(np.arange(1000)), scene) is None
