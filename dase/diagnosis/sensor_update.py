"""Sensor files that a fit or a diagnosis changes: fitted values, and how they came to be."""

from __future__ import annotations

from dataclasses import replace

from dase.results import Diagnosis, Fit
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_edit import SensorText, history_entry_today


def round_parameters(sensor: Sensor, digits: int = 4) -> Sensor:
    """Return a fitted sensor with values that people can read."""
    for effect in sensor.effects:
        values = {p.name: float(f"{getattr(effect, p.name):.{digits}g}") for p in effect.parameters()}
        sensor = sensor.with_effect(replace(effect, **values))
    return sensor


def with_fit(text: SensorText, found: Fit, recording: str) -> SensorText:
    """Return a sensor file with fitted values, and the fall of the error in its history."""
    facts = {
        "error_before": round(found.before, 3),
        "error_after": round(found.error, 3),
        "floor": found.floor,
    }
    entry = history_entry_today("fit", recording=recording, **facts)
    return text.describing(round_parameters(found.sensor)).with_history(entry)


def with_diagnosis(text: SensorText, found: Diagnosis, recording: str) -> SensorText:
    """Return a sensor file with the effects that a diagnosis found, and the error after each as history."""
    text = text.describing(round_parameters(found.sensor))
    steps = ["fit", *(f"add {name}" for name in found.selected)]
    errors = [round(error, 3) for error in (found.before, *found.errors)]
    for did, before, after in zip(steps, errors, errors[1:], strict=False):
        facts = {"error_before": before, "error_after": after, "floor": found.floor}
        text = text.with_history(history_entry_today(did, recording=recording, **facts))
    return text
