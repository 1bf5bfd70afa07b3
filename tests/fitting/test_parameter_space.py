"""Axes of the search."""

from __future__ import annotations

import numpy as np
import pytest

from dase.effects import EFFECTS
from dase.effects.voltage_noise import VoltageNoise
from dase.fitting.model import model_of, with_full_range
from dase.fitting.parameter_space import axes_of, make_axis
from dase.simulation.sensor import Sensor

FACTS = [(name, fact) for name, effect in EFFECTS.items() for fact in effect.parameters()]


@pytest.mark.parametrize(("name", "fact"), FACTS, ids=[f"{name}.{fact.name}" for name, fact in FACTS])
def test_every_place_has_a_value_that_the_effect_takes(name, fact):
    line = make_axis(EFFECTS[name], fact)
    low, high = line.bounds()
    for value in np.append(line.to_value(np.linspace(low - 1, high + 1, 101)), [line.to_value(high)]):
        assert fact.bounds[0] <= value <= fact.bounds[1]
        EFFECTS[name](**{fact.name: float(value)})
    middle = 0.3 * low + 0.7 * high
    assert line.to_place(line.to_value(middle)) == pytest.approx(middle)


@pytest.mark.parametrize(("cutoff", "high"), [(200.0, 1000.0), (2500.0, 2500.0)])
def test_a_search_goes_no_farther_than_what_costs_much_and_tells_nothing(cutoff, high):
    """Noise of some kHz took minutes; what was given stays in reach."""
    sensor = Sensor().with_effect(VoltageNoise(cutoff=cutoff))
    (axis,) = axes_of(sensor, ["voltage_noise.cutoff"])
    assert axis.high == high
    assert axis.to_value(axis.to_place(cutoff)) == pytest.approx(cutoff)


def test_a_model_that_ended_where_its_search_does_may_go_on():
    """`fit` and a diagnosis go on from there; what ended elsewhere stays as it is."""
    sensor = Sensor().with_effect(VoltageNoise(cutoff=1000.0))
    wide = with_full_range(model_of(sensor, ["voltage_noise.cutoff", "voltage_noise.sigma"]))
    highs = {axis.name: axis.high for axis in wide.space.axes}
    assert highs["voltage_noise.cutoff"] == 9000.0
    assert wide.sensor["voltage_noise"].cutoff == pytest.approx(1000.0)
    assert with_full_range(model_of(sensor.with_effect(VoltageNoise(cutoff=300.0)))) is None
