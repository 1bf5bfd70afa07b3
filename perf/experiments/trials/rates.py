"""Event rates in the trials of a fit against those of `dase.simulate`; writes rates.json beside it.

    python -m perf.experiments.trials.rates
    python -m perf.experiments.trials.rates --only flicker

Voltage noise, flicker and readout, over what is plausible for each. `docs/effects.py` draws the table.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.flicker import Flicker
from dase.effects.readout import Readout
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from dase.fitting.batch_simulator import BatchSimulator, SimulationOrder
from dase.fitting.compared_time import common_grid
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.kernels import launch
from dase.probes.stimulus import Grid, Stimulus, sort_into_cells
from perf.benchmarks.compare_commits import commit_of, device_name

WIDTH, HEIGHT = 40, 30

STEPS = (1e-3, 2e-3, 4e-3)
"""Between frames [s]: clips at 1 kHz, at the least that a fit takes as they are, and at 250 frames per
second, whose time it cuts finer."""

THRESHOLD = Threshold(on=0.2, off=0.2, phase=1.0)
"""Where a pixel begins between two levels is by chance, so that rates are smooth in all parameters."""

SIGMAS = (0.05, 0.1, 0.2)
CUTOFFS = (10.0, 50.0, 200.0, 1000.0, 3000.0)
KNEES = (0.01, 0.1, 1.0)
"""Pixels see light of 0.01 to 1."""
NODE_KNEES = (0.1, 1.0)
"""Where the node's pole is ten times as fast as the fixed one in the brightest light, and as fast; at 0.01 a
model takes minutes."""
DEPTHS = (0.15, 0.3, 0.6, 0.9)
LAMPS = (
    Flicker(shape="sine"),
    Flicker(shape="rectified"),
    Flicker(shape="pwm", duty=0.5),
    Flicker(shape="pwm", duty=0.05),
)
FREQUENCIES = (50.0, 100.0, 333.0, 1000.0)
FULLNESS = (0.3, 0.7, 1.0, 1.5, 3.0)
"""Mean rate of what pixels send to what the bus can: below 1 it is full in bursts only."""

ACCURATE = 0.006
"""Error of a ratio at which no more repeats are run: a fifth of the 3 % that are asked about."""


@dataclass(frozen=True)
class Row:
    """A model, and the ratio of its rates.

    Args:
        effect: Its name.
        case: Its parameters, in words.
        events: Simulated, in all repeats.
        ratio: Rate in trials to that in `dase.simulate`.
        error: Standard error of the ratio, over repeats.
    """

    effect: str
    case: str
    events: int
    ratio: float
    error: float


def compare(effect: str, case: str, pair: Callable[[int], tuple[float, float]], most: int = 24) -> Row:
    """Return the ratio of two counts of events.

    Args:
        effect: Name in the row.
        case: Parameters in words.
        pair: Gives the events of a trial and of a simulation for a seed. With one seed both draw the same
            numbers where they sample alike, so errors are those of their difference.
        most: Repeats at most.
    """
    counts: list[tuple[float, float]] = []
    while True:
        counts.append(pair(100 * len(counts) + 7))
        got, want = np.array(counts).T
        ratio = float(got.sum() / max(want.sum(), 1))
        apart = got - ratio * want
        error = float(apart.std(ddof=1) * np.sqrt(len(counts)) / max(want.sum(), 1)) if len(counts) > 1 else 1
        if len(counts) >= most or (len(counts) >= 4 and error < ACCURATE):
            row = Row(effect, case, int(want.sum()), float(f"{ratio:.4f}"), float(f"{error:.2g}"))
            print(f"{effect}, {case}: {ratio:.3f} +- {error:.3f}, {row.events} events", flush=True)
            return row


def pixel_rates(
    effect: VoltageNoise | Flicker, step: float, seconds: float, device: str, cutoff: float = np.inf
) -> Row:
    """Return how often pixels at rest send in trials, against a simulation.

    Args:
        effect: What makes them send.
        step: Between frames [s].
        seconds: Length.
        device: Where kernels run.
        cutoff: Of a photoreceptor [Hz] that smooths it; infinite for none.
    """
    pixels = WIDTH * HEIGHT
    levels = np.geomspace(0.01, 1, pixels).astype(np.float32)
    times = np.arange(round(seconds / step) + 1, dtype=np.float64) * step
    scene = dase.VideoScene(np.tile(levels.reshape(HEIGHT, WIDTH), (len(times), 1, 1)), times)
    first = np.zeros(1, np.uint16)
    last = dase.Events(times[-1:], first, first, np.ones(1, np.bool_), WIDTH, HEIGHT)
    grid = common_grid(last, scene)
    light = np.repeat(levels[:, None], grid.steps, 1)
    cell = sort_into_cells(light, grid.step, np.array([0.05, 0.2, 0.5]), 1e-3)
    numbers = np.arange(pixels, dtype=np.int32)
    trials = BatchSimulator(
        Stimulus(numbers, WIDTH, HEIGHT, grid, light, cell, 1e-3, launch.find_device(device))
    )
    sensor = dase.Sensor((THRESHOLD, effect))
    if np.isfinite(cutoff):
        sensor = sensor.with_effect(Bandwidth(cutoff=cutoff, dark=1.0))

    def pair(seed: int) -> tuple[float, float]:
        got = trials.run(sensor, sensor.parameters()[None], seed=seed).halves.sum()
        return float(got), float(len(dase.simulate(scene, sensor, seed=seed, device=device)))

    if isinstance(effect, Flicker):
        duty = f" of duty {effect.duty:g}" if effect.shape == "pwm" else ""
        said = f"{effect.shape}{duty}, depth {effect.depth:g}, {effect.frequency:g} Hz"
    else:
        said = f"sigma {effect.sigma:g}, cutoff {effect.cutoff:g} Hz, knee {effect.knee:g}"
    said += f", smoothed at {cutoff:g} Hz" if np.isfinite(cutoff) else ""
    return compare(effect.name, f"{said}, step {1e3 * step:g} ms", pair)


def lamp() -> dase.VideoScene:
    """Return light that makes all pixels send at once, and few in between."""
    times = np.arange(301) / 1000
    light = 0.2 * np.exp(0.9 * np.sin(20 * np.pi * times))
    across = 0.5 + np.arange(WIDTH) / WIDTH
    frames = np.tile(light[:, None, None] * across, (1, HEIGHT, 1))
    return dase.VideoScene(frames.astype(np.float32), times)


def disc() -> dase.VideoScene:
    """Return a small disc that runs to and fro: few pixels send at a time."""
    times = np.arange(301) / 1000
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    along = 0.5 * WIDTH + 0.4 * WIDTH * np.sin(14 * np.pi * times)
    up = 0.5 * HEIGHT + 0.3 * HEIGHT * np.sin(6 * np.pi * times)
    away = np.hypot(x - along[:, None, None], y - up[:, None, None])
    return dase.VideoScene((0.05 + 0.9 / (1 + np.exp(2 * (away - 6)))).astype(np.float32), times)


SCENES = {"lamp": lamp, "disc": disc}


def readout_rate(scene_name: str, mode: str, fullness: float, shares: int, device: str) -> Row:
    """Return what some pixels send over a bus that they share, in trials against a simulation of all pixels.

    Args:
        scene_name: Of `SCENES`.
        mode: Of the readout.
        fullness: Rate of the bus, see `FULLNESS`.
        shares: Pixels that each of the other ones that are simulated stands for.
        device: Where kernels run.
    """
    scene = SCENES[scene_name]()
    free = dase.Sensor((THRESHOLD, Shot(rate=5.0)))
    rate = len(dase.simulate(scene, free, seed=4, device=device)) / scene.duration / fullness
    true = free.with_effect(Readout(rate=rate, mode=mode, depth=300.0))
    found = dase.simulate(scene, true, seed=4, device=device)
    half = split_measurement(Measurement(found, scene), pixels=300, seed=1, device=device).train
    grid, looked_at = half.trials.stimulus.grid, half.trials.stimulus.pixels
    if shares > 1 and half.around is not None:
        others = (WIDTH * HEIGHT - 300) / shares
        around = replace(half.around, most_samples=(300 + others) * grid.steps, _loads=[])
        half = replace(half, around=around)
    model = model_of(true)
    load = half.loaded(model.space, model.place).load

    def pair(seed: int) -> tuple[float, float]:
        order = SimulationOrder(true, true.parameters()[None], seed)
        got = half.trials.simulate_streams(order, [true.readout_effects()], load).clock.sum()
        events = dase.simulate(scene, true, seed=seed + 1, device=device)
        return float(got), float(np.count_nonzero(_compared(events, looked_at, grid)))

    said = f"{mode}, fullness {fullness:g}, {scene_name}, others stand for {shares:g}"
    return compare("readout", said, pair)


def _compared(events: dase.Events, pixels: NDArray[np.int32], grid: Grid) -> NDArray[np.bool_]:
    """Return which events are of some pixels, within the time that trials have."""
    mine = np.isin(events.y.astype(int) * WIDTH + events.x, pixels)
    return np.asarray(mine & (events.t >= grid.begin) & (events.t <= grid.times[-1]))


def noise_rows(device: str) -> Iterator[Row]:
    """Compare voltage noise, for as many periods of the cutoff at any of them."""
    for sigma, cutoff, knee, step in itertools.product(SIGMAS, CUTOFFS, KNEES, STEPS):
        seconds = float(np.clip(60 / cutoff, 0.3, 6.0))
        yield pixel_rates(VoltageNoise(sigma=sigma, cutoff=cutoff, knee=knee), step, seconds, device)


def two_pole_noise_rows(device: str) -> Iterator[Row]:
    """Compare noise whose one pole follows the light, likewise."""
    for cutoff, knee, step in itertools.product(CUTOFFS[1::2] + CUTOFFS[-1:], NODE_KNEES, STEPS):
        noise = VoltageNoise(sigma=SIGMAS[-1], cutoff=cutoff, knee=knee, poles="apart")
        yield pixel_rates(noise, step, float(np.clip(60 / cutoff, 0.06, 6.0)), device)


def flicker_rows(device: str) -> Iterator[Row]:
    """Compare lamps, by themselves and behind a photoreceptor whose cutoff is their frequency."""
    for waveform, depth, frequency, step, cutoffs in itertools.product(
        LAMPS, DEPTHS, FREQUENCIES, STEPS, (np.inf, 1.0)
    ):
        lamp = replace(waveform, depth=depth, frequency=frequency)
        yield pixel_rates(lamp, step, 0.3, device, cutoffs * frequency)


def readout_rows(device: str) -> Iterator[Row]:
    """Compare buses."""
    for scene, mode, fullness, shares in itertools.product(
        SCENES, ("delay", "drop", "rows", "columns"), FULLNESS, (1, 3)
    ):
        yield readout_rate(scene, mode, fullness, shares, device)


TABLES = {
    "voltage_noise": noise_rows,
    "two_pole_noise": two_pole_noise_rows,
    "flicker": flicker_rows,
    "readout": readout_rows,
}


def main() -> None:
    """Write the table; of an effect that is not asked for, the rows there were are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    options = parser.parse_args()
    path = Path(__file__).with_suffix(".json")
    table = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    for name in options.only:
        rows = [asdict(row) for row in TABLES[name](options.device)]
        table[name] = {
            "commit": commit_of(Path(__file__).parents[3]),
            "device": device_name(options.device),
            "rows": [{k: v for k, v in row.items() if k != "effect"} for row in rows],
        }
        path.write_text(json.dumps(table, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
