"""What a fit simulates is what `dase.simulate` does, however fast the pixels' voltage changes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.flicker import Flicker
from dase.effects.leak import Leak
from dase.effects.readout import Readout
from dase.effects.refractory import Refractory
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from dase.fitting.batch_simulator import LAUNCHES, BatchSimulator, SimulationOrder
from dase.fitting.descent import descent_work, ranking_work
from dase.fitting.parameter_space import ParameterSpace, axes_of
from dase.fitting.trial_kernels import KernelChoice, KernelSettings
from dase.fitting.trial_sampling import samples_of_screening, samples_per_step, samples_per_step_of_rows
from dase.kernels import launch
from dase.probes.stimulus import STIMULUS, Grid, Stimulus, sort_into_cells

STEP, SIZE, SECONDS = 1e-3, (20, 16), 0.3


@pytest.fixture(scope="module")
def trials(device):
    """A simulator of trials whose pixels are all of a sensor's, some of which see light that changes."""
    pixels, steps = SIZE[0] * SIZE[1], round(SECONDS / STEP) + 1
    wave = 0.2 * np.sin(2 * np.pi * STEP * np.arange(steps))
    light = (0.1 * np.exp(wave * (np.arange(pixels) % 2)[:, None])).astype(np.float32)
    cell = sort_into_cells(light, STEP, np.array([0.05, 0.2, 0.5]), 1e-3)
    numbers = np.arange(pixels, dtype=np.int32)
    grid = Grid(0.0, STEP, steps)
    return BatchSimulator(Stimulus(numbers, *SIZE, grid, light, cell, 1e-3, launch.find_device(device)))


@pytest.fixture(scope="module")
def scene(trials):
    """The same light as a video."""
    light = trials.stimulus.intensity.T.reshape(-1, SIZE[1], SIZE[0])
    return dase.VideoScene(light, trials.stimulus.grid.times)


def sensor_with(*effects):
    return dase.Sensor((Threshold(on=0.2, off=0.2), *effects))


SPEEDS = ((0.4, 10.0), (0.17, 120.0), (0.12, 700.0), (0.1, 3000.0))
NOISES = [VoltageNoise(sigma=sigma, cutoff=cutoff) for sigma, cutoff in SPEEDS]
DEPTHS = ((0.9, 50.0), (0.3, 100.0), (0.25, 333.0), (0.5, 1000.0))
LAMPS = [Flicker(depth=depth, frequency=frequency) for depth, frequency in DEPTHS]
# a dip between two samples, and pulses between them
LAMPS += [
    Flicker(depth=0.15, frequency=333.0, shape="rectified"),
    Flicker(depth=0.4, frequency=1000.0, shape="pwm", duty=0.05),
]


# pulses whose length counts, not their height alone
SMOOTHED = (Flicker(depth=0.6, frequency=1000.0, shape="pwm", duty=0.05), Bandwidth(cutoff=1000.0, dark=1.0))


@pytest.mark.parametrize(
    "effects", [*((one,) for one in NOISES + LAMPS), SMOOTHED], ids=lambda effects: effects[0].name
)
def test_a_trial_sends_as_many_events_as_a_simulation(trials, scene, device, effects):
    sensor = sensor_with(*effects)
    got = trials.run(sensor, sensor.parameters()[None], seed=3).halves.sum()
    stored = trials.stream(sensor, sensor.parameters(), (), seed=3).halves.sum()
    want = len(dase.simulate(scene, sensor, seed=3, device=device))
    assert want > 500
    # samples stand elsewhere where a step is not cut into the same number, and noise has other numbers then
    assert got == pytest.approx(want, rel=0.03, abs=3 * np.sqrt(2 * want))
    assert stored == pytest.approx(got, rel=2e-3)


def test_a_trial_fills_a_bus_as_a_simulation_does(trials, scene, device):
    lamp, bus = Flicker(frequency=400.0, depth=0.5), Readout(rate=2e5, depth=64)
    sensor = sensor_with(lamp, bus)
    got = trials.stream(sensor, sensor.parameters(), sensor.readout_effects(), seed=3).halves.sum()
    want = len(dase.simulate(scene, sensor, seed=3, device=device))
    free = len(dase.simulate(scene, sensor_with(lamp), seed=3, device=device))
    assert want < 0.8 * free
    assert got == pytest.approx(want, rel=0.03)


def test_models_are_sampled_as_each_of_them_needs(trials):
    sensor = sensor_with(VoltageNoise())
    vectors = np.repeat(sensor.parameters()[None], 4, 0)
    at = sensor.parameter_names().index("voltage_noise.cutoff")
    vectors[:, at] = 3000.0, 20.0, 400.0, 1000.0
    assert samples_per_step_of_rows(sensor, vectors, STEP).tolist() == [24, 1, 4, 8]
    assert samples_per_step(sensor, STEP) == 2
    together = trials.run(sensor, vectors, seed=5)
    for n in range(4):
        alone = trials.run(sensor, vectors[n : n + 1], seed=5)
        np.testing.assert_array_equal(together.sums[n], alone.sums[0])
        np.testing.assert_array_equal(together.halves[n], alone.halves[0])
        np.testing.assert_array_equal(together.clock[n], alone.clock[0])
    # repeats of a model all take the same samples, each with random numbers of its own
    repeats = SimulationOrder(sensor, vectors, 5, reseed=True)
    assert repeats.samples_per_step(STEP).tolist() == [24] * 4


def test_the_coarsest_steps_of_a_fit_are_cut_as_finely_as_others():
    """A trial is the simulation in time, however long the steps of its grid are."""
    fast, faster = sensor_with(VoltageNoise(cutoff=3000.0)), sensor_with(VoltageNoise(cutoff=2e4))
    for step in (STIMULUS.common_step, STIMULUS.coarsest_step):
        assert step / samples_per_step(fast, step) <= fast.longest_step() * (1 + 1e-9)
        # noise that nothing is known to have does not make all fits slow
        assert samples_per_step(faster, step) == samples_per_step(fast, step)
    node = sensor_with(VoltageNoise(cutoff=3000.0, knee=0.1, poles="apart"))
    step = STIMULUS.coarsest_step
    assert step / samples_per_step(node, step) <= node.longest_step()
    # shorter steps are cut into as many at most, however fine that is
    assert samples_per_step(faster, 5e-4) == samples_per_step(faster, STIMULUS.common_step)


def test_screening_samples_no_finer_than_it_has_to(trials):
    fast = VoltageNoise(cutoff=3000.0)
    sensor = sensor_with(fast)
    needed = SimulationOrder(sensor, sensor.parameters()[None]).samples_per_step(STEP)
    coarse = samples_of_screening(sensor_with(), STEP)
    assert coarse < needed[0]
    vector = sensor.parameters()[None]
    got = trials.run_all([SimulationOrder(sensor, vector, 5, most=coarse)])[0]
    want = trials.run(sensor, vector, seed=5, finer=coarse)
    np.testing.assert_array_equal(got.halves, want.halves)
    # beside a present model that is sampled finely, candidates that are not would lack its events
    assert samples_of_screening(sensor, STEP) == needed[0]


def test_a_search_asks_for_no_more_samples_than_it_was_told(trials):
    space = ParameterSpace(sensor_with(NOISES[0]), axes_of(sensor_with(NOISES[0]), ["voltage_noise.sigma"]))
    half = SimpleNamespace(frame=SimpleNamespace(step=STEP), scale=SimpleNamespace(target=np.zeros(3)))
    works = [descent_work(half, space, np.zeros(1), seed=0, most=n) for n in (3, 24)]
    works += [ranking_work(half, space, np.zeros((2, 1)), seed=0, most=3)]
    assert [next(work)[0].most for work in works] == [3, 24, 3]


def test_a_kernel_of_its_own_gives_the_same_bits(trials):
    """A sensor that many models of were simulated gets one, and leaves the one that has all effects."""
    if trials.device.is_cuda:
        pytest.skip("on a GPU all candidates share a kernel")
    sensor = sensor_with(Leak(rate=2.0), Refractory(period=4e-3))
    vectors = np.repeat(sensor.parameters()[None], 3, 0)
    once = 3.0 * trials.stimulus.grid.steps * len(trials.stimulus.pixels)
    settings = replace(LAUNCHES["cpu"], kernels=KernelSettings(effects=1, ask=np.inf, compile=once))
    few = BatchSimulator(trials.stimulus, settings=settings, choice=KernelChoice())
    first, second = (few.run(sensor, vectors, seed=5) for _ in range(2))
    assert len(few._kernels) == 2
    assert first.halves.sum() > 300
    np.testing.assert_array_equal(second.halves, first.halves)
    np.testing.assert_array_equal(second.sums, first.sums)


def test_parts_of_a_measurement_share_what_is_known_of_kernels(trials):
    """A kernel that was compiled before is taken once it is asked for, by all simulators of a process."""
    if trials.device.is_cuda:
        pytest.skip("on a GPU all candidates share a kernel")
    sensor = sensor_with(Leak(rate=2.0), Refractory(period=4e-3))
    vectors = np.repeat(sensor.parameters()[None], 3, 0)
    compile_text = KernelSettings(effects=len(sensor.stages()), ask=0, compile=np.inf)
    own = BatchSimulator(trials.stimulus, settings=replace(LAUNCHES["cpu"], kernels=compile_text))
    own.run(sensor, vectors, seed=5)  # compiles it
    choice, ask = KernelChoice(), replace(LAUNCHES["cpu"], kernels=KernelSettings(1, 1.0, np.inf))
    first, second = (BatchSimulator(trials.stimulus, settings=ask, choice=choice) for _ in range(2))
    for simulator in (first, second):
        simulator.run(sensor, vectors, seed=5)
    assert [shared for _, shared in (*first._kernels, *second._kernels)] == [True, False]


def test_what_no_process_has_compiled_is_not_compiled_to_find_out(trials, tmp_path, monkeypatch):
    if trials.device.is_cuda:
        pytest.skip("on a GPU all candidates share a kernel")
    sensor = sensor_with(Leak(rate=2.0), Refractory(period=4e-3))
    vectors = np.repeat(sensor.parameters()[None], 3, 0)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    ask = replace(LAUNCHES["cpu"], kernels=KernelSettings(1, 1.0, np.inf))
    simulator = BatchSimulator(trials.stimulus, settings=ask, choice=KernelChoice())
    for _ in range(2):
        simulator.run(sensor, vectors, seed=5)
    assert [shared for _, shared in simulator._kernels] == [True]


def test_models_whose_effects_differ_by_words_do_not_share_a_kernel(trials):
    """Side by side they are what each of them is alone, though few models fill no lanes."""
    sensors = [sensor_with(Leak(rate=9.0), Refractory(period=0.03, mode=mode)) for mode in ("reset", "drop")]
    orders = [SimulationOrder(one, one.parameters()[None], 5) for one in (*sensors, sensor_with(Leak()))]
    together = trials.run_all(orders)
    for order, sums in zip(orders, together, strict=True):
        alone = trials.run(order.sensor, order.vectors, seed=5)
        np.testing.assert_array_equal(sums.sums, alone.sums)
    assert together[0].halves.sum() != together[1].halves.sum()


def test_a_population_has_the_samples_of_its_middle(trials):
    """However fast the noise of each is: random numbers are in common, and no launch is split."""
    sensor = sensor_with(VoltageNoise(sigma=0.1, cutoff=700.0))
    space = ParameterSpace(sensor, axes_of(sensor, ["voltage_noise.cutoff"]))
    start = space.places()
    half = SimpleNamespace(frame=SimpleNamespace(step=STEP), scale=SimpleNamespace(target=np.zeros(3)))
    (ask,) = next(descent_work(half, space, start, seed=1, radius=0.8))
    needed = samples_per_step_of_rows(sensor, space.vectors(ask.places), STEP)
    assert len(set(needed.tolist())) > 1
    assert ask.finer == samples_per_step(sensor, STEP)
    (ask,) = next(descent_work(half, space, start, seed=1, most=4))
    assert ask.finer == 4
