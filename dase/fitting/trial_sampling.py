"""How finely models under trial are sampled in time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Effect
from dase.simulation.sensor import Sensor

SAMPLES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 80, 96, 128, 160, 192)
"""Samples per step that are taken: few numbers, so that models run together, and that neighbours of a descent
mostly share their random numbers."""
DENSEST = 96e3
"""Samples per second that are not exceeded [Hz]. Of what is plausible, voltage noise of 3 kHz needs 24e3, and
94e3 with two poles of which one follows the light (at a knee of 0.1); pulses of 50 us need 80e3."""
FINE = 24
"""Samples per step that are taken in short steps, too, and of what is beyond the plausible."""
SCREENING_SAMPLES = 4
"""The most by which candidates are screened: right for voltage noise of 500 Hz and lamps of 250 Hz at 1 ms,
rough for faster ones. Those that go on are sampled as they need when they are fitted and judged."""


def samples_per_step(sensor: Sensor, step: float) -> int:
    """Return how many samples per step a model needs, 0 where those at changes of the light do.

    Args:
        sensor: The model.
        step: Of the grid [s].
    """
    if sensor.knows_samples_alone:
        return 1
    return _at_least(max(_wanted(effect, step) for effect in sensor.effects))


def samples_of_screening(present: Sensor, step: float) -> int:
    """Return the most samples per step that models beside a present one take while they are screened.

    No fewer than the present model needs, by whose statistics they are measured: it has lost no events, and
    candidates that made up for events lost between samples would look better than they are.

    Args:
        present: The present model.
        step: Of the grid [s].
    """
    return max(SCREENING_SAMPLES, samples_per_step(present, step))


def samples_per_step_of_rows(sensor: Sensor, vectors: NDArray[Any], step: float) -> NDArray[np.int64]:
    """Return how many samples per step each of some models needs, shape (B,).

    Args:
        sensor: Names the effects.
        vectors: Parameters of the models, shape (B, P).
        step: Of the grid [s].
    """
    if sensor.knows_samples_alone:
        return np.ones(len(vectors), np.int64)
    names = sensor.parameter_names()
    # most effects are seen as well at any sampling
    asking = [e for e in sensor.effects if type(e).longest_step is not Effect.longest_step]
    inside = [e for e in asking if all(f"{e.name}.{p.name}" in names for p in e.parameters())]
    wanted = [max((_wanted(e, step) for e in asking if e not in inside), default=0.0)] * len(vectors)
    for effect in inside:
        columns = [names.index(f"{effect.name}.{p.name}") for p in effect.parameters()]
        for row, values in enumerate(vectors[:, columns].tolist()):
            # float32 may have rounded a value out of its bounds
            within = {
                p.name: float(np.clip(v, *p.bounds)) for p, v in zip(effect.parameters(), values, strict=True)
            }
            wanted[row] = max(wanted[row], _wanted(replace(effect, **within), step))
    return np.array([_at_least(one) for one in wanted], np.int64)


def _wanted(effect: Effect, step: float) -> float:
    """Return how many samples per step show an effect, 0 where those at changes of the light do."""
    wanted = step / effect.longest_step()
    if wanted <= FINE:
        return wanted
    # what nothing is known to have does not make fits slower than what is plausible
    near = {p.name: float(np.clip(getattr(effect, p.name), *p.plausible)) for p in effect.parameters()}
    likely = step / replace(effect, **near).longest_step()
    return min(wanted, max(FINE, min(likely, DENSEST * step)))


def _at_least(samples: float) -> int:
    """Return the fewest samples per step that are as many, the most there are if none is, and 0 for 0."""
    if samples == 0:
        return 0
    # a ratio that is whole but for rounding does not take one sample more
    return next((n for n in SAMPLES if n >= samples - 1e-6), SAMPLES[-1])
