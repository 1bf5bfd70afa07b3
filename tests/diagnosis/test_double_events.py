"""Double events that are seen are tried first: what else is missing is told beside them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.frame_simulator import shaken_texture

import dase
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.state import DiagnosisState, DiagnosisTask
from dase.effects import EFFECTS
from dase.effects.double_events import DoubleEvents
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.simulation.sensor import Sensor

LIBRARY = {name: EFFECTS[name] for name in ("threshold", "shot", "double_events")}


@pytest.fixture(scope="module")
def scene():
    return shaken_texture(gap=1e-3)


@pytest.mark.slow
def test_noise_is_found_beside_double_events(scene):
    true = Sensor().with_effect(EFFECTS["shot"](rate=5.0)).with_effect(DoubleEvents(share=0.2))
    found = diagnose(dase.simulate(scene, true, seed=6), scene=scene, effects=LIBRARY, seed=1)
    assert {one.effect: one.grade for one in found.findings}["double_events"] is Grade.CERTAIN
    assert "shot" in found.selected
    assert found.sensor["double_events"].share == pytest.approx(0.2, rel=0.2)
    assert found.sensor["double_events"].delay == pytest.approx(DoubleEvents().delay, rel=0.2)
    assert found.errors[-1] < found.gate


def test_double_events_are_tried_only_where_they_are_seen(scene):
    measurement = Measurement(dase.simulate(scene, Sensor(), seed=6), scene)
    evidence = split_measurement(measurement, pixels=100)
    state = DiagnosisState(DiagnosisTask(evidence, LIBRARY, 0, lambda *_: None, frozenset()))
    assert DoubleEvents.candidates(state.task.evidence.observe(idle_bus=0.01)) == []
    for opposite, polarity, spread in ((False, "same", 0.0), (True, "opposite", 0.0), (False, "same", 40e-6)):
        state.try_doubles(33e-6, spread=spread, opposite=opposite)
        state.split_anew(replace(evidence))
        tried = DoubleEvents.candidates(state.task.evidence.observe(idle_bus=0.01))
        delay = pytest.approx(33e-6 - 0.5 * spread)
        assert [replace(one, delay=1e-6) for one in tried] == [
            DoubleEvents(delay=1e-6, spread=spread, polarity=polarity)
        ]
        assert [one.delay for one in tried] == [delay]
