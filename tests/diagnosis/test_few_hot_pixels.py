"""Hot pixels that are too few for a fit are left out of it and counted among all pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.few_hot_pixels import beyond_the_model, few_hot_pixels, hot_effect_of
from dase.diagnosis.seen_effects import SeenEffects, find_seen_effects
from dase.effects import EFFECTS
from dase.fitting.measurement import Measurement, camera_scene, static_scene
from dase.results import Finding, Grade
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

LIBRARY = {name: EFFECTS[name] for name in ("threshold", "shot", "leak", "hot")}
HOT = EFFECTS["hot"](share=4e-4, rate=300.0, spread=1.2, balance=0.7)


@pytest.fixture(scope="module")
def events() -> dase.Events:
    """Of a large sensor at rest: noise, and a dozen hot pixels, of which 400 would have a sixth of one."""
    scene = dase.VideoScene(np.full((2, 160, 200), 0.5, np.float32), [0.0, 1.5])
    sensor = Sensor().with_effect(EFFECTS["shot"](rate=4.0)).with_effect(HOT)
    return dase.simulate(scene, sensor, seed=2)


def test_few_hot_pixels_are_counted_and_their_law_is_found(events):
    scene = static_scene(events)
    seen = find_seen_effects(Measurement(events, scene), LIBRARY)
    pixels = few_hot_pixels(seen, events, 400)
    assert pixels is not None
    busy = np.bincount(events.y.astype(np.int64) * events.width + events.x, minlength=200 * 160)
    assert np.isin(np.flatnonzero(busy > 100), pixels).mean() > 0.7
    assert busy[pixels].min() > 3 * busy.mean()
    _, values = hot_effect_of(events, pixels)
    for name in ("share", "rate", "spread", "balance"):
        value = values[f"hot.{name}"]
        # few pixels tell little, and those that are hardly hot are not among them
        assert value.low / 1.5 <= getattr(HOT, name) <= 1.5 * value.high, name
    # where a part has many of them, a fit tells more
    assert few_hot_pixels(seen, events, 20_000) is None


def test_noise_is_found_beside_a_few_hot_pixels(events):
    scene = static_scene(events)
    found = diagnose(events, scene=scene, effects=LIBRARY, pixels=400, most=2, settings=NO_LIMITS)
    grades = {one.effect: str(one.grade) for one in found.findings}
    assert grades["hot"] == "certain"
    assert "hot" in found.selected
    assert "hot" in found.sensor
    assert "shot" in found.selected
    assert found.errors[-1] < found.gate
    assert any("left out" in note for note in found.notes)


def test_pixels_that_send_as_much_by_their_light_are_not_hot():
    """Four pixels have light that changes, four send where it rests."""
    light = np.full((301, 20, 20), 0.3, np.float32)
    light[:, 4, :4] += 0.2 * np.sin(np.arange(301) * 0.4, dtype=np.float32)[:, None]
    scene = dase.VideoScene(light, np.linspace(0.0, 1.5, 301))
    sent = dase.simulate(scene, Sensor(), seed=1)
    lit, dark = 4 * 20 + np.arange(4), 10 * 20 + np.arange(4)
    own = dase.Events(
        np.linspace(0.1, 1.4, 400), np.arange(400) % 4, np.full(400, 10), np.ones(400, bool), 20, 20
    )
    both = dase.Events.concatenate([sent, own])
    measurement = Measurement(both.select(np.argsort(both.t, kind="stable")), scene)
    left = beyond_the_model(measurement, np.concatenate([lit, dark]), Sensor(), seed=0)
    np.testing.assert_array_equal(left, dark)
    camera = replace(
        measurement,
        scene=camera_scene(
            np.full((3, 20, 20), 80, np.uint8), *np.array([[0.0, 0.5, 1.0], [0.1, 0.6, 1.1]]), []
        ),
    )
    assert len(beyond_the_model(camera, lit, Sensor(), seed=0)) == 4


def test_hot_pixels_of_which_none_stands_out_may_be_something_else():
    fitted = Finding("hot", Grade.SUPPORTED)
    entry = Signature(name="hot pixels", answer=Answer.NOT_SEEN, sentence="none")
    for absent, grade in (((entry,), Grade.EITHER), ((), Grade.SUPPORTED)):
        (said,) = SeenEffects(absent=absent).findings([fitted], ())
        assert (said.grade, said.unknown) == (grade, grade is Grade.EITHER)
