"""How wide intervals are."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from dase.effects import EFFECTS
from dase.fitting.confidence_intervals import CONFIDENCE, _side_of
from dase.fitting.model import model_of
from dase.simulation.sensor import Sensor


@pytest.mark.parametrize("hot", [2, 5, 30])
def test_a_few_hot_pixels_know_their_median_rate_by_students_law(hot):
    model = model_of(Sensor().with_effect(EFFECTS["hot"](share=hot / 1500, rate=80.0)))
    half = SimpleNamespace(trials=SimpleNamespace(stimulus=SimpleNamespace(pixels=np.zeros(1500))))
    sides = {axis.name: _side_of(model, axis, half) / CONFIDENCE.side for axis in model.space.axes}
    rate = sides.pop("hot.rate")
    assert rate == pytest.approx(stats.t.ppf(0.95, hot - 1) / 1.6449, rel=1e-3)
    assert list(sides.values()) == pytest.approx([1.0] * len(sides), abs=1e-3)


def test_means_of_few_values_lie_in_nine_of_ten_such_intervals():
    """The same by chance: normal logarithms, of which neither mean nor spread is known."""
    values = np.random.default_rng(1).standard_normal((20_000, 6))
    sides = [stats.t.ppf(0.95, 5), stats.norm.ppf(0.95)]
    error = np.abs(values.mean(1)) / (values.std(1, ddof=1) / np.sqrt(6))
    student, normal = (float(np.mean(error < side)) for side in sides)
    assert student == pytest.approx(0.9, abs=0.01)
    assert normal < 0.86
