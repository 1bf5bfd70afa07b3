"""Latency, the scan of rows, the arbiter and time stamps, each by itself, against plain loops."""

from __future__ import annotations

import zlib
from collections import deque
from fractions import Fraction

import numpy as np
import pytest
from helpers.readout_streams import HEIGHT, WIDTH, bunched, camera, moving, ns, same, through
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.simulation.pixel_array import PixelArray

SLOW_AND_NOISY = (Bandwidth(cutoff=100.0), Shot(rate=60.0))


def rows_of(events: dase.Events) -> list[tuple[int, int, int, int]]:
    """Return (t [ns], x, y, p) of all events."""
    return list(zip(ns(events), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True))


# ---- latency


def test_a_constant_latency_shifts_all_events(device, rng):
    scene = moving(rng)
    want = dase.simulate(scene, camera(Latency.identity()), device=device)
    for delay in (1e-4, 5e-2):
        got = dase.simulate(scene, camera(Latency(delay=delay, light=0.0)), device=device)
        np.testing.assert_array_equal(ns(got), np.array(ns(want)) + round(delay * 1e9))
        for name in "xyp":
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("others", [(), SLOW_AND_NOISY], ids=["alone", "behind noisy slow pixels"])
@pytest.mark.parametrize(("delay", "share", "dark"), [(1e-3, 0.6, 0.02), (1e-2, 0.9, 0.2)])
def test_latency_grows_with_the_inverse_intensity(device, rng, delay, share, dark, others):
    scene = moving(rng)
    times = scene.sample_times()
    effect = Latency(delay=delay, light=share, dark=dark)
    plain = dase.simulate(scene, camera(*others, Latency.identity()), device=device)
    got = dase.simulate(scene, camera(*others, effect), device=device)
    light = scene.frames(times)[np.searchsorted(times, plain.t - 1e-9), plain.y, plain.x]
    due = plain.t + delay * (1 - share + share / (dark + (1 - dark) * light))
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
    array = PixelArray(camera(Latency(delay=0.1, light=0.0)), WIDTH, HEIGHT, device=device)
    first, _ = array.emit(scene, times[:100])
    rest, _ = array.flush()
    assert len(first) > 0
    assert first.t[-1] <= times[99] < rest.t[0]
    assert rest.t[-1] <= times[99] + 0.1
    assert len(array.flush()[0]) == 0
    plain = PixelArray(camera(Latency.identity()), WIDTH, HEIGHT, device=device).emit(scene, times[:100])[0]
    assert len(first) + len(rest) == len(plain)


# ---- row scan


def scanned(
    events: dase.Events, line_ps: int, direction: str, *, keeps: str = "first"
) -> list[tuple[int, int, int, int]]:
    """Return (t [ns], x, y, p) as a scan reads them, found by walking from line to line."""
    lines = {"down": HEIGHT, "up": HEIGHT, "right": WIDTH, "left": WIDTH}[direction]
    requests: dict[tuple[int, int], deque] = {}
    out = []
    line = 0
    waiting = deque(rows_of(events))
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
            held = list(requests.pop((x, y)))
            out += [(now // 1000, x, y, p) for p in (held if keeps == "all" else held[:1])]
        line += 1
    return out


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
@pytest.mark.parametrize(("line_ps", "tick"), [(3_333_300, 1), (4_000_000, 4000)])
def test_row_scan_reads_line_after_line(rng, direction, line_ps, tick):
    events = bunched(rng, 1500, tick)
    got = through(camera(RowScan(line=line_ps * 1e-12, direction=direction)), events)
    assert rows_of(got) == scanned(events, line_ps, direction)
    assert len(got) < 0.95 * len(events)
    every = through(camera(RowScan(line=line_ps * 1e-12, direction=direction, keeps="all")), events)
    assert rows_of(every) == scanned(events, line_ps, direction, keeps="all")
    assert len(every) == len(events)


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
    for t, x, y, p in rows_of(events):
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
    assert rows_of(got) == want
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


def stamped(events: dase.Events, jitter: float, step: int, seed: int) -> list[tuple[int, int, int, int]]:
    """Return (t [ns], x, y, p) in order of stamps, which err by jitter [ns] and are whole steps [ns]."""
    errors = np.random.default_rng([seed, zlib.crc32(b"timestamp")]).standard_normal(len(events))
    out = []
    for (t, *rest), error in zip(rows_of(events), errors, strict=True):
        out.append((t + round(jitter * min(max(error, -5.0), 5.0)), *rest))
    out.sort(key=lambda event: event[0])  # those of one time stay in order; the clock keeps the order too
    return [(t // step * step if step else t, *rest) for t, *rest in out]


# ---- behind noisy slow pixels

MOVED = {
    "a slow scan": (RowScan(line=1e-4, direction="up"), lambda e: scanned(e, 10**8, "up")),
    "a fast scan": (RowScan(line=3e-6, direction="right"), lambda e: scanned(e, 3 * 10**6, "right")),
    "a queue": (Readout(rate=2e4, depth=30), lambda e: queued(e, Fraction(20_000), 30)),
    "a long queue": (Readout(rate=8e3, depth=1e6), lambda e: queued(e, Fraction(8000), 10**6)),
    "a busy bus": (Readout(rate=2e4, mode="drop"), lambda e: queued(e, Fraction(20_000), 1)),
    "a slow bus": (Readout(rate=4e3, mode="drop"), lambda e: queued(e, Fraction(4000), 1)),
    "jitter": (Timestamp(jitter=1e-5, step=0.0), lambda e: stamped(e, 1e4, 0, 3)),
    "a clock": (Timestamp(jitter=0.0, step=1e-4), lambda e: stamped(e, 0.0, 100_000, 3)),
    "jitter and a clock": (Timestamp(jitter=1e-3, step=3.3e-5), lambda e: stamped(e, 1e6, 33_000, 3)),
}


@pytest.mark.parametrize("name", MOVED)
def test_behind_noisy_slow_pixels_it_is_its_twin(device, rng, name):
    scene, pixels, (effect, twin) = moving(rng, 60), camera(*SLOW_AND_NOISY), MOVED[name]
    plain = dase.simulate(scene, pixels, seed=3, device=device)
    got = dase.simulate(scene, pixels.with_effect(effect), seed=3, device=device)
    want = twin(plain)
    assert rows_of(got) == want
    assert len(want) > 500
    assert want != rows_of(plain)
