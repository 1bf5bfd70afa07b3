"""Draw docs/exposure.png: frames of an instant and of 20 ms, and events in step with the exposures.

python docs/exposure.py [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from dase import io
from dase.datasets import generate
from dase.effects.exposure import Exposure
from dase.effects.threshold import Threshold
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import dump_sensor

RATE, LENGTH = 20.0, 0.02


def main(out: Path) -> None:
    """Draw the picture into `out`."""
    sensor = Sensor((Threshold(), Exposure(amplitude=0.15)))
    found = []
    with TemporaryDirectory() as folder:
        for exposure in (0.0, LENGTH):
            job = generate.DatasetJob(
                images="builtin", sensor=dump_sensor(sensor), sequences=1, width=160, height=120,
                duration=0.3, regime="fast", seed=3, frame_rate=RATE, exposure=exposure,
            )  # fmt: skip
            generate.generate_dataset(job, Path(folder) / str(exposure))
            found.append(io.read(job.path(Path(folder) / str(exposure), 0)))
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 2.7), width_ratios=(1, 1, 1.6))
    instant, blurred = found
    for axes, one, title in ((left, instant, "an instant"), (middle, blurred, "20 ms")):
        axes.imshow(one.frames[3], cmap="gray", vmin=0, vmax=255)
        axes.set(title=title, xticks=[], yticks=[])
    edges = np.arange(0, 0.3001, 1e-3)
    for begin in blurred.frame_times - blurred.frame_exposure / 2:
        right.axvspan(1e3 * begin, 1e3 * (begin + LENGTH), color="0.9")
    for polarity, name, colour in ((True, "ON", "#c0392b"), (False, "OFF", "#2c6fbb")):
        counts = np.histogram(blurred.events.t[blurred.events.p == polarity], edges)[0]
        right.plot(1e3 * edges[:-1], counts, color=colour, label=name, linewidth=1)
    right.set(xlabel="time [ms]", ylabel="events per ms", title="bursts in step with the exposures")
    right.legend(loc="upper right")
    figure.tight_layout()
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "exposure.png")
