"""A sensor that limits its rate in periods: the limit is seen, and does not hide what is beside it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import shaken_texture

import dase
from dase.effects import EFFECTS
from dase.effects.rate_control import RateControl
from dase.results import Grade

THRESHOLD = EFFECTS["threshold"](on=0.2, off=0.2)
TRIED = {name: EFFECTS[name] for name in ("rate_control", "refractory", "leak", "bandwidth", "readout")}


@pytest.mark.slow
def test_a_limit_is_certain_and_what_is_beside_it_is_found():
    scene = shaken_texture()
    leak = EFFECTS["leak"](rate=6.0)
    wanted = dase.simulate(scene, dase.Sensor((THRESHOLD, leak)), seed=1)
    most = np.floor(np.quantile(np.bincount((wanted.t / 2e-3).astype(int)), 0.5))
    limit = RateControl(rate=most / 2e-3, period=2e-3, drop="last")
    events = dase.simulate(scene, dase.Sensor((THRESHOLD, leak, limit)), seed=1)
    assert len(events) < 0.97 * len(wanted)
    found = dase.diagnose(
        events, dase.Sensor((THRESHOLD,)), scene=scene, effects=TRIED, most=2, pixels=400, settings=NO_LIMITS
    )
    named = {one.effect: one for one in found.findings}
    assert named["rate_control"].grade is Grade.CERTAIN
    assert named["leak"].grade in (Grade.CERTAIN, Grade.SUPPORTED)
    assert set(named) == {"rate_control", "leak"}
    assert named["rate_control"].parameters["rate_control.period"].value == pytest.approx(2e-3, abs=1e-9)
    assert named["rate_control"].parameters["rate_control.rate"].value == pytest.approx(most / 2e-3, rel=0.02)
    assert found.sensor["rate_control"].drop == "last"
    assert set(found.selected) == {"rate_control", "leak"}
    assert found.errors[-1] < 1.3
