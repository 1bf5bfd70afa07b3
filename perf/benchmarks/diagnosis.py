"""What a diagnosis costs, by candidates and by pixels; writes the table into docs/diagnosis.md.

    python -m perf.benchmarks.diagnosis [--device cuda:0]

One hidden effect, a scene of 1 s at 1 kHz, one effect added. Each model runs twice: the first time compiles.
On a CPU the processor time of all threads is given, which other work on the machine hardly changes.
"""

from __future__ import annotations

import argparse
import re
import time
from pathlib import Path

import numpy as np

import dase
from dase.diagnosis.diagnose import diagnose
from dase.effects import EFFECTS
from dase.simulation.sensor import Sensor
from perf.experiments.blind_diagnosis.scenes import scene_of

CANDIDATES = ("leak", "shot", "mismatch", "jitter", "bandwidth", "linlog", "refractory", "latency")
"""Of about the same cost; half of them, then all."""

PIXELS = (500, 1000, 2000)


def seconds(events: dase.Events, names: tuple[str, ...], pixels: int, device: str) -> tuple[float, int]:
    """Return the time of a diagnosis [s] and the simulations it ran."""
    library = {name: EFFECTS[name] for name in ("threshold", *names)}
    clock = time.process_time if device == "cpu" else time.perf_counter
    for _ in range(2):
        begin = clock()
        found = diagnose(events, scene=scene_of(0), effects=library, most=1, pixels=pixels, device=device)
        spent = clock() - begin
    return spent, found.evaluations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--page", type=Path, default=Path("docs/diagnosis.md"))
    options = parser.parse_args()
    sensor = Sensor().with_effect(EFFECTS["leak"](rate=2.0))
    events = dase.simulate(scene_of(0), sensor, seed=3)
    runs = [(CANDIDATES[:n], 1000) for n in (2, 4, 8)] + [(CANDIDATES[:4], n) for n in PIXELS if n != 1000]
    rows = []
    for names, pixels in runs:
        spent, count = seconds(events, names, pixels, options.device)
        rows.append((len(names), pixels, spent, count))
        print(*rows[-1], flush=True)
    lines = ["| candidates | pixels in each half | time [s] | simulations |", "|---|---|---|---|"]
    lines += [f"| {n} | {pixels} | {spent:.2g} | {count} |" for n, pixels, spent, count in rows]
    by = [np.polyfit(*np.array([(r[k], r[2]) for r in rows if keep(r)]).T, 1) for k, keep in (
        (0, lambda r: r[1] == 1000), (1, lambda r: r[0] == 4))]  # fmt: skip
    kind = "processor time, all threads" if options.device == "cpu" else options.device
    lines += [
        "",
        f"A candidate more costs {by[0][0]:.2g} s, a thousand pixels more {1e3 * by[1][0]:.2g} s ({kind}).",
    ]
    text = options.page.read_text()
    table = "<!-- cost -->\n" + "\n".join(lines) + "\n<!-- /cost -->"
    options.page.write_text(re.sub(r"<!-- cost -->.*<!-- /cost -->", lambda _: table, text, flags=re.DOTALL))


if __name__ == "__main__":
    main()
