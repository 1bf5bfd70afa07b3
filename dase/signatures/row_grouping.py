"""Events that leave together share a row, or a column: how the sensor is read.

An arbiter takes a row with events and sends all of them; so the next event is far more often of the same row
than one some dozen events later. An edge along a row that moves makes its pixels send together, too, if they
are alike: at one instant, as a row with one time stamp for all. It leaves out no pixel between two of them,
so events count only where the pixels beside them on the line are silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.kernels import launch
from dase.kernels.event_groups import (
    count_line_pairs,
    mark_with_neighbours,
    measure_own_gaps,
    order_within_stamps,
)
from dase.signatures.calm_events import row_major_pixels
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
        kept = np.flatnonzero(~self._hot[row_major_pixels(block)])
        t = block.t[kept]
        if len(t) <= s.lags[-1]:
            return
        # files sort events of one stamp as they like: that is no readout
        chosen = kept[_shuffled_within_stamps(t, self._random)]
        place = np.array((block.x[chosen], block.y[chosen]), np.int32)
        of_an_edge = _may_be_of_an_edge(t, place, (block.height, block.width), s)
        begins = np.arange(s.together + 1, dtype=np.int32) * len(t) // s.together
        free, pairs = _count_pairs(t, place, of_an_edge, begins, s)
        for run, (begin, end) in enumerate(pairwise(begins)):
            later = free[run, :, 1:].sum(1, keepdims=True)  # (2, 1)
            if not later.any() or _share_soon(t[begin:end], s) < 0.5:
                continue
            self._next.append(np.where(later, pairs[run, :, 0], 0))
            self._later.append(pairs[run, :, 1:].sum(1) * (free[run, :, :1] / np.maximum(later, 1)))

    @property
    def runs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pairs of successive events, and mean pairs of later ones.

        Each of shape (R, 2, 2): by run; row, column; the same line, lines beside it.
        """
        empty = np.zeros((0, 2, 2))
        if not self._next:
            return empty, empty
        return np.array(self._next, np.float64), np.array(self._later, np.float64)


def _shuffled_within_stamps(t: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.int32]:
    """Return an order of events, sorted by time, in which those of one stamp come as they like."""
    draws = random.random(len(t))
    order = np.arange(len(t), dtype=np.int32)
    alike = t[1:] == t[:-1]
    shared = order[np.append(alike, False) | np.append(False, alike)]
    first = np.maximum.accumulate(np.where(np.append(False, alike), 0, order))
    drawn = shared[np.argsort(draws[shared])]
    launch.run_on_arrays(order_within_stamps, first, drawn, order.copy(), order)
    return order


def _share_soon(t: NDArray[np.float64], settings: GroupingSettings) -> float:
    """Return the share of pairs of later events of a run that come soon enough; 0 where there are too few.

    Args:
        t: Times, sorted [s], shape (N,).
        settings: How many events later, and how soon.
    """
    s = settings
    if len(t) <= s.lags[-1]:
        return 0.0
    soon = [np.count_nonzero(t[lag:] - t[:-lag] < s.span) / (len(t) - lag) for lag in s.lags]
    return float(np.mean(soon))


def _may_be_of_an_edge(
    t: NDArray[np.float64], place: NDArray[np.int32], shape: tuple[int, int], settings: GroupingSettings
) -> NDArray[np.int32]:
    """Return which events an edge along their line may have made, shape (N,): 1 row, 2 column, 3 either.

    Pixels of such an edge see the same light. Where they are alike and each has sent before, each sends once
    between two events of one of them, all at one instant if their memories were set in the same light. So an
    event counts as of an edge if a pixel beside it on its line sends within the time to the nearer of its own
    pixel's other events.

    Args:
        t: Times, sorted [s], shape (N,).
        place: Columns and rows [px], shape (2, N).
        shape: Rows and columns of the sensor.
        settings: How near is beside; the longest time.
    """
    s, gaps, out = settings, np.empty(len(t)), np.zeros(len(t), np.int32)
    launch.run_on_arrays(measure_own_gaps, t, place, s.span, np.full(shape, -1, np.int32), gaps)
    for sign in (1, -1):
        seen = np.full([side + 2 * s.away for side in shape], -1, np.int32)
        # at least as far as the events with which successive ones are compared, and all of one stamp
        launch.run_on_arrays(mark_with_neighbours, t, place, gaps, s.lags[-1], s.away, sign, seen, out)
    return out


def _count_pairs(
    t: NDArray[np.float64],
    place: NDArray[np.int32],
    of_an_edge: NDArray[np.int32],
    begins: NDArray[np.int32],
    settings: GroupingSettings,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return pairs of events of a run that are one apart, and as many as `lags` [events], L in all.

    Args:
        t: Times, sorted [s], shape (N,).
        place: Columns and rows [px], shape (2, N).
        of_an_edge: Events that do not count, shape (N,): 1 on their row, 2 on their column, 3 on both.
        begins: Of runs, and the end of the last, shape (R + 1,).
        settings: Which pairs count.

    Returns:
        All that come soon enough, on rows and on columns, shape (R, 2, L), and those of these that are of one
        line, and of lines near by, shape (R, 2, L, 2).
    """
    s, lags = settings, np.array((1, *settings.lags), np.int32)
    free = np.zeros((len(begins) - 1, 2, len(lags)), np.int32)
    pairs = np.zeros((*free.shape, 2), np.int32)
    launch.run_on_arrays(
        count_line_pairs, t, place, of_an_edge, begins, lags, s.span, s.beside, s.away, free, pairs,
        dim=(len(begins) - 1, len(lags)),
    )  # fmt: skip
    return free, pairs


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
