"""Settings for diagnoses of which only is asked what they find."""

from __future__ import annotations

from dataclasses import replace

from dase.diagnosis.settings import DEFAULTS

NO_LIMITS = replace(
    DEFAULTS,
    detection=replace(
        DEFAULTS.detection, repeats=1, measurements=2, strengths=1, strengths_at_once=1, turns=1
    ),
)
"""What would have been seen beside it is hardly looked for: up to a sixth of the time of a diagnosis."""
