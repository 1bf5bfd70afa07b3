"""Kernels and accumulators against loops, whatever the events come in."""

from __future__ import annotations

import numpy as np
import pytest

from dase.events import Events
from dase.signatures.calm_events import CalmFilter, CalmShare
from dase.signatures.clock import ClockCounts, ClockSettings
from dase.signatures.double_events import DoubleSettings, IntervalCounts, times_of_many


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
