"""One simulator in a process of its own; `peers.py` starts it and asks it for runs, one per line."""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import sys
import time
import types
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CLEAN = dict(theta=0.2, sigma=0.0, cutoff=0.0, leak=0.0, shot=0.0, dead=0.0)
NOISY = dict(theta=0.2, sigma=0.05, cutoff=30.0, leak=0.1, shot=5.0, dead=1e-3)
"""v2e's `noisy` with a dead time: thresholds and their spread, corner [Hz], rates [Hz], dead time [s]."""

SETTINGS = {"clean": CLEAN, "noisy": NOISY}
Run = Callable[[], int]


class Clip:
    """The pictures that every simulator gets.

    Args:
        folder: Holds `frames.npy` (uint8, shape (K, H, W)), `times.npy` [s], and the same as `pictures/` and,
            with losses, as `video.avi`.
    """

    def __init__(self, folder: Path):
        self.frames = np.load(folder / "frames.npy")
        self.times = np.load(folder / "times.npy")
        self.files = sorted(str(f) for f in (folder / "pictures").iterdir())
        self.video = folder / "video.avi"
        self.out = folder / "out"
        """Folder for what simulators write."""
        self.moved = (folder / "moved").exists()
        """Whether the pictures are those of `kernels.moving_layers`, which can be made anew."""

    def read_video(self) -> Iterator[tuple[NDArray[np.uint8], float]]:
        """Yield the pictures of the video and their times [s], as simulators without a reader get them."""
        import cv2

        video = cv2.VideoCapture(str(self.video))
        for t in self.times:
            found, picture = video.read()
            if not found:
                raise RuntimeError("the video is shorter than the clip")
            yield cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), float(t)


def dase_runs(clip: Clip, options: argparse.Namespace) -> dict[str, dict[str, Run]]:
    """Return what dase does by task and setting."""
    import dase
    from dase.datasets.generate import record_scene
    from dase.effects.refractory import Refractory
    from dase.effects.threshold import Threshold
    from dase.kernels import launch
    from dase.simulation.sensor_file import load_sensor

    launch.set_threads(options.threads)
    ideal = dase.Sensor((Threshold(on=0.2, off=0.2, phase=0.0),))
    noisy = load_sensor("v2e-noisy").with_effect(Refractory(period=NOISY["dead"], mode="drop"))
    sensors = {"clean": ideal, "noisy": noisy, "as v2e": load_sensor("v2e-clean")}

    def given() -> dase.Scene:
        return dase.VideoScene(clip.frames, clip.times)

    def moved() -> dase.Scene:
        return photograph(clip)

    def emit(scene: Callable[[], dase.Scene], sensor: dase.Sensor) -> Run:
        return lambda: sum(len(part) for part in dase.stream(scene(), sensor))

    def count(scene: Callable[[], dase.Scene], sensor: dase.Sensor) -> Run:
        edges = clip.times[[0, -1]]
        return lambda: int(dase.count(scene(), sensor, edges).sum())

    def write(sensor: dase.Sensor, suffix: str) -> Run:
        def run() -> int:
            scene = dase.open_video(clip.video, gamma=1.0, between="lines")
            return record_scene(scene, sensor, clip.out / f"dase{suffix}").events

        return run

    def convert(sensor: dase.Sensor, suffix: str) -> Run:
        def run() -> int:
            scene = dase.open_video(clip.video, gamma=1.0, between="lines")
            with dase.io.create(clip.out / f"dase_events{suffix}") as writer:
                count = 0
                for part in dase.stream(scene, sensor):
                    writer.events(part)
                    count += len(part)
            return count

        return run

    out = {"dase, pictures given": {n: emit(given, s) for n, s in sensors.items()}}
    out["dase, video to HDF5 with frames"] = {n: write(s, ".h5") for n, s in sensors.items()}
    out["dase, video to HDF5"] = {n: convert(s, ".h5") for n, s in sensors.items()}
    out["dase, video to DAT"] = {n: convert(s, ".dat") for n, s in sensors.items()}
    if clip.moved:
        out["dase, photograph moved"] = {n: emit(moved, s) for n, s in sensors.items()}
        out["dase, photograph moved, counted"] = {n: count(moved, s) for n, s in sensors.items()}
    return out


def photograph(clip: Clip) -> Any:
    """Return the scene that the pictures of the clip were made of, sampled at the times of the clip."""
    from perf.benchmarks import kernels

    samples, height, width = clip.frames.shape
    scene = kernels.moving_layers(0, width, height, samples)
    scene.sample_times = lambda: clip.times
    return scene


def numpy_runs(clip: Clip, options: argparse.Namespace) -> dict[str, dict[str, Run]]:
    """Return what NumPy and OpenCV do, see `pipeline`; they know the ideal sensor alone."""
    from perf.benchmarks import numpy_baseline

    theta, samples = CLEAN["theta"], len(clip.times)

    def emit(of: Any) -> dict[str, Run]:
        return {
            "clean": lambda: len(
                numpy_baseline.events(numpy_baseline.Pictures(of, clip.times), clip.times, theta)[0]
            )
        }

    def plain() -> int:
        return int(sum(n.sum() for n in numpy_baseline.count_plain(pictures(), samples, theta)))

    def tuned() -> int:
        return int(
            sum(n.sum() for n in numpy_baseline.count_tuned(pictures(), samples, theta, options.threads))
        )

    def pictures() -> numpy_baseline.Pictures:
        return numpy_baseline.Pictures(photograph(clip), clip.times)

    def read() -> int:
        return sum(len(picture) < 0 for picture, _ in clip.read_video())

    out = {"NumPy, pictures given": emit(clip.frames), "reading the video alone": {"clean": read}}
    if clip.moved:
        out["NumPy, photograph moved"] = emit(photograph(clip))
        out["NumPy plain, photograph moved, counted"] = {"clean": plain}
        out["NumPy tuned, photograph moved, counted"] = {"clean": tuned}
    return out


def v2e_runs(clip: Clip, options: argparse.Namespace) -> dict[str, dict[str, Run]]:
    """Return what v2e does (`v2ecore.emulator.EventEmulator`); `as v2e` are its own clean settings."""
    sys.path.insert(0, str(options.path))
    import logging

    import torch
    from v2ecore.emulator import EventEmulator

    logging.disable(logging.WARNING)
    torch.set_num_threads(options.threads)

    def run(setting: str) -> int:
        emulator = EventEmulator(device="cpu", seed=1)
        # its clean thresholds vary by 0.02; without any it does not run
        emulator.set_dvs_params("noisy" if setting == "noisy" else "clean")
        if setting == "noisy":
            emulator.refractory_period_s = NOISY["dead"]
        parts = [emulator.generate_events(f, float(t)) for f, t in zip(clip.frames, clip.times, strict=True)]
        return sum(len(part) for part in parts if part is not None)

    def write(setting: str) -> int:
        # as `v2e.py` does it with `--dvs_h5`: pictures of a video one by one, events appended as they come
        emulator = EventEmulator(device="cpu", seed=1, output_folder=str(clip.out), dvs_h5="v2e.h5")
        emulator.set_dvs_params("noisy" if setting == "noisy" else "clean")
        if setting == "noisy":
            emulator.refractory_period_s = NOISY["dead"]
        count = 0
        for frame, t in clip.read_video():
            part = emulator.generate_events(frame, t)
            count += 0 if part is None else len(part)
        emulator.cleanup()
        return count

    return {
        "v2e": {name: lambda name=name: run(name) for name in ("clean", "noisy")},
        "v2e, video to HDF5": {name: lambda name=name: write(name) for name in ("clean", "noisy")},
    }


def find_openeb(path: Path) -> None:
    """Let `metavision_core_ml.video_to_event` be imported, from a checkout or the folder of its Python."""
    inside = path / "sdk/modules/core_ml/python/pypkg"
    folder = (inside if inside.is_dir() else path) / "metavision_core_ml"
    # its packages import the whole SDK, which the simulator does not need
    for name, at in (("metavision_core_ml", folder), ("metavision_core_ml.video_to_event", None)):
        package = types.ModuleType(name)
        package.__path__ = [str(at or folder / "video_to_event")]
        sys.modules[name] = package
    try:
        import_module("metavision_sdk_base")
    except ImportError:
        # a checkout lacks this compiled part, of which the simulator needs the layout of an event
        names, formats = ["x", "y", "p", "t"], ["<u2", "<u2", "<i2", "<i8"]
        event = np.dtype({"names": names, "formats": formats, "offsets": [0, 2, 4, 8], "itemsize": 16})
        sys.modules["metavision_sdk_base"] = types.SimpleNamespace(EventCD=event)


def openeb_runs(clip: Clip, options: argparse.Namespace) -> dict[str, dict[str, Run]]:
    """Return what the simulator of Prophesee's OpenEB does (`metavision_core_ml.video_to_event`)."""
    find_openeb(options.path)
    from metavision_core_ml.video_to_event.simulator import EventSimulator

    def start(setting: dict[str, float]) -> Any:
        height, width = clip.frames.shape[1:]
        return EventSimulator(
            height, width, setting["theta"], setting["theta"], setting["dead"] * 1e6,
            sigma_threshold=setting["sigma"], cutoff_hz=setting["cutoff"],
            leak_rate_hz=setting["leak"], shot_noise_rate_hz=setting["shot"],
        )  # fmt: skip

    def run(setting: dict[str, float]) -> int:
        simulator = start(setting)
        for frame, t in zip(clip.frames, clip.times, strict=True):
            simulator.image_callback(frame, round(t * 1e6))
        return len(simulator.get_events())

    def write(setting: dict[str, float], most: float) -> int:
        # as `viz_video_to_event_simulator.py --no_display -o` does it, but for the picture it draws of events
        simulator, count = start(setting), 0
        with open(clip.out / "openeb.dat", "wb") as file:

            def put() -> int:
                events = simulator.get_events()
                # the records of its `DatWriter`
                packed = np.empty((len(events), 2), np.uint32)
                packed[:, 0] = events["t"]
                xyp = events["x"].astype(np.uint32) | events["y"].astype(np.uint32) << np.uint32(14)
                packed[:, 1] = xyp | events["p"].astype(np.uint32) << np.uint32(28)
                file.write(packed.tobytes())
                return len(events)

            for frame, t in clip.read_video():
                if simulator.image_callback(frame, round(t * 1e6)) >= most:
                    count += put()
                    simulator.flush_events()
            return count + put()

    return {
        "openeb": {name: lambda setting=s: run(setting) for name, s in SETTINGS.items()},
        # its `flush_events` writes zeros over room for 10^8 events, so it is also timed without
        "openeb, video to DAT": {n: lambda setting=s: write(setting, 50000) for n, s in SETTINGS.items()},
        "openeb, video to DAT at the end": {
            n: lambda setting=s: write(setting, math.inf) for n, s in SETTINGS.items()
        },
    }


def esim_runs(clip: Clip, options: argparse.Namespace) -> dict[str, dict[str, Run]]:
    """Return what esim_py does; it reads pictures from files alone, so uncompressed files they are."""
    import esim_py

    times = clip.times.tolist()

    def run(dead: float) -> int:
        simulator = esim_py.EventSimulator(CLEAN["theta"], CLEAN["theta"], dead, 1e-3, True)
        return len(simulator.generateFromStampedImageSequence(clip.files, times))

    def read() -> int:
        return sum(cv2.imread(name, cv2.IMREAD_GRAYSCALE) is None for name in clip.files)

    import cv2

    return {"esim_py": {"clean": lambda: run(0.0)}, "reading esim_py's files alone": {"clean": read}}


PEERS = {
    "dase": dase_runs,
    "numpy": numpy_runs,
    "v2e": v2e_runs,
    "openeb": openeb_runs,
    "esim": esim_runs,
}


def memory() -> int:
    """Return the greatest resident memory since `forget` [bytes]."""
    try:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget() -> None:
    """Begin to look for the greatest memory anew, where the system can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--path", type=Path)
    parser.add_argument("--processor-time", action="store_true")
    options = parser.parse_args()
    clock = time.process_time if options.processor_time else time.perf_counter
    # simulators may print what they like, the answers go where the parent reads
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import cv2

    cv2.setNumThreads(options.threads)
    runs = PEERS[options.peer](Clip(options.clip), options)
    print(json.dumps({task: list(settings) for task, settings in runs.items()}), file=answers, flush=True)
    for line in sys.stdin:
        task, setting = json.loads(line)
        forget()
        before = memory()
        begin = clock()
        events = runs[task][setting]()
        took = clock() - begin
        print(json.dumps(dict(s=took, events=events, peak=memory(), before=before)), file=answers, flush=True)


if __name__ == "__main__":
    main()
