"""What a simulator that knows the frames of a clip alone keeps of a change from one of them to the next.

A pixel that has sent goes on from there (v2e), or it takes the light of its frame for its memory (PIX2NVS),
or all pixels do so at each frame, sent or not (AirSim). The latter two lose what is below a threshold again
and again, and send nothing of what is slow. They are no property of a camera, so the model has them before
anything is searched. Beside a lamp or hot pixels they may only show once these are in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dase.diagnosis.candidates import scout_of
from dase.diagnosis.held_frames import error_once_fitted
from dase.diagnosis.state import DiagnosisTask, SearchPath, with_same_freedom
from dase.effects.high_pass import CHANGES_OF_FRAMES, HighPass
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, refit_work
from dase.fitting.scheduler import run_side_by_side
from dase.probes.distance import LIMITS, Judgement, leaves_nothing
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

EFFECT = HighPass.name


@dataclass(frozen=True)
class FrameMemorySettings:
    """When pixels forget from frame to frame."""

    better: float = 0.6
    """Share of the error of pixels that go on from where they have sent that others leave, at most: of 30
    clips of simulators in which they go on, 0.82 were left at least, and 0.01 to 0.4 of others with little
    else."""


FRAME_MEMORY = FrameMemorySettings()

NOTES = {
    "frames": "each frame of the clip is compared with the one before alone, as by a simulator that knows "
    "these frames alone: no property of a camera, and nothing else is said of it",
    "sending frames": "pixels that send take the light of their frame for their memory, as in a simulator "
    "that knows the frames of the clip alone: no property of a camera, and nothing else is said of it",
}


def with_memory_of_frames(
    sensor: Sensor,
    measurement: Measurement,
    evidence: SplitMeasurement,
    free: Sequence[str] | None,
    *,
    seed: int,
    settings: FrameMemorySettings = FRAME_MEMORY,
) -> tuple[Sensor, list[str]]:
    """Return a sensor whose pixels forget from frame to frame, if that does better, and what is to be noted.

    Args:
        sensor: One with a high-pass of its own is left as it is.
        measurement: Its clip may say what is known of that.
        evidence: The same, split; asked only where its events come in step with frames.
        free: Parameters of the sensor that may be fitted; None for all.
        seed: Of every random number.
        settings: How much better is enough.
    """
    if not evidence.frame_step or EFFECT in sensor:
        return sensor, []
    scene = measurement.scene
    if isinstance(scene, VideoScene) and scene.forgets:
        return sensor.with_effect(_forgetting(scene.forgets)), [NOTES[scene.forgets]]
    few = scout_of(evidence)  # its pixels say enough of so much
    before = error_once_fitted(few, sensor, sensor, free, seed=seed)
    if before <= LIMITS.quiet:
        return sensor, []
    ways = {at: sensor.with_effect(_forgetting(at)) for at in CHANGES_OF_FRAMES}
    errors = {at: error_once_fitted(few, one, sensor, free, seed=seed) for at, one in ways.items()}
    best = min(errors, key=lambda at: errors[at])
    if errors[best] > settings.better * before:
        return sensor, []
    return ways[best], [NOTES[best]]


def forgets_at_frames(
    task: DiagnosisTask,
    path: SearchPath,
    measurement: Measurement,
    model: FittedModel,
    judgement: Judgement,
    settings: FrameMemorySettings = FRAME_MEMORY,
) -> Measurement | None:
    """Return the measurement of pixels that forget from frame to frame, if that shows beside what is certain.

    Args:
        task: What the diagnosis is asked.
        path: What is certain.
        measurement: Of a clip.
        model: The last one.
        judgement: Its held-out error.
        settings: How much better is enough.

    Returns:
        None where they do not, or where it is known.
    """
    scene, sensor = measurement.scene, model.sensor
    if leaves_nothing(judgement) or EFFECT in task.given:
        return None
    if not task.evidence.frame_step or not isinstance(scene, VideoScene):
        return None
    found = [name for name in task.added_to(model) if name in path.certain]
    if not found:
        return None  # nothing has changed since it was asked
    bare = sensor
    for name in set(task.added_to(model)) - set(found):
        bare = bare.without(name)  # it may stand in for what is forgotten
    ways = {"": bare} | {at: bare.with_effect(_forgetting(at)) for at in CHANGES_OF_FRAMES}
    models = [with_same_freedom(way, model, ()) for way in ways.values()]
    evidence = scout_of(task.evidence)
    fits = run_side_by_side([refit_work(evidence, one, seed=task.seed, rounds=1) for one in models])
    errors = {at: task.judge(one, repeats=task.settings.candidates.few_repeats).error
              for at, one in zip(ways, fits, strict=True)}  # fmt: skip
    best = min(errors, key=lambda at: errors[at])
    if not best or errors[best] > settings.better * errors[""]:
        return None
    return replace(measurement, scene=scene.forgetting(best))


def _forgetting(at: str) -> HighPass:
    """Return what forgets all that is left at a frame."""
    whole = max(p.bounds[1] for p in HighPass.parameters() if p.name == "cutoff")
    return HighPass(cutoff=whole, at=at)
