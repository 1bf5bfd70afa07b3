"""How often a dead time, noise, a leak or a mismatch is told with the scene, and where none is there.

    python -m perf.experiments.seen_with_the_scene.run --key KEY --scenes 6
    # the same of a jitter, which is asked of a model that has all else
    python -m perf.experiments.seen_with_the_scene.run --key KEY --scenes 6 --jitter

Each effect alone at its strong strength, a noisy base, and worlds slightly off; the model lacks what is
hidden, and has the true thresholds. That is harsher than a diagnosis, which asks after its search, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

import dase
from dase.diagnosis.dead_time import find_dead_time
from dase.diagnosis.drifting_memory import find_drifting_memory
from dase.diagnosis.events_at_rest import find_events_at_rest
from dase.diagnosis.light_between_events import LightBetweenEvents
from dase.diagnosis.redrawn_thresholds import find_redrawn_thresholds
from dase.diagnosis.unequal_thresholds import find_unequal_thresholds
from dase.effects import EFFECTS, Threshold
from dase.effects.made_signatures import told_by
from dase.fitting.frame_steps import frame_step_of
from dase.fitting.measurement import Measurement
from dase.probes.timestamp_patterns import find_structure
from dase.signatures.kinds import NOISE_AT_REST
from dase.simulation.sensor import Sensor
from perf.experiments.blind_diagnosis import foreign
from perf.experiments.blind_diagnosis.run import HIDDEN, number_of, truth_of
from perf.experiments.blind_diagnosis.run import Case as BlindCase
from perf.experiments.blind_diagnosis.scenes import draw_scene

PERIODS = (2e-3, 5e-3, 15e-3)
"""Dead times [s]."""


JITTERS = (0.0, 0.1, 0.2)
"""Spreads of thresholds from event to event, relative; 0 for none."""


def rows(key: int, scenes: int) -> Iterator[tuple[str, float, Measurement, Sensor]]:
    """Yield what is hidden, a dead time or 0, the measurement, and the model that lacks it."""
    for number in range(scenes):
        scene = draw_scene(np.random.default_rng([key, number, 1]))
        for name in (*HIDDEN, "nothing"):
            effects = () if name == "nothing" else (name,)
            for noisy in (False, True) if name == "nothing" else (False,):
                if name == "refractory":
                    continue
                true, _ = truth_of(BlindCase("single", effects, "strong", number, noisy=noisy), key)
                events = dase.simulate(scene, true, seed=number)
                model = true if not effects else true.without(name)
                words = "a noisy sensor with 1 ms" if noisy else name
                yield words, 1e-3 if noisy else 0.0, Measurement(events, scene), model
        true, _ = truth_of(BlindCase("single", (), "none", number), key)
        for period in PERIODS:
            for mode in EFFECTS["refractory"].choices()["mode"]:
                sensor = true.with_effect(EFFECTS["refractory"](period=period, mode=mode))
                events = dase.simulate(scene, sensor, seed=number)
                yield f"{mode}, {1e3 * period:g} ms", period, Measurement(events, scene), true
        rng = np.random.default_rng([key, number, 5])
        habits, (on, off) = foreign.draw_habits(rng), 0.2 * np.exp(rng.uniform(-0.25, 0.25, 2))
        frames, times = foreign.clip_of(scene.frames(scene.sample_times()), scene.sample_times(), habits, rng)
        seen = type(scene)(frames.astype(np.float32), times)
        model = Sensor(effects=(Threshold(on=float(on), off=float(off)),))
        for name in ("nothing", *foreign.HIDEABLE):
            hidden: dict[str, Any] = {}
            if name != "nothing":
                low, high = foreign.HIDEABLE[name]
                hidden[name] = float(np.exp(rng.uniform(np.log(low), np.log(high))))
            events = foreign.simulate(frames, times, float(on), float(off), hidden, habits, number)
            yield (
                f"world slightly off: {name}",
                hidden.get("refractory", 0.0),
                Measurement(events, seen),
                model,
            )


def jitter_rows(key: int, scenes: int) -> Iterator[tuple[str, float, Measurement, Sensor]]:
    """Yield what is there beside a jitter, its spread or 0, the measurement, and the model without one."""
    for number in range(scenes):
        rng = np.random.default_rng([key, number, 1])
        scene = draw_scene(rng)
        for name in (*HIDDEN, "a noisy sensor", "nothing"):
            if name == "jitter":
                continue
            effects = (name,) if name in HIDDEN else ()
            case = BlindCase("single", effects, "strong", number, noisy=name == "a noisy sensor")
            model, _ = truth_of(case, key)
            for spread in JITTERS:
                true = model.with_effect(EFFECTS["jitter"](spread=spread)) if spread else model
                events = dase.simulate(scene, true, seed=number)
                yield name, spread, Measurement(events, scene), model


def print_jitters(key: int, scenes: int) -> None:
    """Print in how many recordings a jitter is told, and which."""
    told: dict[tuple[str, float], list[float]] = {}
    count: dict[str, int] = {}
    for name, spread, measurement, model in jitter_rows(key, scenes):
        count[name] = count.get(name, 0) + (spread == 0)
        frames = frame_step_of(measurement.events, measurement.scene)
        light = None if frames else LightBetweenEvents.of(measurement, log_eps=model.log_eps)
        jitter = light and find_redrawn_thresholds(light, model, right=True, seed=0)
        if jitter is not None:
            told.setdefault((name, spread), []).append(jitter.size)
    print("| beside | " + " | ".join(f"{spread:.0%}" if spread else "no jitter" for spread in JITTERS) + " |")
    print("|---" * (len(JITTERS) + 1) + "|")
    for name, many in count.items():
        print(f"| {name} | " + " | ".join(_sizes(told.get((name, s), []), many) for s in JITTERS) + " |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--key", required=True, help="draws scenes, thresholds and habits")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--jitter", action="store_true", help="ask for a jitter alone")
    options = parser.parse_args()
    if options.jitter:
        print_jitters(number_of(options.key), options.scenes)
        return
    found: dict[str, list[str]] = {}
    count: dict[str, int] = {}
    rests: dict[str, dict[str, int]] = {}
    spreads: dict[str, list[float]] = {}
    drifts: dict[str, list[float]] = {}
    for name, period, measurement, model in rows(number_of(options.key), options.scenes):
        events, scene = measurement.events, measurement.scene
        count[name] = count.get(name, 0) + 1
        if len(events) < 2:
            continue
        frame_step = frame_step_of(events, scene) or 0.0
        structure = find_structure(events)
        entry = find_dead_time(measurement, model, frame_step=frame_step, structure=structure, seed=0)
        threshold = model["threshold"]
        assert isinstance(threshold, Threshold)
        thresholds = threshold.on, threshold.off
        rest = find_events_at_rest(measurement, model, thresholds=thresholds, seed=0)
        if rest is not None:
            told = told_by(rest, EFFECTS) if rest.name == NOISE_AT_REST else ()
            said = " ".join([rest.name, *told])
            many = rests.setdefault(name, {})
            many[said] = many.get(said, 0) + 1
        light = LightBetweenEvents.of(measurement, log_eps=model.log_eps)
        unequal = light and find_unequal_thresholds(light, model, seed=0)
        if unequal is not None:
            spreads.setdefault(name, []).append(unequal.size)
        drift = light and find_drifting_memory(light, model, structure=structure, seed=0)
        if drift is not None:
            drifts.setdefault(name, []).append(drift.size)
        if entry is not None:
            found.setdefault(name, []).append(f"{1e3 * entry.details['period']:.3g}/{1e3 * period:.3g}")
    print("| hidden | dead time | its end, and the true one [ms] | at rest | spread of thresholds | drift |")
    print("|---|---|---|---|---|---|")
    for name, many_of_it in count.items():
        some = found.get(name, [])
        at_rest = ", ".join(f"{n} of {many_of_it}: {said}" for said, n in rests.get(name, {}).items())
        unlike, drift = (_sizes(sizes.get(name, []), many_of_it) for sizes in (spreads, drifts))
        ends = ", ".join(some) or "-"
        print(f"| {name} | {len(some)} of {many_of_it} | {ends} | {at_rest or '-'} | {unlike} | {drift} |")


def _sizes(sizes: list[float], many: int) -> str:
    """Return in how many of recordings something is seen, and from which size to which."""
    return f"{len(sizes)} of {many}: {min(sizes):.3g} to {max(sizes):.3g}" if sizes else "-"


if __name__ == "__main__":
    main()
