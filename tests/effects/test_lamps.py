"""Lamps whose light is no sine, and several lamps: twins, closed forms, and trials as simulations."""

from __future__ import annotations

import numpy as np
import pytest
from reference import effects as reference_effects

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.flicker import Flicker
from dase.effects.leak import Leak
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.simulation.sensor_run import sample_times

SHAPES = ("sine", "rectified", "pwm")
SIZE = (4, 6)


def still(light: float, seconds: float, samples: int) -> dase.VideoScene:
    frames = np.full((samples, *SIZE), light, np.float32)
    return dase.VideoScene(frames, np.linspace(0, seconds, samples))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("region", [np.inf, 2.0])
@pytest.mark.parametrize("depth", [0.3, 0.8])
@pytest.mark.parametrize("more", [(), (Vignetting(loss=0.5), Bandwidth(cutoff=150.0))])
def test_a_lamp_is_its_twin(device, shape, region, depth, more):
    lamp = Flicker(frequency=37.0, depth=depth, phase=0.2, shape=shape, duty=0.3, region=region, apart=0.23)
    sensor = dase.Sensor((lamp, *more, Threshold(on=0.17, off=0.23)))
    scene = still(0.4, 0.15, 400)
    times = scene.sample_times()
    got = dase.simulate(scene, sensor, device=device)
    want = reference_effects.events(sensor, times, scene.frames(times), 0)
    place, alike = got.y.astype(int) * SIZE[1] + got.x, []
    for i, rows in enumerate(want):
        mine = got.select(place == i)
        # a crossing at the very top of a swing may be rounded away
        alike.append(len(mine) == len(rows) and np.allclose(mine.t, rows[:, 1], rtol=0, atol=2e-5))
    assert np.mean(alike) > 0.9
    assert sum(len(rows) for rows in want) > 20


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("depth", [0.2, 0.6])
def test_every_shape_swings_as_far(device, shape, depth):
    """From darkest to brightest and back in every period: whole thresholds of log((1 + d) / (1 - d))."""
    frequency, periods = 100.0, 20
    sensor = dase.Sensor((Threshold(on=0.02, off=0.02, phase=0.0), Flicker(depth=depth, shape=shape)))
    got = dase.simulate(still(0.5, periods / frequency, 2), sensor, device=device)
    events = got.select((got.x == 0) & (got.y == 0) & (got.t > 2 / frequency))
    each = events.counts([2 / frequency, 1.0])[0, :, 0, 0] / (periods - 2)
    swing = np.log((0.5 * (1 + depth) + 1e-3) / (0.5 * (1 - depth) + 1e-3))
    np.testing.assert_allclose(each, swing / 0.02, rtol=0.02, atol=1.0)


@pytest.mark.parametrize("duty", [0.1, 0.5, 0.8])
def test_a_switched_lamp_makes_all_events_at_two_moments(device, duty):
    frequency = 100.0
    lamp = Flicker(frequency=frequency, depth=0.5, phase=0.25, shape="pwm", duty=duty)
    scene, sensor = still(0.5, 0.2, 2), dase.Sensor((Threshold(on=0.2, off=0.2), lamp))
    events = dase.simulate(scene, sensor, device=device)
    step = np.diff(sample_times(scene, sensor)).max()
    assert step < duty / frequency
    turn = (events.t * frequency + 0.25) % 1
    late = np.minimum(
        np.abs(turn - np.where(events.p, 0.0, duty)), np.abs(turn - 1 - np.where(events.p, 0, duty))
    )
    assert np.abs(late).max() <= step * frequency + 1e-6
    assert {True, False} == set(events.p.tolist())


def test_what_smooths_short_pulses_feels_as_much_of_them_wherever_samples_fall(device):
    """Pulses of four and a half samples are all of one length, not some of four and some of five."""
    times = np.arange(1801) / 90e3
    scene = dase.VideoScene(np.full((len(times), 4, 4), 0.5, np.float32), times)
    counts = []
    for phase in np.arange(6) / 6 / 90:
        lamp = Flicker(frequency=1000.0, depth=0.6, phase=phase, shape="pwm", duty=0.05)
        sensor = dase.Sensor((Threshold(on=0.02, off=0.02), lamp, Bandwidth(cutoff=1000.0, dark=1.0)))
        counts.append(len(dase.simulate(scene, sensor, device=device)))
    assert max(counts) < 1.05 * min(counts)


def test_rectified_light_dips_once_a_period(device):
    """ON and OFF events crowd at the zeros of the mains, where the light turns sharply."""
    sensor = dase.Sensor((Threshold(on=0.02, off=0.02), Flicker(depth=0.6, shape="rectified")))
    events = dase.simulate(still(0.5, 0.2, 2), sensor, device=device)
    turn = (events.t * 100) % 1
    np.testing.assert_array_equal(events.p[(turn > 0.03) & (turn < 0.45)], True)
    np.testing.assert_array_equal(events.p[(turn > 0.55) & (turn < 0.97)], False)
    # log(1 + d w) at a tenth of a turn from the dip, in thresholds
    level = np.log((0.5 * (1 + 0.6 * (2 * np.sin(0.1 * np.pi) - 1)) + 1e-3) / (0.5 * 0.4 + 1e-3))
    of_one = events.select((events.x == 0) & (events.y == 0) & (events.t > 0.05))
    soon = np.count_nonzero(((of_one.t * 100) % 1 < 0.1) & of_one.p) / 15
    # one less, for the threshold between the last OFF event and the first ON event
    assert soon == pytest.approx(level / 0.02 - 1, abs=1.1)


def test_lamps_of_regions_are_a_third_of_a_turn_apart(device):
    lamp = Flicker(depth=0.6, shape="rectified", region=2.0)
    one = dase.simulate(
        still(0.5, 0.2, 2), dase.Sensor((Threshold(on=0.02, off=0.02, phase=0.0), lamp)), device=device
    )
    first = one.select((one.x < 2) & (one.y < 2) & (one.t > 0.05))
    for right, below in ((1, 0), (0, 1), (2, 1), (1, 1)):
        there = (one.x // 2 == right) & (one.y // 2 == below) & (one.t > 0.05)
        sums = [np.exp(2j * np.pi * 100 * e.t[e.p]).sum() for e in (first, one.select(there))]
        late = np.angle(sums[0] / sums[1]) / (2 * np.pi)  # a later lamp is ahead in its turn
        assert (late - (right + below) / 3 + 0.5) % 1 - 0.5 == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("depth", [0.1, 0.5])
def test_as_many_events_in_trials_as_when_simulated(device, shape, depth):
    lamp = Flicker(frequency=83.0, depth=depth, shape=shape, duty=0.3)
    sensor = dase.Sensor(
        (lamp, Bandwidth(cutoff=200.0), Threshold(on=0.11, off=0.09), Leak(rate=2.0), Shot(rate=4.0))
    )
    times = np.linspace(0, 0.4, 401)
    y, x = np.mgrid[:16, :20]
    waves = np.exp(-1.0 + 0.5 * np.sin(0.4 * x + 0.3 * y - 40 * times[:, None, None]))
    scene = dase.VideoScene(waves.astype(np.float32), times)
    events = dase.simulate(scene, sensor, seed=3, device=device)
    trials = split_measurement(Measurement(events, scene), pixels=100, seed=1, device=device).train.trials
    stimulus = trials.stimulus
    span = stimulus.grid.begin, stimulus.grid.begin + stimulus.grid.step * (stimulus.grid.steps - 1)
    runs = trials.run(sensor, np.repeat(sensor.parameters()[None], 8, 0), reseed=True)
    own = np.zeros(320, bool)
    own[stimulus.pixels] = True
    mine = own[events.y.astype(int) * 20 + events.x] & (events.t > span[0]) & (events.t <= span[1])
    assert runs.clock.sum() / 8 == pytest.approx(np.count_nonzero(mine), rel=0.03)


def test_one_lamp_is_as_before_and_off_is_off(device):
    scene = still(0.4, 0.1, 60)
    sensor = dase.Sensor((Threshold(), Shot(rate=50.0)))
    plain = dase.simulate(scene, sensor, device=device)
    for shape in SHAPES:
        got = dase.simulate(
            scene, sensor.with_effect(Flicker(depth=0.0, shape=shape, region=3.0)), device=device
        )
        np.testing.assert_array_equal(got.t, plain.t)
    one, wide = (
        dase.simulate(scene, sensor.with_effect(Flicker(region=region)), device=device)
        for region in (np.inf, 1e6)
    )
    np.testing.assert_array_equal(one.t, wide.t)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("step", [1e-3, 4e-3])
@pytest.mark.parametrize("frequency", [97.0, 100.0, 333.0, 1000.0])
def test_extremes_between_samples_are_not_cut_off(device, shape, step, frequency):
    """Two events per period, as light without samples has, where a swing is hardly a threshold."""
    depth, seconds, spare = 0.15, 0.4, 0.03
    low, high = np.log([0.5 * (1 - depth) + 1e-3, 0.5 * (1 + depth) + 1e-3])
    theta = (1 - spare) * (high - low)
    # the memory begins half of what is spare below the brightest: the swing reaches as far beyond both levels
    wave = ((np.exp(high - 0.5 * spare * (high - low)) - 1e-3) / 0.5 - 1) / depth
    sine, rectified = np.arcsin(wave) / (2 * np.pi), np.arcsin((wave + 1) / 2) / np.pi
    phase = {"sine": sine, "rectified": rectified, "pwm": 0.0}[shape]
    lamp = Flicker(depth=depth, frequency=frequency, shape=shape, duty=0.1, phase=phase)
    # two levels have no place between them: there the memory goes down a little with each pair of events
    on = theta * (1 - 1e-5 * (shape == "pwm"))
    sensor = dase.Sensor((Threshold(on=on, off=theta, phase=0.0), lamp))
    scene = still(0.5, seconds, round(seconds / step) + 1)
    got = dase.count(scene, sensor, [0.0, seconds], device=device)[0, 0]
    np.testing.assert_allclose(got, seconds * frequency, atol=1.01)
