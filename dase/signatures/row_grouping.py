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
from dase.signatures.chance import ratio_interval, sign_flip_tail
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "grouping"


@dataclass(frozen=True)
class GroupingSettings:
    """Which events are compared."""

    least: float = 1.2  # times as often
    lags: tuple[int, ...] = tuple(range(20, 60, 4))  # events later: no group of a bus any more
    span: float = 5e-3  # [s] within which they must come: edges move some pixels in it
    beside: int = 2  # [px] lines that an edge along them has events of, too; a bus takes one at a time
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
        self._later: list[NDArray[np.float64]] = []

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
            """Return pairs of one row and of rows near by, the same of columns, and all pairs soon enough."""
            soon = t[lag:] - t[:-lag] < s.span
            dx, dy = np.abs(x[lag:] - x[:-lag])[soon], np.abs(y[lag:] - y[:-lag])[soon]
            many = np.zeros((2, 2), np.int64)
            for axis, (along, across) in enumerate(((dx, dy), (dy, dx))):
                line = across[(along > s.away) & (across <= s.beside)]
                same = np.count_nonzero(line == 0)
                many[axis] = same, len(line) - same
            return many, int(soon.sum())

        if len(t) <= s.lags[-1]:
            return
        one, count = shared(1)
        others = [shared(lag) for lag in s.lags]
        pairs = sum(n for _, n in others)
        if pairs < 0.5 * count * len(s.lags):
            return  # too few events for any to come soon
        self._next.append(one)
        self._later.append(np.sum([many for many, _ in others], axis=0) * (count / pairs))

    @property
    def runs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pairs of successive events, and mean pairs of later ones.

        Each of shape (R, 2, 2): by run; row, column; the same line, lines beside it.
        """
        empty = np.zeros((0, 2, 2))
        if not self._next:
            return empty, empty
        return np.array(self._next, np.float64), np.array(self._later, np.float64)


def _test_line(
    near: NDArray[np.float64], later: NDArray[np.float64], lags: int
) -> tuple[float, tuple[float, float, float]]:
    """Return the p of one axis, and how many times as many pairs there are as expected, with an interval.

    Args:
        near: Pairs of successive events, the same line and those beside, shape (R, 2).
        later: Mean pairs of later ones, shape (R, 2).
        lags: How many lags the mean is of.
    """
    count, beside = near.sum(0)
    rest, rest_beside = later.sum(0) * lags
    # an edge along a line makes neighbours of that line fire together, too, as much sooner as the line itself
    share = rest / max(rest_beside, 1.0)
    out = []
    for one, others, usual in ((near[:, 1], beside, share), (later[:, 0], rest, 1 / lags)):
        scale = share if others is beside else 1.0
        p = max(
            float(stats.binom.sf(count - 1, count + round(others), usual / (1 + usual))),
            sign_flip_tail(near[:, 0] - one * scale),
        )
        ratio = count / max(others * usual, 1.0)
        out.append((ratio, p, ratio_interval(int(count), round(others), max(usual, 1e-9))))
    ratio, _, (low, high) = min(out)
    return max(p for _, p, _ in out), (ratio, low, high)


def find_grouping(groups: GroupCounts, level: float) -> Signature:
    """Look for rows or columns that are read together.

    Two nulls, each binomial for all pairs together and by the signs of the runs' differences, which knows
    that pairs of one run depend on each other. Successive events share a line no more often than those 20 to
    60 later; and no more often, compared with lines beside, than those. The largest p and the smallest size
    count.

    Args:
        groups: Counted pairs.
        level: p below which they are there.
    """
    s = groups.settings
    near, later = groups.runs
    if len(near) < 16:
        return without_answer(
            NAME, f"{len(near)} runs of events that follow each other within {s.span * 1e3:g} ms"
        )
    best: Signature | None = None
    for axis, line in enumerate(("row", "column")):
        count, expected = float(near[:, axis, 0].sum()), float(later[:, axis, 0].sum())
        if max(count, expected) < s.fewest or near[:, axis].sum() < s.fewest:
            continue
        p, (size, low, high) = _test_line(near[:, axis], later[:, axis], len(s.lags))
        entry = Signature(
            name=NAME, answer=Answer.NOT_SEEN, p=min(1.0, 2 * p), size=size, low=low, high=high,
            unit="times as often as by chance", least=s.least,
            sentence=f"{line}s are read together: the next event is of the same {line} {size:.3g} times "
            "as often as by chance",
            details={"line": line, "pairs": int(count)},
        )  # fmt: skip
        if best is None or (entry.p, -entry.size) < (best.p, -best.size):
            best = entry
    if best is None:
        return without_answer(NAME, "too few successive events share a row or column")
    unseen = f"the next event shares a {best.details['line']} {best.size:.2f} times as often as by chance"
    return judge_signature(best, level, unseen)
