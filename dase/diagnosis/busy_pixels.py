"""Hot pixels where something moves everywhere: they send more than their light and that of their neighbours.

By events alone a hot pixel is seen where all around it is calm. Where the light of all pixels is known, it is
seen anywhere: it sends twice as much as those beside it whose light changes as much, and at any time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.diagnosis.led_pixels import gain_by_following
from dase.diagnosis.model_at_pixels import count_at_pixels
from dase.events import Events
from dase.formatting import format_count, format_metric
from dase.probes.stimulus import log_light_of
from dase.scenes.scene import Scene
from dase.signatures.kinds import HOT_PIXELS
from dase.signatures.result import Answer, Signature, judge_signature

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BusyPixelSettings:
    """How much more than its neighbours a hot pixel sends."""

    reach: int = 2
    """Pixels to each side that are neighbours."""

    ratio: float = 2.0
    """Times the median of the neighbours' events."""

    most: float = 1.3
    """Times those of the third busiest of them: two may be hot themselves."""

    more: int = 20
    """Events more than that median, at least."""

    errors: float = 6.0
    """Those in units of the root of it."""

    by_light: float = 1.7
    """Times as much more than its light changes more, at least."""

    against: float = 3.0
    """Logarithm of how many times as likely its events are if they come at any time as if with the light."""

    rest: float = 0.05
    """Way of the log intensity below which light makes no event at all."""

    parts: int = 8
    """Of the time, in all of which but one it sends."""

    steady: float = 0.4
    """Of its mean rate in these, at least."""

    nearly: tuple[float, float] = (1.4, 3.0)
    """Times the median of the neighbours' events that pixels send which are nearly as busy."""

    beyond_chance: float = 3.0
    """Errors beyond which those are."""

    apart: float = 2.0
    """Pixels that are busier, as times those that are nearly so: where thresholds or noise differ from pixel
    to pixel, there are more of these."""

    share: float = 0.005
    """Of all pixels that are hot, at most: more are a spread of what all pixels send."""

    least: int = 3
    """Pixels, at least."""

    chance: float = 1e-12
    """That three send as much by that law, at most: thresholds that differ let a few send more."""

    widest: int = 4096
    """Pixels whose light is looked at together, for the memory that takes."""

    log_eps: float = 0.01
    """Added to intensities before the logarithm: below it, light tells little."""


BUSY_PIXELS = BusyPixelSettings()


def find_busy_pixels(events: Events, scene: Scene, settings: BusyPixelSettings = BUSY_PIXELS) -> Signature:
    """Return the signature of hot pixels amid others whose light changes, see `BusyPixelSettings`.

    The null is a Poisson law of the most that light can make: that of the neighbours, as much more as the
    light of the pixel changes more.

    Args:
        events: Of the whole sensor.
        scene: Its light, known at all times.
        settings: What counts.
    """
    size = events.width * events.height
    counts = count_at_pixels(events, np.arange(size)).reshape(events.height, events.width).astype(np.float64)
    around = _neighbours(counts, settings.reach)
    usual = np.maximum(np.nanmedian(around, 0), 0.5).reshape(-1)
    third = np.sort(np.nan_to_num(around, nan=-1.0), 0)[-3].reshape(-1)
    sent = counts.reshape(-1)
    beyond = (sent - usual) / np.sqrt(usual + 1)
    pixels = np.flatnonzero((beyond >= settings.beyond_chance) & (sent >= settings.nearly[0] * usual))
    duration = max(float(events.t[-1] - events.t[0]), 1e-9)
    if len(pixels):
        pixels = pixels[_sends_at_any_time(pixels, events, scene, settings)]
    by_light = usual.copy()
    if len(pixels):
        by_light[pixels] *= _times_as_much_light(pixels, scene, settings)
    is_hot = (sent >= settings.ratio * usual) & (sent - usual >= settings.more) & (beyond >= settings.errors)
    is_hot &= (sent >= settings.most * third) & (sent >= settings.by_light * by_light)
    hot = pixels[is_hot[pixels]]
    nearly = np.count_nonzero(sent[pixels] < settings.nearly[1] * usual[pixels])
    alone = len(pixels) - nearly >= settings.apart * nearly and len(hot) <= settings.share * size
    chance = np.sort(stats.poisson.sf(sent[hot] - 1, by_light[hot]))
    p = min(1.0, size * float(chance[settings.least - 1])) if len(hot) >= settings.least else 1.0
    found = len(hot) if alone else 0
    busiest = int(hot[sent[hot].argmax()]) if len(hot) else 0
    rate = float(sent[busiest]) / duration
    entry = Signature(
        name=HOT_PIXELS, answer=Answer.NOT_SEEN, p=p, size=float(found), low=float(found), high=float(found),
        unit="pixels", least=float(settings.least),
        sentence=f"{format_count(found)} pixels send at any time, and more than light makes others send, the "
        f"busiest {format_metric(rate, 'Hz')} at ({busiest % events.width}, {busiest // events.width})",
        details={
            "pixels": [[int(k % events.width), int(k // events.width)] for k in hot[:1000]],
            "busiest": rate,
        },
    )  # fmt: skip
    return judge_signature(
        entry, settings.chance, "no pixels send more than light makes their neighbours send"
    )


def _sends_at_any_time(
    pixels: NDArray[np.int64], events: Events, scene: Scene, settings: BusyPixelSettings
) -> NDArray[np.bool_]:
    """Return which pixels send all the time and not with their light, row-major (N,) to bool (N,)."""
    gain = gain_by_following(pixels, events, scene)
    column = np.full(events.width * events.height, -1, np.int64)
    column[pixels] = np.arange(len(pixels))
    at = column[events.y.astype(np.int64) * events.width + events.x]
    span = max(float(events.t[-1] - events.t[0]), 1e-9)
    part = np.minimum((settings.parts * (events.t - events.t[0]) / span).astype(np.int64), settings.parts - 1)
    cells = part[at >= 0] * len(pixels) + at[at >= 0]
    sent = np.bincount(cells, minlength=settings.parts * len(pixels)).reshape(settings.parts, -1)
    steady = np.sort(sent, 0)[1] >= settings.steady * sent.mean(0)
    out: NDArray[np.bool_] = steady & ((gain < -settings.against) | (gain == 0.0))
    return out


def _times_as_much_light(pixels: NDArray[np.int64], scene: Scene, settings: BusyPixelSettings) -> Array:
    """Return how much farther the light of pixels goes than that of their neighbours, 1 at least, shape (N,).

    Only these are looked at: a scene may render all of its pictures for each look.
    """
    side = np.arange(-settings.reach, settings.reach + 1)
    dy, dx = (one.reshape(-1) for one in np.meshgrid(side, side, indexing="ij"))
    row, column = np.divmod(pixels, scene.width)
    y, x = row[:, None] + dy, column[:, None] + dx
    inside = (y >= 0) & (y < scene.height) & (x >= 0) & (x < scene.width)
    places = np.where(inside, y * scene.width + x, pixels[:, None])
    needed, back = np.unique(places, return_inverse=True)
    way = _ways_of_light(needed, scene, settings)[back].reshape(places.shape)
    middle = len(dy) // 2
    inside[:, middle] = False
    beside = np.maximum(np.nanmedian(np.where(inside, way, np.nan), 1), settings.rest)
    out: Array = np.maximum(way[:, middle] / beside, 1.0)
    return out


def _ways_of_light(pixels: NDArray[np.int64], scene: Scene, settings: BusyPixelSettings) -> Array:
    """Return how far the log intensity of pixels goes, up and down, shape (N,)."""
    times, out = scene.sample_times(), np.empty(len(pixels))
    for first in range(0, len(pixels), settings.widest):
        part = slice(first, first + settings.widest)
        light = log_light_of(scene, times, pixels[part].astype(np.int32), log_eps=settings.log_eps)
        out[part] = np.abs(np.diff(light, axis=0)).sum(0)
    return out


def _neighbours(values: Array, reach: int) -> Array:
    """Return those of each pixel, not a number beyond the edge, shape (K, H, W)."""
    height, width = values.shape
    wide = np.pad(values, reach, constant_values=np.nan)
    side = range(2 * reach + 1)
    places = [(dy, dx) for dy in side for dx in side if (dy, dx) != (reach, reach)]
    return np.stack([wide[dy : dy + height, dx : dx + width] for dy, dx in places])
