"""Thresholds that differ are told by how far light goes from event to event, whatever a model fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import HEIGHT, WIDTH, counted_between_frames, shaken_texture
from helpers.own_effects import effect_that_makes

import dase
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.unequal_thresholds import (
    UNEQUAL,
    _pattern_of,
    find_unequal_thresholds,
    patterns_of,
)
from dase.effects import EFFECTS
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.results import Finding, Grade
from dase.signatures.kinds import UNEQUAL_THRESHOLDS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor


def found(scene, events, sensor=None, **more):
    sensor = sensor or Sensor()
    light = LightBetweenEvents.of(Measurement(events, scene), log_eps=sensor.log_eps)
    return light and find_unequal_thresholds(light, sensor, seed=0, **more)


def patterns(scene, events):
    light = LightBetweenEvents.of(Measurement(events, scene), log_eps=1e-3)
    assert light.shape == (HEIGHT, WIDTH)
    return patterns_of(light.seen, light.shape)


@pytest.fixture(scope="module")
def scene():
    return shaken_texture()


@pytest.mark.parametrize("spread", [0.06, 0.12, 0.25])
def test_the_spread_is_that_of_the_thresholds(scene, spread):
    sensor = Sensor().with_effect(EFFECTS["mismatch"](spread=spread))
    entry = found(scene, dase.simulate(scene, sensor, seed=1))
    assert entry.found
    assert entry.name == UNEQUAL_THRESHOLDS
    assert entry.size == pytest.approx(spread, rel=0.3)
    assert entry.low <= entry.size <= entry.high


@pytest.mark.parametrize("leak", [0.0, 2.0])
def test_another_simulator_shows_it_as_well(scene, leak):
    entry = found(scene, counted_between_frames(scene, 0.12, leak=leak))
    assert entry is not None
    assert entry.size == pytest.approx(0.12, rel=0.3)
    assert found(scene, counted_between_frames(scene, 0.0, leak=leak)) is None


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("bandwidth", {"cutoff": 20.0}),
        ("dark", {"current": 0.05, "spread": 0.5}),
        ("dead", {"share": 0.03}),
        ("hot", {"share": 0.02, "rate": 200.0}),
        ("jitter", {"spread": 0.3}),
        ("latency", {"delay": 5e-3}),
        ("leak", {"rate": 4.0}),
        ("linlog", {"knee": 0.16, "slope": 2.5}),
        ("refractory", {"period": 8e-3, "mode": "reset"}),
        ("refractory", {"period": 8e-3, "mode": "drop"}),
        ("shot", {"rate": 10.0}),
        ("vignetting", {"loss": 0.8}),
        ("voltage_noise", {"sigma": 0.1, "cutoff": 50.0}),
    ],
)
def test_what_leaves_thresholds_alike_is_not_taken_for_it(scene, name, values):
    sensor = Sensor().with_effect(EFFECTS[name](**values))
    assert found(scene, dase.simulate(scene, sensor, seed=1)) is None


def test_what_both_polarities_share_may_be_of_the_light(scene):
    """A dark current that differs from pixel to pixel looks like it."""
    events = counted_between_frames(scene, 0.12, same=True)
    same = patterns(scene, events)
    assert all(one.differs(UNEQUAL) for one in same)
    assert same[0].shared_with(same[1]) > 0.8
    assert found(scene, events) is None
    apart = patterns(scene, counted_between_frames(scene, 0.12))
    assert apart[0].shared_with(apart[1]) < 0.3


def test_a_model_that_shows_it_by_itself_says_it_is_no_mismatch(scene, monkeypatch):
    events = counted_between_frames(scene, 0.12)
    assert found(scene, events) is not None
    monkeypatch.setattr("dase.diagnosis.light_between_events.simulate", lambda *_, **__: events)
    assert found(scene, events) is None


def at_random(shared: bool, spread: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of 12 events each, and how far each was off, alike in patches of 6x6 pixels if shared."""
    rng = np.random.default_rng(0)
    own = rng.standard_normal((10, 12)).repeat(6, 0).repeat(6, 1) if shared else rng.standard_normal((60, 72))
    pixel = np.arange(60 * 72).repeat(12)
    return pixel, spread * own.reshape(-1)[pixel] + 0.2 * rng.standard_normal(len(pixel))


def test_what_neighbours_share_is_the_scene():
    alone = _pattern_of(*at_random(False), (60, 72), UNEQUAL)
    assert alone.differs(UNEQUAL)
    assert abs(alone.shared) < 0.1
    patches = _pattern_of(*at_random(True), (60, 72), UNEQUAL)
    assert patches.shared > 0.5
    assert not patches.differs(UNEQUAL)


def test_few_pixels_or_small_spreads_tell_nothing(scene):
    pattern = _pattern_of(*at_random(False), (60, 72), UNEQUAL)
    assert not replace(pattern, pixels=UNEQUAL.pixels - 1).differs(UNEQUAL)
    assert not replace(pattern, spread=0.9 * UNEQUAL.least).differs(UNEQUAL)
    events = counted_between_frames(scene, 0.12)
    few = events.select((events.x < 12) & (events.y < 12))
    assert found(scene, few) is None
    assert found(scene, events.select(events.p)) is None
    assert found(scene, Events.empty(WIDTH, HEIGHT)) is None


def test_a_part_of_the_rows_tells_as_well(scene, monkeypatch):
    events = counted_between_frames(scene, 0.12)
    whole = found(scene, events)
    monkeypatch.setattr("dase.diagnosis.light_between_events.busiest_rows", lambda *_: (9, 33))
    entry = found(scene, events)
    assert entry.details["pixels"] < 0.6 * whole.details["pixels"]
    assert entry.size == pytest.approx(0.12, rel=0.3)


def test_it_is_said_in_place_of_the_fixed_pattern():
    own = Signature(name=UNEQUAL_THRESHOLDS, answer=Answer.FOUND, sentence="own")
    pattern = Signature(name="fixed pattern", answer=Answer.FOUND, sentence="pattern")
    (said,) = SeenEffects((pattern, own)).findings([], ())
    assert (said.effect, said.grade, said.seen) == ("mismatch", Grade.CERTAIN, "own")
    # an effect of the user's own may make it
    seen = SeenEffects((own,), library=EFFECTS | {"popping": effect_that_makes("popping")})
    assert seen.named_by(own) == ()
    mine = Finding("popping", Grade.SUPPORTED)
    assert seen.findings([mine], ()) == [mine]


@pytest.mark.slow
def test_a_mismatch_beside_a_leak_of_another_simulator_is_certain(scene):
    events = counted_between_frames(scene, 0.06, leak=2.0)
    library = {name: EFFECTS[name] for name in ("threshold", "mismatch", "leak", "jitter", "linlog", "shot")}
    found = dase.diagnose(events, scene=scene, effects=library, pixels=120, settings=NO_LIMITS)
    said = {one.effect: one for one in found.findings}
    assert said["mismatch"].grade is Grade.CERTAIN
    assert found.parameters["mismatch.spread"].value == pytest.approx(0.06, rel=0.5)
