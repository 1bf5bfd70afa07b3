"""Models and their errors as the search for effects sees them, without any simulation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from dase.effects import EFFECTS
from dase.fitting.model import FittedModel, model_of
from dase.simulation.sensor import Sensor

GATE = 1.2


def model_with(*names: str) -> FittedModel:
    """Return an unfitted model with some effects at their defaults."""
    sensor = Sensor()
    for name in names:
        sensor = sensor.with_effect(EFFECTS[name]())
    return model_of(sensor)


def judged(error: float) -> Any:
    """Return what a judgement is asked for."""
    return SimpleNamespace(error=error, gate=GATE, level=0.2, reach=0.5, families={})
