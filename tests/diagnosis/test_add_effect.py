"""An effect that acts on few pixels is added on its own, without a diagnosis before it."""

from __future__ import annotations

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
