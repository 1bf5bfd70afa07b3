"""Greys of many pictures at once are those of one picture, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from dase.io.image_files import to_grey, weights_of
from dase.kernels.picture_grey import write_greys


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (23, 37)])
def test_greys_equal_those_of_numpy(rng, shape):
    pictures = [rng.integers(0, 256, (*shape, 3), np.uint8) for _ in range(7)]
    greys = np.full((7, *shape), np.nan, np.float32)
    order = [4, 0, 6, 1, 2, 5, 3]  # they may lie anywhere
    write_greys([pictures[i] for i in order], weights_of(pictures[0]), [greys[i] for i in order])
    np.testing.assert_array_equal(greys, [to_grey(picture)[0] for picture in pictures])


def test_every_level_of_each_colour_is_weighed_alike():
    levels = np.arange(256, dtype=np.uint8)
    for channel in range(3):
        picture = np.zeros((1, 256, 3), np.uint8)
        picture[0, :, channel] = levels
        grey = np.empty((1, 256), np.float32)
        write_greys([picture], weights_of(picture), [grey])
        np.testing.assert_array_equal(grey, to_grey(picture)[0])
