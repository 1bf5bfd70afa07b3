"""Statistics of recordings against loops over their events, and what is known of the recordings in shared."""

from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.sample_files import aedat4

from dase import io
from dase.events import Events
from dase.io.sequence import Sequence
from dase.recordings import statistics, summary
from dase.recordings.anomalies import find_anomalies
from dase.recordings.interval_statistics import IntervalSettings, IntervalStatistics
from dase.recordings.statistics import (
    RecordingSurvey,
    SurveySettings,
    sequence_statistics,
    survey_file,
    survey_sequence,
)


def some(rng, count=4000, width=20, height=15, duration=2.0):
    """Events with times in whole microseconds, several at one time and pixel."""
    t = np.sort(rng.integers(0, int(duration * 1e6), count)) / 1e6
    x, y = (rng.integers(0, n, count, np.uint16) for n in (width, height))
    t[1000:1005], x[1000:1005], y[1000:1005] = t[1000], x[1000], y[1000]
    return Events(t, x, y, rng.random(count) < 0.4, width, height)


def by_pixel(e):
    """Times and polarities of each pixel."""
    pixel = e.y.astype(int) * e.width + e.x
    return [(e.t[pixel == k], e.p[pixel == k]) for k in range(e.width * e.height)]


def odd(s):
    return {note.rule: note for note in find_anomalies(s)}


@pytest.mark.parametrize("part", [1 << 20, 700, 3])
def test_statistics_equal_loops_whatever_is_looked_at_together(rng, part):
    e = some(rng, 1500)
    looked = RecordingSurvey(e.width, e.height, SurveySettings(part=part))
    for i in range(0, len(e), 401):
        looked.add_events(e.select(slice(i, i + 401)))
    got = looked.statistics()
    pixels = by_pixel(e)
    between = np.concatenate([np.diff(t) for t, _ in pixels])
    flips = np.concatenate([p[1:] != p[:-1] for _, p in pixels])
    assert got.events == 1500
    assert got.on_share == np.mean(e.p)
    assert got.flip_share == pytest.approx(np.mean(flips))
    assert got.simultaneous == np.count_nonzero(between == 0)
    for name, share in (("shortest", 0.001), ("low", 0.01), ("median", 0.5), ("high", 0.99)):
        assert getattr(got, f"interval_{name}") == pytest.approx(np.quantile(between, share), abs=1e-12)
    assert sum(count for *_, count in got.intervals) == np.count_nonzero(between > 0)
    assert got.stamps == len(np.unique(e.t))
    assert got.quantum == pytest.approx(1e-6)
    gaps = np.diff(e.t)
    assert got.longest_gap == pytest.approx((e.t[gaps.argmax()], gaps.max()))
    assert got.silent_pixels == sum(len(t) == 0 for t, _ in pixels)
    assert got.busiest_rate == pytest.approx(max(len(t) for t, _ in pixels) / got.duration)


def test_isolated_events_equal_a_loop(rng):
    every = SurveySettings(asked=1 << 20)
    e = some(rng, 3000, 40, 30)
    inner = (e.t >= e.t[0] + every.alone) & (e.t < e.t[-1] - every.alone)
    alone = []
    for t, x, y in zip(e.t[inner], e.x[inner].astype(int), e.y[inner].astype(int), strict=True):
        near = (np.abs(e.x.astype(int) - x) <= 1) & (np.abs(e.y.astype(int) - y) <= 1)
        near &= (e.t >= t - every.alone) & (e.t <= t + every.alone)
        alone.append(near.sum() == 1)
    got = survey_sequence(Sequence(e), every).statistics()
    assert 0.5 < np.mean(alone) < 0.99
    assert got.alone_rate == pytest.approx(np.mean(alone) * 3000 / (40 * 30 * got.duration))


def test_hot_pixels_stand_out_from_those_around_them(rng):
    e = some(rng, 30_000, 40, 30)  # 25 events a pixel
    for rows, found in (((7, 9, 900), True), ((7, 9, 200), False)):
        x, y, count = rows
        extra = Events(
            np.linspace(0, 2, count),
            *(np.full(count, k, np.uint16) for k in (x, y)),
            np.arange(count) % 2 > 0,
            40,
            30,
        )
        both = np.concatenate([e.t, extra.t])
        order = np.argsort(both, kind="stable")
        columns = (np.concatenate([getattr(e, k), getattr(extra, k)])[order] for k in "xyp")
        looked = survey_sequence(Sequence(Events(both[order], *columns, 40, 30)))
        assert np.argwhere(looked.hot_pixels()).tolist() == ([[y, x]] if found else [])
        got = looked.statistics()
        assert got.hot_pixels == found
        assert ("hot" in odd(got)) == found
        if found:
            assert got.hot_share == pytest.approx(1 / 34, rel=0.1)
            assert got.busiest_pixel == (x, y)


def test_quantiles_of_many_intervals_are_good_to_a_percent(rng):
    seconds = np.concatenate([np.exp(rng.normal(-5, 2, 50_000)), np.zeros(100)])
    got = IntervalStatistics(IntervalSettings(exact=100))
    for part in np.split(rng.permutation(seconds), 10):
        got.add(part)
    assert got.quantile(0.001) == 0.0
    for share in (0.01, 0.1, 0.5, 0.9, 0.999):
        assert got.quantile(share) == pytest.approx(np.quantile(seconds, share), rel=0.01)


def test_the_period_of_a_readout_is_found_and_none_where_there_is_none(rng):
    turns = rng.geometric(0.02, 20_000)
    for period, jitter in ((195.16e-6, 1e-6), (50e-6, 2e-6), (1e-3, 0.0)):
        got = IntervalStatistics()
        got.add(np.rint((turns * period + rng.normal(0, 1, 20_000) * jitter) * 1e6) / 1e6)
        found, share = got.period()
        assert found == pytest.approx(period, rel=2e-3)
        assert share > 0.7
    for seconds in (
        rng.exponential(0.01, 20_000),
        rng.gamma(4, 1e-3, 20_000),
        rng.normal(75e-6, 4e-6, 20_000),
    ):
        got = IntervalStatistics()
        got.add(np.rint(np.abs(seconds) * 1e6) / 1e6)
        assert math.isnan(got.period()[0])


def test_the_modal_interval(rng):
    got = IntervalStatistics()
    got.add(
        np.rint(np.concatenate([rng.exponential(0.01, 9000), rng.normal(75, 2, 1000) * 1e-6]) * 1e6) / 1e6
    )
    assert got.mode() == pytest.approx(75e-6, abs=4e-6)
    assert math.isnan(IntervalStatistics().mode())


def test_coarse_time_stamps(rng):
    e = some(rng)
    for step, finest in ((1e-3, 1e-3), (195e-6, 195e-6)):
        t = np.sort(np.rint(e.t / step)) * step + 0.25
        got = sequence_statistics(Sequence(replace(e, t=t)))
        assert got.quantum == pytest.approx(finest)
        assert "coarse" in odd(got)
    assert "coarse" not in odd(sequence_statistics(Sequence(e)))
    fine = sequence_statistics(Sequence(replace(e, t=np.sort(rng.random(len(e))))))
    assert dict(summary.statistics_table(fine))["time stamps"].startswith("finer than 1 µs")


def test_doubts(rng):
    e = some(rng)
    none = odd(sequence_statistics(Sequence(e)))
    assert set(none) == set()
    assert set(odd(sequence_statistics(Sequence(Events.empty(4, 3))))) == {"empty"}
    everything_on = odd(sequence_statistics(Sequence(replace(e, p=np.ones(len(e), bool)))))
    assert "100 % of the events are ON" in everything_on["polarity"]
    narrow = odd(sequence_statistics(Sequence(replace(e, width=30, x=e.x + np.uint16(2)))))
    assert narrow["bare"] == "no event in columns 22..29"
    assert narrow["bare"].number == 10
    late = odd(sequence_statistics(Sequence(replace(e, t=e.t + np.where(e.t > 1, 0.5, 0.0)))))
    assert late["gap"].startswith("no event at all for 50")
    twice = odd(
        sequence_statistics(
            Sequence(e.select(np.repeat(np.arange(len(e)), 1 + (np.arange(len(e)) % 100 == 0))))
        )
    )
    assert twice["duplicate"].number >= 40
    flicker = some(rng, 3000, 3, 3)
    pixel = flicker.y.astype(int) * 3 + flicker.x
    order = np.array([np.count_nonzero(pixel[:k] == pixel[k]) for k in range(3000)])
    assert "100 %" in odd(sequence_statistics(Sequence(replace(flicker, p=order % 2 > 0))))["flips"]
    fast = replace(flicker, t=np.arange(3000) // 2 * 1e-6, x=np.repeat(flicker.x[::2], 2), y=flicker.y * 0)
    assert "fast" in odd(sequence_statistics(Sequence(fast)))


def test_doubts_about_frames(rng):
    e, grey = some(rng), rng.integers(1, 255, (4, 15, 20), np.uint8)
    times = np.arange(4) * 0.1

    def told(frames=grey, times=times, exposure=None):
        return set(odd(sequence_statistics(Sequence(e, frames, times, frame_exposure=exposure))))

    assert told(exposure=np.full(4, 0.02)) == set()
    assert told() == {"exposure"}
    assert told(times=None) == {"frames"}
    assert told(exposure=np.full(4, 0.2)) == {"exposure"}
    assert told(frames=grey // 255, exposure=np.full(4, 0.02)) == {"clipped"}


def test_a_file_streams_through_the_same(tmp_path, rng):
    e = some(rng, 20_000, 240, 180)
    frames = [(k * 1000, k * 1000 + 400, rng.integers(0, 256, (180, 240), np.uint8)) for k in range(5)]
    aedat4(tmp_path / "a.aedat4", e, frames=frames)
    notes = []
    seen = []
    got = survey_file(tmp_path / "a.aedat4", notes=notes, progress=seen.append).statistics()
    want = sequence_statistics(io.read(tmp_path / "a.aedat4"))
    assert sum(seen) == len(e)
    for name, value in vars(want).items():
        if isinstance(value, float):
            assert getattr(got, name) == pytest.approx(value, nan_ok=True), name
        else:
            assert getattr(got, name) == value, name
    assert got.exposure == pytest.approx((400e-6, 400e-6))
    assert got.frame_interval == pytest.approx(1e-3)


def test_memory_does_not_grow_with_the_recording(rng):
    e = some(rng, 100_000, 64, 48)
    looked = RecordingSurvey(64, 48)

    def take(count):
        for _ in range(count):
            looked.add_events(replace(e, t=e.t + looked._span[1] if math.isfinite(looked._span[1]) else e.t))

    take(12)  # as many as are kept exactly
    tracemalloc.start()
    take(3)
    before = tracemalloc.get_traced_memory()[0]
    take(10)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert looked.statistics().events == 2_500_000
    assert grown < 1 << 16


def test_info_prints_and_writes_json(tmp_path, rng):
    import importlib

    command = importlib.import_module("dase.cli.info").info_command
    e = some(rng, 5000, 64, 48)
    (tmp_path / "a.txt").write_text(
        "".join(f"{t:.6f} {x} {y} 1\n" for t, x, y in zip(e.t, e.x, e.y, strict=True))
    )
    done = CliRunner().invoke(command, [str(tmp_path / "a.txt")])
    assert done.exit_code == 0, done.output
    assert "format            text" in done.output
    assert "sensor            128 x 128" in done.output
    assert "assumed:  the file does not say how large the sensor is" in done.output
    assert "odd:      100 % of the events are ON" in done.output
    assert "█" in done.output
    words = [str(tmp_path / "a.txt"), "--size", "64x48", "--json"]
    done = CliRunner().invoke(command, [*words, "-"])
    told = json.loads(done.output)
    assert (told["format"], told["width"], told["height"], told["events"]) == ("text", 64, 48, 5000)
    assert told["on_share"] == 1.0
    assert told["period"] is None
    assert {note["rule"] for note in told["notes"]} == {"polarity"}
    done = CliRunner().invoke(command, [*words, str(tmp_path / "a.json")])
    assert "format            text" in done.output
    assert json.loads((tmp_path / "a.json").read_text()) == told
    done = CliRunner().invoke(command, [str(tmp_path / "a.txt"), "--size", "big"])
    assert done.exit_code == 2


def test_what_is_known_of_the_shared_recordings(shared):
    folder = shared / "recordings"
    got = {p.stem: survey_file(p).statistics() for p in folder.glob("*.npz") if p.stem != "noise_iebcs"}
    dvx = got["dvx_noise_static"]
    assert dvx.period == pytest.approx(195e-6, rel=0.01)
    assert dvx.alone_rate == pytest.approx(0.4, abs=0.1)
    assert 0.0001 < dvx.hot_pixels / (640 * 480) < 0.0014
    dot = got["psee_gen31_dot"]
    assert dot.interval_mode == pytest.approx(75e-6)
    assert dot.interval_shortest == pytest.approx(12e-6)
    assert dot.busiest_rate == pytest.approx(66e3, rel=0.01)
    assert got["psee_hd_ros_trigger"].flip_share == pytest.approx(0.97, abs=0.01)
    assert 0.0009 < got["davis240c_camerashake"].interval_shortest < 0.0013
    cradle = got["davis346_cuke_cradle"]
    assert (cradle.frames, cradle.exposure) == (13, pytest.approx((0.02, 0.02)))
    assert cradle.frame_interval == pytest.approx(0.04)
    bench = got["davis240b_evbench1"]
    assert bench.on_share == pytest.approx(0.3, abs=0.01)
    assert bench.active[2] == 190
    assert odd(bench)["bare"] == "no event in columns 190..239"


def with_gaps(rng, gaps):
    """One second of 50 000 events, without any in spans of time [s]."""
    t = np.sort(rng.random(50_000))
    for begin, end in gaps:
        t = t[(t < begin) | (t >= end)]
    n = len(t)
    x, y = (rng.integers(0, 64, n, np.uint16) for _ in "xy")
    return Sequence(Events(t, x, y, rng.random(n) < 0.5, 64, 64))


@pytest.mark.parametrize(
    ("gaps", "said"),
    [
        ([(0.1 + 0.03 * k, 0.118 + 0.03 * k) for k in range(29)], ["18 ms, 29 times, every 30 ms, from"]),
        ([(0.1, 0.118), (0.13, 0.148), (0.5, 0.518), (0.7, 0.9)], ["18 ms, 3 times, some", "200 ms, from"]),
        ([(0.1, 0.15), (0.5, 0.53)], ["50 ms, from 0.100 s on: data may be missing; 2 such gaps"]),
        ([(0.5, 0.53)], ["30 ms, from 0.500 s on: data may be missing"]),
        ([], []),
    ],
)  # fmt: skip
def test_gaps_that_repeat_are_named(rng, gaps, said):
    found = sequence_statistics(with_gaps(rng, gaps))
    assert len(found.gaps) == len(gaps)
    np.testing.assert_allclose([begin for begin, _ in found.gaps], [begin for begin, _ in gaps], atol=1e-3)
    notes = [note for note in find_anomalies(found) if note.rule == "gap"]
    assert len(notes) == len(said)
    for note, words in zip(notes, said, strict=True):
        assert words in note


def test_gaps_do_not_fill_the_memory(rng):
    t = np.repeat(np.arange(5000) * 0.02, 2)
    x = np.zeros(len(t), np.uint16)
    found = sequence_statistics(Sequence(Events(t, x, x, x > 0, 64, 64)))
    assert len(found.gaps) == 1000


@pytest.mark.parametrize("pixels", [1, 3000, 1 << 20, 1 << 31])
def test_pixels_in_order_are_those_of_a_stable_sort(pixels, rng):
    # each several times, so that it shows where equal ones change places
    pixel = rng.permutation(np.repeat(rng.integers(0, pixels, 500), 4))
    np.testing.assert_array_equal(statistics._stable_order(pixel), np.argsort(pixel, kind="stable"))
