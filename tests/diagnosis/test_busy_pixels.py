"""Hot pixels where light changes everywhere, which the scene tells and events alone do not."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.diagnosis.busy_pixels import find_busy_pixels
from dase.diagnosis.seen_effects import find_seen_effects
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene
from dase.signatures.kinds import HOT_PIXELS
from perf.experiments.signatures.run import draw_scene

BARE = dase.Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.22))


def events_of(scene, seed, **effects):
    sensor = BARE
    for name, values in effects.items():
        sensor = sensor.with_effect(EFFECTS[name](**values))
    return dase.simulate(scene, sensor, seed=seed)


def with_hot(events, rng, places, rate):
    """Events with some more, at any time, of some pixels, shape (K, 2)."""
    more = [events]
    for x, y in places:
        t = rng.uniform(events.t[0], events.t[-1], rng.poisson(rate * (events.t[-1] - events.t[0])))
        at = (np.full(len(t), value, np.uint16) for value in (x, y))
        more.append(Events(t, *at, rng.random(len(t)) < 0.5, events.width, events.height))
    both = Events.concatenate(more)
    return both.select(np.argsort(both.t, kind="stable"))


@pytest.fixture(scope="module", params=["turn", "pan"])
def scene(request):
    return draw_scene(np.random.default_rng(31), request.param, 0.7)


def test_hot_pixels_show_amid_others_that_send(scene):
    rng = np.random.default_rng(2)
    plain = events_of(scene, 31)
    counts = np.bincount(plain.y.astype(int) * plain.width + plain.x, minlength=plain.width * plain.height)
    places = np.array([[20, 15], [60, 40], [100, 70], [90, 20]])
    rate = 4 * max(counts.mean(), 20) / 0.7
    entry = find_busy_pixels(with_hot(plain, rng, places, rate), scene)
    assert entry.found
    assert entry.details["pixels"] == sorted(places.tolist(), key=lambda place: place[1] * 120 + place[0])
    assert not find_busy_pixels(plain, scene).found
    # two may be spots
    assert not find_busy_pixels(with_hot(plain, rng, places[:2], rate), scene).found


@pytest.mark.parametrize(
    "effects",
    [
        {"mismatch": {"spread": 0.3}},
        {"mismatch": {"spread": 0.15}, "voltage_noise": {"sigma": 0.06}},
        {"mismatch": {"spread": 0.2}, "shot": {"rate": 10.0}},
    ],
)
def test_thresholds_that_differ_are_no_hot_pixels(scene, effects):
    assert not find_busy_pixels(events_of(scene, 32, **effects), scene).found


def test_pixels_that_send_with_their_light_are_not_hot(scene):
    """Those of low thresholds: each of their events comes several times, a bit later."""
    plain = events_of(scene, 33)
    chosen = np.isin(plain.y.astype(int) * plain.width + plain.x, [3030, 5060, 7590, 8888])
    led = plain.select(chosen)
    later = [
        Events(led.t + 2e-4 * n, led.x, led.y, led.p, led.width, led.height).select(led.t < 0.68)
        for n in range(1, 9)
    ]
    both = Events.concatenate([plain, *later])
    assert not find_busy_pixels(both.select(np.argsort(both.t, kind="stable")), scene).found


def test_a_diagnosis_knows_them_where_events_alone_say_nothing():
    """Fine stripes pass everywhere, so no place is ever calm."""
    rng = np.random.default_rng(4)
    times = np.linspace(0, 0.6, 301)
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    wave = np.sin((x + 0.7 * y)[None] * 0.9 - 2 * np.pi * 12 * times[:, None, None])
    slow = np.sin(2 * np.pi * (x / 40 + y / 60)[None] - 2 * np.pi * 3 * times[:, None, None])
    scene = VideoScene((0.4 + 0.2 * wave + 0.15 * slow).astype(np.float32), times)
    plain = events_of(scene, 5)
    places = np.array([[10, 10], [30, 20], [50, 30]])
    events = with_hot(plain, rng, places, 1000.0)
    assert not dase.find_signatures(events)["hot pixels"].found
    seen = find_seen_effects(Measurement(events, scene), EFFECTS)
    entry = seen.entry_of(HOT_PIXELS)
    assert entry is not None
    assert entry.details["pixels"] == places.tolist()
    assert "hot" in seen.effects
    assert find_seen_effects(Measurement(plain, scene), EFFECTS).entry_of(HOT_PIXELS) is None
