"""Fits of two DAVIS recordings under each rule of the dead time; writes results.json beside it.

    python -m perf.experiments.dead_times.run $DASE_DATA/recordings

The preset of each camera is fitted with its thresholds, the cutoff and the dead time free (`dase.fit`, 600
pixels, three seeds), to all 0.5 s of the cradle and the first second of the shaken camera, so that all takes
about ten minutes of one core. Rules: none (no dead time, which tells what any of them is worth), reset, drop,
delay, and reset with the dead time after OFF events free, too. A seed sets which pixels are looked at, so
errors are to be compared between rules of one seed. The scene is what the camera's own frames tell. Intervals
are of all pixels while the scene lasts, measured and in a simulation of the fitted sensor.
`docs/effects.py` draws the table.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import dase
from dase.effects.refractory import Refractory
from dase.fitting.measurement import Measurement, as_measurement
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import load_sensor
from perf.benchmarks.kernels import commit
from perf.experiments.recordings.run import SOURCES, interval_quantiles
from perf.witness import processor

RESULTS = Path(__file__).with_name("results.json")
LONGEST = {"DAVIS346, cradle": 0.6, "DAVIS240C, shaken": 1.0}
"""Recordings, and what is looked at of them [s]."""
FREE = ("threshold.on", "threshold.off", "bandwidth.cutoff")
DEAD, AFTER_OFF = "refractory.period", "refractory.after_off"
RULES = {
    "none": ("reset", ()),
    "reset": ("reset", (DEAD,)),
    "drop": ("drop", (DEAD,)),
    "delay": ("delay", (DEAD,)),
    "reset, after OFF free": ("reset", (DEAD, AFTER_OFF)),
}
"""Word of the dead time, and what is free of it; without any it is 0."""
SEEDS = (0, 1, 2)
PIXELS = 600


def sensor_by_rule(preset: str, rule: str) -> Sensor:
    """Return a preset with its dead time by a rule."""
    sensor = load_sensor(preset)
    mode, free = RULES[rule]
    dead = sensor["refractory"]
    return sensor.with_effect(replace(dead, mode=mode) if free else replace(dead, mode=mode, period=0.0))


def fit_rule(measured: Measurement, preset: str, rule: str, seed: int) -> dict[str, Any]:
    """Return what a fit under a rule finds, and the intervals that it makes [ms]."""
    begin = time.process_time()
    free = (*FREE, *RULES[rule][1])
    # a fit tries the other rules, too: here each is to be kept
    with patch.object(Refractory, "otherwise", lambda self, beside: []):
        found = dase.fit(measured, sensor_by_rule(preset, rule), free=free, pixels=PIXELS, seed=seed)
    seconds = time.process_time() - begin
    made = dase.simulate(measured.scene, found.sensor, seed=seed)
    values = {name: [e.value, e.low, e.high] for name, e in found.parameters.items()}
    return {
        "rule": rule, "seed": seed, "error": found.error, "before": found.before, "seconds": seconds,
        "values": values, "intervals": interval_quantiles(made),
    }  # fmt: skip


def rounded(value: Any) -> Any:
    """Return numbers with four digits, however deep they lie."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    """Fit all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    found: dict[str, Any] = {"commit": commit(), "processor": processor(), "recordings": {}}
    for name, longest in LONGEST.items():
        source = next(one for one in SOURCES if one.name == name)
        recording = dase.open_recording(options.folder / source.path)
        measured = as_measurement(recording.slice(recording.begin, recording.begin + longest))
        times = measured.scene.sample_times()
        inside = measured.events.slice(float(times[0]), float(times[-1]))
        rows: list[dict[str, Any]] = []
        found["recordings"][name] = {"measured": rounded(interval_quantiles(inside)), "fits": rows}
        for rule in RULES:
            for seed in SEEDS:
                row = rounded(fit_rule(measured, source.preset, rule, seed))
                print(name, row, flush=True)
                rows.append(row)
    RESULTS.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
