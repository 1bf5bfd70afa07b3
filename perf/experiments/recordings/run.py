"""Measured against simulated on recordings of cameras: writes results.json, which docs/effects.md shows.

    python -m perf.experiments.recordings.run $DASE_DATA/recordings
    python -m perf.experiments.recordings.run $DASE_DATA/recordings --only dvs128_flip

Presets of the commit `BEFORE` and of now run without any fit, over what the camera's own frames tell of the
scene, or over constant light where nothing moved. Where no scene is known, only the measurement stands. Where
a recording has a lamp or frames that couple, which no preset has, they stand in one more line.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import dase
from dase.effects.exposure import Exposure
from dase.effects.flicker import Flicker
from dase.effects.refractory import Refractory
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import Events
from dase.fitting.burst_strength import burst_times_of
from dase.fitting.measurement import Measurement, as_measurement, static_scene
from dase.scenes.between_frames import CameraScene
from dase.signatures.find import find_signatures
from dase.signatures.result import Signature
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import load_sensor, parse_sensor

BEFORE = "3859195"
"""Commit whose presets are those before: then crossings in a dead time were dropped unless said otherwise."""

RESULTS = Path(__file__).with_name("results.json")
SHARES = (0.001, 0.01, 0.1)
"""Of the intervals of a pixel that are shorter."""
PAIRS = {"ON-ON": (1, 1), "OFF-OFF": (0, 0), "ON-OFF": (1, 0), "OFF-ON": (0, 1)}
BANDS = (0, 4, 10, 20, 40, 256)
"""Grey levels of 255 between which rates of resting pixels are averaged."""
REST = 6
"""Most grey levels by which the frames of a resting pixel change, within 7 pixels."""
MANY = (1, 2, 4, 8)
"""Events of a pixel that is counted among those that send much."""
RUNS = 4
"""Simulations of resting pixels."""
FEWEST = 300
"""Resting pixels, and intervals, without which no number stands."""


@dataclass(frozen=True)
class Source:
    """A recording and how it is compared.

    Args:
        name: What the table calls it.
        path: In the folder of the recordings.
        preset: The camera's.
        scene: `frames`, `static`, or nothing where no scene is known.
        longest: Of it that is looked at [s].
    """

    name: str
    path: str
    preset: str
    scene: str = ""
    longest: float = 2.0


SOURCES = (
    Source("DAVIS346, cradle", "davis346_cuke_cradle.npz", "davis346", "frames"),
    Source("DAVIS346, street", "native/davis346_street.aedat4", "davis346", "frames", 1.2),
    Source("DAVIS240C, shaken", "davis240c_camerashake.npz", "davis240c", "frames", 1.7),
    Source("DVXplorer, at rest", "dvx_noise_static.npz", "dvxplorer", "static", 1.0),
    Source("HD, nearly at rest", "psee_hd_ros_trigger.npz", "imx636", "static", 1.0),
    Source("DAVIS240B, checkerboard", "davis240b_evbench1.npz", "davis240c"),
    Source("DAVIS240C, shapes", "davis240c_ijrr_shapes.npz", "davis240c"),
    Source("DAVIS240C, boxes", "davis240c_ijrr_boxes.npz", "davis240c"),
    Source("DVS128, stripes", "dvs128_stripes.npz", "dvs128"),
    Source("DVS128, flip", "dvs128_flip.npz", "dvs128"),
    Source("Gen3, circling dot", "psee_gen31_dot.npz", "gen3"),
)


def preset_before(name: str) -> Sensor:
    """Return a preset as it was, in the rule for dead times of that time."""
    spec = f"{BEFORE}:dase/presets/{name}.toml"
    found = subprocess.run(["git", "show", spec], capture_output=True, text=True, check=True)
    sensor = parse_sensor(found.stdout, spec)
    dead = next((effect for effect in sensor.effects if effect.name == "refractory"), None)
    if isinstance(dead, Refractory) and "mode" not in found.stdout:
        sensor = sensor.with_effect(replace(dead, mode="drop"))
    return sensor


def interval_quantiles(events: Events) -> dict[str, list[float]]:
    """Return the quantiles of the times between two events of a pixel [ms], by their polarities."""
    pixel = events.y.astype(np.int64) * events.width + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, time, on = pixel[order], events.t[order], events.p[order].astype(int)
    same = pixel[1:] == pixel[:-1]
    between, first, second = np.diff(time)[same], on[:-1][same], on[1:][same]
    out = {}
    for name, (a, b) in PAIRS.items():
        mine = between[(first == a) & (second == b)]
        if len(mine) >= FEWEST:
            out[name] = [float(q) for q in 1e3 * np.quantile(mine, SHARES)]
    return out


def share_of_ties(events: Events) -> tuple[float, float]:
    """Return the share of events at the time of the one before [1], and of those in its row, too [1]."""
    stamp = np.round(events.t * 1e6)
    tie = np.diff(stamp) == 0
    return float(tie.mean()), float((tie & (np.diff(events.y.astype(int)) == 0)).mean())


def pixels_at_rest(frames: NDArray[Any]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which pixels rest, and their brightness [grey levels], shape (H, W) each."""
    change = frames.max(0).astype(int) - frames.min(0)
    rest: NDArray[np.bool_] = cv2.dilate(change.astype(np.float32), np.ones((15, 15))) <= REST
    return rest, frames.mean(0)


def counts_of_pixels(events: Events) -> NDArray[np.int64]:
    """Return the events of each pixel, shape (H, W)."""
    pixel = events.y.astype(np.int64) * events.width + events.x
    return np.bincount(pixel, minlength=events.width * events.height).reshape(events.height, events.width)


def noise_at_rest(
    streams: list[Events], frames: NDArray[Any] | None, seconds: float
) -> dict[str, list[float | None]]:
    """Return the rates of resting pixels [Hz] in bands of brightness, and shares of pixels that send much.

    Args:
        streams: Of the same pixels for as long.
        frames: What says which pixels rest; None where all do.
        seconds: Length of each stream.
    """
    counts = np.stack([counts_of_pixels(events) for events in streams])
    if frames is None:
        return {"rest": [float(counts.mean() / seconds)], "tail": []}
    rest, level = pixels_at_rest(frames)
    rates: list[float | None] = []
    for low, high in pairwise(BANDS):
        mine = rest & (level >= low) & (level < high)
        rates.append(float(counts[:, mine].mean() / seconds) if mine.sum() >= FEWEST else None)
    tail: list[float | None] = []
    for mine in (rest & (level < BANDS[1]), rest & (level >= BANDS[3])):
        enough = mine.sum() >= FEWEST
        tail += [float((counts[:, mine] >= n).mean()) if enough else None for n in MANY]
    return {"rest": rates, "tail": tail}


def simulate_rest(sensor: Sensor, frames: NDArray[Any], seconds: float, seed: int) -> list[Events]:
    """Return what a sensor sends before the mean of the frames, which has none of their noise."""
    light = np.repeat(frames.mean(0, keepdims=True) / 255, 2, 0).astype(np.float32)
    still = dase.VideoScene(light, [0.0, seconds])
    return [dase.simulate(still, sensor, seed=seed + n) for n in range(RUNS)]


def signature(entries: tuple[Signature, ...], name: str) -> Signature | None:
    """Return a signature if it is there."""
    return next((one for one in entries if one.name == name and one.found), None)


def describe(events: Events, scene: Any) -> dict[str, Any]:
    """Return all that is compared but noise at rest."""
    begins = scene.begin if isinstance(scene, CameraScene) else None
    entries = find_signatures(events, begins=begins).entries
    bursts, lamp = (signature(entries, name) for name in ("frame coupling", "flicker"))
    seconds = float(events.t[-1] - events.t[0])
    ties, in_row = share_of_ties(events)
    return {
        "rate": len(events) / seconds / (events.width * events.height),
        "intervals": interval_quantiles(events),
        "ties": ties,
        "row ties": in_row,
        "bursts": bursts.details["share"] if bursts else 0.0,
        "lamp": [lamp.details["frequency"], lamp.size] if lamp else [],
    }


def with_lamp_and_frames(sensor: Sensor, measured: Measurement, seed: int) -> Sensor:
    """Return the sensor with the lamp and the frames whose signatures a recording has, if it has any.

    When frames are exposed and how often the lamp flickers the events tell. The strength of both, and the
    threshold, which hides or shows them, are set so that the simulation has as many events, as many of them
    in bursts, and as large a swing as the recording. All else is left to compare.
    """
    wanted = describe(measured.events, measured.scene)
    scene = measured.scene
    begins = scene.begin if isinstance(scene, CameraScene) else None
    entries = find_signatures(measured.events, begins=begins).entries
    coupling, lamp = signature(entries, "frame coupling"), signature(entries, "flicker")
    times = burst_times_of(measured, coupling) if coupling else None
    if times is None and lamp is None:
        return sensor
    threshold, amplitude, depth, found = 0.15, 0.08, 0.03, sensor
    for _ in range(ROUNDS):
        found = sensor.with_effect(Threshold(on=threshold, off=threshold))
        if times is not None:
            found = found.with_effect(
                Exposure(
                    amplitude=amplitude, period=times.interval, exposure=times.exposure, begin=times.begin
                )
            )
        if lamp is not None:
            found = found.with_effect(Flicker(frequency=lamp.details["frequency"], depth=depth))
        seen = describe(dase.simulate(scene, found, seed=seed), scene)
        swing = seen["lamp"][1] if seen["lamp"] else LEAST_SWING
        got = f"{seen['rate']:.4g} Hz, {seen['bursts']:.3g} in bursts, swing {swing:.3g}"
        print(f"    {threshold:.4g}, {amplitude:.4g}, {depth:.4g}: {got}", flush=True)
        threshold *= float(np.clip(seen["rate"] / wanted["rate"], 0.5, 2)) ** 0.5
        if wanted["bursts"]:
            amplitude *= float(np.clip(wanted["bursts"] / max(seen["bursts"], 0.01), 0.3, 3)) ** 0.4
        if lamp is not None:
            depth *= float(np.clip(lamp.size / swing, 0.3, 3)) ** 0.7
    return found


ROUNDS = 14
"""Simulations by which strengths of a lamp and of frames are set."""
LEAST_SWING = 0.02
"""What a lamp that is not found is taken to swing by."""


def look_at(source: Source, folder: Path, seed: int = 0) -> dict[str, Any]:
    """Return what is measured in a recording, and simulated where a scene is known."""
    recording = dase.open_recording(folder / source.path)
    recording = recording.slice(recording.begin, recording.begin + source.longest)
    if not source.scene:
        return {"measured": describe(recording.events, None)}
    if source.scene == "static":
        measured = Measurement(recording.events, static_scene(recording.events))
    else:
        measured = as_measurement(recording)
    scene, frames = measured.scene, recording.frames
    times = scene.sample_times()
    inside = measured.events.slice(float(times[0]), float(times[-1]))
    seconds = float(times[-1] - times[0])
    out = {"measured": describe(inside, scene) | noise_at_rest([inside], frames, seconds)}
    now = load_sensor(source.preset)
    seen = with_lamp_and_frames(now, measured, seed)
    sensors = {"before": preset_before(source.preset), "after": now}
    if seen != now:
        sensors["after, with its lamp and frames"] = seen
    for name, sensor in sensors.items():
        made = dase.simulate(scene, sensor, seed=seed)
        still = [made] if frames is None else simulate_rest(sensor, frames, seconds, seed)
        out[name] = describe(made, scene) | noise_at_rest(still, frames, seconds)
        print(f"  {name}: {len(made):,} events for {len(inside):,}", flush=True)
    return out


def main() -> None:
    """Look at all recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", help="file names without suffix")
    options = parser.parse_args()
    found = json.loads(RESULTS.read_text("utf-8")) if RESULTS.is_file() else {}
    for source in SOURCES:
        if options.only and Path(source.path).stem not in options.only:
            continue
        print(source.name, flush=True)
        try:
            found[source.name] = look_at(source, options.folder)
        except InputError as error:
            print(f"  {error}")
            continue
        ordered = {one.name: found[one.name] for one in SOURCES if one.name in found}
        RESULTS.write_text(json.dumps(ordered, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
