"""Thresholds that are drawn anew make second events by themselves, which are no double events."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from dase.diagnosis.seen_beside_model import settle_doubles
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects import EFFECTS
from dase.signatures.kinds import DOUBLE_EVENTS, HOT_PIXELS
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

HOT = Signature(name=HOT_PIXELS, answer=Answer.FOUND, sentence="some send more")


@pytest.mark.parametrize(
    ("spread", "share", "stays"),
    [(0.43, 0.009, False), (0.43, 0.2, True), (0.1, 0.009, True), (None, 0.009, True)],
)
def test_as_many_as_a_wide_jitter_makes_are_none(spread, share, stays):
    """One of 47 % of IEBCS, fitted as 43 %, had *double events* of 0.9 % beside it, certain."""
    doubles = Signature(name=DOUBLE_EVENTS, answer=Answer.FOUND, sentence="twice", size=share)
    added = () if spread is None else ("jitter",)
    sensor = Sensor() if spread is None else Sensor().with_effect(EFFECTS["jitter"](spread=spread))
    task = SimpleNamespace(added_to=lambda model: added)
    seen = settle_doubles(task, SeenEffects((HOT, doubles)), SimpleNamespace(sensor=sensor))
    assert [one.name for one in seen.entries] == ([HOT_PIXELS, DOUBLE_EVENTS] if stays else [HOT_PIXELS])
