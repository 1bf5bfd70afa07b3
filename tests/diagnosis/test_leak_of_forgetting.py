"""Pixels that forget send ON events while their light rests, which is no leak."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from dase.diagnosis import seen_beside_model
from dase.diagnosis.seen_beside_model import settle_leak
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.signatures.kinds import HOT_PIXELS, LEAK_EVENTS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

LEAK = Signature(name=LEAK_EVENTS, answer=Answer.FOUND, sentence="ON events at rest", size=5.8)
HOT = Signature(name=HOT_PIXELS, answer=Answer.FOUND, sentence="some send more")


@pytest.mark.parametrize(
    ("added", "shows_without", "stays"),
    [(("high_pass",), False, False), (("high_pass",), True, True), (("shot",), False, True)],
)
def test_a_leak_is_none_if_the_model_that_forgets_shows_it(monkeypatch, added, shows_without, stays):
    """One of 5.8 Hz was certain beside a high-pass of 0.6 Hz, which was found afterwards."""
    asked = []

    def look(task, seen, measurement, model):
        asked.append(model.sensor)
        entries = (*seen.entries, LEAK) if shows_without else seen.entries
        return SeenEffects(entries)

    monkeypatch.setattr(seen_beside_model, "_look_where_light_rests", look)
    monkeypatch.setattr(seen_beside_model, "_look_at_thresholds", lambda task, seen, measurement, model: seen)
    task = SimpleNamespace(added_to=lambda model: added)
    model = SimpleNamespace(sensor=Sensor().with_effect(EFFECTS["high_pass"](cutoff=0.6)))
    seen = settle_leak(task, SeenEffects((HOT, LEAK)), None, model)
    assert [one.name for one in seen.entries] == ([HOT_PIXELS, LEAK_EVENTS] if stays else [HOT_PIXELS])
    assert bool(asked) is ("high_pass" in added)
