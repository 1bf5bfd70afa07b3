"""The sensors of the study: four targets with physics beyond thresholds, and what is trained on instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dase
from dase.effects import EFFECTS
from dase.io.sequence import Sequence
from dase.learning import job
from dase.learning.recorded_target import cut_windows, join_windows
from dase.learning.run import RunSchedule, train_in_folder
from dase.recordings.recording import Recording
from dase.torch import Batch

VIEW = (240, 180)
"""Columns and rows of the targets."""
FRAME_RATE = 40.0
"""Of the targets' recordings [Hz]."""
CALM, FAST = ("shake",), ("shake", "mixed")
"""Regimes of recordings, and of training and tests."""


def sensor_with(**parameters: dict[str, float]) -> dase.Sensor:
    """Return a sensor of effects and their parameters."""
    return dase.Sensor(tuple(EFFECTS[name](**values) for name, values in parameters.items()))


TARGETS: dict[str, dase.Sensor] = {
    "slow": sensor_with(
        bandwidth={"cutoff": 25.0}, threshold={"on": 0.22, "off": 0.25}, mismatch={"spread": 0.1},
    ),
    "noisy": sensor_with(
        threshold={"on": 0.25, "off": 0.2}, mismatch={"spread": 0.2}, leak={"rate": 0.5}, shot={"rate": 6.0},
    ),
    "tired": sensor_with(
        threshold={"on": 0.15, "off": 0.28}, mismatch={"spread": 0.1}, refractory={"period": 8e-3},
    ),
    "all": sensor_with(
        bandwidth={"cutoff": 60.0}, threshold={"on": 0.3, "off": 0.22}, mismatch={"spread": 0.15},
        leak={"rate": 0.3}, shot={"rate": 3.0}, refractory={"period": 3e-3},
    ),
}  # fmt: skip
"""What networks are tested on. Nobody but the kind `true` and the tests sees these numbers."""

START = sensor_with(
    bandwidth={"cutoff": 200.0}, threshold={"on": 0.2, "off": 0.2}, mismatch={"spread": 0.15},
    leak={"rate": 0.1}, shot={"rate": 1.0}, refractory={"period": 1e-3},
)  # fmt: skip
"""From which fits set out: every effect that a user would try, at usual values; the same for all targets."""

KINDS = (
    "esim", "broad", "preset", "tuned", "eventgan", "learned", "learned_paper", "learned_on_fitted", "fitted",
    "true",
)  # fmt: skip
"""What is trained on; the first three do not know their target."""
OF_NO_TARGET = KINDS[:3]
CAMERA = "davis240c"
"""Of the kind `preset`: that of the real excerpts which networks of flow are tested on; no target."""
LEARNED_BY = {
    "tuned": "tune", "eventgan": "gan", "learned": "train", "learned_paper": "train_paper",
    "learned_on_fitted": "train_on_fit", "fitted": "fit",
}  # fmt: skip
"""What is learned from a target's recording, and the task that does so."""
LEARNED_WITH = {"train": "default", "train_paper": "paper", "train_on_fit": "default"}
"""Tasks that do as `dase train` does, and the presets of its recipe."""
LEARNED_AFTER = {"train_on_fit": "fit"}
"""Tasks that another one of the same target comes before."""
WITHOUT_FLOW = ("eventgan",)
"""Kinds that are not trained for flow: windows are few there, and the first has no frame before it."""

FLIPS = dase.torch.Augment(flips=0.5)


@dataclass(frozen=True)
class Training:
    """A sensor to train on, and how it differs from scene to scene.

    Args:
        sensor: As it is, or its middle.
        randomise: As `dase.torch.Stream` takes it.
        augment: As `dase.torch.Stream` takes it.
        remake: Returns the inputs of a batch, where those of the sensor are not taken.
    """

    sensor: dase.Sensor
    randomise: Callable[[np.random.Generator, int], dict[str, Any]] | None = None
    augment: dase.torch.Augment = FLIPS
    remake: Callable[[Batch], torch.Tensor] | None = None


def tuned_thresholds(base: float) -> Callable[[np.random.Generator, int], dict[str, Any]]:
    """Return S2R's thresholds around one that was tuned: the other polarity's is N(1, 0.1) times as large."""

    def draw(rng: np.random.Generator, count: int) -> dict[str, Any]:
        other = base * np.clip(rng.normal(1.0, 0.1, count), 0.3, 3.0)
        first = rng.random(count) < 0.5
        return {"threshold.on": np.where(first, base, other), "threshold.off": np.where(first, other, base)}

    return draw


def broad_thresholds(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """Return thresholds from 0.05 to 2 whose ratio is up to 1.5, as V2V (2025) randomises."""
    level, half = rng.uniform(0.05, 2.0, count), np.sqrt(1.5 ** rng.uniform(-1, 1, count))
    return {"threshold.on": level * half, "threshold.off": level / half}


def plain_sensor(threshold: float) -> dase.Sensor:
    """Return a sensor of thresholds alone."""
    return sensor_with(threshold={"on": threshold, "off": threshold})


@dataclass(frozen=True)
class LearnSettings:
    """How much `train_on` learns from.

    Args:
        steps: Of the recipe; 0 for those of its preset.
        seconds: Of the learning itself [s], which sets the number of steps; None for `steps`.
        windows: Of the recording, evenly chosen.
        window: Duration of each [s], that of `dase train`.
        batch: Scenes of a step; 0 for those of the preset.
    """

    steps: int = 0
    seconds: float | None = None
    windows: int = 400
    window: float = 0.05
    batch: int = 0


@dataclass(frozen=True)
class TargetRecording:
    """What is known of a target: events and 8-bit frames of a camera that is shaken before photographs.

    Args:
        events: As its sensor sends them.
        frames: Linear intensity at FRAME_RATE, uint8, shape (F, H, W).
        times: Of the frames [s], shape (F,).
        rate: Events per pixel and second, the median over pieces of one second.
    """

    events: dase.Events
    frames: np.ndarray
    times: np.ndarray
    rate: float

    def opened(self) -> Recording:
        """Return it as a file of it would be opened."""
        shown = Sequence(self.events, frames=self.frames, frame_times=self.times)
        recording = Recording.of(shown)
        return recording.masked(~recording.hot)


def in_midst(sensor: dase.Sensor) -> dase.Sensor:
    """Return a fitted sensor whose pixels have seen something before a scene begins.

    The phase tells how a recording began and belongs to no camera; fits of before ended with either, by
    chance. Scenes of a training are cut out of time, as are windows that thresholds are learned from: with
    a phase of 0 pixels make too few events in the first of three windows.
    """
    return sensor.with_effect(replace(sensor["threshold"], phase=1.0))


def record_target(target: dase.Sensor, images: str, seconds: float, device: str) -> TargetRecording:
    """Return a recording of a target.

    Args:
        target: Its sensor.
        images: Photographs.
        seconds: Duration [s].
        device: Where it is simulated.
    """
    stream = dase.torch.Stream(
        images, target, batch=1, steps=round(60 * seconds), size=VIEW, regimes=CALM, seed=77, device=device,
        backgrounds=4, objects=12, renew=0,
    )  # fmt: skip
    made = stream.scene(0, 0)
    events = dase.simulate(made.scene, target, seed=made.seed, device=device)
    times = np.arange(0, seconds - 1e-9, 1 / FRAME_RATE)
    frames = np.round(255 * np.clip(made.scene.frames(times), 0, 1)).astype(np.uint8)
    pieces = np.histogram(events.t, np.arange(0, max(seconds, 1) + 0.5))[0] / min(seconds, 1)
    return TargetRecording(events, frames, times, float(np.median(pieces)) / (VIEW[0] * VIEW[1]))


def train_on(
    recorded: TargetRecording, folder: Path, preset: str, device: str, *, known: dase.Sensor | None = None,
    settings: LearnSettings = LearnSettings(), keep_going: Callable[[], None] = lambda: None,
) -> Path:  # fmt: skip
    """Learn thresholds from a recording as `dase train` does, and return the sensor file.

    The recording's windows are both what its events are taken from and the simulator's scenes, as with
    `dase train FILE`.

    Args:
        recorded: Of the target.
        folder: Of the run: sensor file, weights, log.
        preset: Of the recipe.
        device: Where is learned.
        known: What thresholds are learned on top of; None for nothing.
        settings: How much is learned from.
        keep_going: Called now and then; what it raises ends the run.
    """
    # the name of a recording makes it the recipe of recordings; none is opened
    recipe = job.Job(targets=("recording.npz",), preset=preset, steps=settings.steps, backend=device).recipe()
    if settings.batch:
        recipe = replace(recipe, batch=settings.batch)
    windows = cut_windows(recorded.opened(), window=settings.window, most=settings.windows)
    target, scenes = join_windows([windows], window=settings.window, device=device)
    training = job.compose_training(recipe, target, scenes, known)
    schedule = RunSchedule(seconds=settings.seconds, save_every=float("inf"), result_every=1.0)
    size = recorded.events.width, recorded.events.height
    last = train_in_folder(training, folder, schedule=schedule, on_result=lambda row: keep_going())
    return job.write_sensor(folder, training.mean, mu=last["mu"], name=folder.name, size=size, known=known)


def fit_target(recorded: TargetRecording, device: str) -> dase.Sensor:
    """Return the sensor that `dase.fit` makes of a recording, without a look at the target."""
    scene = dase.CameraScene(recorded.frames, recorded.times)
    return dase.fit(recorded.events, START, scene=scene, device=device, seed=1).sensor


def tune_threshold(rate: float, images: str, device: str, *, scenes: int, windows: int) -> float:
    """Return the threshold at which shaken scenes have the rate of a recording, as S2R chooses it.

    Args:
        rate: Events per pixel and second.
        images: Photographs.
        device: Where scenes are simulated.
        scenes: Whose median rate counts.
        windows: Of each, of 1/60 s.
    """

    def rate_of(threshold: float) -> float:
        stream = dase.torch.Stream(
            images, plain_sensor(threshold), batch=scenes, steps=windows, size=VIEW, regimes=CALM, seed=78,
            device=device, represent=dase.CountImage(), backgrounds=8, objects=12, renew=0,
        )  # fmt: skip
        counts = next(iter(stream)).inputs
        each = counts.sum((0, 2, 3, 4)) / (windows / 60 * VIEW[0] * VIEW[1])
        return float(torch.median(each))

    low, high = np.log(0.02), np.log(2.0)
    for _ in range(9):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rate_of(float(np.exp(middle))) > rate else (low, middle)
    return float(np.exp(0.5 * (low + high)))
