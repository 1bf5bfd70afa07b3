"""The arbiter that reads a row or column at a time: its twin, its laws, and what pixels do while held."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers.readout_streams import HEIGHT, WIDTH, bunched, camera, moving, ns, same, through
from reference import pixel as reference
from reference import readout as twin

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.readout import Readout
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.fitting.readout_simulator import pass_readout, simulate_pixels
from dase.kernels import line_arbiter
from dase.kernels.line_arbiter import ArbiterNumber


def rows_of(events: dase.Events) -> list[tuple[int, int, int, int]]:
    columns = ns(events), events.x.tolist(), events.y.tolist(), events.p.astype(int).tolist()
    return list(zip(*columns, strict=True))


def twin_of(events: dase.Events, bus: Readout) -> list[tuple[int, int, int, int]]:
    times = Fraction(round(bus.line * 1e12), 1000), Fraction(round(1e12 / bus.rate), 1000)
    return twin.read_by_lines(rows_of(events), *times, bus.mode == "columns")


@pytest.mark.parametrize("mode", ["rows", "columns"])
@pytest.mark.parametrize(("rate", "line"), [(1e6, 3e-7), (2e6, 1e-5), (1e5, 0.0), (5e7, 3e-8)])
def test_it_is_its_twin(rng, mode, rate, line):
    events, bus = bunched(rng, 1000), Readout(rate=rate, line=line, mode=mode)
    whole = through(camera(bus), events)
    assert rows_of(whole) == twin_of(events, bus)
    np.testing.assert_array_equal(whole.label, whole.x % 4)
    for count in (1, 5, 200):
        same(through(camera(bus), events, np.sort(rng.integers(0, len(events), count)).tolist()), whole)


@pytest.mark.parametrize("nodes", [1, 3, 1000])
@pytest.mark.parametrize("slots", [64, 4096])
def test_where_late_requests_wait_changes_nothing(rng, monkeypatch, slots, nodes):
    """Without nodes all are in the heap; with few slots most are due later than a turn of the wheel."""
    monkeypatch.setattr(line_arbiter, "SLOTS", slots)
    monkeypatch.setattr(line_arbiter, "NODES", nodes)
    pushed = set()
    events, bus = bunched(rng, 1000), Readout(rate=1e6, line=3e-7, mode="rows")
    reader = bus.reader(WIDTH, HEIGHT, 0)
    for begin in range(0, len(events), 50):
        part = events.select(slice(begin, begin + 50))
        later = events.t[begin + 50] if begin + 50 < len(events) else np.inf
        pushed.update(rows_of(reader.push(part, float(later))[0]))
    assert sorted(pushed) == sorted(twin_of(events, bus))
    assert (int(reader._state["numbers"][ArbiterNumber.NODES]) > 0) == (nodes > 1)


@pytest.mark.parametrize("width", [64, 65, 4096, 4097, 10000])
def test_wide_lines_are_read_as_their_twin_says(rng, width):
    events, bus = bunched(rng, 1000), Readout(rate=1e6, line=3e-7, mode="rows")
    x = rng.integers(0, 6, len(events)) * (width - 1) // 5
    wide = replace(events, x=x.astype(np.uint16), y=events.y % 3, width=width, height=3)
    assert rows_of(through(camera(bus), wide)) == twin_of(wide, bus)


@pytest.mark.parametrize("mode", ["rows", "columns"])
def test_it_is_its_twin_behind_noisy_slow_pixels(device, rng, mode):
    scene, bus = moving(rng, 60), Readout(rate=2e4, line=1e-4, mode=mode)
    pixels = camera(Bandwidth(cutoff=100.0), Shot(rate=60.0))
    plain = dase.simulate(scene, pixels, device=device)
    got = dase.simulate(scene, pixels.with_effect(bus), device=device)
    assert rows_of(got) == twin_of(plain, bus)
    assert 100 < len(got) < 0.9 * len(plain)
    parts = dase.Events.concatenate(dase.stream(scene, pixels.with_effect(bus), device=device, chunk=7))
    same(replace(parts, label=got.label), got)


@pytest.mark.parametrize("mode", ["rows", "columns"])
def test_without_a_limit_of_the_rate_it_changes_nothing(device, rng, mode):
    """Whatever a line would take."""
    scene, pixels = moving(rng, 60), camera(Bandwidth(cutoff=100.0), Shot(rate=60.0))
    plain = dase.simulate(scene, pixels, device=device, labels=True)
    off = pixels.with_effect(Readout(rate=math.inf, line=1e-4, mode=mode))
    same(dase.simulate(scene, off, device=device, labels=True), plain)
    parts = dase.Events.concatenate(dase.stream(scene, off, device=device, chunk=7))
    same(replace(parts, label=plain.label), plain)


@pytest.mark.parametrize("mode", ["rows", "columns"])
def test_what_a_latency_holds_back_at_the_end_leaves_too(device, rng, mode):
    """A latency that is the same in any light makes all later, and nothing else."""
    scene, bus, delay = moving(rng, 60), Readout(rate=2e5, line=1e-5, mode=mode), 0.02
    prompt = dase.simulate(scene, camera(bus), device=device)
    late = camera(Latency(delay=delay, light=0.0), bus)
    got = dase.simulate(scene, late, device=device)
    assert np.count_nonzero(got.t > scene.duration) > 100
    assert [e[1:] for e in rows_of(got)] == [e[1:] for e in rows_of(prompt)]
    np.testing.assert_allclose(got.t, prompt.t + delay, atol=2e-9)
    parts = dase.Events.concatenate(dase.stream(scene, late, device=device, chunk=7))
    same(replace(parts, label=got.label), got)


@pytest.mark.parametrize(("line", "event"), [(1e-3, 2e-4), (3e-4, 1e-3), (1e-2, 1e-2)])
def test_a_held_pixel_sends_at_its_interval_plus_the_time_it_is_held(line, event):
    slope, threshold = 40.0, 0.2
    scene = reference.LogScene(np.array([-9.0, -1.0])[:, None, None], [0.0, 8.0 / slope])
    bus = Readout(rate=1 / event, line=line, mode="rows")
    sensor = reference.only(Threshold(on=threshold, off=threshold, phase=0.0), bus)
    got = dase.simulate(scene, sensor)
    np.testing.assert_allclose(np.diff(got.t), threshold / slope + line + event, rtol=1e-4)
    assert len(got) > 7


@pytest.mark.parametrize(("rate", "line"), [(1e5, 1e-5), (1e6, 5e-5), (3e4, 0.0)])
def test_a_full_array_is_read_row_after_row(rate, line):
    """All pixels ask before their turn: W events in line + W / rate, each pixel once in H of it."""
    level = np.array([-9.0, -1.0])[:, None, None] * np.ones((1, HEIGHT, WIDTH))
    scene = reference.LogScene(level, [0.0, 0.2])
    thresholds = Threshold(on=0.01, off=0.01, phase=1.0)
    got = dase.simulate(scene, reference.only(thresholds, Readout(rate=rate, line=line, mode="rows")))
    row = line + WIDTH / rate
    settled = got.select((got.t > 0.05) & (got.t < 0.19))
    assert len(settled) / 0.14 == pytest.approx(WIDTH / row, rel=0.01)
    times, counts = np.unique(settled.t, return_counts=True)
    np.testing.assert_array_equal(counts[1:-1], WIDTH)  # one stamp for a row
    np.testing.assert_allclose(np.diff(times), row, atol=3e-9)
    one = settled.t[(settled.x == 3) & (settled.y == 4)]
    np.testing.assert_allclose(np.diff(one), HEIGHT * row, rtol=1e-5)


@pytest.mark.parametrize("swing", [0.0, 0.5])
@pytest.mark.parametrize(("line", "event"), [(1e-4, 1e-4), (1e-3, 3e-4)])
def test_pixels_that_see_the_light_themselves_send_as_many(rng, swing, line, event):
    """Their memory at the end of the wait is the light, as where light and arbiter are simulated together."""
    width, step, count, threshold = 6, 1e-5, 20_000, 0.1
    t = step * np.arange(count)[:, None]
    way = rng.uniform(1, 3, 30) * rng.choice([-1, 1], 30)
    level = way * t + swing * np.sin(2 * np.pi * 5 * t + rng.uniform(0, 2 * np.pi, 30))
    want = twin.watch_light(level, step, threshold, line, event, width)
    cut = level[::20]  # straight lines between samples
    scene = reference.LogScene(cut.reshape(-1, 5, width) - 4.0, 20 * step * np.arange(len(cut)))
    bus = Readout(rate=1 / event, line=line, mode="rows")
    got = dase.simulate(scene, reference.only(Threshold(on=threshold, off=threshold, phase=0.0), bus))
    got = got.select(got.t < t[-1])
    plain = dase.simulate(scene, reference.only(Threshold(on=threshold, off=threshold, phase=0.0)))
    assert len(got) == pytest.approx(len(want), rel=0.03)
    if swing and line > 5e-4:
        assert len(want) < 0.8 * len(plain)


def test_rows_tie_as_those_of_cameras_do(rng):
    """With stamps of 1 us most events tie with the one before, and most of these in one row."""
    count = 4000
    t = np.sort(rng.uniform(0, 7e-4, count))
    x, y = rng.integers(0, 240, count), rng.integers(0, 180, count)
    events = dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), x > 100, 240, 180)
    got = through(camera(Readout(rate=1e7, mode="rows"), Timestamp(jitter=0.0, step=1e-6)), events)
    tie = np.diff(got.t) == 0
    assert tie.mean() > 0.7
    before = np.diff(np.floor(events.t * 1e6)) == 0
    assert np.mean(np.diff(got.y)[tie] == 0) > 10 * np.mean(np.diff(events.y)[before] == 0)


@pytest.fixture(scope="module")
def textured() -> dase.VideoScene:
    """Return waves that pass faster and faster."""
    times = np.linspace(0, 0.1, 101)
    y, x = np.mgrid[:24, :48]
    phase = 0.35 * x + 0.2 * y - 60 * (times[:, None, None] + 10 * times[:, None, None] ** 2)
    return dase.VideoScene(np.exp(-1.5 + 0.8 * np.sin(phase)).astype(np.float32), times)


@pytest.mark.parametrize("mode", ["rows", "columns"])
@pytest.mark.parametrize("fill", [0.5, 1.5, 5.0])
@pytest.mark.parametrize("others", [1, 4])
def test_as_many_leave_in_trials_as_when_simulated(textured, mode, fill, others):
    """Some pixels are looked at, and each of the others that are simulated stands for one, or for several."""
    pixels = dase.Sensor().with_effect(Shot(rate=5.0)).with_effect(Bandwidth(cutoff=200.0))
    plain = dase.simulate(textured, pixels, seed=2)
    busy = fill / (len(plain) / 0.1)  # [s] for an event, on average, that makes the bus so full
    bus = Readout(rate=2 / busy, line=busy, mode=mode)
    sensor = pixels.with_effect(bus)
    runs = [dase.simulate(textured, sensor, seed=seed) for seed in (3, 4)]
    assert (len(runs[0]) < 0.95 * len(plain)) == (fill > 1)
    model, half = (
        model_of(sensor),
        split_measurement(Measurement(runs[0], textured), pixels=200, seed=1).train,
    )
    stimulus, own = half.trials.stimulus, np.zeros(48 * 24, bool)
    own[stimulus.pixels] = True
    room = (own.size / others + len(stimulus.pixels)) * stimulus.grid.steps
    around = replace(half.around, most_samples=room, _loads=[])
    load = around.load(model.sensor, stimulus)
    begin, end = stimulus.grid.begin, stimulus.grid.begin + stimulus.grid.step * (stimulus.grid.steps - 1)

    def count(events: dase.Events) -> int:
        mine = own[events.y.astype(int) * 48 + events.x] & (events.t > begin) & (events.t < end)
        return int(np.count_nonzero(mine))

    trials = []
    for seed in (5, 6, 7):
        (events,) = simulate_pixels(stimulus, sensor, sensor.parameters()[None], np.array([seed]))
        trials.append(count(pass_readout(stimulus, events, [bus], seed, load)))
    assert np.mean(trials) == pytest.approx(np.mean([count(run) for run in runs]), rel=0.03)
