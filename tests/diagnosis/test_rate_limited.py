"""A sensor that limits its rate in periods: the limit is seen, and does not hide what is beside it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import shaken_texture

import dase
from dase.diagnosis import rate_limited
from dase.diagnosis.rate_limited import with_limit_of_rate
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.effects.rate_control import RateControl
from dase.effects.stream import Others
from dase.fitting.measurement import Measurement
from dase.results import Diagnosis, Finding, Grade
from dase.signatures.kinds import RATE_LIMIT
from dase.signatures.result import Answer, Signature

THRESHOLD = EFFECTS["threshold"](on=0.2, off=0.2)
TRIED = {name: EFFECTS[name] for name in ("rate_control", "refractory", "leak", "bandwidth", "readout")}


@pytest.mark.parametrize(("in_step", "grade"), [(True, Grade.EITHER), (False, Grade.SUPPORTED)])
def test_beside_a_limit_times_between_frames_must_be_known(monkeypatch, in_step, grade):
    """Which events come too late in a period they tell: a clip of v2e had a *mismatch*, supported."""
    scene = shaken_texture()
    entry = Signature(name=RATE_LIMIT, answer=Answer.FOUND, sentence="", details={})
    compared = SimpleNamespace(
        measurement=Measurement(dase.Events.empty(scene.width, scene.height), scene),
        seen=SeenEffects((entry,)),
    )
    monkeypatch.setattr(rate_limited, "frame_step_of", lambda *given: 1e-3 if in_step else None)
    found = Diagnosis(dase.Sensor(), (), (1.0,), 1.0, 1.0, 1.15, {}, None, ())
    found = replace(found, findings=(Finding("mismatch", Grade.SUPPORTED), Finding("linlog", Grade.CERTAIN)))
    limit = RateControl(rate=1e5, period=2e-3, drop="last")
    said = {one.effect: one.grade for one in with_limit_of_rate(found, compared, limit).findings}
    assert said == {"mismatch": grade, "linlog": Grade.CERTAIN, "rate_control": Grade.CERTAIN}


def test_chance_says_which_of_the_events_at_one_time_pass_beside_others():
    """Those of some pixels had always come before all others'."""
    rng, size = np.random.default_rng(2), 6_000
    t = 1e-3 * np.sort(rng.integers(0, 100, size))
    x, y = (rng.integers(0, most, size) for most in (20, 10))
    events = dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(size) < 0.5, 20, 10)
    own = events.x < 5
    others = Others.of(events.select(~own))
    limit = RateControl(rate=40 / 2e-3, period=2e-3, drop="last")
    passed = limit.reader(20, 10, 1).beside(events.select(own), others, np.ones(2))
    assert len(passed) / np.count_nonzero(own) == pytest.approx(40 / 120, abs=0.05)


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
