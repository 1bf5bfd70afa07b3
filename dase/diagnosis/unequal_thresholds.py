"""Thresholds that differ from pixel to pixel, by how far light went from one event of a pixel to the next.

That is the threshold, whatever the scene does and however badly a model fits: a pixel whose threshold is
higher waits longer each time. All that simulators and cameras do otherwise to it goes by how bright light
is, how fast it changes, and whether it has turned, so the mean of the events that are alike in these is taken
off. What is left is the same in the first half of a pixel's events and in the second if it is of the pixel.

What is left of the scene is the same in both halves, too, where the same edge comes back. But neighbours see
nearly the same, and no neighbour's threshold tells of a pixel's: so only what they do not share counts. A
model with equal thresholds over the same scene must not show it either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps, beyond_those_alike
from dase.effects.mismatch import Mismatch
from dase.errors import InputError
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.signatures import kinds
from dase.signatures.chance import NINETY, sign_flip_tail
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

EFFECT = Mismatch.name


@dataclass(frozen=True)
class UnequalSettings:
    """When thresholds differ.

    Chosen on sets a to c of other simulators and scenes of key `unequal-dev`.
    """

    least: float = 0.03
    """Spread of the thresholds, relative: steps of 8 bits and of frames look like 0.02."""

    alike: float = 0.3
    """What neighbours share of what stays, at most: of what the scene leaves they share most."""

    chance: float = 1e-6
    """Of as much where thresholds are equal."""

    model: float = 0.4
    """Spread that a model with equal thresholds may show, relative to what is seen."""

    pixels: int = 400
    """Pixels that have events of a polarity in both halves, at least."""

    longest: float = 0.05
    """Time from one event to the next that counts, at most [s]: leaks differ from pixel to pixel, too."""

    reach: float = 1.0
    """What one event may be off, relative to the threshold: noise comes however far light went."""

    odd: float = 0.05
    """Pixels that are most off and do not count: hot ones send before light has gone as far."""

    both: float = 0.5
    """What ON and OFF share of what stays, at most: transistors differ independently for either, and dark
    currents that differ from pixel to pixel act on both alike."""

    block: int = 8
    """[px] Neighbours share the scene: blocks are independent, pixels are not."""


UNEQUAL = UnequalSettings()


@dataclass(frozen=True, eq=False)
class Pattern:
    """What stays of the thresholds of the pixels for one polarity.

    Args:
        spread: Standard deviation over pixels, relative, beyond what neighbours share.
        low: Lower end of its 90 % interval.
        high: Upper end.
        shared: What neighbours share, relative to what stays.
        p: Chance of as much where thresholds are equal.
        pixels: How many tell.
        off: How far each pixel is off, relative to the threshold, shape (H, W).
        weight: Of each pixel, 0 where it does not count, shape (H, W).
    """

    spread: float
    low: float
    high: float
    shared: float
    p: float
    pixels: int
    off: Array
    weight: Array

    def differs(self, settings: UnequalSettings) -> bool:
        """Whether thresholds differ."""
        return (
            self.pixels >= settings.pixels
            and self.spread >= settings.least
            and self.shared <= settings.alike
            and self.p <= settings.chance
        )

    def shared_with(self, other: Pattern) -> float:
        """Return what stays of both polarities alike, relative to what stays of each."""
        weight = np.sqrt(self.weight * other.weight)
        alike = float((weight * self.off * other.off).sum()) / max(float(weight.sum()), 1e-9)
        return alike / max(self.spread * other.spread, 1e-9)


def find_unequal_thresholds(
    light: LightBetweenEvents, sensor: Sensor, *, seed: int, settings: UnequalSettings = UNEQUAL
) -> Signature | None:
    """Return how much the thresholds of pixels differ; None where they do not, or where nothing tells.

    Args:
        light: Of the measurement, whose scene is simulated.
        sensor: The model, taken with equal thresholds.
        seed: Of every random number.
        settings: When they differ.
    """
    seen = patterns_of(light.seen, light.shape, settings)
    if not seen or not all(one.differs(settings) for one in seen):
        return None
    if seen[0].shared_with(seen[1]) > settings.both:
        return None
    without = sensor.without(EFFECT) if EFFECT in sensor else sensor
    try:
        made = light.of_model(without, seed=SimulationStream.UNEQUAL_THRESHOLDS.seed(seed))
    except InputError:
        return None
    modelled = patterns_of(made, light.shape, settings)
    # a model that sends too little to tell says nothing against it
    if any(
        one.p <= 0.01 and one.spread > settings.model * other.spread
        for one, other in zip(modelled, seen, strict=False)
    ):
        return None
    spread = math.sqrt(sum(one.spread**2 for one in seen) / len(seen))
    sentence = (
        f"thresholds differ for good from pixel to pixel, by {format_percent(seen[0].spread)} (ON) and "
        f"{format_percent(seen[1].spread)} (OFF): light goes as much farther from one event to the next"
    )
    return Signature(
        name=kinds.UNEQUAL_THRESHOLDS, answer=Answer.FOUND, p=max(one.p for one in seen), size=spread,
        low=min(one.low for one in seen), high=max(one.high for one in seen),
        unit="spread of thresholds over pixels, relative", least=settings.least, sentence=sentence,
        details={"pixels": min(one.pixels for one in seen), "shared": max(one.shared for one in seen)},
    )  # fmt: skip


def patterns_of(
    steps: LightSteps, shape: tuple[int, int], settings: UnequalSettings = UNEQUAL
) -> tuple[Pattern, ...]:
    """Return what stays of the thresholds of pixels for ON and OFF; empty where either has too few events.

    Args:
        steps: From event to event.
        shape: Rows that are looked at, and columns.
        settings: What counts.
    """
    counts = steps.counts & (steps.gap < settings.longest)
    out = []
    for sign in (1, -1):
        used = counts & (steps.on == (sign > 0))
        moved = sign * steps.change[used]
        threshold = float(np.median(moved)) if len(moved) else 0.0
        if threshold <= 0:
            return ()
        off = np.clip(moved / threshold - 1, -settings.reach, settings.reach)
        fast = sign * steps.speed[used]
        off = beyond_those_alike(off, steps.level[used], fast, steps.again[used])
        found = _pattern_of(steps.pixel[used], off, shape, settings)
        if found.pixels < settings.pixels:
            return ()
        out.append(found)
    return tuple(out)


def _pattern_of(
    pixel: NDArray[np.int64], off: Array, shape: tuple[int, int], settings: UnequalSettings
) -> Pattern:
    """Return what the first half of each pixel's events and the second agree in, and its neighbours do not.

    Args:
        pixel: Of each event, row-major, ascending, shape (N,).
        off: How far each was off, relative to the threshold, shape (N,).
        shape: Rows and columns.
        settings: What counts.
    """
    size = shape[0] * shape[1]
    many = np.bincount(pixel, minlength=size)
    odd = np.abs(np.bincount(pixel, off, minlength=size)) / np.sqrt(np.maximum(many, 1))
    even = odd <= np.quantile(odd[many > 0], 1 - settings.odd) if len(pixel) else np.zeros(size, bool)
    rank = np.arange(len(pixel)) - (np.cumsum(many) - many)[pixel]
    later = rank >= (many[pixel] + 1) // 2
    parts = [part & even[pixel] for part in (~later, later)]
    count = np.stack([np.bincount(pixel[part], minlength=size) for part in parts])
    total = np.stack([np.bincount(pixel[part], off[part], minlength=size) for part in parts])
    first, second = (total / np.maximum(count, 1)).reshape(2, *shape)
    both = (count > 0).all(0)
    pixels = int(both.sum())
    if pixels < 2:
        return Pattern(0.0, 0.0, 0.0, 1.0, 1.0, pixels, np.zeros(shape), np.zeros(shape))
    weight = np.where(both, 1 / (1 / np.maximum(count[0], 1) + 1 / np.maximum(count[1], 1)), 0.0)
    weight = weight.reshape(shape)
    near, far = (_around(second, count[1].reshape(shape), shift) for shift in (1, 2))
    whole = float(weight.sum())
    stays, shared = (float((weight * first * other).sum()) / whole for other in (second, near))
    # what falls off evenly with distance is the scene's
    signal = weight * first * (second - (4 * near - far) / 3)
    blocks = _sum_blocks(signal, settings.block)
    p = max(sign_flip_tail(one) for one in (blocks, _sum_blocks(weight * first * second, settings.block)))
    mean, error = float(blocks.sum()) / whole, math.sqrt(float((blocks**2).sum())) / whole
    spread, low, high = (math.sqrt(max(mean + k * NINETY * error, 0.0)) for k in (0, -1, 1))
    of_all = (total.sum(0) / np.maximum(count.sum(0), 1)).reshape(shape)
    shared = shared / stays if stays > 0 else 1.0
    return Pattern(spread, low, high, shared, p, pixels, of_all, weight)


def _around(values: Array, count: NDArray[np.int64], shift: int) -> Array:
    """Return the mean over the events of the four pixels that far away, shape (H, W)."""
    total, events = np.zeros(values.shape), np.zeros(values.shape)
    for axis in (0, 1):
        for way in (shift, -shift):
            total += np.roll(values * count, way, axis)
            events += np.roll(count, way, axis)
    out: Array = total / np.maximum(events, 1)
    return out


def _sum_blocks(field: Array, block: int) -> Array:
    height, width = (-(-size // block) * block for size in field.shape)
    padded = np.zeros((height, width))
    padded[: field.shape[0], : field.shape[1]] = field
    out: Array = padded.reshape(height // block, block, width // block, block).sum((1, 3)).reshape(-1)
    return out
