"""Light behind poles that go with it, against many small steps in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from dase.kernels.slow_light import SlowLight

STEPS = 2000
"""Of the reference, from instant to instant."""


def small_steps(
    level: np.ndarray, light: np.ndarray, times: np.ndarray, cutoffs, dark: float, fixed: float = 0.0
) -> np.ndarray:
    """Return what `SlowLight.behind` does; arguments have the shape that it says."""
    out = level.astype(np.float64).copy()
    speeds = [(one, 1.0) for one in cutoffs] + [(fixed, 0.0)] * (fixed > 0)
    poles = [level[:, 0].astype(np.float64) for _ in speeds]
    for n, gap in enumerate(np.diff(times)):
        share = (light[:, n] + dark) / (1 + dark)
        for k in range(STEPS):
            seen = level[:, n] + (level[:, n + 1] - level[:, n]) * ((k + 0.5) / STEPS)
            for m, (cutoff, goes) in enumerate(speeds):
                before = poles[m].copy()
                speed = 2 * np.pi * cutoff * share**goes
                poles[m] += (1 - np.exp(-speed * gap / STEPS)) * (seen - poles[m])
                seen = 0.5 * (before + poles[m])
        out[:, n + 1] = poles[-1]
    return out


@pytest.mark.parametrize("dark", [0.0, 0.1, 30.0])
@pytest.mark.parametrize("cutoff", [0.5, 20.0, 800.0])
def test_a_pole_follows_the_light(cutoff, dark, device):
    rng = np.random.default_rng(0)
    level = rng.normal(0, 0.7, (37, 9)).astype(np.float32)
    light = np.exp(rng.normal(-1, 1, (37, 8))).astype(np.float32)
    times = np.cumsum(rng.uniform(1e-3, 4e-3, 9))
    got = SlowLight(level, light, times, device).behind((cutoff,), dark)
    assert np.abs(got - small_steps(level, light, times, (cutoff,), dark)).max() < 2e-4


def test_a_second_pole_follows_the_first(device):
    """Where light runs straight for long, the first is straight from instant to instant, nearly."""
    times = np.arange(40) * 2.5e-4
    level = np.stack([np.linspace(0, s, 40) for s in (1.0, -2.0, 0.0)]).astype(np.float32)
    light = np.ones((3, 39), np.float32)
    got = SlowLight(level, light, times, device).behind((60.0, 150.0), 0.0)
    want = small_steps(level, light, times, (60.0, 150.0), 0.0)
    assert np.abs(got - want).max() < 2e-3
    assert np.abs(want[0, -1] - level[0, -1]) > 0.2  # far more than what the two differ by


def test_a_second_pole_may_be_the_same_in_all_light(device):
    times = np.arange(40) * 2.5e-4
    level = np.stack([np.linspace(0, s, 40) for s in (1.0, -2.0, 0.0)]).astype(np.float32)
    light = np.exp(0.5 * (level[:, 1:] + level[:, :-1]) - 1)
    got = SlowLight(level, light, times, device).behind((90.0,), 0.1, 120.0)
    want = small_steps(level, light, times, (90.0,), 0.1, fixed=120.0)
    alike = small_steps(level, light, times, (90.0, 120.0), 0.1)
    assert np.abs(got - want).max() < 2e-3
    assert np.abs(want - alike).max() > 0.02
