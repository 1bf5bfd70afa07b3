"""Events that leave together share a row, or a column: how the sensor is read.

An arbiter takes a row with events and sends all of them; so the next event is far more often of the same row
than one some dozen events later. An edge along a row that moves makes its pixels send together, too, if they
are alike: at one instant, as a row with one time stamp for all. It leaves out no pixel between two of them,
so events count only where the pixels beside them on the line are silent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.signatures.chance import ratio_interval, sign_flip_tail
from dase.signatures.kinds import GROUPING
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class GroupingSettings:
    """Which events are compared."""

    least: float = 1.2  # times as often
    lags: tuple[int, ...] = tuple(range(20, 60, 4))  # events later: no group of a bus any more
    span: float = 5e-3  # [s] within which they must come: edges move some pixels in it
    beside: int = 2  # [px] lines that an edge along them has events of, too; a bus takes one at a time
    away: int = 4  # [px] neighbours fire together because the scene is smooth
    run: int = 1 << 14  # events of a run; the scene of one run says nothing of that of another
    together: int = 4  # runs that are looked at together: what is beside an event may lie in another one
    most: int = 1 << 20  # events in all, spread evenly
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
        block = self._run * self.settings.together
        whole = len(joined) // block
        for i in range(whole):
            if self._turn % self._stride == 0:
                self._count_block(joined.select(slice(i * block, (i + 1) * block)))
            self._turn += 1
        self._held = joined.select(slice(whole * block, None))

    def _count_block(self, block: Events) -> None:
        s = self.settings
        kept = ~self._hot[block.y.astype(np.int64) * block.width + block.x]
        t, x, y = block.t[kept], block.x[kept].astype(np.int32), block.y[kept].astype(np.int32)
        if len(t) <= s.lags[-1]:
            return
        # files sort events of one stamp as they like: that is no readout
        order = _shuffled_within_stamps(t, self._random)
        x, y = x[order], y[order]
        free = [~_may_be_of_an_edge(t, *axes, s) for axes in ((x, y), (y, x))]
        for i in range(s.together):
            run = slice(i * len(t) // s.together, (i + 1) * len(t) // s.together)
            tables = [
                self._count_pairs(t[run], along[run], across[run], some[run])
                for along, across, some in ((x, y, free[0]), (y, x, free[1]))
            ]
            if any(pairs for _, _, pairs in tables):
                self._next.append(np.array([one for one, _, _ in tables]))
                self._later.append(np.array([later for _, later, _ in tables]))

    def _count_pairs(
        self,
        t: NDArray[np.float64],
        along: NDArray[np.int32],
        across: NDArray[np.int32],
        free: NDArray[np.bool_],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], int]:
        """Return pairs of successive events, mean pairs of later ones, each (2,), and all later pairs.

        Of events that are `free`, in places along and numbers of their lines, all of shape (N,).
        """
        s = self.settings
        nothing = np.zeros(2, np.int64), np.zeros(2), 0

        def shared(lag: int) -> tuple[NDArray[np.int64], int, float]:
            """Return pairs of one line and of lines near by, all pairs soon enough, and their share."""
            soon = t[lag:] - t[:-lag] < s.span
            kept = np.flatnonzero(soon & free[lag:] & free[:-lag])
            apart = np.abs(across[kept + lag] - across[kept])
            near = kept[apart <= s.beside]
            far = np.abs(along[near + lag] - along[near]) > s.away
            line = apart[apart <= s.beside][far]
            same = np.count_nonzero(line == 0)
            return np.array([same, len(line) - same]), len(kept), float(soon.mean())

        if len(t) <= s.lags[-1]:
            return nothing
        one, count, _ = shared(1)
        others = [shared(lag) for lag in s.lags]
        pairs = sum(n for _, n, _ in others)
        if pairs == 0 or np.mean([share for _, _, share in others]) < 0.5:
            return nothing
        return one, np.sum([many for many, _, _ in others], axis=0) * (count / pairs), pairs

    @property
    def runs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pairs of successive events, and mean pairs of later ones.

        Each of shape (R, 2, 2): by run; row, column; the same line, lines beside it.
        """
        empty = np.zeros((0, 2, 2))
        if not self._next:
            return empty, empty
        return np.array(self._next, np.float64), np.array(self._later, np.float64)


def _shuffled_within_stamps(t: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.int64]:
    """Return an order of events, sorted by time, in which those of one stamp come as they like."""
    draws = random.random(len(t))
    order = np.arange(len(t))
    alike = t[1:] == t[:-1]
    shared = np.flatnonzero(np.append(alike, False) | np.append(False, alike))
    order[shared] = shared[np.lexsort((draws[shared], t[shared]))]
    return order


def _may_be_of_an_edge(
    t: NDArray[np.float64], along: NDArray[np.int32], across: NDArray[np.int32], settings: GroupingSettings
) -> NDArray[np.bool_]:
    """Return which events an edge along their line may have made, shape (N,).

    Pixels of such an edge see the same light. Where they are alike and each has sent before, each sends once
    between two events of one of them, all at one instant if their memories were set in the same light. So an
    event counts as of an edge if a pixel beside it on its line sends within the time to the nearer of its own
    pixel's other events.

    Args:
        t: Times, sorted [s], shape (N,).
        along: Places along the lines [px].
        across: Numbers of the lines.
        settings: How near is beside; the longest time.
    """
    count, index = len(t), np.arange(len(t))
    pixel = across.astype(np.int64) * (1 << 16) + along
    # lexsort keeps what is alike in its order, and counts numbers of 16 bits instead of comparing them
    order = np.lexsort((along.astype(np.uint16), across.astype(np.uint16)))
    gaps = np.where(np.diff(pixel[order]) == 0, np.diff(t[order]), settings.span)
    alone = np.full(1, settings.span)
    own = np.empty(count)
    own[order] = np.minimum(np.concatenate((alone, gaps)), np.concatenate((gaps, alone)))
    own = np.minimum(own, settings.span)
    # at least as far as the events with which successive ones are compared, and all of one stamp
    reach = settings.lags[-1]
    begins = np.flatnonzero(np.append(True, np.diff(t) > 0))  # of stamps
    lengths = np.diff(np.append(begins, count))
    low = np.maximum(np.repeat(begins, lengths) - reach, 0)
    high = np.minimum(np.repeat(begins + lengths, lengths) + reach, count) - 1
    # times are searched only where they lie further off than that
    early, late = t[low] >= t - own, t[high] <= t + own
    low[early] = np.searchsorted(t, (t - own)[early])
    high[late] = np.searchsorted(t, (t + own)[late], "right") - 1
    cut = (t - own < t[0]) | (t + own > t[-1])  # what is beside them is not at hand
    keys = (pixel * count + index)[order]
    low, high = keys + (low[order] - index[order]), keys + (high[order] - index[order])
    near = cut[order]
    for step in range(1, settings.away + 1):
        for away in (-step * count, step * count):
            open_ = np.flatnonzero(~near)
            first = np.searchsorted(keys, low[open_] + away)
            first[first == count] = count - 1  # the last key is below what is looked for, then
            near[open_] = (keys[first] >= low[open_] + away) & (keys[first] <= high[open_] + away)
    out = np.empty(count, np.bool_)
    out[order] = near
    return out


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

    Only events count that no edge along the line can have made. Two nulls, each binomial for all pairs
    together and by the signs of the runs' differences, which knows that pairs of one run depend on each
    other. Successive events share a line no more often than those 20 to 60 later; and no more often, compared
    with lines beside, than those. The largest p and the smallest size count.

    Args:
        groups: Counted pairs.
        level: p below which they are there.
    """
    s = groups.settings
    near, later = groups.runs
    if len(near) < 16:
        return without_answer(
            GROUPING, f"{len(near)} runs of events that follow each other within {s.span * 1e3:g} ms"
        )
    best: Signature | None = None
    for axis, line in enumerate(("row", "column")):
        count, expected = float(near[:, axis, 0].sum()), float(later[:, axis, 0].sum())
        if max(count, expected) < s.fewest or near[:, axis].sum() < s.fewest:
            continue
        p, (size, low, high) = _test_line(near[:, axis], later[:, axis], len(s.lags))
        entry = Signature(
            name=GROUPING, answer=Answer.NOT_SEEN, p=min(1.0, 2 * p), size=size, low=low, high=high,
            unit="times as often as by chance", least=s.least,
            sentence=f"{line}s are read together: the next event is of the same {line} {size:.3g} times "
            "as often as by chance",
            details={"line": line, "pairs": int(count)},
        )  # fmt: skip
        if best is None or (entry.p, -entry.size) < (best.p, -best.size):
            best = entry
    if best is None:
        return without_answer(
            GROUPING, "too few successive events share a row or column that no moving edge could have made"
        )
    unseen = f"the next event shares a {best.details['line']} {best.size:.2f} times as often as by chance"
    return judge_signature(best, level, unseen)
