"""Hot pixels that are too few for a fit: all events tell what they are, some pixels hardly have one.

A fit looks at some thousand pixels. Where these would have one or two hot ones, chance alone says how many
and how busy, and makes all else look like chance beside them. Then hot pixels are left out of all that is
compared, and counted where all of them are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.diagnosis.model_at_pixels import count_at_pixels, count_of_model
from dase.diagnosis.seen_effects import SeenEffects
from dase.effects.base import Effect
from dase.effects.hot import Hot
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.probes.random_streams import SimulationStream
from dase.results import Diagnosis, Estimate
from dase.scenes.between_frames import CameraScene
from dase.signatures import kinds
from dase.simulation.sensor import Sensor

NAME = Hot.name


@dataclass(frozen=True)
class HotPixelSettings:
    """When hot pixels are too few for a fit, and how their intervals are made."""

    few: float = 3.0
    """Hot pixels that a part of the measurement would have in the mean, below which they are too few."""

    fewest: int = 3
    """As many are announced, at least."""

    of_light: float = 0.5
    """Share of a pixel's events that a model sends without the effect, from which on light explains them."""

    side: float = 0.95
    """Of Student's law up to which intervals of 90 % go: few pixels know how far they lie apart no better."""


HOT_PIXELS = HotPixelSettings()


def few_hot_pixels(
    seen: SeenEffects, events: Events, pixels: int, settings: HotPixelSettings = HOT_PIXELS
) -> NDArray[np.int64] | None:
    """Return which pixels are hot where they are too few for a fit, row-major (K,); None where they are not.

    Args:
        seen: In the events.
        events: Of the whole sensor.
        pixels: In each part of a measurement.
        settings: When they are too few.
    """
    for entry in seen.entries:
        if entry.name == kinds.HOT_PIXELS and NAME in seen.library:
            places = np.array(entry.details["pixels"], np.int64).reshape(-1, 2)
            share = entry.size / (events.width * events.height)
            # the signature lists a thousand at most
            if share * pixels < settings.few and len(places) == entry.size:
                return places[:, 1] * events.width + places[:, 0]
    return None


def hot_effect_of(
    events: Events, pixels: NDArray[np.int64], settings: HotPixelSettings = HOT_PIXELS
) -> tuple[Effect, dict[str, Estimate]]:
    """Return the effect that makes some pixels hot, and its parameters with 90 % intervals.

    Args:
        events: Of the whole sensor.
        pixels: Which are hot, row-major, shape (K,), K at least 2.
        settings: How wide intervals are.
    """
    count, size = len(pixels), events.width * events.height
    at = events.y.astype(np.int64) * events.width + events.x
    sent = np.bincount(at, minlength=size)[pixels]
    on = np.bincount(at, weights=events.p, minlength=size)[pixels]
    rates = np.log(np.maximum(sent, 1) / max(float(events.t[-1] - events.t[0]), 1e-9))
    facts = {p.name: p for p in Hot.parameters()}

    def estimate(name: str, *values: float) -> Estimate:
        return Estimate(*(float(np.clip(value, *facts[name].bounds)) for value in values))

    middle, spread = float(rates.mean()), float(rates.std(ddof=1))
    side = float(stats.t.ppf(settings.side, count - 1))
    off = side * spread / np.sqrt(count)
    # of normal logarithms, the spread follows a chi-squared law
    ends = spread * np.sqrt((count - 1) / stats.chi2.ppf([0.95, 0.05], count - 1))
    shares = on / np.maximum(sent, 1)
    balance, beside = float(shares.mean()), side * float(shares.std(ddof=1)) / np.sqrt(count)
    least, most = 0.5 * stats.chi2.ppf(0.05, 2 * count), 0.5 * stats.chi2.ppf(0.95, 2 * count + 2)
    found = {
        "share": estimate("share", count / size, least / size, most / size),
        "rate": estimate("rate", *np.exp([middle, middle - off, middle + off])),
        "spread": estimate("spread", spread, *ends),
        "balance": estimate("balance", balance, balance - beside, balance + beside),
    }
    values = {name: one.value for name, one in found.items()}
    effect = Hot(
        share=values["share"], rate=values["rate"], spread=values["spread"], balance=values["balance"]
    )
    return effect, {f"{NAME}.{name}": one for name, one in found.items()}


def beyond_the_model(
    measurement: Measurement,
    pixels: NDArray[np.int64],
    sensor: Sensor,
    *,
    seed: int,
    settings: HotPixelSettings = HOT_PIXELS,
) -> NDArray[np.int64]:
    """Return the hot pixels without those of which a model without the effect sends half of the events.

    Light alone sends many where a response is steep, as that of a lin-log sensor in its dark is.

    Args:
        measurement: Its scene is simulated; between a camera's frames it is a guess, and tells nothing.
        pixels: Which are hot, row-major, shape (K,).
        sensor: The model.
        seed: Of its random numbers.
        settings: What counts.
    """
    if isinstance(measurement.scene, CameraScene):
        return pixels
    pixels = np.sort(pixels)
    by_light = count_of_model(measurement, sensor, pixels, seed=SimulationStream.HOT_PIXELS.seed(seed))
    return pixels[by_light < settings.of_light * count_at_pixels(measurement.compared_events(), pixels)]


def with_hot_pixels(
    found: Diagnosis, measurement: Measurement, pixels: NDArray[np.int64], *, seed: int
) -> Diagnosis:
    """Return a diagnosis, made without the hot pixels, with the effect that makes them.

    Args:
        found: Its sensor is the model.
        measurement: The light and the events.
        pixels: Which are hot, row-major, shape (K,).
        seed: Of random numbers.
    """
    if not any(one.effect == NAME for one in found.findings):
        return found  # the scene shows as much
    pixels = beyond_the_model(measurement, pixels, found.sensor, seed=seed)
    if len(pixels) < HOT_PIXELS.fewest:
        others = tuple(one for one in found.findings if one.effect != NAME)
        note = "pixels that looked hot send as much by their light in the last model, and are not"
        return replace(found, findings=others, notes=(*found.notes, note))
    effect, parameters = hot_effect_of(measurement.events, pixels)
    return replace(
        found,
        sensor=found.sensor.with_effect(effect),
        selected=(*found.selected, NAME),
        errors=(*found.errors, found.errors[-1]),
        parameters={**found.parameters, **parameters},
        findings=tuple(
            replace(one, parameters=dict(parameters)) if one.effect == NAME else one for one in found.findings
        ),
    )
