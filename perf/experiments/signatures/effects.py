"""Which signatures each effect of the library shows, alone and at three strengths: others' are false.

    python -m perf.experiments.signatures.effects OUT.jsonl [--seeds 1,2,3] [--only latency,shot]

What shows on a sensor without the effect, too, is the scene's and does not count, as in a diagnosis. A
signature is right of each effect that says it makes it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import dase
from dase.diagnosis.seen_effects import shows_in
from dase.effects import EFFECTS
from dase.effects.made_signatures import made_by
from dase.signatures.result import Signature
from perf.experiments.blind_diagnosis.run import HIDDEN
from perf.experiments.signatures import run as experiment

MORE: dict[str, tuple[dict[str, Any], ...]] = {
    "high_pass": tuple(dict(cutoff=f) for f in (0.5, 3.0, 20.0)),
    "exposure": tuple(dict(amplitude=a) for a in (0.1, 0.2, 0.5)),
    "double_events": tuple(dict(share=s, on=0.0) for s in (0.003, 0.01, 0.05)),
    "anti_flicker": (dict(start=6.0, stop=4.0), dict(start=5.0, stop=3.0), dict(start=4.0, stop=2.0)),
    "trail_filter": tuple(dict(threshold=t) for t in (0.002, 0.01, 0.05)),
    "rate_control": tuple(dict(rate=r) for r in (6e5, 3e5, 1e5)),
}
"""Effects that the blind benchmark does not hide, at weak, medium and strong."""

MODES: dict[str, tuple[dict[str, Any], ...]] = {
    "readout": (dict(mode="rows", rate=4e5), dict(mode="drop", rate=4e5)),
    "refractory": (dict(mode="delay", period=5e-3),),
    "latency": (dict(delay=8e-3, light=0.0), dict(delay=3e-4, light=1.0, dark=0.02)),
    "shot": (dict(rate=100.0, bright=0.0, balance=0.3),),
    "voltage_noise": (dict(sigma=0.1, cutoff=3000.0),),
    "timestamp": (dict(jitter=1e-4, step=1e-6),),
}
"""Other laws of an effect."""


def strengths(name: str) -> tuple[dict[str, Any], ...]:
    """Return the values of an effect at weak, medium and strong, and those of its other laws."""
    if name == "readout":
        return tuple(dict(rate=6e5 * v["rate"]) for v in HIDDEN[name]) + MODES[name]
    return (HIDDEN | MORE)[name] + MODES.get(name, ())


def false_signatures(
    scene: dase.Scene, base: dase.Sensor, plain: tuple[Signature, ...], name: str, values: dict[str, Any],
    seed: int,
) -> list[Signature]:  # fmt: skip
    """Return signatures that are found and that none of an effect's own.

    Args:
        scene: What is seen.
        base: A sensor without the effect.
        plain: Signatures of its events.
        name: Of the effect.
        values: Its parameters.
        seed: Of the noise.
    """
    events = dase.simulate(scene, base.with_effect(EFFECTS[name](**values)), seed=seed)
    entries = dase.find_signatures(events).entries if len(events) else ()
    return [
        entry for entry in entries
        if entry.found and not made_by(EFFECTS[name], entry.name) and not shows_in(plain, entry)
    ]  # fmt: skip


def effects_tried() -> list[str]:
    """Return the names of all effects of the library that can be added to a sensor and change its events."""
    return [name for name in EFFECTS if name in HIDDEN or name in MORE]


def run_seed(seed: int, names: list[str]) -> Iterator[dict[str, Any]]:
    """Yield what each effect shows beside its own, on scenes that move in four ways and on one at rest."""
    for kind in ("shake", "objects", "static", "turn", "pan"):
        rng = np.random.default_rng([seed, *kind.encode()])
        on, off = rng.uniform(0.14, 0.28, 2)
        base = dase.Sensor().with_effect(EFFECTS["threshold"](on=float(on), off=float(off)))
        scene = experiment.draw_scene(rng, kind, 1.0)
        events = dase.simulate(scene, base, seed=seed)
        plain = dase.find_signatures(events).entries if len(events) else ()
        for name in names:
            for values in strengths(name):
                false = false_signatures(scene, base, plain, name, values, seed + 1)
                yield {
                    "seed": seed, "kind": kind, "effect": name, "values": values,
                    "false": [[entry.name, entry.sentence] for entry in false],
                }  # fmt: skip


def main() -> None:
    """Run, and print what was false."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--only", default=",".join(effects_tried()))
    options = parser.parse_args()
    rows = []
    with options.out.open("a") as out:
        for seed in (int(part) for part in options.seeds.split(",")):
            for row in run_seed(seed, options.only.split(",")):
                out.write(json.dumps(row) + "\n")
                out.flush()
                rows.append(row)
                for name, sentence in row["false"]:
                    print(f"{row['kind']} {row['effect']} {row['values']}: {name}: {sentence}", flush=True)
    wrong = sum(bool(row["false"]) for row in rows)
    print(f"something false in {experiment.limits(wrong, len(rows))} of recordings")


if __name__ == "__main__":
    main()
