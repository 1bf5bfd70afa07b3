"""Time stamps that are off by less than a frame show in how fast events follow each other."""

from __future__ import annotations

import pytest
from helpers.frame_simulator import shaken_texture

import dase
from dase.diagnosis.diagnose import diagnose
from dase.effects import EFFECTS
from dase.effects.timestamp import LEAST_JITTER, Timestamp
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.simulation.sensor import Sensor

LIBRARY = {name: EFFECTS[name] for name in ("threshold", "jitter", "latency", "timestamp")}


@pytest.fixture(scope="module")
def scene():
    return shaken_texture(gap=1e-3)


def test_stamps_that_are_off_are_tried_where_no_clock_is_seen(scene):
    evidence = split_measurement(Measurement(dase.simulate(scene, Sensor(), seed=6), scene), pixels=100)
    (tried,) = Timestamp.candidates(evidence.observe(idle_bus=0.01))
    assert (tried.step, tried.idle(())) == (0.0, ())
    assert Timestamp(jitter=0.9 * LEAST_JITTER).idle(()) == ("jitter",)
    slow = Sensor().with_effect(Timestamp(step=2e-3, jitter=0.0))
    evidence = split_measurement(Measurement(dase.simulate(scene, slow, seed=6), scene), pixels=100)
    (tried,) = Timestamp.candidates(evidence.observe(idle_bus=0.01))
    assert (tried.step, tried.jitter) == (pytest.approx(2e-3), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.0, 4e-4])
def test_stamps_that_are_off_are_found(scene, off):
    true = Sensor().with_effect(Timestamp(jitter=off, step=1e-6))
    found = diagnose(dase.simulate(scene, true, seed=6), scene=scene, effects=LIBRARY, seed=1)
    wanted = {"timestamp": Grade.SUPPORTED} if off else {}
    assert {one.effect: one.grade for one in found.findings} == wanted
    if off:
        assert found.parameters["timestamp.jitter"].value == pytest.approx(off, rel=0.2)
        assert found.errors[-1] < found.gate
