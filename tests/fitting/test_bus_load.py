"""A bus that all pixels share, where only some of them are looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dase
from dase.diagnosis.candidates import variants_to_try
from dase.effects import EFFECTS
from dase.effects.mismatch import Mismatch
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.stream import Others
from dase.fitting import readout_simulator
from dase.fitting.batch_simulator import SimulationOrder
from dase.fitting.bus_use import BusUse, least_bus_rate
from dase.fitting.data_split import SPLIT, split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, model_of, with_effect_added
from dase.fitting.readout_simulator import simulate_pixels
from dase.fitting.scheduler import SimulationRequest, answer_requests
from dase.probes.events_by_pixel import sort_by_pixel
from dase.probes.timestamp_patterns import TimestampStructure, find_structure, share_at
from dase.simulation.sensor import Sensor

WIDTH, HEIGHT, SECONDS = 40, 30, 0.3
BUS = Readout(rate=1.2e5, depth=300.0)


@pytest.fixture(scope="module")
def scene() -> dase.VideoScene:
    """Return a small disc that runs to and fro: few pixels have events at a time."""
    times = np.arange(round(SECONDS * 1000) + 1) / 1000
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    along = 0.5 * WIDTH + 0.4 * WIDTH * np.sin(2 * np.pi * 7 * times)
    up = 0.5 * HEIGHT + 0.3 * HEIGHT * np.sin(2 * np.pi * 3 * times)
    away = np.hypot(x - along[:, None, None], y - up[:, None, None])
    return dase.VideoScene((0.05 + 0.9 / (1 + np.exp(2 * (away - 6)))).astype(np.float32), times)


@pytest.fixture(scope="module")
def true() -> Sensor:
    return Sensor().with_effect(EFFECTS["shot"](rate=5.0)).with_effect(BUS)


@pytest.fixture(scope="module")
def evidence(scene, true, device):
    return split_measurement(
        Measurement(dase.simulate(scene, true, seed=4), scene), pixels=150, seed=1, device=device
    )


def stream(rng, count: int) -> dase.Events:
    """Return events in bunches, columns numbered."""
    t = np.sort(np.abs(rng.choice(rng.uniform(0, 2e-2, 20), count) + rng.normal(0, 2e-4, count)))
    x, p = np.arange(count) % 50, rng.random(count) < 0.5
    return dase.Events(1e-9 * np.rint(1e9 * t), x.astype(np.uint16), np.zeros(count, np.uint16), p, 50, 1)


@pytest.mark.parametrize("bus", [Readout(rate=1e5, depth=50.0), Readout(rate=1e5, mode="drop")])
def test_some_events_beside_others_leave_as_from_one_queue(rng, bus):
    events = stream(rng, 3000)
    mine = events.x < 5
    rest = events.select(~mine)
    others = Others.of(rest)
    got = bus.reader(50, 1, 0).beside(events.select(mine), others, np.ones(2))
    whole, _ = bus.reader(50, 1, 0).push(events, np.inf)
    want = whole.select(whole.x < 5)
    assert 0 < len(want) < mine.sum()
    # events at one time may change places
    assert abs(len(got) - len(want)) <= 0.01 * len(want)
    late = [np.bincount((e.t / 1e-3).astype(int), minlength=40) for e in (got, want)]
    assert np.abs(late[0] - late[1]).sum() <= 0.02 * len(want)


@pytest.mark.parametrize("weight", [(0.0, 0.0), (0.3, 0.3), (1.7, 0.0), (2.5, 2.5)])
def test_others_take_as_much_time_as_what_they_stand_for(rng, weight):
    bus, rest = Readout(rate=5e3, depth=1e6), stream(rng, 2000)
    others = Others.of(rest)
    last = replace(rest.select(slice(1)), t=rest.t[-1:] + 1e-9)
    (end,) = bus.reader(50, 1, 0).beside(last, others, np.array(weight)).t
    before = sum(w * np.count_nonzero(rest.p == p) for p, w in enumerate(weight))
    begin = rest.t[0] if before else last.t[0]  # the bus does not rest from the first to the last
    assert end - begin == pytest.approx((before + 1) / bus.rate, rel=0.03)


@pytest.mark.parametrize("room", [1, 1 << 22])
def test_models_that_are_simulated_together_are_those_alone(evidence, true, monkeypatch, room):
    monkeypatch.setattr(readout_simulator, "SAMPLES_OF_A_RUN", room)
    stimulus = evidence.train.trials.stimulus
    vectors = np.repeat(true.parameters()[None], 9, 0)
    vectors[:, true.parameter_names().index("threshold.on")] = np.linspace(0.15, 0.4, 9)
    seeds, finer = np.array([3, 3, 3, 4, 4, 4, 4, 3, 3]), np.array([1, 1, 1, 1, 2, 2, 2, 2, 1])
    together = simulate_pixels(stimulus, true, vectors, seeds, finer)
    assert len(together) == 9
    for n, events in enumerate(together):
        one = slice(n, n + 1)
        (alone,) = simulate_pixels(stimulus, true, vectors[one], seeds[one], finer[one])
        for name in ("t", "x", "y", "p"):
            np.testing.assert_array_equal(getattr(events, name), getattr(alone, name))
    assert len({len(events) for events in together}) > 5


def busy(half, true, load) -> np.ndarray:
    """Return the events of each 3 ms in the mean over 16 repeats, and those that were measured, (2, K)."""
    order = SimulationOrder(true, np.repeat(true.parameters()[None], 16, 0), 9, reseed=True)
    model = half.trials.simulate_streams(order, [true.readout_effects()] * 16, load).clock.mean(0)
    both = np.stack([model, half.found.clock[0]]).reshape(2, 2, -1).sum(1)
    return np.add.reduceat(both, np.arange(0, both.shape[1], 3), axis=1)


def test_some_pixels_of_the_true_model_send_what_they_send_among_all(evidence, true):
    """What was measured went through the bus beside the events of all pixels of another seed."""
    half = evidence.train.loaded(*place(true))
    one, of_share = busy(half, true, half.load), busy(half, true, None)
    chance = [((m - f) ** 2 / (m + 1)).mean() for m, f in (one, of_share)]
    assert chance[0] < 1 < 1.5 < chance[1]  # a share of the bus at all times does not tell
    assert len(half.load._events[0]) > 0


def place(sensor: Sensor):
    model = model_of(sensor)
    return model.space, model.place


def test_a_model_that_sends_more_is_taken_to_do_so_everywhere(evidence, true, scene):
    """Thresholds that are not those of the load."""
    half = evidence.train
    other = true.with_effect(replace(true["threshold"], on=0.4, off=0.3))
    near, far = (half.loaded(*place(s)).load for s in (true, other))
    stimulus = half.trials.stimulus
    events = simulate_pixels(stimulus, true, true.parameters()[None], np.array([5]))[0]
    bare = [np.bincount(load._events[0].p.astype(int), minlength=2) for load in (near, far)]
    ours, theirs = (load.weight(events) * own for load, own in zip((near, far), bare, strict=True))
    np.testing.assert_allclose(theirs, ours, rtol=0.15)
    assert np.all(bare[1] < 0.8 * bare[0])


@pytest.mark.parametrize("limit", ["most_samples", "most_events"])
def test_some_of_many_pixels_stand_for_all(evidence, true, limit):
    half = evidence.train
    everyone = half.loaded(*place(true)).load
    assert len(everyone._events[0]) > 0  # before there is less room
    few = {
        "most_samples": 500 * half.trials.stimulus.grid.steps,
        "most_events": 0.4 * len(everyone._events[0]),
    }
    fewer = replace(half.around, **{limit: few[limit]}, _loads=[])
    some = fewer.load(true, half.trials.stimulus)
    events = simulate_pixels(half.trials.stimulus, true, true.parameters()[None], np.array([5]))[0]
    assert len(some._events[0]) < 0.5 * len(everyone._events[0])
    total = [load.weight(events).sum() / 2 * len(load._events[0]) for load in (some, everyone)]
    assert total[0] == pytest.approx(total[1], rel=0.2)


@pytest.fixture(scope="module")
def lamp() -> dase.VideoScene:
    """Return light that makes all pixels send at once, and none in between."""
    times = np.arange(round(SECONDS * 1000) + 1) / 1000
    light = 0.2 * np.exp(0.9 * np.sin(2 * np.pi * 10 * times))
    across = 0.5 + np.arange(WIDTH) / WIDTH
    frames = np.tile(light[:, None, None] * across, (1, HEIGHT, 1))
    return dase.VideoScene(frames.astype(np.float32), times)


@pytest.mark.parametrize("mode", ["delay", "drop", "rows"])
@pytest.mark.parametrize("fullness", [0.5, 1.0, 2.0])
def test_the_rate_in_trials_is_that_of_a_simulation(lamp, device, mode, fullness):
    """Where all others are simulated, and where each of some stands for three."""
    free, repeats = Sensor().with_effect(EFFECTS["shot"](rate=5.0)), 6
    rate = len(dase.simulate(lamp, free, seed=4, device=device)) / SECONDS / fullness
    true = free.with_effect(Readout(rate=rate, mode=mode, depth=300.0))
    found = dase.simulate(lamp, true, seed=4, device=device)
    half = split_measurement(Measurement(found, lamp), pixels=300, seed=1, device=device).train
    looked_at, grid = half.trials.stimulus.pixels, half.trials.stimulus.grid
    want = np.zeros(repeats)
    for n in range(repeats):
        events = dase.simulate(lamp, true, seed=100 + n, device=device)
        mine = np.isin(events.y.astype(int) * WIDTH + events.x, looked_at)
        want[n] = np.count_nonzero(mine & (events.t >= grid.begin) & (events.t <= grid.times[-1]))
    order = SimulationOrder(true, np.repeat(true.parameters()[None], repeats, 0), 9, reseed=True)
    for others in (WIDTH * HEIGHT, 300):
        limited = replace(half.around, most_samples=(300 + others) * grid.steps, _loads=[])
        load = replace(half, around=limited).loaded(*place(true)).load
        sent = half.trials.simulate_streams(order, [true.readout_effects()] * repeats, load).clock.sum(1)
        assert sent.mean() == pytest.approx(want.mean(), rel=0.03)


def test_others_that_stand_for_all_are_spread_over_the_picture(evidence):
    chosen = evidence.train.trials.stimulus.pixels
    around = replace(evidence.train.around, most_samples=400.0)
    others = around.others(chosen, 1, 1)
    assert len(others) == 400 - len(chosen)
    assert len(np.unique(others)) == len(others)
    assert not np.isin(others, chosen).any()
    parts = np.bincount(others // (WIDTH * HEIGHT // 10), minlength=10)
    rest = np.bincount(np.setdiff1d(np.arange(WIDTH * HEIGHT), chosen) // (WIDTH * HEIGHT // 10))
    np.testing.assert_allclose(parts, rest * len(others) / rest.sum(), atol=2)


def test_what_others_send_is_worked_out_once_for_each_model_of_their_pixels(evidence, true):
    half = evidence.train
    first = half.loaded(*place(true)).load
    assert half.loaded(*place(true.with_effect(replace(BUS, rate=2e5)))).load is first
    assert half.loaded(*place(true.with_effect(EFFECTS["shot"](rate=6.0)))).load is not first
    assert evidence.held.loaded(*place(true)).load is not first


def test_events_are_sorted_to_their_pixels(evidence, rng):
    stimulus, size = evidence.train.trials.stimulus, WIDTH * HEIGHT
    counts = (5000, 0, 3000)
    streams = []
    for count in counts:
        at = rng.integers(0, size, count)
        t = stimulus.grid.begin + 1e-9 * np.sort(rng.integers(0, 10**8, count))
        x, y = (at % WIDTH).astype(np.uint16), (at // WIDTH).astype(np.uint16)
        streams.append(dase.Events(t, x, y, rng.random(count) < 0.4, WIDTH, HEIGHT))
    start, time, polarity = (a.numpy() for a in sort_by_pixel(stimulus, streams))
    for n, events in enumerate(streams):
        index = events.y.astype(int) * WIDTH + events.x
        for i, pixel in enumerate(stimulus.pixels):
            mine, got = events.select(index == pixel), slice(start[n, i], start[n, i + 1])
            want = np.rint((mine.t - stimulus.grid.begin) * 1e9).astype(np.int64)
            np.testing.assert_array_equal(time[got], want)
            np.testing.assert_array_equal(polarity[got], mine.p)


def test_others_go_through_what_is_before_the_bus(evidence, true):
    load, scan = evidence.train.loaded(*place(true)).load, RowScan(line=1e-6)
    plain, scanned = load.others((), 0), load.others((scan,), 0)
    assert 0.9 * len(plain.time) < len(scanned.time) <= len(plain.time)
    assert np.all(np.diff(scanned.time) >= 0)
    at_lines = [np.mean(np.abs(o.time / 1e6 - np.round(o.time / 1e6)) < 0.01) for o in (plain, scanned)]
    assert at_lines[0] < 0.1
    assert at_lines[1] > 0.99


def test_answers_do_not_depend_on_what_is_asked_beside(evidence, true):
    model = model_of(true)
    half = model.calibrate(evidence.scout, repeats=6, seed=1)
    asks = [SimulationRequest(half, model.space, model.place[None] + d, 3) for d in (0.0, 0.1)]
    alone_ = [answer_requests([ask])[0] for ask in asks]
    for got, want in zip(answer_requests(asks), alone_, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-7)
    assert np.abs(alone_[0] - alone_[1]).max() > 1e-2


def test_the_rate_of_a_bus_that_was_full_is_seen(evidence):
    first = variants_to_try(evidence, Readout)
    assert {e.mode for e in first} == {"delay", "drop", "rows", "columns"}
    assert all(abs(e.rate - BUS.rate) <= 1.01 / SPLIT.burst for e in first)


def test_a_bus_is_no_candidate_where_it_is_known_to_be_free(evidence, rng):
    count = 20_000
    x, y = rng.integers(0, 50, (2, count), dtype=np.uint16)
    apart = dase.Events(1e-5 * np.arange(count), x, y, x > 20, 50, 50)
    assert least_bus_rate(apart, TimestampStructure()) == pytest.approx(1e5, rel=1e-3)  # the runs of 4096
    bursts = replace(apart, t=np.repeat(0.02 * np.arange(20), 1000))
    assert least_bus_rate(bursts, TimestampStructure()) == pytest.approx(512 / 1e-6)
    # what shares a tick may have been sent at any time of it
    assert least_bus_rate(bursts, TimestampStructure(step=1e-3)) == pytest.approx(512 / 1e-3)
    assert least_bus_rate(bursts, TimestampStructure(line=1e-5)) == 0
    assert evidence.bus.load >= 0.8  # it was full
    free = BusUse(loss=0.001, load=0.05, row_load=0.05, column_load=0.05)
    assert variants_to_try(replace(evidence, bus=free), Readout) == []


@pytest.mark.parametrize(
    ("use", "modes"),
    [
        # what waits shows near a load of 1 alone, what is lost wherever a hundredth finds the bus busy
        pytest.param(
            BusUse(loss=0.02, load=0.3, row_load=0.7, column_load=0.3), {"drop"}, id="some are lost"
        ),
        pytest.param(
            BusUse(loss=0.005, load=0.9, row_load=0.3, column_load=0.3), {"delay"}, id="seldom full"
        ),
        pytest.param(
            BusUse(loss=0.005, load=0.1, row_load=0.9, column_load=0.1), {"rows"}, id="rows take long"
        ),
        pytest.param(BusUse(loss=0.005, load=0.1, row_load=0.1, column_load=0.9), {"columns"}, id="columns"),
        pytest.param(BusUse(), {"delay", "drop", "rows", "columns"}, id="nothing is known"),
    ],
)
def test_a_bus_is_a_candidate_in_the_modes_in_which_it_would_show(evidence, use, modes):
    assert {one.mode for one in variants_to_try(replace(evidence, bus=use), Readout)} == modes


def test_a_bus_begins_no_slower_than_the_closest_events(evidence):
    """Slower ones send no two of them; where lines are taken, those of a line come together."""
    use = BusUse(rate=50 * evidence.highest_event_rate)
    for one in variants_to_try(replace(evidence, bus=use), Readout):
        assert one.rate == (evidence.highest_event_rate if one.by_lines else use.rate)
    # fewer came together than over some milliseconds: that is then the least
    for one in variants_to_try(replace(evidence, bus=BusUse(rate=1.0)), Readout):
        assert one.rate == evidence.highest_event_rate


def test_no_search_goes_below_what_a_bus_is_seen_to_send():
    present = model_of(Sensor())
    bus = with_effect_added(present, Readout(rate=2e6))
    assert lowest(bus) == pytest.approx(0.95 * 2e6)
    # nor where another effect comes in beside, or the bus is fitted again
    faster = replace(bus, place=np.where(np.array(bus.space.names) == "readout.rate", np.log(3e6), bus.place))
    assert lowest(with_effect_added(faster, Mismatch())) == pytest.approx(0.95 * 2e6)
    assert lowest(model_of(faster.sensor, faster.space.names, before=faster)) == pytest.approx(0.95 * 2e6)
    # of a sensor that is given nothing is known
    assert lowest(model_of(Sensor().with_effect(Readout(rate=2e6)))) < 5e5


def lowest(model: FittedModel) -> float:
    """Return the least rate of a bus that a search tries."""
    return next(axis.low for axis in model.space.axes if axis.name == "readout.rate")


def by_chance(rng, rate: float, seconds: float = 0.2) -> dase.Events:
    """Return a Poisson process of pixels anywhere."""
    t = np.sort(rng.uniform(0, seconds, round(rate * seconds)))
    x, y = rng.integers(0, 50, (2, len(t)), dtype=np.uint16)
    return dase.Events(1e-9 * np.rint(1e9 * t), x, y, x > 20, 50, 50)


@pytest.mark.parametrize("load", [0.05, 0.3, 0.7, 1.5])
@pytest.mark.parametrize("mode", ["delay", "drop", "rows", "columns"])
def test_no_bus_is_busier_than_the_time_stamps_say(rng, mode, load):
    bus = Readout(rate=2e6, line=5e-7, mode=mode)
    busy = 1e-6 if bus.by_lines else 5e-7  # for one event
    before = by_chance(rng, load / busy)
    sent, _ = bus.reader(50, 50, 1).push(before, np.inf)
    sent = replace(sent, t=1e-6 * np.rint(1e6 * sent.t))
    use = BusUse.of(sent, TimestampStructure(), span=SPLIT.burst)
    lines = {"rows": sent.y, "columns": sent.x}.get(mode)
    starts = (
        len(sent) if lines is None else len(np.unique(np.stack([np.rint(1e6 * sent.t), lines]), axis=1).T)
    )
    true = (starts * bus.line * bus.by_lines + len(sent) / bus.rate) / np.ptp(sent.t)
    known = {"rows": use.row_load, "columns": use.column_load}.get(mode, use.load)
    assert known >= 0.97 * true
    assert known >= 0.8 or load < 1 or mode == "drop"  # a full bus is seen to be full
    if mode == "drop":
        lost = 1 - len(sent) / len(before)
        assert use.loss >= 0.9 * lost


def test_a_bus_that_sends_far_faster_than_events_come_is_seen_idle(rng):
    quiet, rush = by_chance(rng, 2e4), by_chance(rng, 1e5, 0.002)
    # 64 events that the bus sent in a microsecond tell how fast it is
    n = np.arange(64, dtype=np.uint16)
    fast = dase.Events(np.full(64, 0.1), n % 50, n % 7, n > 20, 50, 50)
    events = dase.Events.concatenate([quiet, rush, fast])
    events = events.select(np.argsort(events.t, kind="stable"))
    use = BusUse.of(events, TimestampStructure(), span=SPLIT.burst)
    assert use.load < 0.01
    assert use.loss < 0.001
    assert use.row_load > use.load  # of 7 rows in a microsecond, not of 64 events
    # an arbiter of columns took all 50 in a microsecond
    assert use.column_load < 0.2
    # of events that a readout stamps line by line nothing is known
    assert BusUse.of(events, TimestampStructure(line=1e-5), span=SPLIT.burst) == BusUse()
    # a clock hides how often a line was taken
    ticks = replace(events, t=1e-3 * np.floor(1e3 * events.t))
    assert BusUse.of(ticks, TimestampStructure(step=1e-3), span=SPLIT.burst).row_load > 0.8


def test_a_bus_that_is_never_free_is_no_clock(rng):
    """It sends at ticks, one event each; to a clock as fast, events come by chance."""
    step, count = 1e-5, 20_000
    x, y = rng.integers(0, 50, (2, count), dtype=np.uint16)
    full = dase.Events(0.01 + step * np.arange(count), x, y, x > 20, 50, 50)
    assert share_at(full.t, step) == 1
    assert find_structure(full).step == 0
    by_chance = np.sort(rng.integers(0, count, count))
    assert find_structure(replace(full, t=0.01 + step * by_chance)).step == pytest.approx(step, rel=1e-4)
