"""Every effect does its physics, at the rate asked for; and refuses what makes no sense."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.event_comparison import KS, distance, tracks
from helpers.small_scenes import ramp, static
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.leak import Leak
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.kernels import pixel_stages
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor_file import load_sensor, parse_sensor, read_presets


@pytest.mark.parametrize("light", [0.8, 0.05])
@pytest.mark.parametrize(("cutoff", "dark"), [(100.0, 0.1), (900.0, 0.02)])
def test_a_step_charges_with_the_cutoff_of_its_light(device, light, cutoff, dark):
    expected = cutoff * (dark + (1 - dark) * light)
    tau = 1 / (2 * np.pi * expected)
    # a step by 0.6 in a millionth of the time constant, then 4 time constants of constant light
    before = (light + 1e-3) * np.exp(-0.6) - 1e-3
    times = np.concatenate([[-1e-6 * tau], np.linspace(0, 4 * tau, 401)])
    scene = dase.VideoScene(np.r_[before, np.full(401, light)][:, None, None], times)
    slow = Bandwidth(cutoff=cutoff, dark=dark)
    sensor = reference.only(Threshold(on=0.05, off=0.05, phase=0.0), slow)
    events = dase.simulate(scene, sensor, device=device)
    assert len(events) == 11
    assert events.p.all()
    # event n comes at -τ log(1 - 0.05 n / 0.6)
    slope = np.polyfit(-np.log1p(-np.arange(1, 12) / 12), events.t, 1)[0]
    assert 1 / (2 * np.pi * slope) == pytest.approx(expected, rel=0.02)


def test_a_sine_at_the_cutoff_loses_3_db(device):
    frequency, swings = 50.0, 40
    times = np.linspace(0, swings / frequency, 200 * swings + 1)
    level = -3 + 1.5 * np.sin(2 * np.pi * frequency * times)
    scene = dase.VideoScene((np.exp(level) - 1e-3)[:, None, None], times)
    thresholds = Threshold(on=0.01, off=0.01, phase=0.0)
    counts = []
    for sensor in (reference.only(thresholds), reference.only(thresholds, Bandwidth(cutoff=50.0, dark=1.0))):
        edges = np.array([10, swings]) / frequency  # the first swings die down
        counts.append(dase.count(scene, sensor, edges, device=device).sum())
    assert counts[0] == pytest.approx(30 * 2 * 3 / 0.01, rel=0.02)
    assert counts[1] / counts[0] == pytest.approx(np.sqrt(0.5), rel=0.02)


def test_the_twin_of_the_low_pass_solves_its_equation(rng):
    times = np.cumsum(rng.uniform(0.5, 2, 40)) * 1e-3
    level, cutoff = rng.normal(0, 1, 40), rng.uniform(20, 400, 40)
    got = reference.lowpass(times, level, cutoff)
    y, fine = level[0], 4000
    for k in range(1, 40):
        dt, rate = (times[k] - times[k - 1]) / fine, 2 * np.pi * cutoff[k]
        middle = level[k - 1] + (np.arange(fine) + 0.5) / fine * (level[k] - level[k - 1])
        for u in middle:
            y += dt * rate * (u - y) / (1 + 0.5 * dt * rate)
        assert got[k] == pytest.approx(y, abs=1e-6)
    # far into a ramp the output lags by the time constant
    line = reference.lowpass(np.arange(50.0), 3 * np.arange(50.0), np.full(50, 0.5 / np.pi))
    assert line[-1] == pytest.approx(3 * (49 - 1.0), abs=1e-9)


def test_the_low_pass_does_not_depend_on_sampling(device):
    # one straight step of a ramp, and the same ramp in 64 steps, end at the same voltage
    sensor = reference.only(Threshold(on=0.01, off=0.01, phase=0.0), Bandwidth(cutoff=3.0, dark=1.0))
    totals = [
        dase.count(ramp(3.0, 0.2, 1, samples), sensor, [0, 0.2], device=device).sum() for samples in (2, 65)
    ]
    tau = 1 / (2 * np.pi * 3.0)
    want = 3.0 - 3.0 / 0.2 * tau * (1 - np.exp(-0.2 / tau))
    assert totals[0] == pytest.approx(want / 0.01, abs=1.5)
    assert totals[1] == pytest.approx(want / 0.01, abs=1.5)


def test_leak_events_of_a_static_scene(device):
    rate, spread, seconds = 2.0, 0.25, 60.0
    scene = static(np.full((30, 30), 0.02), seconds, 61)
    sensor = reference.only(Threshold(off=0.1), Leak(rate=rate, spread=spread))
    off, on = dase.count(scene, sensor, [0, seconds], device=device)[0, 0]
    assert off.sum() == 0
    rates = on / seconds
    assert rates.mean() == pytest.approx(rate, abs=3 * rate * spread / 30)
    assert rates.std() == pytest.approx(rate * spread, abs=3 * rate * spread / np.sqrt(2 * 900))
    intervals = np.diff(tracks(dase.simulate(scene, sensor, device=device))[0])
    np.testing.assert_allclose(intervals, intervals[0], rtol=1e-4)


def test_leak_rates_do_not_depend_on_the_threshold(device):
    scene = static(np.full((4, 5), 0.3), 10.0, 21)
    for on in (0.1, 0.8):
        sensor = reference.only(Threshold(on=on), Leak(rate=3.0, spread=0.0))
        counts = dase.count(scene, sensor, [0, 10], device=device)[0, 0, 1]
        np.testing.assert_allclose(counts, 30, atol=1)


@pytest.mark.parametrize("light", [0.0, 0.4, 1.0])
def test_shot_rate_balance_and_independence(device, light):
    rate, bright, balance, seconds, pixels = 10.0, 0.25, 0.7, 20.0, 400
    scene = static(np.full((20, 20), light), seconds, 41)
    sensor = reference.only(Shot(rate=rate, bright=bright, balance=balance))
    off, on = dase.count(scene, sensor, [0, seconds], device=device)[0, 0]
    total, want = (on + off).sum(), pixels * seconds * rate * (1 - (1 - bright) * light)
    assert total == pytest.approx(want, abs=3 * np.sqrt(want))
    assert on.sum() / total == pytest.approx(balance, abs=3 * np.sqrt(balance * (1 - balance) / total))
    # Poisson counts: variance over mean is 1, and neighbours know nothing of each other
    counts = (on + off).reshape(20, 20).astype(float)
    assert counts.var() / counts.mean() == pytest.approx(1, abs=3 * np.sqrt(2 / pixels))
    assert abs(np.corrcoef(counts[:, 1:].ravel(), counts[:, :-1].ravel())[0, 1]) < 3 / np.sqrt(380)


def test_shot_intervals_are_exponential(device):
    scene = static(np.full((15, 15), 0.5), 20.0, 21)
    sensor = reference.only(Shot(rate=16.0, bright=0.25))
    # of every pixel the first 20 of about 200 intervals, so that the end of the scene cuts none short
    intervals = [np.diff(np.r_[0, t[:20]]) for t in tracks(dase.simulate(scene, sensor, device=device))]
    waits = np.sort(np.concatenate(intervals))
    assert len(waits) == 225 * 20
    assert distance(waits, 1 - np.exp(-10.0 * waits)) < KS
    pairs = np.concatenate([np.stack([i[:-1], i[1:]]) for i in intervals], axis=1)
    assert abs(np.corrcoef(pairs)[0, 1]) < 3 / np.sqrt(pairs.shape[1])


def test_shot_events_do_not_depend_on_sampling(device):
    sensor = reference.only(Shot(rate=5.0))
    coarse, fine = (
        dase.simulate(static(np.full((6, 6), 0.3), 8.0, samples), sensor, device=device)
        for samples in (3, 4001)
    )
    assert len(coarse) > 500
    np.testing.assert_array_equal(coarse.p, fine.p)
    np.testing.assert_allclose(coarse.t, fine.t, rtol=3e-5)


@pytest.mark.parametrize("effect", [Shot(rate=0.02, bright=1.0), Leak(rate=0.02, spread=0.0)])
def test_rare_events_survive_fine_sampling(device, effect):
    # at 20 kHz a step spends a millionth of the mean interval, little more than float32 resolves of one
    sensor = reference.only(effect)
    coarse = static(np.full((1, 8), 0.3), 150.0, 31)
    want = dase.simulate(coarse, sensor, device=device)
    times = np.arange(3_000_001) / 20_000
    array, parts = PixelArray(sensor, 8, 1, device=device), []
    for part in np.array_split(times, np.arange(200_000, len(times), 200_000)):
        parts.append(array.emit(_Still(8, part), part)[0])
    got = dase.Events.concatenate(parts)
    assert len(want) > 10
    np.testing.assert_allclose(got.t, want.t, rtol=1e-3)


class _Still(reference.LogScene):
    """Eight pixels of log(0.301) for ever."""

    def __init__(self, width: int, times: np.ndarray):
        super().__init__(np.full((len(times), 1, width), np.log(0.301)), times)


def test_mismatch_spreads_thresholds(device):
    sensor = reference.only(Threshold(on=0.2, off=0.3), Mismatch(spread=0.15))
    off, on = PixelArray(sensor, 60, 50, seed=5, device=device).thresholds()[0].astype(float)
    for got, nominal in ((on, 0.2), (off, 0.3)):
        assert got.mean() == pytest.approx(nominal, abs=3 * 0.15 * nominal / np.sqrt(3000))
        assert got.std() == pytest.approx(0.15 * nominal, abs=3 * 0.15 * nominal / np.sqrt(6000))
    assert abs(np.corrcoef(on, off)[0, 1]) < 3 / np.sqrt(3000)
    twin = np.array([reference.thresholds(sensor, i, 5) for i in range(200)]).T
    np.testing.assert_allclose([off[:200], on[:200]], twin, rtol=2e-6)
    wide = PixelArray(reference.only(Mismatch(spread=1.0)), 60, 50, device=device).thresholds()
    assert wide.min() == np.float32(0.01)


def test_mismatch_of_comparators_moves_both_thresholds_alike(device):
    sensor = reference.only(Threshold(on=0.2, off=0.3), Mismatch(spread=0.12, relative_to="mean"))
    off, on = PixelArray(sensor, 60, 50, seed=5, device=device).thresholds()[0].astype(float)
    for got, nominal in ((on, 0.2), (off, 0.3)):
        assert got.mean() == pytest.approx(nominal, abs=3 * 0.03 / np.sqrt(3000))
        assert got.std() == pytest.approx(0.03, abs=3 * 0.03 / np.sqrt(6000))
    assert abs(np.corrcoef(on, off)[0, 1]) < 3 / np.sqrt(3000)
    twin = np.array([reference.thresholds(sensor, i, 5) for i in range(200)]).T
    np.testing.assert_allclose([off[:200], on[:200]], twin, rtol=2e-6)


def test_mismatched_rates_follow_the_inverse_threshold(device):
    sensor = reference.only(Threshold(on=0.06, off=0.09, phase=0.0), Mismatch(spread=0.2))
    off, on = PixelArray(sensor, 200, 1, seed=2, device=device).thresholds()[0]
    for change, theta, polarity in ((6.0, on, 1), (-6.0, off, 0)):
        counts = dase.count(ramp(change, 1.0, 200), sensor, [0, 1], seed=2, device=device)[0, 0]
        assert counts[1 - polarity].sum() == 0
        assert np.all(np.abs(counts[polarity] - (6.0 / theta - 0.5)) <= 0.51)


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_no_two_events_are_closer_than_the_dead_time(device, rng, mode):
    period, times = 7e-3, np.arange(200) * 2e-3
    level = -np.abs(np.cumsum(rng.normal(0, 0.3, (200, 6, 6)), 0))
    sensor = reference.only(Refractory(period=period, mode=mode), Shot(rate=20.0), Leak(), mode=mode)
    tracked = tracks(dase.simulate(dase.VideoScene(np.exp(level), times), sensor, device=device))
    shortest = min(np.diff(t).min() for t in tracked)
    # held in reset, a pixel has all of the way to the next threshold before it
    assert period - 1e-8 < shortest < (1.2 if mode == "reset" else 1.01) * period


def test_the_dead_time_drops_what_is_too_fast(device):
    # crossings every 2 ms from 2 ms on; in drop mode every third is sent, in delay mode one every 5 ms
    scene = ramp(5.0, 0.05, 1, samples=26)
    quiet = Threshold(on=0.2, off=0.2, phase=0.0)
    ideal = dase.simulate(scene, reference.only(quiet), device=device).t
    np.testing.assert_allclose(ideal, 2e-3 * np.arange(1, len(ideal) + 1), atol=1e-7)
    lost = Refractory(period=5e-3, mode="drop")
    drop = dase.simulate(scene, reference.only(quiet, lost, mode="drop"), device=device).t
    np.testing.assert_allclose(drop, ideal[::3], atol=1e-8)
    late = Refractory(period=5e-3, mode="delay")
    delay = dase.simulate(scene, reference.only(quiet, late, mode="delay"), device=device).t
    np.testing.assert_allclose(delay, 2e-3 + 5e-3 * np.arange(10), atol=1e-7)


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_the_dead_time_spares_slow_signals(device, rng, mode):
    scene = ramp(-5.0, 1.0, 20)
    want = dase.simulate(scene, reference.only(Threshold()), device=device)
    short = Refractory(period=0.039, mode=mode)
    got = dase.simulate(scene, reference.only(Threshold(), short, mode=mode), device=device)
    assert len(want) > 400
    for name in "txyp":
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_a_dead_pixel_delays_by_the_dead_time(device):
    # a step of 2.5 thresholds: two crossings at once, the second comes when the dead time ends
    level = np.array([0.0, 0.5, 0.5, 0.5])[:, None, None] - 2
    scene = dase.VideoScene(np.exp(level) - 1e-3, [0.0, 1e-6, 0.01, 0.02])
    sensor = reference.only(Threshold(phase=0.0), Refractory(period=4e-3, mode="delay"), mode="delay")
    t = dase.simulate(scene, sensor, device=device).t
    np.testing.assert_allclose(t, [4e-7, 4e-7 + 4e-3], atol=2e-9)


def test_the_initial_phase_is_uniform(device):
    # the first event of a ramp comes when the rest of the way to the threshold is gone: uniformly
    for sign in (1, -1):
        sensor = reference.only(Threshold(on=0.4, off=0.8))
        events = dase.simulate(ramp(sign * 2.0, 1.0, 2000), sensor, device=device)
        first = np.sort([t[0] for t in tracks(events)])
        assert distance(first, first / (0.2 if sign > 0 else 0.4)) < KS


def test_only_a_spread_phase_counts_without_bias(device):
    change, pixels = 2.6, 2000
    for sign, theta in ((1, 1.0), (-1, 0.7)):
        scene = ramp(sign * change, 0.01, pixels, samples=3)
        channel = (1 + sign) // 2
        spread, bunched = (
            dase.count(scene, reference.only(Threshold(on=1.0, off=0.7, phase=phase)), [0, 1], device=device)[
                0, 0
            ]
            for phase in (1.0, 0.0)
        )
        fraction = change / theta % 1
        error = np.sqrt(fraction * (1 - fraction) / pixels)
        assert spread[channel].mean() == pytest.approx(change / theta, abs=3 * error)
        assert np.all(bunched[channel] == np.floor(change / theta))
        assert spread[1 - channel].sum() == bunched[1 - channel].sum() == 0


OUTSIDE = [
    (lambda: Threshold(on=0.0), r"threshold\.on must lie in \[0\.01, 10\] log intensity, got 0"),
    (lambda: Bandwidth(cutoff=-1.0), r"bandwidth\.cutoff must lie in \[0\.01, inf\] Hz, got -1"),
    (lambda: Bandwidth(cutoff=10**400), r"bandwidth\.cutoff: a whole number of 401 digits is too large"),
    (lambda: Leak(rate=float("nan")), r"leak\.rate must lie in \[0, 100000\] Hz, got nan"),
    (lambda: Shot(balance=1.1), r"shot\.balance must lie in \[0, 1\] 1, got 1\.1"),
    (lambda: Mismatch(spread="wide"), r"mismatch\.spread must be a number \[1\], got 'wide'"),
    (lambda: Refractory(period=True), r"refractory\.period must be a number \[s\], got True"),
    (lambda: Refractory(mode="late"), r"refractory\.mode must be one of reset, drop, delay, got 'late'"),
    (lambda: Leak.from_table({"rat": 1.0}), r"effect 'leak' has no parameter 'rat': did you mean 'rate'\?"),
    (lambda: dase.Sensor((Leak(),)), "needs the effect 'threshold', got leak"),
    (lambda: dase.Sensor((Threshold(), Leak(), Leak())), "each effect may appear once, got"),
    (lambda: dase.Sensor(log_eps=float("nan")), r"log_eps must lie in \(0, 1\), got nan"),
    (lambda: dase.Sensor(size=(0, 4)), "size must lie between 1x1 and 16384x16384, got 0x4"),
    (lambda: load_sensor("davis345"), "'davis345' is neither a preset nor a file: did you mean 'davis346'"),
    (lambda: load_sensor("no/such.toml"), r"sensor file no/such\.toml does not exist"),
]


@pytest.mark.parametrize(("make", "message"), OUTSIDE)
def test_refusals_name_thing_rule_and_value(make, message):
    with pytest.raises(dase.InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[treshold]\non = 0.2", "there is no effect 'treshold': did you mean 'threshold'?"),
        ("[threshold]\nonn = 0.2", "effect 'threshold' has no parameter 'onn': did you mean 'on'?"),
        ("[threshold]\non = nan", "threshold.on must lie in [0.01, 10] log intensity, got nan"),
        ("[threshold]\non = '0.2'", "threshold.on must be a number [log intensity], got '0.2'"),
        ("threshold = 3", "'threshold' must be a table [threshold], got 3"),
        ("sizes = [3, 4]\n[threshold]", "there is no entry 'sizes': did you mean 'size'?"),
        ("size = [3.0, 4]\n[threshold]", "size must be two whole numbers [columns, rows], got [3.0, 4]"),
        ("log_eps = true\n[threshold]", "log_eps must be a number, got True"),
        ("[leak]", "needs the effect 'threshold'"),
        ("[threshold", "is not TOML"),
        ("name = 3\n[threshold]", "name must be a text, got 3"),
    ],
)
def test_a_faulty_file_is_named(tmp_path, text, message):
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(dase.InputError) as error:
        load_sensor(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


def test_a_file_that_is_no_text_is_named(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(dase.InputError, match=r"camera\.toml is not UTF-8 text"):
        load_sensor(path)


@pytest.mark.parametrize("sensor", [*read_presets(), "identity", "full"])
def test_a_sensor_file_says_everything(tmp_path, sensor):
    made = {
        "identity": reference.only(mode="delay"),
        "full": dase.Sensor(tuple(e() for e in dase.EFFECTS.values()), name='a "b" #c', size=(7, 5)),
    }
    first = made[sensor] if sensor in made else load_sensor(sensor)
    path = tmp_path / "camera.toml"
    path.write_text(dase.dump_sensor(first))
    second = load_sensor(path)
    assert second == first if sensor != "identity" else second.effects == first.effects
    np.testing.assert_array_equal(second.parameters(), first.parameters())
    assert dase.dump_sensor(second) == dase.dump_sensor(first)
    assert parse_sensor(dase.dump_sensor(first), "text") == second


@pytest.mark.parametrize("effect", dase.EFFECTS.values(), ids=lambda effect: effect.name)
def test_every_effect_explains_itself(effect):
    assert len(effect.about()) > 100
    assert re.search(r"\b(19|20)\d\d\b", effect.source)
    for parameter in effect.parameters():
        low, high = parameter.bounds
        assert low <= parameter.plausible[0] < parameter.plausible[1] <= high
        assert low <= parameter.default <= high
        assert parameter.unit
        assert parameter.about
    off = [p.name for p in effect.parameters() if p.off is not None]
    assert off  # an effect of two independent parts has two
    assert {stage for stage, _ in effect().compiled().functions} <= set(pixel_stages.STAGES)
