"""Events that leave together share a row, or a column: how the sensor is read.

An arbiter takes a row with events and sends all of them; so the next event is far more often of the same row
than one some dozen events later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import grouped
from dase.signatures.chance import ratio_interval, sign_flip_tail
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "grouping"


@dataclass(frozen=True)
class GroupingSettings:
    """Which events are compared."""

    least: float = 1.2  # times as often
    lags: tuple[int, ...] = tuple(range(20, 60, 4))  # events later: no group of a bus any more
    span: float = 5e-3  # [s] within which they must come: edges move some pixels in it
    away: int = 4  # [px] neighbours fire together because the scene is smooth
    run: int = 1 << 14  # events of a run; the scene of one run says nothing of that of another
    most: int = 1 << 20  # events in all, of runs spread evenly
    fewest: int = 20  # pairs of one row or column


class GroupCounts:
    """Counts, in runs of events, pairs that share a row or column.

    Args:
        events: How many events there will be.
        hot: Pixels to leave out, shape (H * W,).
        settings: Which events are compared.
        seed: Of the order of events that share a time stamp.
    """

    def __init__(
        self, events: int, hot: NDArray[np.bool_], settings: GroupingSettings | None = None, seed: int = 0
    ):
        self.settings = settings or GroupingSettings()
        # short recordings have shorter runs: fewer than 32 could not be significant
        self._run = max(min(self.settings.run, events // 64), 256)
        self._stride = max(1, round(events / self.settings.most))
        self._hot = hot
        self._random = np.random.default_rng(seed)
        self._held: Events | None = None
        self._turn = 0
        self._next: list[NDArray[np.int64]] = []
        self._later: list[NDArray[np.int64]] = []

    def push(self, events: Events) -> None:
        """Take events."""
        joined = events if self._held is None else Events.concatenate([self._held, events])
        whole = len(joined) // self._run
        for i in range(whole):
            if self._turn % self._stride == 0:
                self._count_run(joined.select(slice(i * self._run, (i + 1) * self._run)))
            self._turn += 1
        self._held = joined.select(slice(whole * self._run, None))

    def _count_run(self, run: Events) -> None:
        s = self.settings
        pixel = run.y.astype(np.int64) * run.width + run.x
        kept = ~self._hot[pixel]
        t, x, y = run.t[kept], run.x[kept].astype(np.int64), run.y[kept].astype(np.int64)
        # files sort events of one stamp as they like: that is no readout
        order = np.lexsort((self._random.random(len(t)), t))
        x, y = x[order], y[order]

        def shared(lag: int) -> tuple[NDArray[np.int64], int]:
            """Return pairs of one row, and of one column, and all pairs, of those soon enough."""
            soon = t[lag:] - t[:-lag] < s.span
            dx, dy = np.abs(x[lag:] - x[:-lag])[soon], np.abs(y[lag:] - y[:-lag])[soon]
            row = np.count_nonzero((dx > s.away) & (dy == 0))
            column = np.count_nonzero((dy > s.away) & (dx == 0))
            return np.array([row, column]), int(soon.sum())

        if len(t) <= s.lags[-1]:
            return
        one, count = shared(1)
        others = [shared(lag) for lag in s.lags]
        pairs = sum(n for _, n in others)
        if pairs < 0.5 * count * len(s.lags):
            return  # too few events for any to come soon
        self._next.append(one)
        self._later.append(np.sum([many for many, _ in others], axis=0) * (count / pairs * len(s.lags)))

    @property
    def runs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pairs of successive events, and those of later ones summed over the lags, by run, each (R, 2)."""
        empty = np.zeros((0, 2))
        return (
            np.array(self._next, np.float64) if self._next else empty,
            np.array(self._later, np.float64) if self._later else empty,
        )


def find_grouping(groups: GroupCounts, level: float) -> Signature:
    """Look for rows or columns that are read together.

    The null has the next event no more alike than those 20 to 60 later: binomial for all pairs together, and
    by the signs of the runs' differences, which knows that pairs of one run depend on each other. The larger
    p counts.

    Args:
        groups: Counted pairs.
        level: p below which they are there.
    """
    s = groups.settings
    near, later = groups.runs
    lags = len(s.lags)
    if len(near) < 16:
        return without_answer(NAME, f"{len(near)} runs of events that follow each other within {s.span * 1e3:g} ms")
    total, others = near.sum(0), later.sum(0)
    if min((total + others / lags).max(), others.max()) < s.fewest:
        return without_answer(NAME, f"{grouped(int(total.sum()))} successive events share a row or column: too few")
    best: Signature | None = None
    for axis, line in enumerate(("row", "column")):
        if total[axis] + others[axis] < s.fewest:
            continue
        count, rest = int(total[axis]), round(float(others[axis]))
        p = max(
            float(stats.binom.sf(count - 1, count + rest, 1 / (1 + lags))),
            sign_flip_tail(near[:, axis] - later[:, axis] / lags),
        )
        ratio = count * lags / max(rest, 1)
        low, high = ratio_interval(count, rest, 1 / lags)
        entry = Signature(
            name=NAME, answer=Answer.NOT_SEEN, p=min(1.0, 2 * p), size=ratio, low=low, high=high,
            unit="times as often as by chance", least=s.least,
            sentence=f"{line}s are read together: the next event is of the same {line} {ratio:.3g} times as often as "
            "by chance",
            details={"line": line, "pairs": count},
        )  # fmt: skip
        if best is None or (entry.p, -entry.size) < (best.p, -best.size):
            best = entry
    assert best is not None
    unseen = f"the next event shares a {best.details['line']} {best.size:.2f} times as often as by chance"
    return judge_signature(best, level, unseen)
