"""Readout effects against plain loops over events, and what must hold however the stream is cut."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
import reference

import dase
from dase import io, synth
from dase.config import parse_sensor
from dase.effects import Reader, StreamEffect, parameter
from dase.effects.latency import Latency
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.readout import Readout
from dase.effects.refractory import Refractory
from dase.effects.row_scan import RowScan
from dase.effects.shot import Shot
from dase.effects.stream import order
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.outlet import Outlet
from dase.pixels import Pixels

WIDTH, HEIGHT = 13, 11
STREAM = (RowScan, Readout, Timestamp)


def camera(*effects: dase.Effect) -> dase.Sensor:
    return dase.Sensor((Threshold(), *effects))


def bunched(rng: np.random.Generator, count: int = 3000, tick: int = 1) -> dase.Events:
    """Return events that come in bunches at whole ticks [ns], many at the same, labelled by their columns."""
    centres = rng.integers(0, 2_000_000, 40)
    t = np.sort(np.abs(rng.choice(centres, count) + rng.normal(0, 2000, count).astype(np.int64)))
    t[1::5] = t[:-1:5]
    t = t // tick * tick
    x, y = rng.integers(0, WIDTH, count, np.uint16), rng.integers(0, HEIGHT, count, np.uint16)
    label = (x % 4).astype(np.int8)
    return dase.Events(1e-9 * np.sort(t), x, y, rng.random(count) < 0.5, WIDTH, HEIGHT, label)


def through(sensor: dase.Sensor, events: dase.Events, cuts: list[int] | None = None, seed: int = 0):
    """Return what leaves a sensor whose pixels send `events`, cut into parts before some indices."""
    outlet = Outlet(sensor, events.width, events.height, seed=seed)
    edges = [0, *(cuts or []), len(events)]
    parts = []
    for begin, end in pairwise(edges):
        later = events.t[end] if end < len(events) else events.t[-1]
        parts.append(outlet.push(events.select(slice(begin, end)), float(later)))
    return dase.Events.concatenate([*parts, outlet.flush()])


def same(a: dase.Events, b: dase.Events) -> None:
    assert len(a) > 0
    for name in ("t", "x", "y", "p", "label"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def ns(events: dase.Events) -> list[int]:
    return np.rint(events.t * 1e9).astype(int).tolist()


def moving(rng: np.random.Generator, samples: int = 200, size: tuple[int, int] = (HEIGHT, WIDTH)):
    """Return a video of wandering log intensities, samples whole 2^-12 s."""
    level = -np.abs(np.cumsum(rng.normal(0, 0.25, (samples, *size)), 0) + rng.uniform(-4, -0.5, size))
    return dase.VideoScene(np.exp(level).astype(np.float32), np.cumsum(rng.integers(4, 24, samples)) / 4096)


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


@pytest.mark.parametrize("mode", ["delay", "drop"])
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


def test_large_parts_are_taken_in_pieces(rng, monkeypatch):
    events, sensor = bunched(rng), camera(*(effect() for effect in STREAM))
    whole = through(sensor, events)
    monkeypatch.setattr("dase.outlet.PART", 100)
    same(through(sensor, events), whole)


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
        np.testing.assert_array_equal(order(*some), np.lexsort(some[::-1]))


# ---- counting


def test_counts_are_those_of_what_leaves(device, rng):
    scene, sensor = moving(rng), everything()
    events = dase.simulate(scene, sensor, device=device)
    edges = np.unique(events.t[[100, 700, 710, 1200]])
    later = np.array(ns(events))
    want = np.zeros((3, 2, WIDTH * HEIGHT), int)
    for w, (begin, end) in enumerate(pairwise(edges)):
        inside = (later > round(begin * 1e9)) & (later <= round(end * 1e9))
        place = events.y.astype(int) * WIDTH + events.x
        np.add.at(want[w], (events.p[inside].astype(int), place[inside]), 1)
    np.testing.assert_array_equal(dase.count(scene, sensor, edges, device=device)[0], want)
    assert want.sum() > 500


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


# ---- latency


def test_a_constant_latency_shifts_all_events(device, rng):
    scene = moving(rng)
    want = dase.simulate(scene, camera(Latency.identity()), device=device)
    for delay in (1e-4, 5e-2):
        got = dase.simulate(scene, camera(Latency(delay=delay, light=0.0)), device=device)
        np.testing.assert_array_equal(ns(got), np.array(ns(want)) + round(delay * 1e9))
        for name in "xyp":
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_latency_grows_with_the_inverse_intensity(device, rng):
    scene = moving(rng)
    times = scene.sample_times()
    effect = Latency(delay=1e-3, light=0.6, dark=0.02)
    plain = dase.simulate(scene, camera(Latency.identity()), device=device)
    got = dase.simulate(scene, camera(effect), device=device)
    light = scene.frames(times)[np.searchsorted(times, plain.t - 1e-9), plain.y, plain.x]
    due = plain.t + 1e-3 * (0.4 + 0.6 / (0.02 + 0.98 * light))
    held = 0
    for y in range(HEIGHT):
        for x in range(WIDTH):
            there = (plain.x == x) & (plain.y == y)
            want = np.maximum.accumulate(due[there])  # they do not overtake each other
            held += np.count_nonzero(want > due[there])
            leaves = got.select((got.x == x) & (got.y == y))
            np.testing.assert_array_equal(leaves.p, plain.p[there])
            np.testing.assert_allclose(leaves.t, want, rtol=0, atol=1e-8)
    assert held > 20
    assert np.ptp(due - plain.t) > 1e-2


def test_events_that_catch_up_leave_in_order(device):
    # ON in the dark, OFF in the light soon after: the OFF events would be first
    level = np.array([-6.0, -5.7, -1.0, -1.5, -1.5])[:, None, None] * np.ones((1, 3))
    sensor = reference.only(Threshold(phase=0.0), Latency(delay=0.01, light=1.0, dark=0.001))
    scene = reference.LogScene(level, [0.0, 0.001, 0.002, 0.003, 0.5])
    for chunk in (1, 2, 64):
        events = dase.Events.concatenate(dase.stream(scene, sensor, device=device, chunk=chunk))
        for x in range(3):
            there = events.select(events.x == x)
            np.testing.assert_array_equal(there.p, [True] * 25 + [False] * 2)
            assert np.ptp(there.t) == 0


def test_latency_is_never_more_than_a_second(device):
    level = np.array([-6.9, -8.0, -8.0])[:, None, None]
    sensor = reference.only(Threshold(on=1.0, off=1.0, phase=0.0), Latency(delay=0.1, light=1.0, dark=1e-4))
    events = dase.simulate(reference.LogScene(level, np.arange(3.0)), sensor, device=device)
    np.testing.assert_allclose(events.t, 1.0 / 1.1 + 1.0, rtol=1e-6)


def test_late_events_wait_in_the_pixels(device, rng):
    scene = moving(rng)
    times = scene.sample_times()
    array = Pixels(camera(Latency(delay=0.1, light=0.0)), WIDTH, HEIGHT, device=device)
    first, _ = array.emit(scene, times[:100])
    rest, _ = array.flush()
    assert len(first) > 0
    assert first.t[-1] <= times[99] < rest.t[0]
    assert rest.t[-1] <= times[99] + 0.1
    assert len(array.flush()[0]) == 0
    plain = Pixels(camera(Latency.identity()), WIDTH, HEIGHT, device=device).emit(scene, times[:100])[0]
    assert len(first) + len(rest) == len(plain)


# ---- row scan


def scanned(events: dase.Events, line_ps: int, direction: str) -> list[tuple[int, int, int, int]]:
    """Return (t [ns], x, y, p) as a scan reads them, found by walking from line to line."""
    lines = {"down": HEIGHT, "up": HEIGHT, "right": WIDTH, "left": WIDTH}[direction]
    requests: dict[tuple[int, int], deque] = {}
    rows = list(zip(ns(events), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True))
    out = []
    line = 0
    waiting = deque(rows)
    while waiting or requests:
        now = line * line_ps
        while waiting and waiting[0][0] * 1000 <= now:
            _, x, y, p = waiting.popleft()
            requests.setdefault((x, y), deque()).append(p)
        place = line % lines
        if direction in ("up", "left"):
            place = lines - 1 - place
        axis = 1 if direction in ("down", "up") else 0
        for x, y in sorted(pixel for pixel in requests if pixel[axis] == place):
            out.append((now // 1000, x, y, requests.pop((x, y))[0]))
        line += 1
    return out


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
@pytest.mark.parametrize(("line_ps", "tick"), [(3_333_300, 1), (4_000_000, 4000)])
def test_row_scan_reads_line_after_line(rng, direction, line_ps, tick):
    events = bunched(rng, 1500, tick)
    got = through(camera(RowScan(line=line_ps * 1e-12, direction=direction)), events)
    rows = list(zip(ns(got), got.x.tolist(), got.y.tolist(), got.p.tolist(), strict=True))
    assert rows == scanned(events, line_ps, direction)
    assert len(rows) < 0.95 * len(events)


def test_row_scan_of_a_simulation(device, rng):
    line, scan = 2e-5, HEIGHT * 20_000
    events = dase.simulate(moving(rng), camera(RowScan(line=line)), device=device)
    t, row = np.array(ns(events)), events.y.astype(int)
    np.testing.assert_array_equal(t % scan, row * 20_000)
    pixel = row * WIDTH + events.x
    between = np.concatenate([np.diff(t[pixel == i]) for i in range(WIDTH * HEIGHT)])
    assert np.all(between > 0)  # one event of a pixel per scan
    assert set(between % scan) == {0}
    assert len(set(between // scan)) > 10


def test_row_scan_of_a_real_camera(shared):
    # the 640 columns of this camera are read from right to left, every 195.163 µs
    data = np.load(shared / "recordings" / "dvx_noise_static.npz")
    scan = 195.163e-6
    still = dase.VideoScene(np.full((6, 480, 640), 0.5, np.float32), np.linspace(0, 0.05, 6))
    effect = RowScan(line=scan / 640, direction="left")
    sensor = camera(Shot(rate=10.0), effect, Timestamp(jitter=0.0, step=1e-6))
    made = dase.simulate(still, sensor)
    without = dase.simulate(still, sensor.without("row_scan"))
    for t, x, want in (
        (data["t_us"] * 1e-6, data["x"], True),
        (made.t, made.x, True),
        (without.t, without.x, False),
    ):
        phase = t / scan + x.astype(float) / 640
        assert (abs(np.mean(np.exp(2j * np.pi * phase))) > 0.995) == want


# ---- limited bandwidth


def queued(events: dase.Events, rate: Fraction, depth: int) -> list[tuple[int, int, int, int]]:
    """Return (t [ns], x, y, p) that leave a queue, in exact fractions, keeping the list of who is in it."""
    service, inside, out = Fraction(10**9) / rate, deque(), []
    for t, x, y, p in zip(ns(events), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True):
        while inside and inside[0] <= t:
            inside.popleft()
        if len(inside) < depth:
            inside.append(max(Fraction(t), inside[-1] if inside else 0) + service)
            out.append((int(inside[-1] // 1), x, y, p))
    return out


@pytest.mark.parametrize(("rate", "depth"), [(10**6, 1), (10**6, 2), (800_000, 40), (2_000_000, 10**6)])
def test_readout_is_a_queue(rng, rate, depth):
    events = bunched(rng)
    got = through(camera(Readout(rate=float(rate), depth=float(depth))), events)
    want = queued(events, Fraction(rate), depth)
    assert list(zip(ns(got), got.x.tolist(), got.y.tolist(), got.p.tolist(), strict=True)) == want
    assert len(want) == len(events) if depth == 10**6 else len(want) < 0.9 * len(events)
    if depth == 1:
        same(through(camera(Readout(rate=float(rate), depth=77.0, mode="drop")), events), got)


def test_readout_caps_the_rate(device, rng):
    scene, rate = moving(rng), 2e4
    ample = dase.simulate(scene, camera(), device=device)
    for effect in (Readout(rate=rate, depth=300), Readout(rate=rate, mode="drop")):
        events = dase.simulate(scene, camera(effect), device=device)
        assert np.diff(events.t).min() >= 1 / rate - 2e-9
        for window in (1e-3, 1e-2, 1e-1):
            edges = np.arange(0.0, 0.7, window)
            most = np.histogram(events.t, edges)[0].max()
            assert most <= rate * window + 1
            assert np.histogram(ample.t, edges)[0].max() > rate * window + 1
    patient = dase.simulate(scene, camera(Readout(rate=rate, depth=1e9)), device=device)
    assert len(patient) == len(ample)  # late, but none is lost
    assert np.all(patient.t - ample.t >= 1 / rate - 2e-9)
    assert patient.t[-1] - ample.t[-1] > 0.05


# ---- time stamps


def everywhere(rng: np.random.Generator) -> dase.Events:
    """Return one event of each of 40 000 pixels, so that each can be found again."""
    place = rng.permutation(40_000)
    t = 1e-9 * np.sort(rng.integers(10**6, 10**9, len(place)))
    x, y = (place % 200).astype(np.uint16), (place // 200).astype(np.uint16)
    return dase.Events(t, x, y, rng.random(len(place)) < 0.5, 200, 200)


def by_place(events: dase.Events) -> np.ndarray:
    """Return the time of each pixel's only event, in order of place [s]."""
    out = np.full(40_000, np.nan)
    out[events.y.astype(int) * 200 + events.x] = events.t
    return out


def test_jitter_is_normal(rng):
    events = everywhere(rng)
    got = through(camera(Timestamp(jitter=2e-4, step=0.0)), events)
    error = by_place(got) - by_place(events)
    assert np.all(np.diff(got.t) >= 0)
    assert error.std() == pytest.approx(2e-4, rel=3 / np.sqrt(80_000))
    assert error.mean() == pytest.approx(0, abs=3 * 2e-4 / 200)
    shares = [np.mean(np.abs(error) < k * 2e-4) for k in (1, 2)]
    np.testing.assert_allclose(shares, [0.6827, 0.9545], atol=0.007)
    assert np.abs(error).max() <= 5 * 2e-4 + 1e-9
    # neighbours in the stream know nothing of each other
    assert abs(np.corrcoef((error[:-1], error[1:]))[0, 1]) < 3 / 200
    again, other = (through(camera(Timestamp(jitter=2e-4, step=0.0)), events, seed=s) for s in (0, 1))
    same(again, got)
    assert abs(np.corrcoef(by_place(other) - by_place(events), error)[0, 1]) < 3 / 200


def test_the_clock_shows_its_last_tick(rng):
    events = everywhere(rng)
    for step in (1e-6, 3.3e-5):
        got = through(camera(Timestamp(jitter=0.0, step=step)), events)
        ticks = np.array(ns(events)) // round(step * 1e9)
        np.testing.assert_array_equal(ns(got), ticks * round(step * 1e9))
        np.testing.assert_array_equal(got.x, events.x)


# ---- files, sensors, refusals


def test_files_hold_what_leaves(tmp_path, rng):
    scene, sensor = moving(rng), everything()
    report = synth.record_scene(scene, sensor, tmp_path / "a.h5", frame_rate=20.0, seed=4, labels=True)
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
        (lambda: Readout(mode="wait"), r"readout\.mode must be one of delay, drop, got 'wait'"),
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
