"""Opposite pairs at rest: a pixel with nothing around it sends an event, and soon one of the other polarity.

Light that passes through a lens cannot rise and fall again at one pixel within some milliseconds and leave
its 24 neighbours alone; noise can. Shot noise makes ON and OFF events that know nothing of each other: pairs
come by chance. Noise on the pixel's voltage crosses a threshold and returns: there are more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_seconds
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.chance import poisson_interval
from dase.signatures.kinds import OPPOSITE_PAIRS
from dase.signatures.result import Answer, Signature, judge_signature, without_answer
from dase.signatures.tones import LAMPS, ToneSettings, swings


@dataclass(frozen=True)
class PairSettings:
    """What makes a pair."""

    least: float = (
        0.5  # times the pairs of independent ON and OFF events: noise has as many, a scene hardly any
    )
    scene: float = 0.1  # times those pairs, a bound for what a scene leaves where it is calm
    left: float = 2.0  # pairs beside that: ten simulated scenes left none to three
    bulk: float = 0.98  # share of the pixels that must have the pairs without the busiest
    returning: float = 2.0  # times those pairs, from which on noise returns
    shortest: float = 0.3  # [s] in less, hardly any two events of a pixel are far from each other
    near: float = 0.02  # [s] a pair
    later: tuple[float, float] = (0.1, 0.4)  # [s] no pair any more, but still the same scene
    busiest: float = 4.0  # [Hz] of a pixel at rest; of one that sends more, few intervals are long
    most: int = 100_000  # pairs of which times are kept
    in_step: float = 1e-3  # chance below which pairs come in step with one tone
    tones: ToneSettings = LAMPS


class PairCounts:
    """Counts successive calm events of each pixel by their distance.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        settings: What makes a pair.
    """

    def __init__(self, width: int, height: int, settings: PairSettings | None = None):
        self.settings = settings or PairSettings()
        pixels = width * height
        self._time = np.full(pixels, -np.inf)
        self._polarity = np.zeros(pixels, np.bool_)
        self.events = np.zeros((2, pixels), np.int64)
        """Calm events, OFF and ON."""
        self.opposite = np.zeros((2, pixels), np.int64)
        """Opposite pairs, near and later."""
        self._near = np.zeros(pixels, np.bool_)
        self._pairs = [Events.empty(width, height)]
        self._room = self.settings.most

    def push(self, calm: Events) -> None:
        """Take calm events."""
        if not len(calm):
            return
        pixel = row_major_pixels(calm)
        order = np.argsort(pixel, kind="stable")
        pixel, t, p = pixel[order], calm.t[order], calm.p[order]
        first = np.concatenate(([True], pixel[1:] != pixel[:-1]))
        before = np.where(first, self._time[pixel], np.roll(t, 1))
        flips = p != np.where(first, self._polarity[pixel], np.roll(p, 1))
        gap = t - before
        near = gap < self.settings.near
        # of a pixel that goes on, only the first pair: the others follow from it
        again = near & np.where(first, self._near[pixel], np.roll(near, 1))
        self._keep(calm.select(np.sort(order[near & flips & ~again])))
        begin, end = self.settings.later
        size = len(self._time)
        for row, chosen in ((0, near), (1, (gap >= begin) & (gap < end))):
            self.opposite[row] += np.bincount(pixel[chosen & flips], minlength=size)
        for row in range(2):
            self.events[row] += np.bincount(pixel[p == bool(row)], minlength=size)
        last = np.append(first[1:], True)
        self._time[pixel[last]], self._polarity[pixel[last]] = t[last], p[last]
        self._near[pixel[last]] = near[last]

    def _keep(self, pairs: Events) -> None:
        """Keep pairs, in order of time, so that which are the first does not depend on the chunks."""
        if self._room > 0 and len(pairs):
            self._pairs.append(pairs.select(slice(0, self._room)))
            self._room -= len(self._pairs[-1])

    def tone(self, pixels: NDArray[np.bool_]) -> tuple[float, float]:
        """Return the tone [Hz] with which pairs of all pixels come in step, and its chance.

        Noise of a pixel knows nothing of that of others. Light that swings ends pairs with ON while it rises
        and with OFF while it falls. Time stamps of a coarse clock are no tone: both come at its ticks.

        Args:
            pixels: Of which the pairs are, shape (H * W,).

        Returns:
            0 Hz and 1 where they last no cycle of the slowest tone.
        """
        pairs, s = Events.concatenate(self._pairs), self.settings.tones
        pairs = pairs.select(pixels[row_major_pixels(pairs)])
        t = pairs.t - pairs.t.min(initial=np.inf)
        if t.max(initial=0.0) < 1 / s.slowest:
            return 0.0, 1.0
        known = t < s.span
        t, sign = t[known], np.where(pairs.p[known], 1.0, -1.0)
        tones, (swing,) = swings([(t, sign)], 0.0, float(t.max()), s)
        best = int(swing.argmax())
        chance = s.independent(float(t.max())) * math.exp(-(float(swing[best]) ** 2) / len(t))
        return float(tones[best]), min(1.0, chance)


def _pairs_of_trains(events: NDArray[np.int64], duration: float, s: PairSettings) -> float:
    """Return the near pairs of independent trains of OFF and ON events, counts of shape (2, N)."""
    off, on = events
    return float((off * on).sum() * 2 * s.near / max(duration, s.near))


def find_opposite_pairs(
    pairs: PairCounts, hot: NDArray[np.bool_], duration: float, level: float, *, lamp: bool = False
) -> Signature:
    """Look for opposite pairs at rest.

    The null has a tenth of the pairs that independent ON and OFF trains of each pixel would have, and two
    pairs: Poisson distributed. It must fail without the busiest pixels, too: of a hot pixel amid things that
    move only bursts are calm. Then the same with all of these pairs, or as many as those farther apart tell,
    says whether noise returns.

    Args:
        pairs: Counted pairs.
        hot: Pixels to leave out, shape (H * W,).
        duration: Of the recording [s].
        level: p below which they are there.
        lamp: Whether the light flickers, which makes opposite pairs.
    """
    s = pairs.settings
    total = pairs.events.sum(0)
    rest = ~hot & (total <= max(s.busiest * duration, 10.0))
    usual = rest & (total <= max(float(np.quantile(total[~hot], s.bulk)) if np.any(~hot) else 0.0, 2.0))
    off, on = pairs.events[:, rest]
    near = int(pairs.opposite[0, rest].sum())
    events = int((off + on).sum())
    trains, trains_of_usual = (_pairs_of_trains(pairs.events[:, some], duration, s) for some in (rest, usual))
    # a train of rate r has exp(r t) times as many intervals below t as above
    begin, end = s.later
    favour = np.exp((off + on) / max(duration, end) * (begin + end) / 2)
    local = float((pairs.opposite[1, rest] * favour).sum()) * s.near / (end - begin)
    expected = max(trains, local)
    bound = s.scene * trains + s.left
    p, p_more = (float(stats.poisson.sf(near - 1, mean)) for mean in (bound, expected))
    near_of_usual = int(pairs.opposite[0, usual].sum())
    p = max(p, float(stats.poisson.sf(near_of_usual - 1, s.scene * trains_of_usual + s.left)))
    low, high = (limit / max(trains, 0.5) for limit in poisson_interval(near))
    size = near / max(trains, 0.5)
    rates = [float(row.sum()) / max(duration, 1e-9) / max(len(row), 1) for row in (off, on)]
    known: dict[str, Any] = {
        "p": p, "size": size, "low": low, "high": high,
        "unit": "times the pairs of independent events", "least": s.least,
        "details": {
            "pairs": near, "independent": trains, "later": local, "p_returning": p_more,
            "calm_events": events, "off_rate": rates[0], "on_rate": rates[1],
        },
    }  # fmt: skip
    if duration < s.shortest:
        return without_answer(
            OPPOSITE_PAIRS, f"{format_seconds(duration)} of events: a pixel has no time to rest", **known
        )
    if lamp:
        return without_answer(
            OPPOSITE_PAIRS, f"{near} pairs, but light that flickers makes them, too", **known
        )
    tone, chance = pairs.tone(rest)
    if chance < s.in_step:
        return without_answer(
            OPPOSITE_PAIRS, f"{near} pairs, but in step with light that swings at {tone:.4g} Hz", **known
        )
    # what independent trains would have must be seen
    if stats.poisson.sf(math.ceil(trains) - 1, bound) >= level and p >= level:
        told = f"{near} pairs, independent ones would have {trains:.2g}, too few"
        reason = f"{format_count(events)} calm events: {told}"
        return without_answer(OPPOSITE_PAIRS, reason, **known)
    returns = p_more < level and near >= s.returning * expected
    kind = (
        "noise of the pixels at rest that returns"
        if returns
        else "noise of the pixels at rest, as shot noise"
    )
    said = f"{kind}: {near} opposite pairs within 20 ms, independent events have {trains:.3g}"
    known["details"] |= {"returns": returns}
    unseen = f"{near} opposite pairs at rest, independent events would have {trains:.3g}"
    return judge_signature(
        Signature(name=OPPOSITE_PAIRS, answer=Answer.NOT_SEEN, sentence=said, **known), level, unseen
    )
