"""Chances against enumeration, and intervals against what they must hold."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import stats

from dase.signatures.chance import mean_interval, poisson_interval, ratio_interval, sign_flip_tail


def test_sign_flips_equal_enumeration(rng):
    signs = np.array(list(product((-1, 1), repeat=14)))
    for _ in range(20):
        values = rng.standard_normal(14) * rng.exponential(size=14) + 0.5
        want = np.mean((signs * np.abs(values)).sum(1) >= values.sum() - 1e-12)
        if values.sum() > 0:
            assert sign_flip_tail(values) == pytest.approx(want, rel=0.25, abs=1e-3)


def test_sign_flips_of_many_values_are_normal():
    values = np.r_[np.ones(5200), -np.ones(4800)]
    assert sign_flip_tail(values) == pytest.approx(stats.norm.sf(4.0), rel=0.1)


@pytest.mark.parametrize(
    ("values", "want"),
    [([], 1.0), ([0.0, 0.0], 1.0), ([-1.0, -2.0], 1.0), ([1.0] * 20, 0.5**20), ([3.0], 0.5)],
)
def test_sign_flips_at_the_ends(values, want):
    assert sign_flip_tail(np.array(values, float)) == pytest.approx(want)


def test_large_values_make_large_sums_less_rare():
    spread, one = np.full(100, 0.1), np.r_[np.zeros(99), 10.0]
    assert sign_flip_tail(one) == pytest.approx(0.5)
    assert sign_flip_tail(spread) < 1e-20


def test_intervals_hold_the_truth_in_nine_of_ten(rng):
    held = [low <= 7.0 <= high for low, high in map(poisson_interval, rng.poisson(7.0, 2000))]
    assert 0.89 < np.mean(held) < 0.97
    draws = rng.binomial(400, 0.3, 1000)
    held = [low <= 1.0 <= high for low, high in (ratio_interval(int(n), 400 - int(n), 3 / 7) for n in draws)]
    assert 0.89 < np.mean(held) < 0.94
    held = [low <= 2.0 <= high for _, low, high in (mean_interval(rng.normal(2, 3, 8)) for _ in range(1000))]
    assert 0.87 < np.mean(held) < 0.93
