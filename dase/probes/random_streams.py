"""Which random numbers are for what, so that no two purposes share any and results can be repeated."""

from __future__ import annotations

from enum import Enum, IntEnum

import numpy as np


class SimulationStream(Enum):
    """What simulations are for: what is added to the user's seed, and what for each further turn.

    Models that are compared with one another share their random numbers, so that only what they differ in
    shows. Repeats that calibrate or judge a model must not be those by which it was fitted. The numbers are
    part of the results: a diagnosis can be repeated to the last digit as long as they stay as they are.
    """

    FIT = (0, 1)
    """Populations of a descent; a turn is a round of a refit, a start of a fit, or a last step."""
    DESCENT = (0, 10_007)
    """Descents of one refit: farther apart than the rounds of one are from each other."""
    CALIBRATE_FIT = (100, 0)
    """Repeats of a model under fit, which give its sampling errors."""
    CALIBRATE_SCOUT = (200, 0)
    """Repeats of the present model on the scout."""
    CALIBRATE_PRESENT = (300, 0)
    """Repeats of the present model on the training half, which stand in for the measurement in a test."""
    JUDGE = (500, 0)
    """Repeats of a model on the held-out half."""
    CLOUD = (700, 0)
    """Repeats in which a closer look sees what chance does."""
    DIRECTIONS = (900, 1)
    """Means of models, which give the ways on which a closer look is taken; a turn is a simulation of it."""
    CONFIDENCE = (900, 100)
    """Repeats of the fitted model that give its intervals; a turn is a last step."""
    SLOPES = (0, 10)
    """Slopes of statistics that intervals are taken from; a turn is a width at which they are seen."""
    SLOPE_MODELS = (1, 0)
    """Models that give these slopes."""
    SCENE_DOUBT = (1100, 1)
    """Events of a model over its own scene, and with a turn more the model over half of the frames."""
    DETECTION = (1300, 1)
    """Measurements with an effect that was not found; a turn is a strength."""
    DEAD_TIME = (1500, 0)
    """Events of a model without a dead time, of which short intervals are counted."""
    EVENTS_AT_REST = (1700, 0)
    """Events of a model where light rests."""
    UNEQUAL_THRESHOLDS = (1900, 0)
    """Events of a model with equal thresholds."""
    DRIFTING_MEMORY = (2100, 0)
    """Events of a model without a leak."""
    REDRAWN_THRESHOLDS = (2500, 0)
    """Events of a model whose thresholds stay as they are."""
    SILENT_PIXELS = (2300, 1)
    """Events of a model at pixels that are silent; a turn is a repeat."""
    HOT_PIXELS = (2700, 0)
    """Events of a model at pixels that seem to be hot."""
    STEPS_IN_THE_DARK = (2900, 0)
    """Events of a model whose response is the logarithm of light alone."""
    KINKED_RESPONSE = (3100, 0)
    """Events of a model whose response has no kink."""
    STIMULUS = (0, 1000)
    """Standard recordings; a turn is a stimulus."""
    RECORDING = (1, 500_000)
    """Recordings of a model that is told apart from another; a turn is a model, with room for all of its."""

    def __init__(self, distance: int, per_turn: int):
        self.distance, self.per_turn = distance, per_turn

    def seed(self, seed: int, turn: int = 0) -> int:
        """Return the seed of this purpose for a user's seed; `turn` counts repetitions of the purpose."""
        return seed + self.distance + self.per_turn * turn


class Draw(IntEnum):
    """What is drawn on the host; the number is the second word of the generator's seed."""

    PIXELS = 1
    """Which pixels are looked at, and the light of a standard recording."""
    OTHER_PIXELS = 2
    """Which pixels stand for all that are not looked at."""
    TOLERANCE = 3
    """By how much repeats are off by what is of no concern."""
    POPULATION = 7
    """Directions of the populations of a descent."""
    FAR_START = 11
    """Where further starts of a fit begin."""
    SLOPES = 13
    """Places at which slopes of statistics are seen."""

    PIXELS_OF_INTERVALS = 17
    """Pixels whose intervals are looked at one by one."""

    PIXELS_OF_RESTS = 19
    """Pixels of which it is asked when their light rests."""

    def generator(self, seed: int) -> np.random.Generator:
        """Return the random numbers of this purpose for a user's seed."""
        return np.random.default_rng([seed, int(self)])
