"""Pixels that are held in reset after each event: closed forms on ramps, and an independent pixel of 1 µs."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.event_comparison import tracks
from reference import pixel as reference
from reference.pixel import Stream

import dase
from dase.effects import EFFECTS
from dase.effects.refractory import Refractory
from dase.effects.threshold import Threshold


def ramp(slope: float, seconds: float, samples: int, pixels: int = 1) -> reference.LogScene:
    """Return a log intensity that rises by `slope` per second, sampled at uneven times."""
    times = seconds * np.linspace(0, 1, samples) ** 1.3
    return reference.LogScene(slope * times[:, None, None] * np.ones((1, 1, pixels)), times)


def held(period: float, **settings: float) -> dase.Sensor:
    dead = Refractory(period=period, **settings)
    return reference.only(Threshold(on=0.2, off=0.2, phase=0.0), dead)


@pytest.mark.parametrize("slope", [40.0, -40.0])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.9, 0.99, 3.0, 7.5])
@pytest.mark.parametrize("samples", [2, 9, 700])
def test_a_ramp_has_an_event_every_crossing_time_and_dead_time(device, slope, share, samples):
    """Whatever the sampling: dead times end in the middle of steps, several in one or one in many."""
    crossing, after_off = 0.2 / abs(slope), 0.7
    scene = ramp(slope, 0.4, samples)
    events = dase.simulate(scene, held(share * crossing, after_off=after_off), device=device)
    interval = crossing * (1 + share * (1.0 if slope > 0 else after_off))
    want = crossing + interval * np.arange(int((0.4 - crossing) / interval) + 1)
    assert abs(len(events) - len(want)) <= 1  # the last may fall on the very end
    assert len(events) > 5
    np.testing.assert_allclose(events.t, want[: len(events)], rtol=2e-5)
    assert np.all(events.p == (slope > 0))


def test_other_rules_send_more(device):
    """At 0.99 of the interval a reset pixel sends half of what one does whose memory follows."""
    scene, counts = ramp(40.0, 0.4, 50), []
    for mode in ("reset", "drop", "delay"):
        quiet = Threshold(on=0.2, off=0.2, phase=0.0)
        sensor = reference.only(quiet, Refractory(period=0.99 * 5e-3, mode=mode), mode=mode)
        counts.append(len(dase.simulate(scene, sensor, device=device)))
    assert counts[0] == pytest.approx(0.4 / (5e-3 * 1.99), abs=1)
    assert counts[1] == counts[2] == pytest.approx(80, abs=1)


def test_what_happens_in_the_dead_time_is_forgotten(device):
    """A flash that comes and goes while the pixel is held leaves no trace; one that stays is the new rest."""
    level = np.array([0.0, 0.25, 1.5, 0.25, 0.25, 0.25, 2.0, 2.0, 2.0])[:, None, None]
    times = np.array([0.0, 1e-3, 2e-3, 3e-3, 4e-3, 12e-3, 13e-3, 20e-3, 40e-3])
    events = dase.simulate(reference.LogScene(level, times), held(5e-3), device=device)
    # of the second step a part is seen: 0.25 to 2.0 in a millisecond crosses once, then the pixel is held
    np.testing.assert_allclose(events.t, [0.8e-3, 12e-3 + 0.2 / 1.75 * 1e-3], atol=1e-8)


def brute(level: np.ndarray, step: float, theta: float, on_dead: float, off_dead: float) -> list[list]:
    """Return the events of pixels that look at their light once per `step`, shape (K, N)."""
    memory, wake = level[0].copy(), np.full(level.shape[1], -1)
    out: list[list] = [[] for _ in memory]
    for k in range(1, len(level)):
        memory = np.where(k == wake, level[k], memory)
        change = np.where(k >= wake, level[k] - memory, 0.0)
        for i in np.flatnonzero(np.abs(change) >= theta):
            out[i].append((k * step, change[i] > 0))
            dead = on_dead if change[i] > 0 else off_dead
            wake[i] = k + round(dead / step)
            memory[i] = level[k, i]
    return out


@pytest.mark.parametrize("dead", [0.4e-3, 1.3e-3, 6e-3])
def test_a_pixel_that_looks_each_microsecond_sends_the_same(device, rng, dead):
    samples, pixels, step = 61, 40, 1e-6
    times = np.arange(samples) * 1e-3
    level = np.cumsum(rng.normal(0, 0.25, (samples, pixels)), 0)
    fine = np.arange(60_001) * step
    dense = np.stack([np.interp(fine, times, level[:, i]) for i in range(pixels)], 1)
    want = brute(dense, step, 0.2, dead, 0.5 * dead)
    scene = reference.LogScene(level[:, None], times)
    events = dase.simulate(scene, held(dead, after_off=0.5), device=device)
    got = [list(zip(events.t[events.x == i], events.p[events.x == i], strict=True)) for i in range(pixels)]
    alike = [len(g) == len(w) and np.array_equal([p for _, p in g], [p for _, p in w])
             for g, w in zip(got, want, strict=True)]  # fmt: skip
    # a turn of the light close to a threshold may be seen by one of them alone
    assert np.mean(alike) > 0.85
    assert sum(map(len, want)) > 200
    late = [abs(a - b) for g, w, same in zip(got, want, alike, strict=True) if same
            for (a, _), (b, _) in zip(g, w, strict=True)]  # fmt: skip
    assert np.quantile(late, 0.99) < 1e-4
    assert np.median(late) < 5e-6


def test_dead_times_differ_from_pixel_to_pixel(device):
    period, pixels, crossing = 4e-3, 400, 5e-3
    events = dase.simulate(ramp(40.0, 0.1, 20, pixels), held(period, spread=0.3), seed=4, device=device)
    dead = np.array([np.diff(t).mean() for t in tracks(events)]) - crossing
    own = [Stream("refractory_gate_pixel_normal", 4, i).normal() for i in range(pixels)]
    np.testing.assert_allclose(dead, period * np.maximum(1 + 0.3 * np.array(own), 0), atol=2e-6)
    assert dead.std() == pytest.approx(0.3 * period, rel=4 / np.sqrt(2 * pixels))


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_noise_that_passes_comes_as_often_as_without_a_dead_time(device, mode):
    rate, seconds, pixels = 80.0, 1.0, 900
    level = np.zeros((101, 1, pixels))
    scene = reference.LogScene(level, np.linspace(0, seconds, 101))
    noise = EFFECTS["shot"](rate=rate, bright=1.0)

    def sent(**rule):
        dead = Refractory(period=20e-3, mode=mode, **rule)
        return dase.simulate(scene, reference.only(Threshold(), noise, dead, mode=mode), device=device)

    passing, held = sent(noise="passes"), sent(noise="held")
    want = rate * seconds * pixels
    assert abs(len(passing) - want) < 4 * np.sqrt(want)
    # a dead time after each event: a renewal process of period and mean waiting time
    assert abs(len(held) / (want / (1 + rate * 20e-3)) - 1) < 0.05
    order = np.lexsort((passing.t, passing.x))
    gaps = np.diff(passing.t[order])[np.diff(passing.x[order].astype(int)) == 0]
    assert abs(np.mean(gaps < 20e-3) - (1 - np.exp(-rate * 20e-3))) < 0.02
