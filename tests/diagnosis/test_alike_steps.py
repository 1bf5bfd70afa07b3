"""Noise hides a current and darker corners from medians of steps, not from those that are alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import shaken_texture
from helpers.sensors import sensor_with

import dase
from dase.diagnosis.alike_steps import ALIKE, find_alike_steps
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.effects import EFFECTS
from dase.effects.made_signatures import told_by
from dase.errors import InputError
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.scenes.video import VideoScene
from dase.signatures.kinds import CURRENT_AT_CORNERS, LARGER_STEPS_IN_THE_DARK
from dase.simulation.sensor import Sensor

DARK = {"current": 0.05}
NOISE = {"rate": 15.0, "bright": 0.0}


@pytest.fixture(scope="module", params=[11, 12])
def scene(request):
    """Return a texture that shakes, in light from a spot to a tenth of it, wherever that is."""
    even = shaken_texture(seed=request.param)
    times = even.sample_times()
    frames = even.frames(times)
    height, width = frames.shape[1:]
    y, x = np.mgrid[:height, :width]
    spot = np.random.default_rng(request.param).uniform(0.1, 0.9, 2) * (height, width)
    brighter = np.maximum(np.exp(-(((y - spot[0]) / 20) ** 2) - ((x - spot[1]) / 30) ** 2), 0.1)
    return VideoScene((frames * brighter).astype(np.float32), times)


def found(scene, sensor, asked=None, **changed):
    events = dase.simulate(scene, sensor, seed=3)
    settings = replace(ALIKE, **changed)
    return find_alike_steps(Measurement(events, scene), asked or Sensor(), seed=0, settings=settings)


@pytest.mark.parametrize("more", [{"shot": NOISE}, {"shot": NOISE, "mismatch": {"spread": 0.05}}])
def test_a_current_is_told_beside_noise(scene, more):
    one = found(scene, sensor_with(dark=DARK, **more))
    entry = one.in_the_dark()
    assert entry.name == LARGER_STEPS_IN_THE_DARK
    assert told_by(entry, EFFECTS) == ("dark",)
    assert entry.size == entry.details["current"] == pytest.approx(0.05, rel=0.1)
    assert one.at_corners() == ()  # all get the same light


@pytest.mark.parametrize(
    ("loss", "more", "off"),
    [(0.4, {}, 0.04), (0.65, {}, 0.04), (0.5, {"mismatch": {"spread": 0.1}}, ALIKE.known_loss)],
)
def test_darker_corners_are_told_beside_it(scene, loss, more, off):
    """Thresholds that differ blur the peak, and what is read is too low."""
    one = found(scene, sensor_with(dark=DARK, shot=NOISE, vignetting={"loss": loss}, **more))
    (corners,) = one.at_corners()
    assert corners.name == CURRENT_AT_CORNERS
    assert told_by(corners, EFFECTS) == ("vignetting",)
    assert corners.size == corners.details["loss"] == pytest.approx(loss, abs=off + 1e-9)
    assert corners.low <= loss + 1e-9
    assert loss <= corners.high + 1e-9
    assert one.current == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"shot": NOISE},
        {"linlog": {"knee": 0.2}},
        {"vignetting": {"loss": 0.7}},
        {"bandwidth": {"cutoff": 30.0}},
        {"bandwidth": {"cutoff": 60.0}, "vignetting": {"loss": 0.7}},
        {"refractory": {"period": 0.01}},
        {"leak": {"rate": 3.0}},
        {"voltage_noise": {"sigma": 0.05}},
        {"high_pass": {"cutoff": 5.0}},
        {"mismatch": {"spread": 0.2}},
    ],
)
def test_what_else_makes_steps_differ_is_no_current(scene, more):
    assert found(scene, sensor_with(**more)) is None


def test_what_a_model_shows_as_well_is_not_told(scene, monkeypatch):
    """Nor what one shows that sends too little, and none where the current ends where it is looked for."""
    true = sensor_with(dark=DARK, shot=NOISE)
    assert found(scene, true, sensor_with(dark=DARK)) is not None  # asked without it
    assert found(scene, true, sensor_with(threshold={"on": 2.0, "off": 2.0})) is None
    assert found(scene, true, current=(0.004, 0.03)) is None
    assert found(scene, true, steps=10**7) is None
    with monkeypatch.context() as changed:
        changed.setattr(LightBetweenEvents, "of_model", lambda self, sensor, seed: self.seen)
        assert found(scene, true) is None

    def refuse(self, sensor, seed):
        raise InputError("no")

    monkeypatch.setattr(LightBetweenEvents, "of_model", refuse)
    assert found(scene, true) is None


@pytest.mark.slow
def test_a_diagnosis_is_certain_of_corners_and_current(scene):
    sensor = sensor_with(dark=DARK, shot=NOISE, vignetting={"loss": 0.6})
    library = {name: EFFECTS[name] for name in ("dark", "linlog", "vignetting", "shot")}
    said = diagnose(dase.simulate(scene, sensor, seed=3), scene=scene, effects=library, pixels=200)
    told = {one.effect: one.grade for one in said.findings}
    assert told["vignetting"] is told["dark"] is Grade.CERTAIN
    assert said.sensor["vignetting"].loss == pytest.approx(0.6, abs=0.06)
    assert said.sensor["dark"].current == pytest.approx(0.05, rel=0.15)
    bare = sensor_with(dark=DARK, shot=NOISE)
    said = diagnose(dase.simulate(scene, bare, seed=3), scene=scene, effects=library, pixels=200)
    assert "vignetting" not in {one.effect for one in said.findings}
