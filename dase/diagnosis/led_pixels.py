"""Whether pixels that stand out as hot follow the light of a scene, as those of low thresholds do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from dase.events import Events
from dase.probes.stimulus import log_light_of
from dase.scenes.scene import Scene
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.result import Signature


@dataclass(frozen=True)
class LedPixelSettings:
    """How events of a pixel are compared with the changes of its light."""

    late: float = 0.005
    """Time by which an event may come after the light that makes it, and change be spread [s]."""

    alone: float = 0.05
    """Share of the events of a pixel that follows light which come at any time: noise, and what is late."""

    sure: float = 3.0
    """Logarithm of how many times as likely a pixel's events are if it follows, from which on it does."""

    most: float = 0.5
    """Share of the pixels that follow from which on none is said to be hot."""

    pixels: int = 100
    """Pixels that are looked at, at most."""

    instants: int = 20_000
    """Samples of the scene that are looked at, at most, from its begin on."""

    log_eps: float = 0.01
    """Added to intensities before the logarithm: below it, light tells little."""


LED_PIXELS = LedPixelSettings()


def follow_the_light(
    entry: Signature, events: Events, scene: Scene, settings: LedPixelSettings = LED_PIXELS
) -> bool:
    """Whether most pixels of a signature of hot pixels send when their light changes, and not at any time.

    A pixel whose threshold is close to zero sends at changes that no neighbour sees. Alone it looks hot, but
    rests with its light; a hot one does not. Times of its events are more likely either by how much the
    light changes then, or by the time alone. Of light that changes all the time nothing is told.

    Args:
        entry: The signature, with the places of its pixels.
        events: Of the sensor.
        scene: Its light, known at all times.
        settings: How they are compared.
    """
    places = np.array(entry.details["pixels"], np.int64).reshape(-1, 2)
    places = places[:: -(-len(places) // settings.pixels) or 1]
    if not len(places):
        return False
    more = gain_by_following(places[:, 1] * events.width + places[:, 0], events, scene, settings)
    return bool(np.mean(more > settings.sure) >= settings.most)


def gain_by_following(
    pixels: NDArray[np.int64], events: Events, scene: Scene, settings: LedPixelSettings = LED_PIXELS
) -> NDArray[np.float64]:
    """Return how much more likely events of pixels are by changes of the light than by the time, shape (N,).

    The logarithm of it; 0 where light never changes, or always as fast.

    Args:
        pixels: Row-major, shape (N,).
        events: Of the sensor.
        scene: Its light, known at all times.
        settings: How they are compared.
    """
    times = scene.sample_times()[: settings.instants]
    if not len(pixels) or len(times) < 3:
        return np.zeros(len(pixels))
    light = log_light_of(scene, times, pixels.astype(np.int32), log_eps=settings.log_eps)
    steps = np.diff(times)
    change = np.abs(np.diff(light, axis=0)) / steps[:, None]
    # events come in the time after the change
    width = 1 + int(np.ceil(settings.late / float(np.median(steps))))
    change = uniform_filter1d(change, width, axis=0, origin=(width - 1) // 2)
    usual = steps @ change / steps.sum()
    relative = change / np.where(usual > 0, usual, 1.0)
    gain = np.log((1 - settings.alone) * np.where(usual > 0, relative, 1.0) + settings.alone)
    column = np.full(events.width * events.height, -1, np.int64)
    column[pixels] = np.arange(len(pixels))
    at = column[row_major_pixels(events)]
    known = (at >= 0) & (events.t >= times[0]) & (events.t < times[-1])
    step = np.searchsorted(times, events.t[known], side="right") - 1
    more = np.bincount(at[known], gain[step, at[known]], minlength=len(pixels))
    return more.astype(np.float64)
