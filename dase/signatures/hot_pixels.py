"""Hot pixels: far more events than their neighbours, alone, all the time.

Only calm events count, with nothing near them in space and time: an edge that passes is never calm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_metric, format_percent
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.kinds import HOT_PIXELS
from dase.signatures.result import Answer, Signature, judge_signature, without_answer
from dase.signatures.tones import LAMPS, ToneSettings, swings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HotSettings:
    """What makes a pixel hot."""

    least: int = 3  # pixels: one may be a spot in the scene, two have low thresholds in a simulated sensor
    ratio: float = 2.0  # times the usual count of its neighbours
    share: float = 0.15  # of its calm events at least in each half of the time
    chance: float = 1e-3  # over all pixels, below which one is counted
    bulk: float = 0.995  # share of the pixels of which the usual spread is taken
    in_phase: float = 0.5  # of its events, beside a lamp: a pixel that follows it is not hot
    of_its_own: float = 0.8  # of its strongest tone at least, for one that sends at even times has its own
    most: int = 1_000_000  # calm events of which times are kept
    asked: int = 100  # pixels at most that are asked for a tone in common
    tones: ToneSettings = LAMPS
    in_common: float = 1e-3  # chance of a tone below which pixels have it in common
    apart: float = 2.0  # cycles over all of the time that a tone has more or less than the ticks of a clock
    overtones: int = 4  # a pixel with a low threshold sends several times in a cycle
    border: int = 2  # pixels from the edge: what passes outside nobody sees, and there it looks calm
    calm: float = 0.05  # share of places and times in which a hot pixel would have been seen alone


class CalmCounts:
    """Counts the calm events of each pixel, and keeps the first of them.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        middle: The time that divides the recording in halves [s].
    """

    def __init__(self, width: int, height: int, middle: float):
        self.width, self.height = width, height
        self._middle = middle
        self.halves = np.zeros((2, width * height), np.int64)
        self._first = [Events.empty(width, height)]
        self._room = HotSettings.most

    def push(self, calm: Events) -> None:
        """Take calm events."""
        pixel = row_major_pixels(calm)
        cut = int(np.searchsorted(calm.t, self._middle))
        for half, part in enumerate((pixel[:cut], pixel[cut:])):
            self.halves[half] += np.bincount(part, minlength=self.width * self.height)
        if self._room > 0 and len(calm):
            self._first.append(calm.select(slice(0, self._room)))
            self._room -= len(self._first[-1])

    def first_of(self, pixels: NDArray[np.int64], span: float) -> list[tuple[Array, Array]]:
        """Return times [s] and signs of the first calm events of some pixels, no longer than a span [s]."""
        events = Events.concatenate(self._first)
        place = row_major_pixels(events)
        known = np.isin(place, pixels)
        if known.any():
            known &= events.t < events.t[known][0] + span
        t, sign, place = events.t[known], np.where(events.p[known], 1.0, -1.0), place[known]
        return [(t[place == one], sign[place == one]) for one in pixels]


def _tone_in_common(trains: Sequence[tuple[Array, Array]], tick: float, s: HotSettings) -> float:
    """Return the tone [Hz] that pixels have in common, and not of ticks of `tick` [s], 0 where there is none.

    Noise of a pixel knows nothing of the others'. Light that swings, be it in a corner of the view, is
    followed by pixels with low thresholds alone, in one rhythm. Rayleigh statistics of independent pixels add
    up to a gamma law; the pixel that says most is left out of the sum, as one that sends at even times has a
    tone of its own.
    """
    trains = [one for one in trains if len(one[0])]
    if len(trains) < s.least:
        return 0.0
    begin = min(float(t[0]) for t, _ in trains)
    span = max(float(t[-1]) for t, _ in trains) - begin
    tones, sums = swings(trains, begin, span, s.tones)
    power = sums**2 / np.array([[len(t)] for t, _ in trains])
    others = power.sum(0) - power.max(0)
    cycles = tones * tick
    of_ticks = (cycles > 0.5) & (np.abs(cycles - np.round(cycles)) < s.apart * tick / span)
    others = np.where(of_ticks, 0.0, others)
    best = int(others.argmax())
    if s.tones.independent(span) * stats.gamma.sf(others[best], len(trains) - 1) > s.in_common:
        return 0.0
    return float(tones[best])


def _follow(trains: Sequence[tuple[Array, Array]], tone: float, s: HotSettings) -> NDArray[np.bool_]:
    """Return which pixels follow light that swings at a tone [Hz], or of which it is an overtone, shape (K,).

    The light is the same for all. Two hot pixels that send at nearly the same even times have a tone in
    common, too, and any other is near one of its overtones for some cycles, but has another as its strongest.
    """
    orders = np.arange(1, s.overtones + 1)
    best = np.zeros(len(trains), np.bool_)
    for order in orders:
        tones = tone / order * orders
        tones = tones[(tones >= s.tones.slowest) & (tones <= s.tones.fastest)]
        led = np.array([_is_led(*train, tones, s) for train in trains], np.bool_)
        if np.count_nonzero(led) > np.count_nonzero(best):
            best = led
    return best


def _is_led(t: Array, sign: Array, tones: Array, s: HotSettings) -> bool:
    """Return whether events, times [s] and signs, are in phase with one of some tones [Hz] above all."""
    most = float(np.abs(np.exp(-2j * np.pi * tones[:, None] * t) @ sign).max(initial=0.0))
    if not 0 < s.in_phase * len(t) <= most:
        return False
    _, own = swings([(t, sign)], float(t[0]), float(t[-1] - t[0]), s.tones)
    return most >= s.of_its_own * float(own.max(initial=0.0))


def _led_pixels(
    calm: CalmCounts, chance: Array, lamp: float, tick: float, s: HotSettings
) -> NDArray[np.int64]:
    """Return the pixels that stand out by following light that swings, row-major, shape (K,).

    Where that are half of those that stand out, all are in doubt; of fewer a rhythm in common tells nothing,
    if no lamp is known, for so fast as some hot pixels send they have any.

    Args:
        calm: The calm events.
        chance: Of as many of an ordinary pixel, shape (H * W,).
        lamp: A frequency that is known [Hz], or 0.
        tick: Of the time stamps [s], or 0.
        s: What makes a pixel hot.
    """
    out = np.flatnonzero(chance < s.chance / len(chance))
    out = out[np.argsort(chance[out], kind="stable")]
    trains = calm.first_of(out, s.tones.span)
    tone = lamp or _tone_in_common(trains[: s.asked], tick, s)
    if not tone:
        return out[:0]
    led = _follow(trains, tone, s)
    if 2 * np.count_nonzero(led) >= len(led):
        return out
    return out[led] if lamp else out[:0]


def _usual_counts(total: NDArray[np.int64], width: int, height: int) -> NDArray[np.float64]:
    """Return the mean count of the ring of 72 pixels around each, or of all pixels where that is more."""
    field = total.reshape(height, width).astype(np.float64)
    wide, core = (cv2.blur(field, (n, n), borderType=cv2.BORDER_REFLECT) * n**2 for n in (9, 3))
    ring = (wide - core) / 72
    out: NDArray[np.float64] = np.maximum(ring.reshape(-1), total.mean())
    return out


def _has_all_neighbours(width: int, height: int, border: int) -> NDArray[np.bool_]:
    """Return which pixels are that far from the edge at least, shape (H * W,)."""
    out = np.zeros((height, width), np.bool_)
    out[border : height - border, border : width - border] = True
    return out.reshape(-1)


def _pixel_chances(
    total: NDArray[np.int64], width: int, height: int, s: HotSettings
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the chance of as many calm events of an ordinary pixel, and how many are usual, each (H * W,).

    Ordinary pixels differ: a gamma distribution of rates over pixels makes counts negative binomial. Its
    shape comes from the pixels below a high quantile.
    """
    usual = _usual_counts(total, width, height)
    bulk = total <= max(float(np.quantile(total, s.bulk)), 1.0)
    mean, variance = float(total[bulk].mean()), float(total[bulk].var())
    shape = mean**2 / max(variance - mean, 1e-3 * mean) if mean > 0 else 1e6
    shape = min(max(shape, 0.3), 1e6)
    return stats.nbinom.sf(total - 1, shape, shape / (shape + usual)), usual


def find_hot_pixels(
    calm: CalmCounts,
    quiet: float,
    duration: float,
    level: float,
    *,
    lamp: float = 0.0,
    tick: float = 0.0,
    settings: HotSettings | None = None,
) -> tuple[Signature, NDArray[np.bool_]]:
    """Look for pixels that send by themselves.

    Args:
        calm: The calm events.
        quiet: Share of places and times with nothing going on.
        duration: Of the recording [s].
        level: p below which there are any.
        lamp: Frequency of light that flickers [Hz]; 0 where none was found.
        tick: From one time stamp that there may be to the next, of any pixel [s]; 0 where none was found: in
            step with that are all pixels, whatever makes them send.
        settings: What makes a pixel hot.

    Returns:
        The signature, and which pixels are hot, bool, shape (H * W,).
    """
    s = settings or HotSettings()
    total = calm.halves.sum(0)
    nothing = np.zeros(len(total), np.bool_)
    chance, usual = _pixel_chances(total, calm.width, calm.height, s)
    steady = calm.halves.min(0) >= np.maximum(2, s.share * total)
    alone = steady & (total >= s.ratio * usual) & _has_all_neighbours(calm.width, calm.height, s.border)
    pixels = len(chance)
    led = _led_pixels(calm, np.where(alone, chance, 1.0), lamp, tick, s)
    follow = len(led)
    alone[led] = False
    chance = np.where(alone, chance, 1.0)
    found = chance < s.chance / pixels
    # as many as are announced must each be beyond chance
    p = min(1.0, pixels * float(np.partition(chance, s.least - 1)[s.least - 1])) if pixels >= s.least else 1.0
    busiest = int(np.where(alone, total, -1).argmax())
    low, high = (int(np.count_nonzero(chance < q / pixels)) for q in (level, 1.0))
    duration = max(duration, 1e-9)
    rate, usually = total[busiest] / duration, format_metric(total.mean() / duration, "Hz")
    entry = Signature(
        name=HOT_PIXELS, answer=Answer.NOT_SEEN,
        p=p, size=float(found.sum()), low=float(low), high=float(high),
        unit="pixels", least=float(s.least),
        sentence=f"{format_count(int(found.sum()))} pixels send by themselves, the busiest "
        f"{format_metric(rate, 'Hz')} at ({busiest % calm.width}, {busiest // calm.width}); "
        f"usual is {usually}",
        details={
            "pixels": [[int(k % calm.width), int(k // calm.width)] for k in np.flatnonzero(found)[:1000]],
            "busiest": float(rate),
        },
    )  # fmt: skip
    unseen = f"no {s.least} pixels stand out; {usually} of calm events per pixel"
    if follow:
        unseen += f"; {follow} would, but follow light that flickers"
    entry = judge_signature(entry, level, unseen)
    if not entry.found and quiet < s.calm:
        reason = (
            f"only {format_percent(quiet)} of the places and times are calm: hot pixels would not stand out"
        )
        return without_answer(HOT_PIXELS, reason), nothing
    return entry, found if entry.found else nothing
