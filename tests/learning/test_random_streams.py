"""Results of trainings can be repeated for as long as seeds of their parts stay as they are."""

from __future__ import annotations

import numpy as np
import pytest

from dase.learning.random_streams import TrainingDraw, TrainingStream


def test_seeds_of_pytorch_stay_as_they_are():
    """The numbers are literal: another one here would be another training."""
    assert [(one.name, one.seed(5), one.seed(5, process=2)) for one in TrainingStream] == [
        ("WEIGHTS", 5, 2_000_011),
        ("NOISE", 6, 2_000_012),
        ("CRITICS", 7, 2_000_013),
        ("KNOWN_PHYSICS", 8, 2_000_014),
    ]


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (TrainingDraw.TEXTURES.generator(5), [5, 0]),
        (TrainingDraw.SCENES.generator(5), [5, 1]),
        (TrainingDraw.SCENES.generator(5, process=3), [5, 1, 3]),
        (TrainingDraw.TARGETS_SCENES.generator(5), [5, 2]),
        (TrainingDraw.SIMULATED_TARGET.generator(5), [5, 4]),
    ],
)
def test_generators_of_numpy_stay_as_they_are(draw, words):
    assert draw.random() == np.random.default_rng(words).random()
