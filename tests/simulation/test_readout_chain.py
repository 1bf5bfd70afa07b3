"""Readout effects against plain loops over events, and what must hold however the stream is cut."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from helpers.readout_streams import HEIGHT, WIDTH, bunched, camera, moving, ns, same, through

import dase
from dase import io
from dase.datasets import generate
from dase.effects import Reader, StreamEffect, parameter
from dase.effects.latency import Latency
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.rate_control import RateControl
from dase.effects.readout import Readout
from dase.effects.refractory import Refractory
from dase.effects.row_scan import RowScan
from dase.effects.shot import Shot
from dase.effects.stream import order_events
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.simulation.readout_chain import ReadoutChain
from dase.simulation.sensor_file import parse_sensor

STREAM = (RowScan, Readout, Timestamp)


def everything(mode: str = "delay", scan: str = "down") -> dase.Sensor:
    """Return a sensor with noise and every readout effect, each strong."""
    return camera(
        Mismatch(spread=0.1),
        Leak(rate=8.0),
        Shot(rate=60.0),
        Refractory(period=1e-3),
        Latency(delay=4e-3, light=0.7),
        RowScan(line=1e-4, direction=scan),
        Readout(rate=3e4, depth=20, mode=mode),
        Timestamp(jitter=2e-3, step=1e-5),
    )


# ---- all of them


@pytest.mark.parametrize("effect", [Latency, *STREAM], ids=lambda effect: effect.name)
def test_switched_off_it_is_not_there(device, rng, effect):
    scene, plain = moving(rng), camera(Shot(rate=30.0))
    off = plain.with_effect(effect.identity())
    want = dase.simulate(scene, plain, device=device)
    same(dase.simulate(scene, off, device=device), want)
    times = scene.sample_times()
    np.testing.assert_array_equal(
        dase.count(scene, off, times, device=device), dase.count(scene, plain, times, device=device)
    )
    on = dase.simulate(scene, plain.with_effect(effect()), device=device)
    assert len(on) != len(want) or not np.array_equal(on.t, want.t)


@pytest.mark.parametrize("mode", ["delay", "drop", "rows"])
@pytest.mark.parametrize("labels", [False, True])
def test_chunks_do_not_matter(device, rng, mode, labels):
    scene, sensor = moving(rng), everything(mode)
    whole = dase.simulate(scene, sensor, device=device, labels=labels)
    for chunk in (1, 2, 7, 64, 199, 200):
        parts = dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=chunk, labels=labels))
        same(parts, whole)
    assert len(whole) > 1000
    assert whole.t[-1] > scene.sample_times()[-1]  # latency brings events after the last sample
    other = dase.simulate(scene, sensor, device=device, seed=1)
    assert not np.array_equal(other.t, whole.t)


@pytest.mark.parametrize("tick", [1, 4000])
@pytest.mark.parametrize(
    "effect",
    [
        RowScan(line=3.7e-6),
        RowScan(line=4e-6),
        RowScan(line=3.7e-6, direction="left"),
        Readout(rate=1e6, depth=30),
        Readout(rate=1e6, mode="drop"),
        Readout(rate=1e6, mode="rows"),
        Readout(rate=1e6, line=5e-6, mode="columns"),
        Timestamp(jitter=3e-6, step=0.0),
        Timestamp(jitter=3e-6, step=7e-7),
        Timestamp(jitter=0.0, step=7e-7),
    ],
    ids=repr,
)
def test_parts_do_not_matter_and_labels_go_along(rng, effect, tick):
    events, sensor = bunched(rng, tick=tick), camera(effect)
    whole = through(sensor, events)
    for count in (1, 5, 400):
        cuts = np.sort(rng.integers(0, len(events), count)).tolist()
        same(through(sensor, events, cuts), whole)
    assert np.all(np.diff(whole.t) >= 0)
    np.testing.assert_array_equal(whole.label, whole.x % 4)
    assert np.bincount(whole.label).min() > 15


def test_large_parts_are_taken_in_pieces(rng):
    events, sensor = bunched(rng), camera(*(effect() for effect in STREAM))
    whole = through(sensor, events)
    chain = ReadoutChain(sensor, events.width, events.height, part=100)
    pieces = [chain.push(events, float(events.t[-1])), chain.flush()]
    same(dase.Events.concatenate(pieces), whole)


def test_they_act_in_the_order_of_the_sensor(rng):
    events, step = bunched(rng), Timestamp(jitter=0.0, step=1e-4)
    scan = RowScan(line=1e-6)
    stamped_last = through(camera(scan, step), events)
    stamped_first = through(camera(step, scan), events)
    assert set(np.rint(stamped_last.t * 1e9) % 100_000) == {0}
    late = np.rint(stamped_first.t * 1e9).astype(int)
    np.testing.assert_array_equal(late % (HEIGHT * 1000), stamped_first.y.astype(int) * 1000)


@dataclass(frozen=True, kw_only=True)
class Mute(StreamEffect):
    """A user's own: one polarity is lost."""

    name: ClassVar[str] = "mute"
    source: ClassVar[str] = "this test"
    polarity: float = parameter(1.0, unit="1", off=-1.0, bounds=(-1.0, 1.0), plausible=(0.0, 1.0), about="")

    def reader(self, width: int, height: int, seed: int) -> Reader:
        muted = bool(self.polarity)

        class Half(Reader):
            def push(self, events, until):
                return events.select(events.p != muted), until

        return Half()


def test_an_effect_of_the_users_own(device, rng):
    scene = moving(rng)
    want = dase.simulate(scene, camera(), device=device)
    got = dase.simulate(scene, camera(Mute()), device=device)
    same(got, want.select(~want.p))
    assert dase.count(scene, camera(Mute()), [0, 9], device=device)[0, 0, 1].sum() == 0
    same(dase.simulate(scene, camera(Mute.identity()), device=device), want)


def test_indices_that_sort(rng):
    columns = [rng.integers(-5, 5, 500) for _ in range(3)]
    wide = [rng.integers(-(2**60), 2**60, 500), columns[0]]  # more than 62 bits together
    for some in (columns, wide, columns[:1], [np.zeros(7, int)], [np.empty(0, int)]):
        np.testing.assert_array_equal(order_events(*some), np.lexsort(some[::-1]))


# ---- counting


def test_counts_are_those_of_what_each_pixel_sends(device, rng):
    scene, sensor = moving(rng), everything()
    events = dase.simulate(scene, sensor.without("readout"), device=device)
    edges = np.unique(events.t[[100, 700, 710, 1200]])
    later = np.array(ns(events))
    want = np.zeros((3, 2, WIDTH * HEIGHT), int)
    for w, (begin, end) in enumerate(pairwise(edges)):
        inside = (later > round(begin * 1e9)) & (later <= round(end * 1e9))
        place = events.y.astype(int) * WIDTH + events.x
        np.add.at(want[w], (events.p[inside].astype(int), place[inside]), 1)
    np.testing.assert_array_equal(dase.count(scene, sensor, edges, device=device)[0], want)
    assert want.sum() > 500


def test_counts_leave_out_what_pixels_share_and_the_ticks_of_a_clock(device, rng):
    scene, plain, edges = moving(rng), camera(Shot(rate=30.0)), [0.0, 0.2, 0.9]
    sensor = plain
    for effect in (Readout(rate=1e3, mode="drop"), Timestamp(jitter=0.0, step=1e-4), RateControl(rate=1e4)):
        sensor = sensor.with_effect(effect)
    assert not sensor.by_single_pixels().changes_event_stream()
    want = dase.count(scene, plain, edges, device=device)
    np.testing.assert_array_equal(dase.count(scene, sensor, edges, device=device), want)
    assert len(dase.simulate(scene, sensor, device=device)) < 0.8 * want.sum()
    alone = dase.count(scene, sensor, edges, device=device, pixels=[50, 3])
    np.testing.assert_array_equal(alone, want[..., [50, 3]])


def test_a_batch_has_an_outlet_for_each_row(device, rng):
    scene, sensor = moving(rng), everything()
    other = sensor.with_effect(Threshold(on=0.5)).with_effect(Latency(delay=1e-3))
    vectors = np.stack([sensor.parameters(), other.parameters()])
    got = dase.count(scene, sensor, [0.1, 0.3, 0.5], device=device, parameters=vectors)
    for row, alone in enumerate((sensor, other)):
        want = dase.count(scene, alone, [0.1, 0.3, 0.5], device=device)[0]
        np.testing.assert_array_equal(got[row], want)
    assert not np.array_equal(got[0], got[1])


def test_some_pixels_alone(device, rng):
    scene, chosen = moving(rng), np.array([50, 3, 77])
    effects = Latency(delay=1e-3), RowScan(line=1e-4)
    whole = dase.simulate(scene, camera(*effects), device=device)
    part = dase.simulate(scene, camera(*effects), device=device, pixels=chosen)
    same(part, whole.select(np.isin(whole.y.astype(int) * WIDTH + whole.x, chosen)))
    counts = dase.count(scene, camera(*effects), [0.0, 9.0], device=device, pixels=chosen)[0, 0]
    want = whole.counts([0.0, 9.0])[0].reshape(2, -1)[:, chosen]
    np.testing.assert_array_equal(counts, want)
    with pytest.raises(dase.InputError, match="effect 'readout' needs all 143 pixels of the sensor, got 3"):
        dase.simulate(scene, camera(Readout()), device=device, pixels=chosen)
    with pytest.raises(dase.InputError, match="pixels must differ"):
        dase.count(scene, camera(*effects), [0, 9], device=device, pixels=[3, 3])


# ---- files, sensors, refusals


def test_files_hold_what_leaves(tmp_path, rng):
    scene, sensor = moving(rng), everything()
    report = generate.record_scene(scene, sensor, tmp_path / "a.h5", frame_rate=20.0, seed=4, labels=True)
    got = io.read(tmp_path / "a.h5").events
    same(got, dase.simulate(scene, sensor, seed=4, labels=True))
    assert report.events == len(got)


def test_sensor_files_keep_them_in_order():
    for sensor in (everything("drop", "left"), camera(Timestamp(), Readout())):
        again = parse_sensor(dase.dump_sensor(sensor), "text")
        assert again == replace(sensor, name=again.name)
        assert [e.name for e in again.effects] == [e.name for e in sensor.effects]
    text = dase.dump_sensor(everything("drop", "left"))
    assert 'direction = "left"' in text
    assert 'mode = "drop"' in text


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Latency(delay=-1e-6), r"latency\.delay must lie in \[0, 0\.1\] s, got -1e-06"),
        (lambda: Latency(dark=0.0), r"latency\.dark must lie in \[0\.0001, 1\] 1, got 0"),
        (lambda: Readout(rate=0.0), r"readout\.rate must lie in \[1, inf\] Hz, got 0"),
        (lambda: Readout(depth=0.0), r"readout\.depth must lie in \[1, inf\] 1, got 0"),
        (
            lambda: Readout(mode="wait"),
            r"readout\.mode must be one of delay, drop, rows, columns, got 'wait'",
        ),
        (lambda: RowScan(line=float("nan")), r"row_scan\.line must lie in \[0, 0\.1\] s, got nan"),
        (lambda: RowScan(line=1e-10), r"row_scan\.line must be 0 or at least 1e-09 s, got 1e-10"),
        (lambda: RowScan(direction="back"), r"row_scan\.direction must be one of down, up, right, left"),
        (lambda: Timestamp(jitter=1.0), r"timestamp\.jitter must lie in \[0, 0\.1\] s, got 1"),
        (lambda: Timestamp(step=1e-12), r"timestamp\.step must be 0 or at least 1e-09 s, got 1e-12"),
    ],
)
def test_refusals_name_thing_rule_and_value(make, message):
    with pytest.raises(dase.InputError, match=message):
        make()


def test_times_on_a_calendar_are_refused(rng):
    events = bunched(rng)
    late = replace(events, t=events.t + 1.7e9)
    with pytest.raises(dase.InputError, match=r"need times within 4e\+06 s of 0, got 1\.7e\+09"):
        through(camera(RowScan()), late)
    same(through(camera(), late), late)
