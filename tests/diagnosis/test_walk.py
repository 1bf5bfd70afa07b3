"""Noise that returns and a walk that does not are told apart, where a clip's frames are known."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.effects import EFFECTS
from dase.effects.voltage_noise import VoltageNoise


def turning_texture(step: float, length: float) -> dase.VideoScene:
    """Return a pattern that moves to the right and up and down, for so long [s]."""
    rng = np.random.default_rng(3)
    right, down = rng.uniform(-0.5, 0.5, (2, 20, 1, 1))
    phase = rng.uniform(0, 6, (20, 1, 1))
    y, x = np.mgrid[:64, :96]
    times = np.arange(0, length, step)
    waves = [np.sin(right * (x - 40 * t) + down * (y + 15 * np.sin(6 * t)) + phase).mean(0) for t in times]
    return dase.VideoScene(np.clip(0.4 + np.array(waves, np.float32), 0.02, 1), times)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("true", "pixels", "length"),
    [
        # its cutoff comes out within a tenth only with more pixels and time
        (VoltageNoise(sigma=0.08, cutoff=150.0), 300, 1.0),
        (VoltageNoise(poles="none", sigma=0.06, floor=1.0, period=0.005), 200, 0.7),
    ],
    ids=["returns", "walks"],
)
def test_a_diagnosis_tells_which_noise_it_is(true, pixels, length):
    scene = turning_texture(0.005, length)
    events = dase.simulate(scene, dase.Sensor().with_effect(true), seed=6)
    found = dase.diagnose(events, scene=scene, pixels=pixels, settings=NO_LIMITS)
    assert found.selected == ("voltage_noise",)
    noise = found.sensor["voltage_noise"]
    assert noise.poles == true.poles
    light = 0.4

    def spread(one):
        share = one.floor + (1 - one.floor) * one.knee / (light + one.knee)
        return one.sigma * share**0.5

    assert spread(noise) == pytest.approx(spread(true), rel=0.1)
    if true.poles == "alike":
        assert noise.cutoff == pytest.approx(true.cutoff, rel=0.1)
    else:
        assert noise.period == pytest.approx(0.005)


def test_light_that_does_not_change_for_seconds_is_no_clip():
    """Two equal pictures stand for it, seconds apart: no walk goes from one to the other."""
    scene = dase.VideoScene(np.full((2, 24, 32), 0.3, np.float32), [0.0, 3.0])
    events = dase.simulate(scene, dase.Sensor().with_effect(EFFECTS["shot"](rate=4.0)), seed=2)
    library = {name: EFFECTS[name] for name in ("threshold", "shot", "voltage_noise")}
    found = dase.diagnose(events, scene="static", effects=library, pixels=200, most=1, settings=NO_LIMITS)
    assert found.selected == ("shot",)
