"""An effect that acts on few pixels is added on its own, without a diagnosis before it."""

from __future__ import annotations

import pytest
from helpers.frame_simulator import shaken_texture

import dase
from dase.diagnosis.add_effect import fit_added
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS
from dase.simulation.sensor import Sensor


def test_an_effect_of_few_pixels_is_added_to_a_model_that_was_not_diagnosed(device):
    """It is screened on all pixels of the training half, which nothing has calibrated before."""
    scene, plain = moving_bars(duration=0.4), Sensor((EFFECTS["threshold"](on=0.2, off=0.2),))
    hot = EFFECTS["hot"](share=0.02, rate=500.0, spread=0.0)
    events = dase.simulate(scene, plain.with_effect(hot), seed=1, device=device)
    before, found = fit_added(events, plain, EFFECTS["hot"](), scene=scene, pixels=100, device=device)
    assert before > 0
    assert found.parameters["hot.share"].value > 0


@pytest.mark.slow
def test_a_lens_is_added_to_a_model_of_a_clip():
    scene, plain = shaken_texture(), Sensor((EFFECTS["threshold"](on=0.12, off=0.12),))
    events = dase.simulate(scene, plain.with_effect(EFFECTS["optics_blur"](sigma=2.0)), seed=1)
    before, found = fit_added(events, plain, EFFECTS["optics_blur"](), scene=scene, pixels=100)
    assert found.sensor["optics_blur"].sigma == pytest.approx(2.0, rel=0.08)
    assert found.error < 0.5 * before
    with pytest.raises(dase.InputError, match="bayer acts on pictures, and cannot be fitted"):
        fit_added(events, plain, EFFECTS["bayer"](), scene=scene)
    with pytest.raises(dase.InputError, match=r"free: optics_blur\.sigma acts on pictures"):
        dase.fit(events, found.sensor, scene=scene, free=["optics_blur.sigma"])
