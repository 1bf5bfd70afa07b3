"""Events of the photoreceptor's circuit fitted with either law of its poles; writes fits.json beside it.

    python -m perf.experiments.photoreceptor.run

Truth is `second_order` with `poles = "apart"`, whose damping changes with light, before a scene that goes
from dark to bright; `docs/effects.py` draws the table.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import dase
from dase.effects.second_order import SecondOrder
from dase.effects.threshold import Threshold

RESULTS = Path(__file__).with_name("fits.json")
THETA = 0.2
"""Thresholds of the true sensor."""
CUTOFF, DARK = 60.0, 0.01
"""Its natural frequency at intensity 1 [Hz], and its photocurrent at intensity 0."""
DAMPINGS = (0.35, 0.7, 1.5)
"""Its damping at intensity 1."""


def waves(width: int = 64, height: int = 48, samples: int = 600) -> dase.VideoScene:
    """Return waves that drift, 20 times as bright on the right as on the left, at 1 kHz."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    times = np.arange(samples) / 1000
    made = [(rng.uniform(0.1, 0.6), *rng.uniform(0, 6.28, 2), rng.uniform(20, 120)) for _ in range(8)]
    level = np.zeros((samples, height, width))
    for pitch, angle, phase, speed in made:
        across = pitch * (x * np.cos(angle) + y * np.sin(angle)) + phase
        level += 0.35 * np.sin(across + speed * times[:, None, None])
    light = np.clip(np.exp(level - 3.5 + 3 * x / width), 0.002, 1).astype(np.float32)
    return dase.VideoScene(light, times)


def main() -> None:
    """Fit all."""
    scene, rows = waves(), []
    for damping in DAMPINGS:
        slow = SecondOrder(cutoff=CUTOFF, damping=damping, dark=DARK, poles="apart")
        events = dase.simulate(scene, dase.Sensor((slow, Threshold(on=THETA, off=THETA))), seed=1)
        for poles in ("apart", "alike"):
            # neither begins at the truth
            guess = SecondOrder(cutoff=2 * CUTOFF, damping=0.8, dark=DARK, poles=poles)
            model = dase.Sensor((guess, Threshold(on=0.25, off=0.25)))
            found = dase.fit(events, model, scene=scene, pixels=400)
            fitted, threshold = found.sensor["second_order"], found.sensor["threshold"]
            assert isinstance(fitted, SecondOrder)
            assert isinstance(threshold, Threshold)
            row = {
                "damping": damping, "poles": poles, "error": found.error,
                "cutoff": fitted.cutoff, "fitted damping": fitted.damping, "dark": fitted.dark,
                "on": threshold.on, "off": threshold.off,
            }  # fmt: skip
            print(row, flush=True)
            rows.append({k: v if isinstance(v, str) else float(f"{v:.4g}") for k, v in row.items()})
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
