"""Hot pixels: far more events than their neighbours, alone, all the time.

Only calm events count, with nothing near them in space and time: an edge that passes is never calm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_metric, format_percent
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "hot pixels"


@dataclass(frozen=True)
class HotSettings:
    """What makes a pixel hot."""

    least: int = 3  # pixels: one may be a spot in the scene, two have low thresholds in a simulated sensor
    ratio: float = 2.0  # times the usual count of its neighbours
    share: float = 0.15  # of its calm events at least in each half of the time
    chance: float = 1e-3  # over all pixels, below which one is counted
    bulk: float = 0.995  # share of the pixels of which the usual spread is taken
    in_phase: float = 0.5  # of its events, with a lamp: a pixel that follows it is not hot
    border: int = 2  # pixels from the edge: what passes outside nobody sees, and there it looks calm
    calm: float = 0.05  # share of places and times in which a hot pixel would have been seen alone


class CalmCounts:
    """Counts the calm events of each pixel.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        middle: The time that divides the recording in halves [s].
        frequency: Of a lamp [Hz]; 0 for none.
    """

    def __init__(self, width: int, height: int, middle: float, frequency: float = 0.0):
        self.width, self.height = width, height
        self._middle, self._frequency = middle, frequency
        self.halves = np.zeros((2, width * height), np.int64)
        self.phase = np.zeros(width * height, np.complex128)
        """Sums of the events' signs times their turn of the lamp."""

    def push(self, calm: Events) -> None:
        """Take calm events."""
        pixel = row_major_pixels(calm)
        cut = int(np.searchsorted(calm.t, self._middle))
        for half, part in enumerate((pixel[:cut], pixel[cut:])):
            self.halves[half] += np.bincount(part, minlength=self.width * self.height)
        if self._frequency:
            turn = np.exp(-2j * np.pi * self._frequency * calm.t) * np.where(calm.p, 1.0, -1.0)
            np.add.at(self.phase, pixel, turn)


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
    calm: CalmCounts, quiet: float, duration: float, level: float, settings: HotSettings | None = None
) -> tuple[Signature, NDArray[np.bool_]]:
    """Look for pixels that send by themselves.

    Args:
        calm: The calm events.
        quiet: Share of places and times with nothing going on.
        duration: Of the recording [s].
        level: p below which there are any.
        settings: What makes a pixel hot.

    Returns:
        The signature, and which pixels are hot, bool, shape (H * W,).
    """
    s = settings or HotSettings()
    total = calm.halves.sum(0)
    nothing = np.zeros(len(total), np.bool_)
    chance, usual = _pixel_chances(total, calm.width, calm.height, s)
    steady = calm.halves.min(0) >= np.maximum(2, s.share * total)
    alone = steady & (total >= s.ratio * usual)
    led = alone & (np.abs(calm.phase) >= s.in_phase * total)
    follow = int(np.count_nonzero(led & (chance < s.chance / len(chance))))
    alone &= ~led & _has_all_neighbours(calm.width, calm.height, s.border)
    chance = np.where(alone, chance, 1.0)
    pixels = len(chance)
    found = chance < s.chance / pixels
    # as many as are announced must each be beyond chance
    p = min(1.0, pixels * float(np.partition(chance, s.least - 1)[s.least - 1])) if pixels >= s.least else 1.0
    busiest = int(np.where(alone, total, -1).argmax())
    low, high = (int(np.count_nonzero(chance < q / pixels)) for q in (level, 1.0))
    duration = max(duration, 1e-9)
    rate, usually = total[busiest] / duration, format_metric(total.mean() / duration, "Hz")
    entry = Signature(
        name=NAME, answer=Answer.NOT_SEEN, p=p, size=float(found.sum()), low=float(low), high=float(high),
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
        unseen += f"; {follow} would, but follow the light that flickers"
    entry = judge_signature(entry, level, unseen)
    if not entry.found and quiet < s.calm:
        reason = (
            f"only {format_percent(quiet)} of the places and times are calm: hot pixels would not stand out"
        )
        return without_answer(NAME, reason), nothing
    return entry, found if entry.found else nothing
