"""Kernels and accumulators against loops, whatever the events come in."""

from __future__ import annotations

import numpy as np
import pytest

from dase.events import Events
from dase.probes.timestamp_patterns import PATTERNS, is_certain, share_at
from dase.signatures.calm_events import CalmFilter, CalmShare, intervals_of_pixels
from dase.signatures.clock import ClockCounts, ClockSettings
from dase.signatures.double_events import DoubleSettings, IntervalCounts, times_of_many
from dase.signatures.faint_bursts import _fold, _fold_heights
from dase.signatures.row_grouping import (
    GroupCounts,
    GroupingSettings,
    _count_pairs,
    _may_be_of_an_edge,
    _shuffled_within_stamps,
)


def some(rng, count=600, width=23, height=17, duration=0.5):
    """Events in whole microseconds, several at one time."""
    t = np.sort(rng.integers(0, int(duration * 1e6), count)) / 1e6
    t[100:103] = t[100]
    x, y = (rng.integers(0, n, count, np.uint16) for n in (width, height))
    return Events(t, x, y, rng.random(count) < 0.4, width, height)


def pieces(events, size):
    return [events.select(slice(i, i + size)) for i in range(0, len(events), size)]


@pytest.mark.parametrize("size", [600, 100, 1])
def test_calm_events_equal_a_loop(rng, size):
    e = some(rng)
    x, y = e.x.astype(int), e.y.astype(int)
    near = (np.abs(x[:, None] - x) <= 2) & (np.abs(y[:, None] - y) <= 2)
    near &= (x[:, None] != x) | (y[:, None] != y)
    want = ~(near & (np.abs(e.t[:, None] - e.t) <= 0.02)).any(1)
    looked = CalmFilter(e.width, e.height)
    parts = [*(looked.push(part) for part in pieces(e, size)), looked.flush()]
    assert np.array_equal(np.concatenate([part.t for part, _ in parts]), e.t)
    assert np.array_equal(np.concatenate([part.x for part, _ in parts]), e.x)
    assert np.array_equal(np.concatenate([calm for _, calm in parts]), want)
    assert 0 < want.sum() < len(want)


@pytest.mark.parametrize("size", [600, 37, 1])
def test_calm_share_equals_a_loop(rng, size):
    e = some(rng)
    looked = CalmShare(e.width, e.height, e.t[0], CalmFilter(e.width, e.height))
    for part in pieces(e, size):
        looked.push(part)
    cells = {(int((t - e.t[0]) / 0.04), y // 5, x // 5) for t, x, y in zip(e.t, e.x, e.y, strict=True)}
    spans = int((e.t[-1] - e.t[0]) / 0.04) + 1
    assert looked.share(e.t[-1]) == pytest.approx(1 - len(cells) / (spans * 5 * 4))


@pytest.mark.parametrize("size", [600, 7])
def test_short_intervals_equal_a_loop(rng, size):
    e = some(rng, width=3, height=2)
    looked = IntervalCounts(3, 2, DoubleSettings(tie=1e-4, near=1e-3, slow=(2e-3,), far=5e-3, shared=0.05))
    for part in pieces(e, size):
        looked.push(part)
    looked.finish()
    pixel = e.y.astype(int) * 3 + e.x
    away = np.abs(e.t[:, None] - e.t)
    at_once, around = ((away <= reach + 1e-12).sum(1) - 1 for reach in (1e-4, 5e-3))
    own_time = at_once <= 0.05 * around
    assert np.array_equal(times_of_many(e.t, slice(50, 90), looked.settings), ~own_time[50:90])
    assert 0.1 < own_time.mean() < 0.9
    in_all = []
    for k in range(6):
        t, p, alone = e.t[pixel == k], e.p[pixel == k], own_time[pixel == k][1:]
        gaps, same = np.diff(t), p[1:] == p[:-1]
        silent = same & (np.concatenate(([np.inf], gaps[:-1])) >= 5e-3 - 1e-9)
        for polarity in (False, True):
            rows = []
            for chosen in (same, silent, silent & alone):
                own = gaps[chosen & (p[1:] == polarity)]
                below = [np.count_nonzero(own < limit - 1e-9) for limit in (1e-4, 1e-3, 2e-3, 5e-3)]
                rows.append(np.diff(below, prepend=0).tolist())
            assert looked.counts[:, :, int(polarity), k].tolist() == rows
            in_all += [gaps[same & (p[1:] == polarity)]]
        assert looked.events[:, k].sum() == np.count_nonzero(pixel == k)
        assert looked.events[1, k] == np.count_nonzero(e.p[pixel == k])
    gaps, edges = np.concatenate(in_all), looked.edges - 1e-9
    sums = np.bincount(np.searchsorted(edges, gaps, side="right"), gaps, len(edges) + 1)
    assert looked.sums == pytest.approx(sums[:-1])


@pytest.mark.parametrize("size", [600, 13])
def test_clock_counts_equal_a_histogram_and_end(rng, size):
    e = some(rng)
    clock = ClockCounts(e.width, e.height, ClockSettings(step=1e-3, tiles=4, longest=0.2))
    for part in pieces(e, size):
        clock.push(part)
    bins = ((e.t - e.t[0]) / 1e-3).astype(int)
    inside = e.t < e.t[0] + 0.2
    want = np.zeros((bins[inside].max() + 1, 2, 16), int)
    tile = e.y.astype(int) * 4 // 17 * 4 + e.x.astype(int) * 4 // 23
    np.add.at(want, (bins[inside], e.p[inside].astype(int), tile[inside]), 1)
    assert np.array_equal(clock.counts, want)
    assert clock.times[0] == pytest.approx(e.t[0] + 5e-4)


def test_intervals_of_pixels_equal_a_loop(rng):
    e = some(rng)
    pixel, last, want = e.y.astype(int) * e.width + e.x, {}, []
    for t, k in zip(e.t, pixel, strict=True):
        want.append(t - last.get(k, -np.inf))
        last[k] = t
    assert np.array_equal(intervals_of_pixels(e), want)


def test_events_of_one_stamp_are_shuffled_by_their_draws(rng):
    t = np.sort(rng.integers(0, 150, 600)) / 1e6
    order = _shuffled_within_stamps(t, np.random.default_rng(5))
    assert np.array_equal(order, np.lexsort((np.random.default_rng(5).random(len(t)), t)))


@pytest.mark.parametrize("stamps", [500_000, 20_000, 200])
def test_events_of_edges_equal_a_loop(rng, stamps):
    s = GroupingSettings(lags=(3, 5, 7), away=2, span=0.05)
    e = some(rng)
    t = np.floor(e.t * stamps) / stamps
    place, index = np.array((e.x, e.y), np.int32), np.arange(len(t))
    pixel = e.y.astype(int) * e.width + e.x
    want = np.zeros(len(t), int)
    for i in range(len(t)):
        own = np.abs(t[(pixel == pixel[i]) & (index != i)] - t[i]).min(initial=s.span)
        stamp = index[t == t[i]]
        near = (index >= stamp[0] - 7) & (index <= stamp[-1] + 7)
        near |= (t >= t[i] - own) & (t <= t[i] + own)
        for axis in range(2):
            apart = np.abs(place[axis] - place[axis, i])
            beside = (place[1 - axis] == place[1 - axis, i]) & (apart > 0) & (apart <= 2)
            unknown = t[i] - own < t[0] or t[i] + own > t[-1]
            want[i] += (1 + axis) * bool(unknown or (near & beside).any())
    assert np.array_equal(_may_be_of_an_edge(t, place, (e.height, e.width), s), want)
    assert len(np.unique(want)) == 4


def test_pairs_on_lines_equal_a_loop(rng):
    s = GroupingSettings(lags=(3, 5), span=5e-4)
    e = some(rng, count=6000)
    place = np.array((e.x, e.y), np.int32)
    left_out = rng.integers(0, 4, len(e), np.int32)
    begins = np.array((0, 2000, 6000), np.int32)
    free, pairs = np.zeros((2, 2, 3), int), np.zeros((2, 2, 3, 2), int)
    for run in range(2):
        for k, lag in enumerate((1, 3, 5)):
            for i in range(begins[run], begins[run + 1] - lag):
                for axis in range(2):
                    closed = (left_out[i] | left_out[i + lag]) & (1 + axis)
                    if closed or e.t[i + lag] - e.t[i] >= s.span:
                        continue
                    free[run, axis, k] += 1
                    along, across = np.abs(place[:, i + lag] - place[:, i])[[axis, 1 - axis]]
                    if across <= 2 and along > 4:
                        pairs[run, axis, k, min(across, 1)] += 1
    found = _count_pairs(e.t, place, left_out, begins, s)
    assert np.array_equal(found[0], free)
    assert np.array_equal(found[1], pairs)
    assert pairs.min() > 0


def test_pairs_do_not_depend_on_pieces(rng):
    e = some(rng, count=20_000)
    runs = []
    for size in (20_000, 777):
        groups = GroupCounts(len(e), np.zeros(23 * 17, bool))
        for part in pieces(e, size):
            groups.push(part)
        runs.append(groups.runs)
    assert len(runs[0][0])
    assert all(np.array_equal(*both) for both in zip(*runs, strict=True))


def test_heights_of_folds_are_those_of_one_fold_after_the_other(rng):
    rate = rng.normal(size=1003)
    # of halves and quarters steps lie in the middle between two
    periods = np.concatenate((rng.uniform(28, 400, 50), 28 + np.arange(60) / 4, [500.5, 501.0, 501.5]))
    want = [_fold(rate, float(period))[0].max() for period in periods]
    assert np.array_equal(_fold_heights(rate, periods), want)


@pytest.mark.parametrize("follow", [0.0, 0.5, 0.9, 0.975, 1.0])
@pytest.mark.parametrize("slack", [0.0, 3e-6])
def test_a_regularity_is_certain_where_enough_times_follow_it(rng, follow, slack):
    step = 17.3e-6
    reach = np.where(rng.random(20_000) < follow, max(slack, 1e-6), step / 2)
    t = np.sort(step * rng.integers(0, 60_000, 20_000) + rng.uniform(-reach, reach))
    assert is_certain(t, step, slack) == (share_at(t, step, slack) >= PATTERNS.certain) == (follow > 0.97)
