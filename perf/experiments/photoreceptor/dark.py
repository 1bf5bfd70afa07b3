"""Events of a photoreceptor with one dark current, fitted with one and with two; writes dark.json beside it.

    python -m perf.experiments.photoreceptor.dark

Truth has a dark current that light and bandwidth share, before a scene that goes from dark to bright. It is
fitted as it is, with a floor of the bandwidth beside the current, and with that floor alone.
`docs/effects.py` draws the table.
"""

from __future__ import annotations

import json
from pathlib import Path

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.dark import Dark
from dase.effects.threshold import Threshold
from perf.experiments.photoreceptor.run import THETA, waves

RESULTS = Path(__file__).with_name("dark.json")
CUTOFF, SPREAD = 60.0, 0.3
"""Of the true sensor: cutoff at intensity 1 [Hz], standard deviation of the logarithm of the current."""
CURRENTS = (0.003, 0.01, 0.04)
"""Its median dark current, as intensity."""
MODELS: dict[str, tuple[dase.Effect, ...]] = {
    "one for both": (Dark(spread=SPREAD),),
    "one of each, to begin with": (Dark(spread=SPREAD, speed="own"),),
    "of the bandwidth alone": (),
}
"""What is fitted: effects beside thresholds and bandwidth."""


def main() -> None:
    """Fit all."""
    scene, rows = waves(), []
    for current in CURRENTS:
        dark = Dark(current=current, spread=SPREAD)
        true = dase.Sensor((dark, Bandwidth(cutoff=CUTOFF), Threshold(on=THETA, off=THETA)))
        events = dase.simulate(scene, true, seed=1)
        for name, more in MODELS.items():
            # none begins at the truth
            model = dase.Sensor((*more, Bandwidth(cutoff=2 * CUTOFF), Threshold(on=0.25, off=0.25)))
            found = dase.fit(events, model, scene=scene, pixels=400)
            row = {
                "true current": current, "model": name, "error": found.error,
                "speed": found.sensor.to_table()["dark"]["speed"] if more else "none",
                **{key: [e.value, e.low, e.high] for key, e in found.parameters.items()},
            }  # fmt: skip
            print(row, flush=True)
            rows.append(json.loads(json.dumps(row), parse_float=lambda text: float(f"{float(text):.4g}")))
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
