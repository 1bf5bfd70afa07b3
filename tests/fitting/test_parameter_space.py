"""Axes of the search."""

from __future__ import annotations

import numpy as np
import pytest

from dase.effects import EFFECTS
from dase.fitting.parameter_space import make_axis

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
