"""A limit of the rate: in even periods of time never more than so many events pass, and often just as many.

Simulators and controllers that count events in periods, and leave out what is too many, pile up periods with
one number of events, the largest. Counts of anything else get rarer the larger they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_percent, format_seconds
from dase.signatures.kinds import RATE_LIMIT
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class RateLimitSettings:
    """What is a limit."""

    tick: float = 1e-6  # [s] periods are tried in whole ticks
    shortest: int = 100  # ticks: a camera's are 200
    longest: int = 20_000  # ticks: periods of more are too few in a clip
    time: int = 2_000_000  # ticks that are looked at: an error of a period adds up, and so does the work
    fewest: int = 30  # periods that are looked at
    least: float = 0.02  # share of the periods that are full
    fewest_full: int = 10
    fewest_events: int = 20  # in a full period: small counts are alike by chance
    # counts about the largest that are as full: some came or went later
    wide: tuple[int, ...] = (0, 1)
    beside: int = 5  # counts below those, for each of them, with which they are compared
    piled: float = 4.0  # times as many as of each of those, at least
    above: float = 0.05  # of the full periods: periods of more that something else may have added to
    shifts: tuple[float, ...] = (0.125, 0.25, 0.5, 0.75)  # of a period: cut otherwise, few are full
    shifted: float = 0.5  # of the full periods, that may be full wherever they are cut: a bus has no periods
    pixels: float = 0.9  # of those that send: where each sends once, as many send each time
    near: float = 1.02  # times a period, up to which others may be the same
    alike: float = 0.8  # of the logarithm of a chance, from which on they are
    bins: int = 16  # of a period, in which two of them are compared
    turns: int = 64  # periods after which a scene may come again
    scatter: float = 0.1  # of chance, between periods: less where a scene comes again
    fewest_alike: int = 5  # periods to be compared


class EventTimes:
    """Counts events by time, over the first seconds.

    Args:
        settings: How time is divided.
    """

    def __init__(self, settings: RateLimitSettings | None = None):
        self.settings = settings or RateLimitSettings()
        self._begin = 0
        self._counts = np.zeros(0, np.int32)

    def push(self, events: Events) -> None:
        """Take events that follow those before."""
        s = self.settings
        # a hair, so that whole ticks are not less by rounding
        ticks = np.floor(events.t / s.tick + 1e-3).astype(np.int64)
        if not len(self._counts):
            self._begin = int(ticks[0])
            self._counts = np.zeros(s.time, np.int32)
        ticks = ticks[: int(np.searchsorted(ticks, self._begin + s.time))] - self._begin
        if len(ticks):
            self._counts[: int(ticks[-1]) + 1] += np.bincount(ticks).astype(np.int32)

    @property
    def begin(self) -> int:
        """When the first tick begins, in ticks of the recording's clock."""
        return self._begin

    @property
    def counts(self) -> NDArray[np.int32]:
        """Events in each tick up to the last that has any, shape (K,)."""
        some = np.flatnonzero(self._counts[::-1])
        return self._counts[: len(self._counts) - int(some[0])] if len(some) else self._counts[:0]


@dataclass(frozen=True)
class _Limit:
    """Periods that are full, and how likely as many are by chance.

    Args:
        log_p: Logarithm of the chance of as many.
        period: Ticks of each.
        offset: Of the first, from the first event [ticks].
        most: Events in a full one.
        width: By how many it may have more or fewer.
        full: How many are.
        periods: How many there are.
    """

    log_p: float
    period: int
    offset: int
    most: int
    width: int
    full: int
    periods: int


def find_rate_limit(times: EventTimes, pixels: int, level: float) -> Signature:
    """Look for periods of which many have one number of events, the largest.

    The null has the numbers of events in periods get rarer the larger they are, at the upper end: of those
    that have the largest, or a few less, the share at the largest is no more than one in as many as there
    are numbers. The chance is that of a binomial law, times the periods that are tried.

    Args:
        times: When events come.
        pixels: That send.
        level: p below which it is there.
    """
    s = times.settings
    counts = times.counts
    longest = min(s.longest, len(counts) // s.fewest)
    if longest < s.shortest:
        return without_answer(RATE_LIMIT, f"{format_seconds(len(counts) * s.tick)} are too short")
    gone = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    seen, tried = list[_Limit](), len(s.wide) * (longest + 1 - s.shortest)
    for period in range(s.shortest, longest + 1):
        offset = -times.begin % period  # periods count from 0 of the clock
        one = _full_periods(np.diff(gone[offset::period]), period, offset, s)
        if one is not None and one.most < s.pixels * pixels and _is_of_periods(one, gone, s):
            seen.append(one)
    if not seen:
        return Signature(
            name=RATE_LIMIT, answer=Answer.NOT_SEEN, p=1.0, size=0.0, unit="share of the periods",
            least=s.least, sentence="periods have no largest number of events that many of them have",
        )  # fmt: skip
    best = min(seen, key=lambda one: one.log_p)
    # full periods end before their time is over: they look alike if they are taken a bit too short
    alike = [one for one in seen if one.period < s.near * best.period and one.log_p <= s.alike * best.log_p]
    best = max(alike, key=lambda one: one.period)
    low, high = stats.beta.interval(0.9, best.full + 0.5, best.periods - best.full + 0.5)
    lasts, size = best.period * s.tick, best.full / best.periods
    entry = Signature(
        name=RATE_LIMIT, answer=Answer.NOT_SEEN, p=float(min(1.0, np.exp(min(best.log_p, 0.0)) * tried)),
        size=size, low=float(low), high=float(high), unit="share of the periods", least=s.least,
        sentence=f"in {format_percent(size)} of periods of {format_seconds(lasts)} just "
        f"{format_count(best.most)} events pass, and hardly ever more",
        details={"period": lasts, "most": best.most, "rate": best.most / lasts},
    )  # fmt: skip
    return judge_signature(entry, level, "periods have no largest number of events that many of them have")


def _full_periods(each: NDArray[np.int64], period: int, offset: int, s: RateLimitSettings) -> _Limit | None:
    """Return the largest number of events that many periods have, shape (N,); None where there is none."""
    most = int(each.max(initial=0))
    if most < s.fewest_events:
        return None
    sizes = np.bincount(each, minlength=most + 1)
    # the largest of all, or the one of the upper half that most have: something else may have added to a few
    usual = most // 2 + int(np.argmax(sizes[most // 2 :]))
    if 3 * int(sizes[usual]) < max(s.fewest_full, s.least * len(each)):
        return None
    best = None
    for top in {most, usual}:
        for width in s.wide:
            low, high = top - width, min(top + width, most)
            full, above = int(sizes[low : high + 1].sum()), int(sizes[high + 1 :].sum())
            numbers = high + 1 - low
            near = min(s.beside * numbers, low)
            below = int(sizes[low - near : low].sum())
            if full < max(s.fewest_full, s.least * len(each)) or above > s.above * full:
                continue
            if full * near < s.piled * below * numbers:
                continue
            log_p = _log_chance(full, below, numbers / (numbers + near))
            if best is None or log_p < best.log_p:
                best = _Limit(log_p, period, offset, top, width, full, len(each))
    return best


def _log_chance(full: int, below: int, share: float) -> float:
    """Return the logarithm of the chance that so many and more are full, of all that come near."""
    log_p = float(stats.binom.logsf(full - 1, full + below, share))
    return log_p if math.isfinite(log_p) else full * math.log(share)


def _is_of_periods(found: _Limit, gone: NDArray[np.int64], s: RateLimitSettings) -> bool:
    """Return whether periods are full where they are cut so and not otherwise, and no scene comes again.

    Args:
        found: The periods.
        gone: Events before each tick, shape (K + 1,).
    """

    def is_full(begins: NDArray[np.int64]) -> NDArray[np.bool_]:
        out: NDArray[np.bool_] = (
            np.abs(gone[begins + found.period] - gone[begins] - found.most) <= found.width
        )
        return out

    begins = np.arange(found.offset, len(gone) - 2 * found.period, found.period)
    full = is_full(begins)
    shifts = [round(share * found.period) for share in s.shifts]
    if min(np.count_nonzero(is_full(begins + shift)) for shift in shifts) > s.shifted * found.full:
        return False
    within = np.arange(s.bins + 1) * found.period // s.bins
    filled = np.diff(gone[begins[:, None] + within], axis=1)
    for turn in range(1, min(s.turns, len(begins) - 1) + 1):
        both = full[turn:] & full[:-turn]
        a, b = filled[turn:][both], filled[:-turn][both]
        if np.count_nonzero(both) >= s.fewest_alike and ((a - b) ** 2).sum() < s.scatter * (a + b).sum():
            return False
    return True
