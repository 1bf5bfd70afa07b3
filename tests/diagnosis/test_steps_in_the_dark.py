"""A dark current and a knee are told by how much farther light goes from event to event in the dark."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.frame_simulator import shaken_texture
from helpers.sensors import sensor_with

import dase
from dase.diagnosis import seen_beside_model
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.diagnosis.seen_effects import SeenEffects, with_size_that_was_seen
from dase.diagnosis.steps_in_the_dark import (
    DARK_STEPS,
    find_current_at_corners,
    find_larger_steps_in_the_dark,
)
from dase.effects import EFFECTS
from dase.effects.made_signatures import told_by
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene
from dase.signatures.kinds import KINDS, LARGER_STEPS_IN_THE_DARK, TIME_STAMPS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor


@pytest.fixture(scope="module")
def scene():
    """Return a texture that shakes, a tenth as bright on the left as on the right."""
    even = shaken_texture()
    times = even.sample_times()
    frames = even.frames(times)
    brighter = np.geomspace(0.1, 1.0, frames.shape[2], dtype=np.float32)
    return VideoScene((frames * brighter).astype(np.float32), times)


def found(scene, sensor, asked=None):
    events = dase.simulate(scene, sensor, seed=3)
    return find_larger_steps_in_the_dark(Measurement(events, scene), asked or Sensor(), seed=0)


@pytest.mark.parametrize("more", [{}, {"jitter": {"spread": 0.1}}, {"mismatch": {"spread": 0.1}}])
def test_a_current_is_told_whatever_thresholds_do(scene, more):
    entry = found(scene, sensor_with(dark={"current": 0.05}, **more))
    assert told_by(entry, EFFECTS) == ("dark",)
    assert entry.details["current"] == entry.size == pytest.approx(0.05, rel=0.08)
    assert entry.low <= 0.05 <= entry.high


@pytest.mark.parametrize("loss", [0.35, 0.6])
@pytest.mark.parametrize("more", [{}, {"leak": {"rate": 1.0}}])
def test_a_current_that_is_larger_toward_the_corners_tells_how_much_light_they_lose(scene, loss, more):
    sensor = sensor_with(dark={"current": 0.05}, vignetting={"loss": loss}, **more)
    measurement = Measurement(dase.simulate(scene, sensor, seed=3), scene)
    entry = find_current_at_corners(measurement, Sensor(), seed=0)
    assert told_by(entry, EFFECTS) == ("vignetting",)
    assert entry.low < loss < entry.high
    # behind these corners the current is what it is
    corners = sensor_with(vignetting={"loss": loss})
    known = find_larger_steps_in_the_dark(measurement, corners, seed=0)
    assert known.details["current"] == pytest.approx(0.05, rel=0.08)


@pytest.mark.parametrize(
    "effects",
    [
        {"dark": {"current": 0.05}},
        {"dark": {"current": 0.05}, "mismatch": {"spread": 0.1}},
        {"dark": {"current": 0.05, "spread": 0.3}},
        {"dark": {"current": 0.05}, "jitter": {"spread": 0.1}},
        {"vignetting": {"loss": 0.6}},
        {"linlog": {"knee": 0.2}, "vignetting": {"loss": 0.6}},
    ],
)
def test_corners_are_not_told_where_they_are_as_bright_or_no_current_is_there(scene, effects):
    events = dase.simulate(scene, sensor_with(**effects), seed=3)
    assert find_current_at_corners(Measurement(events, scene), Sensor(), seed=0) is None


@pytest.mark.parametrize("log_eps", [1e-3, 0.03])
def test_a_knee_is_no_current(scene, log_eps):
    bare = Sensor(log_eps=log_eps)
    entry = found(scene, bare.with_effect(EFFECTS["linlog"](knee=0.2)), bare)
    assert told_by(entry, EFFECTS) == ("linlog",)
    assert entry.details["knee"] == entry.size == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"bandwidth": {"cutoff": 30.0}},
        {"refractory": {"period": 0.01}},
        {"leak": {"rate": 2.0}},
        {"shot": {"rate": 5.0}},
        {"voltage_noise": {"sigma": 0.05}},
        {"high_pass": {"cutoff": 5.0}},
    ],
)
def test_what_else_makes_steps_differ_is_neither(scene, more):
    assert found(scene, sensor_with(**more)) is None


def test_what_a_model_without_either_shows_is_not_told(scene, monkeypatch):
    """Nor where the model sends too little to show anything."""
    assert found(scene, Sensor(log_eps=0.05), Sensor(log_eps=0.05)) is None
    true = sensor_with(dark={"current": 0.05})
    assert found(scene, true, sensor_with(threshold={"on": 2.0, "off": 2.0})) is None
    same = dase.simulate(scene, true, seed=3)
    of_model = LightBetweenEvents.of_model
    with monkeypatch.context() as changed:
        changed.setattr(LightBetweenEvents, "of_model", lambda self, sensor, seed: self.steps_between(same))
        assert found(scene, true) is None
    assert LightBetweenEvents.of_model is of_model
    # what is asked for is left out of the model before
    assert found(scene, sensor_with(dark={"current": 0.05}), sensor_with(dark={"current": 0.05})) is not None


def test_too_few_steps_tell_nothing(scene):
    events = dase.simulate(scene, sensor_with(dark={"current": 0.05}), seed=3)
    many = replace(DARK_STEPS, steps=len(events))
    measurement = Measurement(events, scene)
    assert find_larger_steps_in_the_dark(measurement, Sensor(), seed=0, settings=many) is None


def test_steps_of_a_few_columns_tell_too_little_of_how_well_it_is_known(scene):
    events = dase.simulate(scene, sensor_with(dark={"current": 0.05}), seed=3)
    some = events.select(events.x < 8)
    few = replace(DARK_STEPS, steps=200, of_group=60)
    measurement = Measurement(some, scene)
    alone = replace(few, block=1000)  # all of one block, so of one group
    assert find_larger_steps_in_the_dark(measurement, Sensor(), seed=0, settings=alone) is None


@pytest.mark.parametrize(
    ("details", "late"),
    [
        ({"step": 1e-4}, False), ({"step": 1e-3}, True), ({"line": 1e-5, "period": 1.2e-3}, True),
        ({"line": 1e-6, "period": 1e-4}, False), ({}, False),
    ],
)  # fmt: skip
def test_steps_tell_nothing_where_a_scan_or_a_clock_stamps_events_late(details, late, monkeypatch):
    """Light goes on until they are stamped: beside a scan of 1.2 ms a current was certain in a sealed run."""
    asked = []
    for finder in ("find_larger_steps_in_the_dark", "find_alike_steps"):
        monkeypatch.setattr(seen_beside_model, finder, lambda *_, **more: asked.append(more))
    stamps = Signature(name=TIME_STAMPS, answer=Answer.FOUND, details=details, sentence="")
    seen = SeenEffects((stamps,))
    task = SimpleNamespace(evidence=SimpleNamespace(contradiction=""), given=frozenset(), seed=0)
    model = SimpleNamespace(sensor=Sensor())
    assert seen_beside_model._look_at_steps_in_the_dark(task, seen, None, model) is seen
    assert len(asked) == (0 if late else 2)


def test_it_is_certain_however_badly_a_model_fits():
    assert KINDS[LARGER_STEPS_IN_THE_DARK].whatever_fits
    assert KINDS[LARGER_STEPS_IN_THE_DARK].beside_model


def test_what_was_seen_has_its_size_where_no_fit_gave_one(scene):
    diagnosis = dase.diagnose(
        dase.simulate(scene, sensor_with(dark={"current": 0.05}), seed=3), scene=scene, most=1, pixels=300
    )
    assert [(one.effect, one.grade.value) for one in diagnosis.findings] == [("dark", "certain")]
    assert diagnosis.findings[0].parameters["dark.current"].value == pytest.approx(0.05, rel=0.1)
    entry = found(scene, sensor_with(dark={"current": 0.05}))
    bare = replace(
        diagnosis, parameters={}, findings=tuple(replace(f, parameters={}) for f in diagnosis.findings)
    )
    said = with_size_that_was_seen(bare, entry, "dark.current")
    assert said.findings[0].parameters["dark.current"].value == entry.size
    assert with_size_that_was_seen(diagnosis, entry, "dark.current") is diagnosis
