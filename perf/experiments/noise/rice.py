"""Events of voltage noise against Rice's formula, at cutoffs and thresholds; writes rice.json beside it.

    python -m perf.experiments.noise.rice
    python -m perf.experiments.noise.rice --poles apart    noise of two poles against small steps: apart.json

`docs/effects.py` draws the tables from them.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

import dase
from dase.effects.refractory import Refractory
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise

CUTOFFS = (10.0, 50.0, 200.0, 1000.0, 3000.0)
"""Corner frequencies in bright light [Hz]: the plausible range."""

DEAD_TIMES = (0.01, 0.1, 1.0)
"""After which the memory is the noise of that moment [periods of the corner]."""


def rice_rate(corner: float, ratio: float) -> float:
    """Return the events per second and pixel that Rice's formula tells, of both polarities together.

    Of noise of two equal poles; see `rice_events` for the levels that are passed.

    Args:
        corner: -3 dB frequency of the noise, behind two equal poles [Hz].
        ratio: Threshold over the standard deviation of the noise.
    """
    return rice_events(corner / math.sqrt(math.sqrt(2) - 1), ratio)  # the pole over 2 pi


def rice_events(passed: float, ratio: float) -> float:
    """Return the events per second and pixel of noise that passes its mean so many times upwards.

    Events move a memory by whole thresholds, so a pixel has levels a threshold apart, anywhere beside the
    mean of its voltage: the next ones at a above and at threshold - a below. The memory goes to and fro
    between them, an event each way, and waits on each for the other to be passed: of both together 1 /
    rate(a) + 1 / rate(threshold - a). The mean over pixels is that over a.

    Args:
        passed: Times per second that the noise passes its mean upwards [Hz].
        ratio: Threshold over the standard deviation of the noise.
    """
    above = (np.arange(2000) + 0.5) / 2000 * ratio
    waits = np.exp(0.5 * above**2) + np.exp(0.5 * (ratio - above) ** 2)
    return float(passed * np.mean(2 / waits))


def simulated_rate(
    cutoff: float,
    ratio: float,
    *,
    pixels: int = 5000,
    periods: float = 150.0,
    dead: float = 0.0,
    device: str = "cpu",
    seed: int = 0,
) -> tuple[float, float]:
    """Return the events per second and pixel that `dase.count` has, and their standard error.

    Args:
        cutoff: Of the bias [Hz]; at the knee, where the light is, the corner is half of it.
        ratio: Threshold over the standard deviation of the noise.
        pixels: How many.
        periods: Of the corner that are counted, after as many in which memories find their places.
        dead: Dead time after which the memory is the noise of that moment, in periods of the corner.
        device: Where kernels run.
        seed: Of the noise.
    """
    corner, knee, sigma = cutoff / 2, 0.1, 0.1
    noise = VoltageNoise(sigma=sigma, cutoff=cutoff, knee=knee, dark=1e-6)
    theta = ratio * sigma * math.sqrt(0.5)
    sensor = dase.Sensor((Threshold(on=theta, off=theta), noise))
    if dead:
        sensor = sensor.with_effect(Refractory(period=dead / corner, mode="reset"))
    times = np.array([0.0, 2 * periods / corner])
    scene = dase.VideoScene(np.full((2, 1, pixels), knee, np.float32), times)
    counts = dase.count(scene, sensor, times.mean() * np.arange(1, 3), seed=seed, device=device)[0, 0]
    rates = counts.sum(0) * corner / periods
    return float(rates.mean()), float(rates.std() / math.sqrt(pixels))


POLES = ((0.1, 0.0), (1.0, 0.0), (10.0, 0.0), (30.0, 0.0), (100.0, 0.0), (0.02, 50.0), (0.2, 50.0))
"""Poles of the node in units of the fixed one, from light of a tenth of the knee to a hundred times it, and
gains of the loop around both: dampings of 1 to 5, and of 0.50 and 0.19."""

LEVELS = (1.0, 2.0, 3.0)
"""Thresholds in standard deviations of the voltage."""

LIGHT, DARK, FIXED = 0.9, 0.003, 10.0
"""Where noise of two poles is looked at: intensity, dark current as intensity, fixed pole [Hz]."""


def fine_rates(
    ratio: float,
    rng: np.random.Generator,
    *,
    gain: float = 0.0,
    pixels: int = 5000,
    periods: float = 40.0,
    before: float = 20.0,
    step: float = 0.05,
) -> NDArray[np.float64]:
    """Return events per period of the fixed pole, of a photoreceptor's noise in small steps.

    A node behind which there is a fixed pole, or which drives an amplifier that drives it back.

    The process is exact at any step; this is NumPy alone and shares nothing with the effect.

    Args:
        ratio: Pole of the node in units of the fixed one.
        rng: Draws the noise and where the memories begin.
        gain: Of the amplifier.
        pixels: How many, each with a memory for each of `LEVELS`.
        periods: That are counted.
        before: Periods not counted, in which memories find their places.
        step: Time constants of the faster pole in a step.

    Returns:
        Means over pixels and their standard errors, shape (2, levels).
    """
    dt = step / (2 * math.pi * max(ratio, 1.0, math.sqrt((1 + gain) * ratio)))
    node, output = ([-ratio, ratio], [-gain, -1.0]) if gain else ([-ratio, 0.0], [1.0, -1.0])
    drift = 2 * math.pi * np.array([node, output])
    kept = expm(drift * dt)
    stationary = solve_continuous_lyapunov(drift, -np.diag([1.0, 0.0]))
    root = np.linalg.cholesky(stationary - kept @ stationary @ kept.T).astype(np.float32)
    state = (np.linalg.cholesky(stationary) @ rng.standard_normal((2, pixels))).astype(np.float32)
    theta = (np.array(LEVELS) * math.sqrt(stationary[1, 1])).astype(np.float32)[:, None]
    memory = state[1] + theta * rng.uniform(-1, 1, (len(LEVELS), pixels)).astype(np.float32)
    events = np.zeros((len(LEVELS), pixels))
    kept = kept.astype(np.float32)
    for n in range(-round(before / dt), round(periods / dt)):
        state = kept @ state + root @ rng.standard_normal((2, pixels), dtype=np.float32)
        moved = np.trunc((state[1] - memory) / theta)
        memory += moved * theta
        if n >= 0:
            events += np.abs(moved)
    return np.stack([events.mean(1), events.std(1) / math.sqrt(pixels)]) / periods


def noise_of_poles(ratio: float, gain: float, cutoff: float = FIXED) -> VoltageNoise:
    """Return noise whose node has so many times the fixed pole at `LIGHT`."""
    knee = (LIGHT + DARK) / ratio
    return VoltageNoise(sigma=1.0, cutoff=cutoff, knee=knee, dark=DARK, gain=gain, poles="apart")


def apart_rate(
    ratio: float,
    level: float,
    *,
    gain: float = 0.0,
    cutoff: float = FIXED,
    pixels: int = 5000,
    periods: float = 40.0,
    before: float = 20.0,
    device: str = "cpu",
    seed: int = 0,
) -> tuple[float, float]:
    """Return the events per period of the fixed pole that `dase.count` has, and their standard error.

    Args:
        ratio: Pole of the node in units of the fixed one.
        level: Threshold over the standard deviation of the voltage.
        gain: Of the loop around both poles.
        cutoff: The fixed pole [Hz].
        pixels: How many.
        periods: That are counted.
        before: Periods not counted, in which memories find their places.
        device: Where kernels run.
        seed: Of the noise.
    """
    noise = noise_of_poles(ratio, gain, cutoff)
    theta = level * noise.sigma / math.sqrt(1 + ratio)
    sensor = dase.Sensor((Threshold(on=theta, off=theta), noise))
    edges = np.array([before, before + periods]) / cutoff
    scene = dase.VideoScene(np.full((2, 1, pixels), LIGHT, np.float32), np.array([0.0, edges[1]]))
    counts = dase.count(scene, sensor, edges, seed=seed, device=device)[0, 0].sum(0) / periods
    return float(counts.mean()), float(counts.std() / math.sqrt(pixels))


def compare_poles() -> None:
    """Write what noise of two poles sends, in small steps of its own and in the samples of `dase.count`."""
    rows, rng = [], np.random.default_rng(0)
    apart_rate(1.0, 1.0, pixels=10, periods=1.0)  # compiles
    for ratio, gain in POLES:
        fine, errors = fine_rates(ratio, rng, gain=gain)
        for level, want, error in zip(LEVELS, fine, errors, strict=True):
            begin = time.process_time()
            rate, spread = apart_rate(ratio, level, gain=gain)
            spent = time.process_time() - begin
            row = {
                "ratio": ratio, "gain": gain, "level": level, "rate": rate, "fine": want,
                "error": rate / want * math.hypot(spread / rate, error / want),
                "rice": rice_events(math.sqrt((1 + gain) * ratio), level),
                "samples": 1 / (FIXED * noise_of_poles(ratio, gain).longest_step()),
                "seconds": spent,
            }  # fmt: skip
            print(
                f"{ratio:g}, {gain:g}, {level:g} sigma: {rate / want:.3f} of {want:.4g}, {spent:.1f} s",
                flush=True,
            )
            rows.append({name: float(f"{value:.4g}") for name, value in row.items()})
    Path(__file__).with_name("apart.json").write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


def compare_cutoffs() -> None:
    """Write what noise of two equal poles sends, and what Rice's formula tells."""
    rows = []
    for ratio in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        # cutoffs without a dead time, then dead times at one of them
        cases = [(cutoff, 0.0) for cutoff in CUTOFFS] + [(CUTOFFS[2], dead) for dead in DEAD_TIMES]
        for cutoff, dead in cases:
            rate, error = simulated_rate(cutoff, ratio, pixels=16000, dead=dead)
            rice = rice_rate(cutoff / 2, ratio)
            print(
                f"{ratio:g} sigma, {cutoff:g} Hz, {dead:g}: {rate / rice:.3f} +- {error / rice:.3f}",
                flush=True,
            )
            row = {"ratio": ratio, "cutoff": cutoff, "dead": dead, "rate": rate, "error": error, "rice": rice}
            rows.append({name: float(f"{value:.5g}") for name, value in row.items()})
    Path(__file__).with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


def main() -> None:
    """Write one of the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--poles", choices=["alike", "apart"], default="alike")
    compare_poles() if parser.parse_args().poles == "apart" else compare_cutoffs()


if __name__ == "__main__":
    main()
