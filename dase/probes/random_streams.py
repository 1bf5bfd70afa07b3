"""Which random numbers are for what, so that no two purposes share any and results can be repeated."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class SimulationStream(IntEnum):
    """What simulations are for; the number is added to the user's seed.

    Models that are compared with one another share their random numbers, so that only what they differ in
    shows. Repeats that calibrate or judge a model must not be those by which it was fitted.
    """

    FIT = 0
    """Populations of a descent."""
    CALIBRATE_FIT = 100
    """Repeats of a model under fit, which give its sampling errors."""
    CALIBRATE_SCOUT = 200
    """Repeats of the present model on the scout."""
    CALIBRATE_PRESENT = 300
    """Repeats of the present model on the training half, which stand in for the measurement in a test."""
    JUDGE = 500
    """Repeats of a model on the held-out half."""
    CLOUD = 700
    """Repeats in which a closer look sees what chance does."""
    DIRECTIONS = 900
    """Means of models, which give the ways on which a closer look is taken."""
    CONFIDENCE = 900
    """Repeats of the fitted model that give its intervals; a hundred further for each last step."""

    def seed(self, seed: int, turn: int = 0) -> int:
        """Return the seed of this purpose for a user's seed; `turn` counts repetitions of the purpose."""
        return seed + int(self) + 100 * turn


class Draw(IntEnum):
    """What is drawn on the host; the number is the second word of the generator's seed."""

    PIXELS = 1
    OTHER_PIXELS = 2
    TOLERANCE = 3
    POPULATION = 7
    FAR_START = 11
    SLOPES = 13

    def generator(self, seed: int) -> np.random.Generator:
        """Return the random numbers of this purpose for a user's seed."""
        return np.random.default_rng([seed, int(self)])
