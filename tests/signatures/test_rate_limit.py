"""Periods that are full of events: a limit of the rate, and what looks like one and is none."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.effects import EFFECTS
from dase.effects.rate_control import RateControl
from dase.effects.readout import Readout
from dase.events import Events
from perf.experiments.signatures import run as experiment


@pytest.fixture(scope="module")
def moving():
    """Events of a scene that turns, some thousand per millisecond at most."""
    sensor = dase.Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.22))
    scene = experiment.draw_scene(np.random.default_rng(3), "shake", 1.0)
    events = dase.simulate(scene, sensor, seed=3)
    return events.select(events.t < 0.7)


def limited(events, period, quantile):
    """Events of a sensor that lets no more pass in a period than are in a share of the periods."""
    most = float(np.quantile(np.bincount((events.t / period).astype(int)), quantile))
    effect = RateControl(rate=most / period, period=period, drop="last")
    passed, _ = effect.reader(events.width, events.height, 0).push(events, np.inf)
    return passed, most


def rate_limit(events):
    return dase.find_signatures(events)["rate limit"]


@pytest.mark.parametrize(("period", "quantile"), [(1.3e-3, 0.8), (5e-3, 0.4), (2e-4, 0.9)])
def test_a_limit_shows_with_its_period(moving, period, quantile):
    passed, most = limited(moving, period, quantile)
    assert len(passed) < len(moving)
    entry = rate_limit(passed)
    assert entry.found
    assert entry.details["period"] == pytest.approx(period, abs=1e-9)
    assert entry.details["rate"] == pytest.approx(np.floor(most) / period, rel=2.0 / most)
    full = np.bincount((passed.t / period).astype(int)) >= np.floor(most) - 1
    assert entry.low <= full.mean() <= entry.high


def test_a_limit_shows_in_whole_microseconds_and_beside_leaks(moving):
    passed, _ = limited(moving, 2e-3, 0.6)
    rng = np.random.default_rng(2)
    t = rng.uniform(0, 0.7, len(passed) // 500)
    x, y = (rng.integers(0, size, len(t)).astype(np.uint16) for size in (passed.width, passed.height))
    more = Events(t, x, y, np.ones(len(t), bool), passed.width, passed.height)
    both = Events.concatenate([passed, more])
    both = both.select(np.argsort(both.t, kind="stable"))
    stamped = Events(np.floor(both.t * 1e6) * 1e-6, both.x, both.y, both.p, both.width, both.height)
    assert rate_limit(stamped).details.get("period") == pytest.approx(2e-3, abs=1e-9)


def test_the_answer_does_not_depend_on_how_events_are_cut(moving):
    passed, _ = limited(moving, 1.3e-3, 0.8)
    whole = dase.find_signatures(passed)["rate limit"]
    assert whole == dase.find_signatures(passed, chunk=777)["rate limit"]


def test_a_limit_is_no_full_bus(moving):
    passed, _ = limited(moving, 5e-3, 0.1)
    found = dase.find_signatures(passed)
    assert found["rate limit"].found
    assert not found["full bus"].found


def test_scenes_have_none(moving):
    assert not rate_limit(moving).found


def test_noise_has_none():
    rng = np.random.default_rng(4)
    count = 200_000
    x, y = (rng.integers(0, size, count).astype(np.uint16) for size in (64, 48))
    noise = Events(np.sort(rng.uniform(0, 1, count)), x, y, rng.random(count) < 0.5, 64, 48)
    assert not rate_limit(noise).found


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_full_bus_has_none(moving, share):
    rate = share * np.quantile(np.bincount((moving.t / 1e-3).astype(int)), 0.9) * 1e3
    sent, _ = Readout(rate=rate).reader(moving.width, moving.height, 0).push(moving, np.inf)
    assert not rate_limit(sent).found


def test_a_scene_that_comes_again_has_none(moving):
    turn = moving.select((moving.t > 0.1) & (moving.t < 0.112))
    at = np.round((turn.t - 0.1) * 1e6) * 1e-6
    again = [Events(at + 0.012 * n, turn.x, turn.y, turn.p, turn.width, turn.height) for n in range(60)]
    assert not rate_limit(Events.concatenate(again)).found


def test_pixels_that_send_once_for_each_frame_have_none():
    """As those of a simulator do whose light flashes: all of them, at times of their own."""
    rng = np.random.default_rng(5)
    y, x = (a.ravel().astype(np.uint16) for a in np.mgrid[:48, :64])
    flashes = []
    for n in range(100):
        if n % 2:
            t = np.sort(rng.uniform(0, 4e-3, len(x)))
            order = rng.permutation(len(x))
            flashes.append(Events(5e-3 * n + t, x[order], y[order], np.ones(len(x), bool), 64, 48))
        elif n % 4:
            some = rng.permutation(len(x))[: rng.integers(100, 2000)]
            t = np.sort(rng.uniform(0, 4e-3, len(some)))
            flashes.append(Events(5e-3 * n + t, x[some], y[some], np.zeros(len(some), bool), 64, 48))
    assert not rate_limit(Events.concatenate(flashes)).found
