"""Pixels that forget send ON events while their light rests, which is no leak."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from dase.diagnosis import seen_beside_model
from dase.diagnosis.seen_beside_model import settle_leak
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.signatures.kinds import DRIFTING_MEMORY, HOT_PIXELS, LEAK_EVENTS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

LEAK = Signature(name=LEAK_EVENTS, answer=Answer.FOUND, sentence="ON events at rest", size=5.8)
DRIFT = Signature(name=DRIFTING_MEMORY, answer=Answer.FOUND, sentence="thresholds drift")
HOT = Signature(name=HOT_PIXELS, answer=Answer.FOUND, sentence="some send more")


@pytest.mark.parametrize("entry", [LEAK, DRIFT])
@pytest.mark.parametrize("leaks", [False, True])
@pytest.mark.parametrize(
    ("added", "shows_without", "stays"),
    [(("high_pass",), False, False), (("high_pass",), True, True), (("shot",), False, True)],
)
def test_a_leak_is_none_if_the_model_that_forgets_shows_it(
    monkeypatch, entry, leaks, added, shows_without, stays
):
    """One of 5.8 Hz was certain beside a high-pass of 0.6 Hz, which was found afterwards."""
    asked = []

    def look(given, sensor, **more):
        asked.append(sensor)
        return entry if shows_without else None

    monkeypatch.setattr(seen_beside_model, "find_events_at_rest", look)
    monkeypatch.setattr(seen_beside_model, "find_drifting_memory", look)
    monkeypatch.setattr(seen_beside_model.LightBetweenEvents, "of", lambda *given, **more: "light")
    task = SimpleNamespace(added_to=lambda model: added, evidence=SimpleNamespace(structure=None), seed=0)
    sensor = Sensor().with_effect(EFFECTS["high_pass"](cutoff=0.6))
    model = SimpleNamespace(sensor=sensor.with_effect(EFFECTS["leak"](rate=1.0)) if leaks else sensor)
    seen = settle_leak(task, SeenEffects((HOT, replace(entry, size=5.8))), None, model)
    assert [one.name for one in seen.entries] == ([HOT_PIXELS, entry.name] if stays else [HOT_PIXELS])
    assert len(asked) == ("high_pass" in added)
    assert all("leak" not in one for one in asked)
