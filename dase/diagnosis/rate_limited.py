"""Recordings whose rate of events is limited in periods: the sensor has the limit before any fit.

Which events a limit leaves out depends on all pixels and not on light, and no fit of another effect makes up
for it. Both numbers of it are seen exactly, so nothing of it is left to fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dase.diagnosis.compared_measurement import ComparedMeasurement
from dase.diagnosis.seen_effects import shows_in
from dase.effects import EFFECTS, Effect
from dase.effects.made_signatures import makers_of
from dase.effects.rate_control import RateControl
from dase.fitting.frame_steps import frame_step_of
from dase.results import Diagnosis, Estimate, Finding, Grade
from dase.signatures.find import find_signatures
from dase.signatures.kinds import RATE_LIMIT
from dase.simulation.simulate import simulate


def limit_of_rate(compared: ComparedMeasurement, library: Mapping[str, type[Effect]]) -> RateControl | None:
    """Return the limit of the rate that is seen and not of the scene; None where there is none.

    Args:
        compared: The measurement.
        library: Effects that may be named, name to class.
    """
    entry, given = compared.seen.entry_of(RATE_LIMIT), compared.given
    makers = makers_of(RATE_LIMIT, {**EFFECTS, **library})
    if entry is None or RateControl.name not in library or any(name in given for name in makers):
        return None
    made = simulate(compared.measurement.scene, given, seed=compared.seed)
    if len(made) and shows_in(find_signatures(made).entries, entry):
        return None
    return RateControl(rate=entry.details["rate"], period=entry.details["period"], drop="last")


def with_limit_of_rate(found: Diagnosis, compared: ComparedMeasurement, limit: RateControl) -> Diagnosis:
    """Return a diagnosis that names the limit, which its model had from the beginning.

    Args:
        found: Made with the limit in the sensor.
        compared: The measurement, which shows the limit.
        limit: As it was seen.
    """
    entry = compared.seen.entry_of(RATE_LIMIT)
    assert entry is not None
    known = {
        f"{limit.name}.{name}": Estimate(value, value, value)
        for name, value in (("rate", limit.rate), ("period", limit.period))
    }
    certain = Finding(limit.name, Grade.CERTAIN, parameters=known, seen=entry.sentence)
    measurement = compared.measurement
    if measurement.held or frame_step_of(measurement.events, measurement.scene):
        # where times between frames are a simulator's own, which events come too late in a period is a guess
        doubtful = (
            replace(one, grade=Grade.EITHER, unknown=True) if one.grade is Grade.SUPPORTED else one
            for one in found.findings
        )
        found = replace(found, findings=tuple(doubtful))
    return replace(
        found,
        selected=(*found.selected, limit.name),
        errors=(*found.errors, found.errors[-1]),
        parameters={**found.parameters, **known},
        findings=(*found.findings, certain),
    )
