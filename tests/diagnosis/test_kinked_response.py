"""The kink of v2e's response is told by how far light goes between events on either side of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import bright_texture, counted_between_frames, shaken_texture
from helpers.sensors import sensor_with

import dase
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.kinked_response import KINK, find_kinked_response
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.effects import EFFECTS
from dase.effects.made_signatures import told_by
from dase.effects.vignetting import Vignetting
from dase.errors import InputError
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.scenes.video import VideoScene
from dase.signatures.kinds import KINK_AT_CORNERS, KINKED_RESPONSE
from dase.simulation.sensor import Sensor


@pytest.fixture(scope="module")
def scene():
    """Return a texture of which more than half is darker than the kink."""
    even = shaken_texture()
    light = even.frames(even.sample_times())
    return VideoScene(np.round(255 * (0.015 + 0.5 * light)).astype(np.uint8), even.sample_times())


def with_dark_corners(scene, loss):
    """Return the scene behind a lens by the cos⁴ law."""
    light = scene.frames(scene.sample_times())
    height, width = light.shape[1:]
    y, x = np.mgrid[:height, :width]
    middle = 0.5 * (height - 1), 0.5 * (width - 1)
    off = ((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / (middle[0] ** 2 + middle[1] ** 2)
    return VideoScene(light / (1 + (1 / np.sqrt(1 - loss) - 1) * off) ** 2, scene.sample_times())


def found(events, scene, sensor=None, **changed):
    settings = replace(KINK, **changed)
    return find_kinked_response(Measurement(events, scene), sensor or Sensor(), seed=0, settings=settings)


@pytest.mark.parametrize("more", [{}, {"shot": 1.0}, {"leak": 2.0}])
@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_the_line_of_v2e_is_told_whatever_thresholds_do(scene, spread, more):
    (entry,) = found(counted_between_frames(scene, spread, **more), scene)
    assert entry.name == KINKED_RESPONSE
    assert told_by(entry, EFFECTS) == ("linlog",)
    assert entry.size == entry.details["knee"] == 20 / 255


@pytest.mark.slow
def test_a_diagnosis_says_what_makes_it_and_how_far_errors_fall(scene):
    events = counted_between_frames(with_dark_corners(scene, 0.5), 0.0, leak=3.0)
    library = {name: EFFECTS[name] for name in ("linlog", "vignetting", "leak", "shot")}
    said = diagnose(events, scene=scene, effects=library, pixels=200)
    assert said.selected[:2] == ("linlog", "vignetting")
    assert len(said.errors) == len(said.selected) + 1
    assert said.errors[0] > said.errors[1] > said.errors[2]
    told = {one.effect: one for one in said.findings}
    for n, name in enumerate(("linlog", "vignetting")):
        assert told[name].grade is Grade.CERTAIN
        assert (told[name].error_without, told[name].error_with) == said.errors[n : n + 2]
    assert said.sensor["linlog"].knee == said.parameters["linlog.knee"].value == 20 / 255
    assert said.sensor["linlog"].slope == said.parameters["linlog.slope"].value == pytest.approx(np.log(20))
    assert said.parameters["vignetting.loss"].value == pytest.approx(0.5, abs=0.06)
    bare = diagnose(events, scene=scene, effects={"leak": EFFECTS["leak"]}, pixels=200, most=1)
    assert "linlog" not in bare.sensor  # a library without it


@pytest.mark.parametrize("loss", [0.4, 0.7])
def test_corners_that_are_darker_have_it_at_more_light(scene, loss):
    events = counted_between_frames(with_dark_corners(scene, loss), 0.05)
    response, corners = found(events, scene)
    assert response.name == KINKED_RESPONSE
    assert corners.name == KINK_AT_CORNERS
    assert told_by(corners, EFFECTS) == ("vignetting",)
    assert corners.size == corners.details["loss"] == pytest.approx(loss, abs=0.06)
    assert corners.low < corners.size < corners.high
    (alone,) = found(events, scene, Sensor().with_effect(Vignetting(loss=loss)))
    assert alone.name == KINKED_RESPONSE  # what is known is not told


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"linlog": {"knee": 0.2}},
        {"dark": {"current": 0.05}},
        {"bandwidth": {"cutoff": 30.0}},
        {"vignetting": {"loss": 0.7}},
        {"shot": {"rate": 5.0}},
        {"voltage_noise": {"sigma": 0.05}},
        {"high_pass": {"cutoff": 5.0}},
        {"optics_blur": {"sigma": 1.0}},
    ],
)
def test_what_else_makes_steps_differ_is_no_kink(scene, more):
    events = dase.simulate(scene, sensor_with(**more), seed=3)
    assert found(events, scene) == ()


def test_a_kink_that_a_model_shows_as_well_is_not_told(scene, monkeypatch):
    events = counted_between_frames(scene, 0.05)
    # one that sends too little says nothing against it, and one with a knee is asked without it
    assert len(found(events, scene, sensor_with(threshold={"on": 3.0, "off": 3.0}))) == 1
    assert len(found(events, scene, sensor_with(linlog={"slope": 3.0}))) == 1
    with monkeypatch.context() as changed:
        changed.setattr(LightBetweenEvents, "of_model", lambda self, sensor, seed: self.seen)
        assert found(events, scene) == ()

    def refuse(self, sensor, seed):
        raise InputError("no")

    with monkeypatch.context() as changed:
        changed.setattr(LightBetweenEvents, "of_model", refuse)
        assert found(events, scene) == ()


def test_nothing_is_told_where_little_light_is_as_dark_as_that(scene):
    bright = bright_texture(gap=2e-3, length=0.8)
    assert found(counted_between_frames(bright, 0.05), bright) == ()
    events = counted_between_frames(scene, 0.05)
    assert found(events, scene, steps=len(events)) == ()
    assert found(events, scene, of_level=len(events)) == ()
    assert found(events, scene, differ=2.0) == ()
    assert found(events, scene.held(1e-6)) == ()
