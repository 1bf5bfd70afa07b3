"""The photoreceptor's speed: how it differs between pixels, and its two equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensors import counts, every
from helpers.small_scenes import ramp, still

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.second_order import SecondOrder
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise

FINE = Threshold(on=0.01, off=0.01, phase=0.0)


def time_to_half(sensor: dase.Sensor, levels: tuple[float, float], times: np.ndarray, device: str) -> float:
    """Return when half of an edge has gone by [s], which is at time 0, between two log intensities."""
    light = np.exp(np.r_[levels[0], np.full(len(times), levels[1])])[:, None, None] - 1e-3
    scene = dase.VideoScene(light, np.r_[times[0] - 1e-7, times])
    events = dase.simulate(scene, sensor, device=device)
    way = np.cumsum(np.where(events.p, 0.01, -0.01))
    return float(events.t[np.argmax(np.abs(way) >= 0.5 * abs(levels[1] - levels[0]))] - times[0])


@pytest.mark.parametrize("decades", [0.3, 1.0, 2.0])
def test_edges_of_a_source_follower_take_the_times_of_its_equation(device, decades):
    factor, dark, cutoff = 10**decades, 0.01, 5.0
    sensor = every(FINE, Bandwidth(cutoff=cutoff, dark=dark, signal="large"))
    low, high = np.log(0.9 / factor), np.log(0.9)
    times = np.linspace(0, 0.5 * factor, 4001) / cutoff
    # e^-v nears its end as e^-ωt, with the ω of the light after the edge
    up, down = np.array([factor**-0.5 - 1 / factor, 1 - factor**-0.5]) / (1 - 1 / factor)
    found = []
    for levels, left in (((low, high), up), ((high, low), down)):
        omega = 2 * np.pi * cutoff * (dark + (1 - dark) * (np.exp(levels[1]) - 1e-3))
        found.append(time_to_half(sensor, levels, times, device))
        assert found[-1] == pytest.approx(-np.log(left) / omega, rel=0.03, abs=times[1])
    if decades == 1:
        assert found[1] / found[0] == pytest.approx(1.92, rel=0.15)  # 10 of a linear one


def test_small_contrasts_are_the_same_by_both_equations(device):
    scene = dase.VideoScene(np.exp(np.r_[-1.0, np.full(200, -0.8)])[:, None, None], np.arange(201) * 1e-3)
    small, large = (
        counts(scene, every(FINE, Bandwidth(cutoff=5.0, dark=0.5, signal=signal)), 0.05, device).sum()
        for signal in ("small", "large")
    )
    assert 8 < small < 17
    assert abs(large - small) <= 1


def test_a_source_follower_does_not_depend_on_sampling(device):
    sensor = every(FINE, Bandwidth(cutoff=1.5, dark=1.0, signal="large"))
    for change in (5.0, -5.0):
        totals = [counts(ramp(change, 0.3, 1, n), sensor, 0.3, device).sum() for n in (2, 9, 1025)]
        np.testing.assert_allclose(totals, totals[0], atol=1.5)
        assert totals[0] > 50


@pytest.mark.parametrize("slow", [Bandwidth(cutoff=0.1, dark=1.0), SecondOrder(cutoff=0.4, dark=1.0)])
def test_the_spread_of_the_speed_is_that_asked_for(device, slow):
    scene, phases = ramp(5.0, 0.3, 2000, 9), Threshold(on=0.01, off=0.01)

    def way(effect):
        return counts(scene, every(phases, effect), 0.3, device)[1]

    less, as_given, more = (
        way(replace(slow, cutoff=share * slow.cutoff)).mean() for share in (0.9, 1.0, 1.1)
    )
    per_speed = (more - less) / 0.2
    assert as_given > 30
    assert way(replace(slow, spread=0.1)).std() / per_speed == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("signal", ["small", "large"])
def test_infinitely_fast_is_off_to_the_bit(device, rng, signal):
    light = still(rng.random(40), 0.3, 30).frames(np.linspace(0, 0.3, 30))
    scene = dase.VideoScene(
        np.abs(light + 0.3 * rng.random(light.shape).astype(np.float32)), np.arange(30) * 0.01
    )
    noise = VoltageNoise(sigma=0.1, cutoff=50.0)
    off = every(noise, Bandwidth(cutoff=np.inf, dark=0.1, spread=0.5, signal=signal))
    got, want = (dase.simulate(scene, s, seed=2, device=device) for s in (off, every(noise)))
    assert len(want) > 100
    np.testing.assert_array_equal(got.t, want.t)
    np.testing.assert_array_equal(got.p, want.p)
