"""What a bus changes in what is compared, by how busy it is, and which buses are tried there.

    python -m perf.experiments.bus_loads.run --key KEY

Scenes of the blind benchmark are seen by a sensor with noise behind buses of each mode, and compared with the
same sensor without a bus: the error says whether anything is to be found. Loads are of the busiest 2 ms.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import dase
from dase.diagnosis.candidates import variants_to_try
from dase.effects import EFFECTS, Readout
from dase.figures.style import format_number
from dase.fitting.data_split import SPLIT, split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.simulation.sensor import Sensor
from perf.experiments.blind_diagnosis.run import number_of
from perf.experiments.blind_diagnosis.scenes import draw_scene

LOADS = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.8, 0.9, 1.0, 1.2)


def most_lines(events: dase.Events, line: np.ndarray) -> float:
    """Return the most changes of a line per second of 2 ms [Hz]."""
    starts = events.t[1:][np.diff(line.astype(np.int64)) != 0]
    return float(np.bincount(((starts - events.t[0]) / SPLIT.burst).astype(int)).max()) / SPLIT.burst


def buses(events: dase.Events) -> Iterator[tuple[float, Readout]]:
    """Yield buses of each mode with the loads that the events would bring them."""
    count = np.bincount(((events.t - events.t[0]) / SPLIT.burst).astype(int)).max() / SPLIT.burst
    for load in LOADS:
        yield load, Readout(rate=count / load, mode="delay")
        yield load, Readout(rate=count / load, mode="drop")
        # half of the time for lines, half for their events
        lines = most_lines(events, events.y)
        yield load, Readout(rate=2 * count / load, line=0.5 * load / lines, mode="rows")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--key", required=True)
    parser.add_argument("--scenes", type=int, default=2)
    options = parser.parse_args()
    sensor = Sensor().with_effect(EFFECTS["shot"](rate=2.0)).with_effect(EFFECTS["mismatch"](spread=0.1))
    print("| scene | mode | load | events lost | error without the bus | gate | that mode is tried |")
    print("|---|---|---|---|---|---|---|")
    for number in range(options.scenes):
        scene = draw_scene(np.random.default_rng([number_of(options.key), number, 1]))
        bare = dase.simulate(scene, sensor, seed=1)
        for load, bus in buses(bare):
            events = dase.simulate(scene, sensor.with_effect(bus), seed=1)
            # files have whole microseconds
            events = replace(events, t=1e-6 * np.rint(1e6 * events.t))
            evidence = split_measurement(Measurement(events, scene), seed=1)
            judged = model_of(sensor, ()).judge(evidence.report, repeats=30, seed=2)
            tried = bus.mode in {one.mode for one in variants_to_try(evidence, Readout)}
            print(
                f"| {number} | {bus.mode} | {load:g} | {100 * (1 - len(events) / len(bare)):.2g} % | "
                f"{format_number(judged.error)} | {judged.gate:.2f} | {'yes' if tried else 'no'} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
