"""Events of voltage noise against Rice's formula, at cutoffs and thresholds; writes rice.json beside it.

    python -m perf.experiments.noise.rice

`docs/effects.py` draws the table from it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

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

    Events move a memory by whole thresholds, so a pixel has levels a threshold apart, anywhere beside the
    mean of its voltage: the next ones at a above and at threshold - a below. The memory goes to and fro
    between them, an event each way, and waits on each for the other to be passed: of both together 1 /
    rate(a) + 1 / rate(threshold - a). The mean over pixels is that over a.

    Args:
        corner: -3 dB frequency of the noise, behind two equal poles [Hz].
        ratio: Threshold over the standard deviation of the noise.
    """
    passed = corner / math.sqrt(math.sqrt(2) - 1)  # upwards through the mean: the pole over 2 pi
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


def main() -> None:
    """Write the table."""
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


if __name__ == "__main__":
    main()
