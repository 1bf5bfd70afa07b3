"""Simulators whose pixels forget from one frame of a clip to the next."""

from __future__ import annotations

import pytest
from helpers.frame_simulator import bright_texture, counted_between_frames

import dase
from dase.effects import HighPass

WAYS = {"frames": "compared with the one before alone", "sending frames": "take the light of their frame"}


@pytest.fixture(scope="module")
def clip() -> dase.VideoScene:
    """A shaken texture, 125 frames a second."""
    return bright_texture(8e-3)


@pytest.mark.parametrize(("forgets", "hot"), [("frames", 0), ("sending frames", 0), ("frames", 40)])
def test_what_a_simulator_forgets_at_frames_is_no_effect_and_hides_none(clip, forgets, hot):
    """Both were mute at errors of 4 and 10; beside hot pixels it shows once these are in the model."""
    events = counted_between_frames(clip, 0.0, forgets=forgets, hot=hot)
    found = dase.diagnose(events, scene=clip, pixels=400, seed=1)
    assert {one.effect for one in found.findings} == ({"hot"} if hot else set())
    assert found.unexplained is None
    assert sum(WAYS[forgets] in note for note in found.notes) == 1
    memory = found.sensor["high_pass"]
    assert isinstance(memory, HighPass)
    assert memory.at == forgets
    assert found.sensor["threshold"].on == pytest.approx(0.2, rel=0.03)


def test_pixels_that_go_on_from_where_they_have_sent_forget_nothing(clip):
    found = dase.diagnose(counted_between_frames(clip, 0.0), scene=clip, pixels=400, seed=1)
    assert "high_pass" not in found.sensor
    assert not any(way in note for way in WAYS.values() for note in found.notes)
    assert not found.findings
