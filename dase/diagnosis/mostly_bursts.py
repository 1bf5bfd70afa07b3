"""Recordings of little but bursts in step with a camera's frames: nothing is left to compare without them.

Bursts are left out of all that is compared with models, as a rule. Where a camera rests, or its frames
disturb the pixels much, next to nothing lies between them. Then the effect that makes them is put into the
sensor first, and all events are compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dase.diagnosis.compared_measurement import ComparedMeasurement
from dase.effects import Effect
from dase.fitting.burst_strength import BurstStrength
from dase.fitting.data_split import SPLIT
from dase.fitting.pixels_of_parts import PARTS
from dase.results import Diagnosis, Finding, Grade
from dase.signatures.kinds import FRAME_COUPLING


@dataclass(frozen=True)
class MostlyBurstsSettings:
    """When a recording has little but bursts."""

    between: float = 0.2
    """Share of the events that lie between them, at most."""

    needed: float = 10.0
    """Events between them of the pixels that are compared, at most, in units of what a fit needs: it sees a
    third of these pixels, and a part of the time."""


MOSTLY_BURSTS = MostlyBurstsSettings()


def bursts_of_all_events(
    compared: ComparedMeasurement,
    library: Mapping[str, type[Effect]],
    settings: MostlyBurstsSettings = MOSTLY_BURSTS,
) -> BurstStrength | None:
    """Return the effect that makes nearly all events; None where enough of them lie between bursts.

    Args:
        compared: The measurement.
        library: Effects, name to class.
        settings: When that is so.
    """
    events = compared.measurement.compared_events()
    if compared.bursts is None or not len(events):
        return None
    between = len(events) - int(np.count_nonzero(compared.bursts.contains(events.t)))
    looked = min(PARTS * compared.pixels / (events.width * events.height), 1.0)
    if between > settings.between * len(events) or between * looked > settings.needed * SPLIT.least_events:
        return None
    return compared.strength_of_bursts(compared.seen, compared.given, library)


def with_bursts_of_all_events(
    found: Diagnosis, compared: ComparedMeasurement, strength: BurstStrength
) -> Diagnosis:
    """Return a diagnosis that says what makes the bursts, which its model had from the beginning.

    Args:
        found: Made with the effect in the sensor.
        compared: The measurement, without it.
        strength: The effect, as the bursts alone tell it.
    """
    entry, name = compared.seen.entry_of(FRAME_COUPLING), strength.effect.name
    assert entry is not None
    mine = {key: value for key, value in found.parameters.items() if key.startswith(f"{name}.")}
    certain = Finding(
        name, Grade.CERTAIN, error_without=strength.error_without, error_with=strength.error_with,
        parameters=mine or dict(strength.parameters), seen=entry.sentence,
    )  # fmt: skip
    return replace(
        found,
        selected=(*found.selected, name),
        errors=(*found.errors, found.errors[-1]),
        findings=(*found.findings, certain),
        notes=(*found.notes, "nearly all events lie in bursts that come with the frames, and are compared"),
    )
