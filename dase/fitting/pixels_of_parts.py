"""Which pixels are in which part of a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.fitting.compared_time import ComparedTime
from dase.fitting.pixel_selection import choose_trusted_pixels, find_trusted_parts
from dase.probes.random_streams import Draw
from dase.probes.stimulus import Trust

Array = NDArray[np.float64]

PARTS = 3
"""Groups of pixels: those that are fitted, that choose between models, and that report."""


@dataclass(frozen=True, eq=False)
class PixelsOfParts:
    """Pixels of all parts of a measurement, as many in each.

    Args:
        numbers: Row-major indices, those of one part after the other, shape (PARTS N,).
        trust: Where and when the scene is to be trusted, at odd pixels never; None for everywhere.
        notes: What is said of the choice.
    """

    numbers: NDArray[np.int32]
    trust: Trust | None = None
    notes: tuple[str, ...] = ()

    @property
    def each(self) -> int:
        """Pixels N of a part."""
        return len(self.numbers) // PARTS

    def parts(self) -> list[slice]:
        """Return where the pixels of each part are among all."""
        return [slice(n * self.each, (n + 1) * self.each) for n in range(PARTS)]


def choose_pixels(
    time: ComparedTime,
    cut: int,
    *,
    odd_pixels: NDArray[np.int64] | None,
    most: int,
    least: int,
    seed: int,
) -> PixelsOfParts:
    """Choose the pixels of the parts: by chance, or by what the scene does where it can be trusted.

    Args:
        time: That is compared.
        cut: The step at which the time begins that judges.
        odd_pixels: Row-major indices of pixels that are not chosen, shape (K,); None for none.
        most: Pixels in each part; there are fewer where the sensor has fewer, or fewer can be trusted.
        least: Pixels in each part without which nothing is compared.
        seed: Of the choice.

    Raises:
        InputError: There are next to none.
    """
    width, height, trust = time.scene.width, time.scene.height, time.trust
    size = width * height
    each = min(most, (size - (0 if odd_pixels is None else len(odd_pixels))) // PARTS)
    if each < least:
        raise InputError(
            f"a diagnosis needs at least {least} pixels to fit, as many to choose by and as "
            f"many to report by, got {most} of {width}x{height}"
        )
    # a stream of its own: the same pixels are chosen whatever else is drawn from the seed
    rng = Draw.PIXELS.generator(seed)
    if trust is None:
        # other pixels judge: fixed patterns, such as mismatch, would be known from the fitted ones
        order = rng.permutation(size)
        if odd_pixels is not None:
            order = order[~np.isin(order, odd_pixels)]
        return PixelsOfParts(order[: PARTS * each].astype(np.int32))
    if odd_pixels is not None:
        trust = partial(_trust_but_in, odd_pixels, trust)
    looks = find_trusted_parts(time.events, time.scene, time.times, cut, trust)
    chosen = choose_trusted_pixels(looks, each, rng, least=least)
    return PixelsOfParts(chosen, trust, (looks.sentence(),))


def _trust_but_in(
    odd_pixels: NDArray[np.int64], trust: Trust, times: Array, pixels: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return what a trust says, and that some pixels are not to be trusted, shape (T, N)."""
    return trust(times, pixels) & ~np.isin(pixels, odd_pixels)
