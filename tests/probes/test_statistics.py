"""Sums over events and models run by the hundred, against plain loops and the simulator itself."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import dase
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS, StreamEffect
from dase.fitting.batch_simulator import SimulationOrder
from dase.fitting.data_split import split_measurement
from dase.fitting.descent import DESCENT
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.fitting.scheduler import answer_requests, run_side_by_side, run_work
from dase.fitting.trial_sampling import samples_per_step
from dase.kernels import event_probes as kernels
from dase.probes.accumulators import GROUP, PROBE_TIMES, compute_totals, leave_groups_out
from dase.probes.statistics import FAMILIES, LAYOUT, compute_statistics, peak_of, refine_frequency
from dase.probes.timestamp_patterns import TimestampStructure, find_structure
from dase.simulation.sensor import Sensor

ON = {
    "flicker": dict(depth=0.3), "vignetting": dict(loss=0.5), "dark": dict(current=0.02, spread=0.3),
    "linlog": dict(knee=0.1), "bandwidth": dict(cutoff=80.0), "second_order": dict(cutoff=80.0, damping=0.5),
    "voltage_noise": dict(sigma=0.08, cutoff=60.0), "mismatch": dict(spread=0.2), "jitter": dict(spread=0.2),
    "leak": dict(rate=3.0), "shot": dict(rate=5.0), "hot": dict(share=0.05), "dead": dict(share=0.1),
    "refractory": dict(period=4e-3, after_off=1.5, spread=0.2), "latency": dict(delay=2e-3),
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> dase.VideoScene:
    return moving_bars()


@pytest.fixture(scope="module")
def events(scene) -> dase.Events:
    return dase.simulate(scene, Sensor().with_effect(EFFECTS["shot"](rate=3.0)), seed=4)


@pytest.fixture(scope="module")
def evidence(events, scene, device):
    return split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)


def reference(events, stimulus, middle) -> np.ndarray:
    """Add up what `observe_event` adds up, event by event."""
    step, out = stimulus.grid.step, np.zeros(kernels.SumPlace.SIZE)
    lags = np.rint(np.array(PROBE_TIMES.lags) / step).astype(int)
    ends = np.rint(np.array(PROBE_TIMES.classes) / step).astype(int)
    level, last = stimulus.level, stimulus.grid.steps - 1
    for i, pixel in enumerate(stimulus.pixels):
        mine = events.select(events.y.astype(int) * events.width + events.x == pixel)
        before, polarity, deviation, run = -1, 0, None, 0
        for t, p in zip(mine.t, mine.p.astype(int), strict=True):
            k = int(np.ceil((t - stimulus.grid.begin - 2e-6) / step))
            if not 0 <= k <= last:
                continue
            run = run + 1 if before == k else 1
            cell, apart = int(stimulus.cell[i, k]), None
            if cell != kernels.MASKED:
                kind, band = divmod(cell, kernels.BANDS)
                out[kernels.SumPlace.RATE + p * kernels.CELLS + cell] += 1
                if kind >= kernels.RESTING:
                    seen = level[i, np.clip(k - lags, 0, last)]
                    out[kernels.SumPlace.LAG + np.arange(kernels.LAGS) * kernels.BANDS + band] += (
                        2 * p - 1
                    ) * -np.diff(seen)
                    out[kernels.SumPlace.LAG_COUNT + band] += 1
                broken = stimulus.holes and (stimulus.cell[i, before:k] == kernels.MASKED).any()
                if before >= 0 and not broken:
                    gap = k - before
                    octave = 0 if gap == 0 else min(int(np.ceil(np.log2(gap))) + 1, kernels.INTERVALS - 1)
                    kin = p if p == polarity else 2
                    out[
                        kernels.SumPlace.ISI
                        + (3 * (kind < kernels.RESTING) + kin) * kernels.INTERVALS
                        + octave
                    ] += 1
                    group = int(gap > ends[0]) + int(gap > ends[1])
                    pair = (2 * p + polarity) * kernels.CLASSES + group
                    change = (2 * p - 1) * (level[i, k] - level[i, before])
                    apart = np.clip(change - middle[pair], -1, 1)
                    out[kernels.SumPlace.CHANGE + 3 * pair + np.arange(3)] += (
                        1,
                        change,
                        abs(change - middle[pair]),
                    )
                    if deviation is not None:
                        out[kernels.SumPlace.SERIAL + 2 * group + np.arange(2)] += 1, apart * deviation
                out[kernels.SumPlace.REPEAT + 3 * band + np.arange(min(run, 3))] += 1
            before, polarity, deviation = k, p, apart
    return out


def test_sums_equal_a_loop_over_events(evidence, events):
    half = evidence.train
    want = reference(events, half.trials.stimulus, half.trials.middle)
    np.testing.assert_allclose(half.found.sums[0], want, rtol=2e-4, atol=2e-3)
    assert half.found.sums[0, : 2 * kernels.CELLS].sum() == half.found.halves.sum() > 1000
    assert half.found.clock.sum() == half.found.halves.sum()


def test_no_pair_of_events_reaches_across_what_is_not_compared(scene, device):
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["shot"](rate=3.0)), seed=4, device=device)
    spans = np.random.default_rng(0).random((100, scene.width * scene.height)) < 0.7

    def trust(times, pixels):
        return spans[np.floor(times / 0.02).astype(int)][:, pixels]

    half = split_measurement(Measurement(events, scene, trust=trust), pixels=300, seed=1, device=device).train
    stimulus = half.trials.stimulus
    want = reference(events, stimulus, half.trials.middle)
    np.testing.assert_allclose(half.found.sums[0], want, rtol=2e-4, atol=2e-3)
    across = reference(events, replace(stimulus, holes=False), half.trials.middle)
    isi = slice(kernels.SumPlace.ISI, kernels.SumPlace.LAG)
    assert want[isi].sum() < across[isi].sum() - 500


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if n in ON or n == "threshold"])
def test_a_trial_gives_the_events_of_the_simulator(evidence, name):
    """Sampled alike, the kernel of many models emits what the simulator emits, for each effect."""
    trials = evidence.scout.trials
    sensor = Sensor() if name == "threshold" else Sensor().with_effect(EFFECTS[name](**ON[name]))
    finer = max(samples_per_step(sensor, trials.stimulus.grid.step), 1)
    got = trials.run(sensor, sensor.parameters()[None], seed=9, finer=finer)
    want = trials.stream(sensor, sensor.parameters(), (), seed=9)
    assert want.halves.sum() > 500
    # times are rounded differently in the last bit: an event at the end of a step may fall into the next one
    assert np.count_nonzero(got.halves != want.halves) < 2e-3 * got.halves.size
    np.testing.assert_allclose(got.sums[0, : 2 * kernels.CELLS], want.sums[0, : 2 * kernels.CELLS], atol=3)
    assert abs(got.sums - want.sums).sum() < 2e-3 * abs(want.sums).sum()


def test_effects_that_are_off_change_nothing(evidence):
    """One kernel with every effect serves the plain model, bit for bit."""
    trials = evidence.scout.trials
    plain = Sensor(effects=(dase.EFFECTS["threshold"](phase=1.0),))
    every = plain
    for name, effect in EFFECTS.items():
        if name != "threshold" and not issubclass(effect, StreamEffect):
            every = every.with_effect(effect.identity())
    one, all_ = (trials.run(s, s.parameters()[None], seed=3, finer=0) for s in (plain, every))
    np.testing.assert_array_equal(one.sums, all_.sums)
    np.testing.assert_array_equal(one.halves, all_.halves)


def test_leaving_out_samples_at_rest_keeps_the_counts(evidence):
    """Samples where nothing changes may be left out: no event appears or is lost."""
    trials = evidence.train.trials
    for effects in ((), (EFFECTS["leak"](rate=5.0),), (EFFECTS["bandwidth"](cutoff=30.0),)):
        sensor = Sensor()
        for effect in effects:
            sensor = sensor.with_effect(effect)
        sparse, dense = (trials.run(sensor, sensor.parameters()[None], seed=5, finer=f) for f in (0, 1))
        assert abs(sparse.halves.sum() / dense.halves.sum() - 1) < 2e-3
        assert np.abs(sparse.clock - dense.clock).sum() < 0.1 * dense.clock.sum()  # some come a step earlier


def test_rows_of_a_batch_are_independent(evidence):
    trials = evidence.scout.trials
    vectors = np.repeat(Sensor().parameters()[None], 3, 0)
    vectors[:, 0] = 0.15, 0.2, 0.3
    together = trials.run(Sensor(), vectors, seed=2)
    for n in range(3):
        alone = trials.run(Sensor(), vectors[n : n + 1], seed=2)
        np.testing.assert_array_equal(together.halves[n], alone.halves[0])
    apart = trials.run(Sensor(), np.repeat(vectors[:1], 2, 0), seed=2, reseed=True)
    assert np.any(apart.halves[0] != apart.halves[1])


def side_by_side(lanes, orders):
    """Run models on a CPU in its vectors, compare them with one after the other, and return their sums."""
    threads = copy(lanes)
    threads._kernels, threads._lanes = {}, 1
    found = lanes.run_all(orders)
    for one, other in zip(found, threads.run_all(orders), strict=True):
        np.testing.assert_array_equal(one.halves, other.halves)
        np.testing.assert_array_equal(one.sums, other.sums)
        np.testing.assert_array_equal(one.clock, other.clock)
    return found


def test_models_side_by_side_are_those_alone(evidence, device, rng):
    """A CPU works on several models of a pixel in its vectors: the same to the last bit."""
    if str(device).startswith("cuda"):
        pytest.skip("on a GPU every model of a pixel has a thread of its own")
    names = ("leak", "shot", "dark", "linlog", "bandwidth", "latency", "jitter", "voltage_noise")
    sensors = [Sensor().with_effect(EFFECTS[n](**ON[n])) for n in names]
    # enough effects for the kernel that has all of them
    sensors = [s.with_effect(EFFECTS["refractory"](period=2e-3)) for s in sensors]
    orders = []
    for n, sensor in enumerate(sensors):
        vectors = np.repeat(sensor.parameters()[None], 5, 0)
        vectors[:, :2] *= np.exp(rng.uniform(-0.3, 0.3, (5, 2)))
        vectors[:, 2] = rng.choice([0.0, 1.0], 5)
        orders.append(SimulationOrder(sensor, vectors, seed=n, reseed=n % 2 > 0, finer=1))
    for sums in side_by_side(evidence.scout.trials, orders):
        assert sums.halves.sum() > 500


def test_more_events_than_may_wait(evidence, device, rng):
    """Where the models of a thread have more events in a pixel than wait until they are looked at."""
    if str(device).startswith("cuda"):
        pytest.skip("on a GPU no event waits")
    vectors = np.repeat(Sensor().parameters()[None], kernels.LANES, 0)
    vectors[:, :2] = rng.uniform(0.01, 0.02, (kernels.LANES, 2))
    orders = [SimulationOrder(Sensor(), vectors, seed=3, ticks=ticks) for ticks in (0.0, 3e-3)]
    for sums in side_by_side(evidence.scout.trials, orders):
        assert sums.halves.sum((0, 2)).max() > 2 * kernels.QUEUE


def test_a_clock_is_the_same_inside_the_kernel(evidence):
    """Events that the kernel stamps by a clock that ticks fall where those that go through one fall."""
    clock = EFFECTS["timestamp"](step=3e-3, jitter=0.0)
    sensor = Sensor().with_effect(clock)
    trials = replace(evidence.train.trials, structure=TimestampStructure(step=clock.step))
    vector = sensor.parameters()[None]
    ticks = trials.ticks(sensor)
    assert ticks == clock.step
    got, free = trials.run_all([SimulationOrder(sensor, vector, 9, finer=1, ticks=t) for t in (ticks, 0.0)])
    want = trials.stream(sensor, vector, sensor.readout_effects(), seed=9)
    many = want.clock.sum()
    assert np.abs(got.clock - want.clock).sum() < 1e-2 * many < 0.5 * np.abs(free.clock - want.clock).sum()
    np.testing.assert_allclose(got.stamps, want.stamps, atol=1e-2)
    # where more than that is to be felt, events have to go through it
    assert trials.ticks(sensor.with_effect(EFFECTS["readout"](rate=1e5))) is None
    other = replace(trials, structure=TimestampStructure(step=2e-3))
    assert other.ticks(sensor) is None


def test_counts_fold_as_plain_loops_would(evidence, rng):
    """Products over the halves, pixels that count oddly, and rings, summed up where the counts are."""
    half = evidence.train
    expected = half.found.halves[0] * rng.uniform(0.5, 1.5, half.found.halves[0].shape)
    frame = replace(half.frame, expected=expected)
    counts, got = half.found.halves[0].astype(float), compute_totals(half.found, frame).folded[0]
    d = (counts - expected).reshape(-1, 2, 2, 2)  # state, half, polarity
    products = np.einsum("nsp,nsq->spq", d[:, :, 0], d[:, :, 1]).reshape(2, 4)
    own = (d**2).sum((0, 2))
    np.testing.assert_allclose(got[:12], np.concatenate([products, own], 1).ravel(), rtol=1e-4, atol=1e-2)
    rings = [counts[frame.zone == z].reshape(-1, 2, 2, 2).sum((0, 2)) for z in range(kernels.ZONES)]
    np.testing.assert_array_equal(got[kernels.FoldPlace.RINGS :], np.stack(rings, -1).ravel())
    left = leave_groups_out(half.found, frame)
    keep = np.arange(len(expected)) >= GROUP
    d = d[keep]
    np.testing.assert_allclose(
        left.folded[0][:4], np.einsum("np,nq->pq", d[:, 0, 0], d[:, 0, 1]).ravel(), rtol=1e-4, atol=1e-2
    )
    np.testing.assert_allclose(left.expected[0], expected[keep].sum(0))


def kept(work, seen):
    """Do a work, and keep what it asks for with the answers."""
    try:
        asks = next(work)
        while True:
            answers = yield asks
            seen += zip(asks, answers, strict=True)
            asks = work.send(answers)
    except StopIteration as stop:
        return stop.value


def test_searches_side_by_side_end_where_each_ends_alone(evidence):
    models = [
        model_of(Sensor().with_effect(EFFECTS[name](**ON[name]))) for name in ("leak", "shot", "linlog")
    ]
    half = models[0].calibrate(evidence.scout, repeats=6, seed=1)
    seen = [[] for _ in models]
    for model, each in zip(models, seen, strict=True):
        run_work(kept(model.search_work(half, seed=3, iterations=1), each))
    assert max(map(len, seen)) > 5
    # beside the first populations of all, every population has the answers it has alone
    first = [each[0][0] for each in seen]
    for ask, want in (pair for each in seen for pair in each):
        np.testing.assert_allclose(answer_requests([*first, ask])[-1], want, rtol=1e-6, atol=1e-7)
    # the end can be compared after one: a place off by 1e-9 counts an event more or less in the next ones
    once = replace(DESCENT, longest=1)
    ends = run_side_by_side([m.search_work(half, seed=3, iterations=1, settings=once) for m in models])
    for found, model in zip(ends, models, strict=True):
        want = run_work(model.search_work(half, seed=3, iterations=1, settings=once))
        np.testing.assert_allclose(found.place, want.place, atol=1e-5)
        assert found.loss == pytest.approx(want.loss, rel=1e-4)


def test_silent_pixels_are_counted(evidence, events):
    """A pixel is silent if it sends nothing where at least six events are expected."""
    half = evidence.train
    expected = half.found.halves[0].astype(float)  # as if the model were exact
    busy = np.flatnonzero(expected.sum(1) >= 6)[:7]
    few = np.flatnonzero((expected.sum(1) < 6) & (expected.sum(1) > 0))[:3]
    muted = half.trials.stimulus.pixels[np.concatenate([busy, few])]
    place = events.y.astype(int) * events.width + events.x
    found = half.trials.look(events.select(~np.isin(place, muted)))
    frame = replace(half.frame, expected=expected)
    values = [compute_statistics(sums, frame)[0][0, LAYOUT["silent"]] for sums in (half.found, found)]
    np.testing.assert_allclose(np.exp(np.concatenate(values)) - 3, [0, 7], atol=1e-9)


def test_families_fill_the_vector():
    assert list(LAYOUT) == list(FAMILIES)
    ends = [(part.start, part.stop) for part in LAYOUT.values()]
    assert ends[0][0] == 0
    assert all(a[1] == b[0] for a, b in pairwise(ends))


@pytest.mark.parametrize(
    "effect",
    [EFFECTS["timestamp"](step=3e-4, jitter=0.0), EFFECTS["row_scan"](line=1.2e-5, direction="up")],
)
def test_regular_time_stamps_are_found(scene, effect):
    events = dase.simulate(scene, Sensor().with_effect(effect), seed=1)
    found = find_structure(events)
    if effect.name == "timestamp":
        assert found.step == pytest.approx(3e-4, rel=1e-4)
    else:
        assert found.line == pytest.approx(1.2e-5, rel=1e-3)
        assert found.direction == "up"
    assert found.shares(events).max() > 0.97


@pytest.mark.parametrize("doubles", [0.0, 0.02])
@pytest.mark.parametrize("scan", [211e-6, 540e-6, 900e-6])
def test_a_scan_is_found_where_pixels_send_once_in_a_frame(rng, scan, doubles):
    """No two events of a row are less than two scans apart, but for those that are repeated at once."""
    frame = np.repeat(np.arange(1000), 20)
    x, y = (rng.integers(0, size, len(frame)).astype(np.uint16) for size in (64, 48))
    begin = y * (scan / 48)
    t = np.ceil((frame * 2.6 * scan - begin) / scan) * scan + begin
    again = rng.random(len(t)) < doubles
    t, x, y = (np.concatenate([one, one[again]]) for one in (t, x, y))
    t[len(frame) :] += 5e-6
    order = np.argsort(t, kind="stable")
    sent = dase.Events(np.round(t[order], 6), x[order], y[order], np.ones(len(t), bool), 64, 48)
    found = find_structure(sent)
    assert found.direction == "down"
    assert found.line * 48 == pytest.approx(scan, rel=1e-3)
    # without the scan there is none
    moved = np.sort(np.round(sent.t + 0.5 * scan * rng.random(len(t)), 6))
    assert find_structure(replace(sent, t=moved)) == TimestampStructure()


def test_a_scan_that_begins_anywhere_and_pauses_is_found(scene):
    """As real ones do: the clock of the file begins within a scan, and between scans nothing is read."""
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["shot"](rate=20.0)), seed=1)
    line, lines = 4e-6, events.width
    scan = line * lines * 1.015
    place = lines - 1 - events.x.astype(float)
    t = np.ceil((events.t - place * line) / scan) * scan + place * line + 0.37 * scan
    order = np.argsort(t)
    found = find_structure(replace(events.select(order), t=np.rint(1e6 * t[order]) * 1e-6))
    assert found.direction == "left"
    assert found.line == pytest.approx(scan / lines, rel=1e-3)


def test_a_regularity_must_last(scene):
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["timestamp"](step=3e-4, jitter=0.0)), seed=1)
    t = events.t.copy()
    t[len(t) * 3 // 4 :] += 1e-5
    assert find_structure(replace(events, t=t)).step == 0


def test_ordinary_time_stamps_have_no_regularity(scene):
    found = find_structure(dase.simulate(scene, Sensor(), seed=1))
    assert found.step == found.line == 0


def test_a_bus_is_shared_out(evidence):
    """A few pixels get their part of a bus."""
    trials = evidence.train.trials
    sensor = Sensor().with_effect(EFFECTS["readout"](rate=1e5, mode="drop"))
    free = trials.stream(sensor, sensor.parameters(), (), seed=1).halves.sum()
    held = trials.stream(sensor, sensor.parameters(), sensor.readout_effects(), seed=1).halves.sum()
    assert held < 0.95 * free


def a_lamp(rng, frequency: float, seconds: float = 1.0) -> dase.Events:
    """Events whose polarity follows a lamp, among others that do not."""
    t = np.sort(rng.uniform(0, seconds, 60_000))
    on = rng.random(len(t)) < 0.5 + 0.15 * np.cos(2 * np.pi * frequency * t + 1.0)
    x, y = (rng.integers(0, 32, len(t)) for _ in range(2))
    return dase.Events(t, x, y, on, 32, 32)


@pytest.mark.parametrize("frequency", [49.83, 100.0, 213.7])
def test_a_lamp_is_known_better_than_a_turn_of_the_window(rng, frequency):
    events = a_lamp(rng, frequency)
    for off in (-0.6, 0.0, 0.8):
        # a window of 0.6 s has frequencies 1.7 Hz apart
        assert refine_frequency(events, 0.0, 0.6, frequency + off) == pytest.approx(frequency, abs=0.08)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_lamp_is_told_by_its_own_tone_where_an_overtone_stands_farther_above_the_rest(seed):
    """In a clip with frames each 2 ms a lamp of 120 Hz was looked for at 237 Hz alone, and missed."""
    rng, steps, step = np.random.default_rng(seed), 265, 2e-3
    time = (np.arange(steps) + 0.5) * step
    # motion swings the rate up to 40 Hz and about 110 Hz, and leaves what is above quiet
    motion = 100 * np.convolve(rng.standard_normal(steps + 14), np.sqrt(np.hanning(15)), "valid")
    net = motion + motion[::-1] * np.cos(2 * np.pi * 110 * time)
    net += 420 * np.sin(2 * np.pi * 120 * time) + 200 * np.sin(2 * np.pi * 238.5 * time + 1)
    counts = np.round(4000 + np.concatenate([-net, net]) / 2).astype(np.int64)
    found = peak_of(counts, step)
    assert found.frequency == pytest.approx(120.0, abs=1.0)
    assert found.chance < 1e-6


def test_how_likely_chance_makes_the_highest_peak_of_the_rate(rng):
    steps, step = 4000, 1e-3
    chances = np.array([peak_of(rng.poisson(0.5, 2 * steps), step).chance for _ in range(40)])
    # of independent events a probability is exceeded as often as it says, or less often
    assert (chances < 0.2).mean() < 0.4
    assert (chances < 0.01).sum() < 3
    swing = 0.3 * np.sin(2 * np.pi * 137.3 * step * np.arange(steps))
    lamp = rng.poisson(0.5 * np.concatenate([1.0 - swing, 1.0 + swing]))
    found = peak_of(lamp, step)
    assert found.frequency == pytest.approx(137.3, abs=0.2)
    assert found.chance < 1e-6
    assert peak_of(np.zeros(2 * steps, np.int64), step).chance == 1.0
    # from frame to frame of a clip at 25 Hz no frequency that is looked for shows
    assert peak_of(rng.poisson(3.0, 100), 0.04) == (0.0, 1.0)


def test_slow_clocks_are_seen_in_busy_recordings(rng):
    t = np.sort(np.round(rng.uniform(0, 0.3, 400_000) / 1e-3) * 1e-3)
    x, y = (rng.integers(0, 64, len(t)) for _ in range(2))
    events = dase.Events(t, x, y, rng.random(len(t)) < 0.5, 64, 64)
    # 50,000 events have 38 ticks, too few
    assert find_structure(events).step == pytest.approx(1e-3, rel=1e-4)
    free = dase.Events(np.sort(rng.uniform(0, 0.3, len(t))), x, y, events.p, 64, 64)
    assert find_structure(free) == TimestampStructure()
