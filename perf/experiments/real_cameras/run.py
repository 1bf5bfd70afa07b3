"""Diagnoses recordings of real cameras, one after the other, and writes docs/real-cameras.md and its picture.

    # all that are there
    python -m perf.experiments.real_cameras.run $DASE_DATA/recordings
    python -m perf.experiments.real_cameras.run $DASE_DATA/recordings --only dvx_noise_static
    # the page from what was found before
    python -m perf.experiments.real_cameras.run $DASE_DATA/recordings --report

The recordings are other people's and not part of dase; the page has their names, statistics and one picture.
What was found lies in `--log`, one file per recording; recordings that have one are not diagnosed again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import dase
import dase.io
from dase.diagnosis.diagnose import diagnose
from dase.fitting.measurement import Measurement, camera_scene, open_measurement
from dase.recordings.statistics import RecordingSurvey
from dase.scenes.frame_alignment import align
from dase.simulation.simulate import stream
from perf.benchmarks.kernels import commit
from perf.experiments.real_cameras.report import write_page

LONGEST = 2.0
"""Of a recording at rest that is looked at [s]."""


@dataclass(frozen=True)
class Camera:
    """A recording: how it is opened, and what can be seen in it without any model.

    Args:
        open: Path to a measurement.
        sensor: Name of the camera.
        shows: What it is of.
        visible: What can be seen in the events, and the effects that would say so.
        window: Time that is pictured [s].
        pixels: In each half; a whole field of noise costs as much as all it shows.
    """

    open: Callable[[Path], Measurement]
    sensor: str
    shows: str
    visible: tuple[tuple[str, tuple[str, ...]], ...]
    window: float = 0.02
    pixels: int = 1500


def with_frames(path: Path) -> Measurement:
    """Open a recording with the scene between its own frames, as `dase diagnose` does."""
    return open_measurement(path)


def shortened(measured: Measurement, longest: float) -> Measurement:
    events = measured.events
    keep = events.t <= events.t[0] + longest
    return replace(measured, events=events.select(keep))


def static(path: Path) -> Measurement:
    """Open a recording of a scene in which nothing moves."""
    return shortened(open_measurement(path, "static"), LONGEST)


def without_times(path: Path) -> Measurement:
    """Open a recording whose frames have no times: equal steps, as late as fits best.

    As long as from burst to burst where the events show bursts at even times, else as long as fits best.
    """
    with np.load(path) as data:
        frames = data["frames"]
    events = dase.io.read(path).events
    best: Any = None
    bursts = dase.find_signatures(events)["frame coupling"]
    steps = [bursts.details["interval"]] if bursts.found else np.arange(0.046, 0.0581, 0.001)
    for step in steps:
        times = events.t[0] + step * np.arange(len(frames))
        found = align(events, frames, times)
        if best is None or found.score > best[0].score:
            best = found, times, step
    found, times, step = best
    frames, begin, _ = found.apply(frames, times, times)
    notes = [
        f"the frames have no times: {1e3 * step:.2f} ms apart, {1e3 * found.offset:.0f} ms after the first "
        f"event they correlate best with the events, at {found.score:.2f}"
    ]
    begin = times + found.offset if "offset" not in found.clear else begin
    scene = camera_scene(frames, begin, begin, notes)
    return Measurement(events, scene, scene.is_trusted, tuple(notes))


def from_histograms(path: Path, seconds: float = 2.0, side: int = 50) -> Measurement:
    """Make events of histograms of intervals: three static fields of 50 x 50 pixels, at 0.1, 161, 3000 lux.

    Each pixel and polarity has a train of its own: its intervals in random order, the first cut at random.
    What the histograms do not have is lost: in which order intervals came, how ON and OFF follow each other.
    """
    from perf.experiments.noise.run import EDGES, LEVELS, measured

    rng = np.random.default_rng(0)
    parts, light = [], np.zeros((side, 3 * side), np.float32)
    for field, (level, counts) in enumerate(measured(path).items()):
        lux, length = LEVELS[level]
        light[:, field * side : (field + 1) * side] = lux / 3000
        for polarity, pixel in np.ndindex(2, side * side):
            bins = np.repeat(np.arange(counts.shape[2]), counts[polarity, pixel])
            if len(bins) == 0:
                continue
            gaps = 1 / np.exp(rng.uniform(np.log(EDGES[bins]), np.log(EDGES[bins + 1])))
            t = np.cumsum(rng.permutation(gaps))
            t = np.mod(t + rng.uniform(0, length), length)
            t = t[t < seconds]
            where = (np.full(len(t), field * side + pixel % side), np.full(len(t), pixel // side))
            parts.append((t, *where, np.full(len(t), polarity)))
    t, x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t)
    events = dase.Events(
        t[order],
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        p[order].astype(bool),
        3 * side,
        side,
    )
    times = np.arange(0, seconds + 1e-9, 2e-3)
    scene = dase.VideoScene(np.broadcast_to(light, (len(times), *light.shape)), times)
    note = "events were made of histograms of intervals: their order, and how ON and OFF follow, is lost"
    return Measurement(events, scene, None, (note,))


def of_a_dot(path: Path) -> Measurement:
    """Open a recording of a bright dot that goes in circles; its way is taken from the events.

    A wave of two harmonics goes through the events of the leading edge, which is sharp; the middle of the dot
    follows it by the time at which these lie on a circle best. Dot and ground are even, their contrast is a
    guess. The events of the leading edge are called OFF in the file, and the slow tail behind the dot, where
    it gets dark and a pixel is slow, ON: polarities are taken the other way round.
    """
    stored = dase.io.read(path).events
    events = replace(stored, p=~stored.p)
    lead = events.select(events.p)
    frequency = _frequency(lead)
    basis = _wave(lead.t, frequency)
    places = np.stack([lead.x, lead.y], 1).astype(np.float64)
    fit = np.linalg.lstsq(basis, places, rcond=None)[0]
    near = np.hypot(*(places - basis @ fit).T) < 40  # the others are noise, not of the dot
    fit = np.linalg.lstsq(basis[near], places[near], rcond=None)[0]
    best = (np.inf, 0.0, 0.0)
    for late in np.arange(0, 3e-3, 5e-5):
        apart = np.hypot(*(places[near] - _wave(lead.t[near] - late, frequency) @ fit).T)
        spread = float(np.percentile(apart, 75) - np.percentile(apart, 25))
        best = min(best, (spread, late, float(np.median(apart))))
    _, late, radius = best
    times = np.arange(events.t[0] + 2.5e-4, events.t[-1], 2.5e-4)
    x, y = np.meshgrid(np.arange(events.width, dtype=np.float32), np.arange(events.height, dtype=np.float32))
    frames = np.empty((len(times), events.height, events.width), np.float32)
    for frame, (a, b) in zip(frames, _wave(times - late, frequency) @ fit, strict=True):
        frame[:] = 0.02 + 0.5 * np.clip((radius - np.hypot(x - a, y - b)) / 2 + 0.5, 0, 1)
    notes = (
        f"no frames: the scene is an even dot of radius {radius:.0f} px whose way is taken from the events, "
        f"{frequency:.1f} turns per second",
        "polarities are taken the other way round: the file calls the leading edge of the bright dot OFF",
    )
    swept = cv2.dilate((frames.max(0) > 0.1).astype(np.uint8), np.ones((41, 41), np.uint8)).reshape(-1) > 0

    def trust(t: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        return np.broadcast_to(swept[pixels], (len(t), len(pixels)))

    return Measurement(events, dase.VideoScene(frames, times), trust, notes)


def _wave(times: np.ndarray, frequency: float) -> np.ndarray:
    """Return a constant and two harmonics, shape (K, 5)."""
    turn = 2 * np.pi * frequency * times
    return np.stack([np.ones_like(turn), *(f(k * turn) for k in (1, 2) for f in (np.cos, np.sin))], 1)


def _frequency(events: dase.Events) -> float:
    """Return how often the middle of the events goes round in a second."""
    edges = np.linspace(events.t[0], events.t[-1], 100)
    cuts = pairwise(np.searchsorted(events.t, edges))
    middle = np.array([(np.median(events.x[a:b]), np.median(events.y[a:b])) for a, b in cuts])
    times = 0.5 * (edges[1:] + edges[:-1])
    tried = np.geomspace(5, 500, 2000)
    left = []
    for frequency in tried:
        basis = _wave(times, frequency)
        fit = np.linalg.lstsq(basis, middle, rcond=None)[0]
        left.append(float(((middle - basis @ fit) ** 2).sum()))
    return float(tried[int(np.argmin(left))])


CAMERAS = {
    "davis346_cuke_cradle": Camera(
        with_frames, "DAVIS346", "Newton's cradle, camera at rest, 0.5 s, 13 frames with exposures",
        (("shortest interval of a pixel about 1 ms", ("refractory",)), ("hot pixels", ("hot",)),
         ("noise of pixels at rest", ("opposite pairs", "leak", "shot", "voltage_noise"))),
    ),
    "davis240c_camerashake": Camera(
        with_frames, "DAVIS240C", "box and mug, camera shaken by hand, 12 s, of which a part is compared",
        (("bursts of the whole array with the frames", ("exposure",)), ("lamps at 100 Hz", ("flicker",)),
         ("rows that are read together", ("grouping", "readout")),
         ("shortest interval of a pixel about 1 ms", ("refractory",))),
        0.005,
    ),
    "davis240b_evbench1": Camera(
        without_times, "DAVIS240B", "pan and tilt over a checkerboard, 1.07 s, frames without times",
        (("bursts of the whole array every 51 ms", ("exposure",)), ("lamps at 120 Hz", ("flicker",)),
         ("hot pixels", ("hot",)), ("rows that are read together", ("grouping", "readout")),
         ("only 30 % ON events", ("threshold",)),
         ("no events in columns 190 to 239", ("dead",))),
        0.01,
    ),
    "dvx_noise_static": Camera(
        static, "iniVation, 640x480", "nothing moves, 2 s: noise alone, about 0.5 Hz per pixel",
        (("noise of both polarities", ("shot", "voltage_noise")),
         ("hot pixels, one of them stuck", ("hot",)),
         ("columns that are read every 195 µs", ("row_scan", "timestamp"))),
        0.2,
    ),
    "noise_iebcs": Camera(
        from_histograms, "of IEBCS", "noise at 0.1, 161 and 3000 lux, from histograms of intervals",
        (("both polarities in the dark", ("shot", "voltage_noise")), ("ON alone in the light", ("leak",)),
         ("pixels far above the others", ("hot",))),
        0.5, 600,
    ),
    "psee_gen31_dot": Camera(
        of_a_dot, "Prophesee Gen3.1", "a bright dot in circles, 50 ms, no frames",
        (("a pixel at 66 kHz", ("hot",)), ("rows that are read together", ("grouping", "readout")),
         ("modal interval of a pixel 75 µs", ("refractory",))),
        0.001,
    ),
}  # fmt: skip


def look(name: str, path: Path, options: argparse.Namespace) -> None:
    """Diagnose one recording and keep what was found."""
    camera = CAMERAS[name]
    measured = camera.open(path)
    found = diagnose(measured, pixels=camera.pixels, device=options.device)
    (options.log / f"{name}.json").write_text(json.dumps(found.to_json() | {"commit": options.commit}))
    np.savez_compressed(options.log / f"{name}.npz", **pictures(camera, measured, found.sensor))

    print(f"{name}: {found.seconds:.0f} s, {found.finding()}", flush=True)
    for step in found.history:
        ranks = ", ".join(f"{r.effect} {r.error:.2f}" for r in step.ranking[:5])
        print(f"    {step.error:6.2f} gate {step.gate:4.2f} {step.chosen} [{ranks}]", flush=True)


def pictures(camera: Camera, measured: Measurement, sensor: dase.Sensor) -> dict[str, np.ndarray]:
    """Return counts of a window, measured and simulated, what the camera saw, and facts of the events."""
    events, scene = measured.events, measured.scene
    begin = max(float(scene.sample_times()[0]), float(events.t[0]))
    end = min(float(scene.sample_times()[-1]), float(events.t[-1]))
    at = begin + 0.55 * (end - begin)
    parts = []
    for part in stream(scene, sensor, seed=1):
        parts.append(part)
        if len(part) and part.t[-1] > at + camera.window:
            break
    simulated = dase.Events.concatenate(parts)
    edges = [at, at + camera.window]
    times = scene.sample_times()
    grey = scene.frames(times[[np.searchsorted(times, at)]])[0]
    pixel = events.y.astype(np.int64) * events.width + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    counts = np.bincount(pixel, minlength=events.width * events.height)
    looked = RecordingSurvey(events.width, events.height)
    looked.add_events(events)
    return {
        "measured": events.counts(edges)[0], "simulated": simulated.counts(edges)[0], "grey": grey,
        "rate": np.array(len(events) / (events.t[-1] - events.t[0])),
        "on": np.array(events.p.mean()), "shortest": np.array(np.quantile(gaps, 1e-3)),
        "busiest": np.array(counts.max() / (events.t[-1] - events.t[0])),
        "hot": np.array(np.count_nonzero(looked.hot_pixels())),
        "seconds": np.array(events.t[-1] - events.t[0]), "events": np.array(len(events)),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default=",".join(CAMERAS))
    parser.add_argument("--log", type=Path, default=Path("out/real_cameras"))
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--again", action="store_true", help="diagnose what was diagnosed before, too")
    parser.add_argument("--report", action="store_true", help="only write the page")
    parser.add_argument("--commit", help="what to record where there is no git")
    options = parser.parse_args()
    options.commit = options.commit or commit()
    for folder in (options.log, options.out):
        folder.mkdir(parents=True, exist_ok=True)
    for name in options.only.split(","):
        path = options.folder / f"{name}.npz"
        done = (options.log / f"{name}.json").exists() and not options.again
        if options.report or done:
            continue
        if not path.exists():
            print(f"{path} is not there", flush=True)
            continue
        look(name, path, options)
    write_page(CAMERAS, options.log, options.out)


if __name__ == "__main__":
    main()
