"""How far statistics of a right model may be off because the scene between frames is only guessed.

Nobody knows the light between two frames of a camera, but what half of the frames would have made of it can
be seen: the model's own events over the scene as it is are compared with the model over the scene between
every second frame. What that differs by, beyond its sampling error, is what a scene between frames is worth.
A share of it is added to what each statistic may be off by: with all frames the gaps are half as long.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.fitting.data_split import SplitMeasurement, make_subset
from dase.fitting.model import FittedModel
from dase.fitting.subset import CalibratedSubset, PixelSubset
from dase.probes.random_streams import SimulationStream
from dase.probes.statistics import LAYOUT
from dase.probes.stimulus import MASKED, STIMULUS, Stimulus, light_of, sort_into_cells
from dase.probes.timestamp_patterns import TimestampStructure
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene
from dase.simulation.simulate import simulate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneDoubtSettings:
    """How much of what half the frames make is added."""

    share: float = 0.5
    """Of what the statistics differ by with half of the frames, so that plain sensors of made scenes count
    as right, see `perf/experiments/scene_doubt`."""

    fewest_frames: int = 4
    """Frames without which half of them are no scene."""

    repeats: int = 24
    """Simulations of the model over the scene between half of the frames."""


SCENE_DOUBT = SceneDoubtSettings()


def is_guessed(scene: Scene, settings: SceneDoubtSettings = SCENE_DOUBT) -> bool:
    """Whether the light between the frames of a scene is not known at the steps of a comparison."""
    if not isinstance(scene, CameraScene) or len(scene) < settings.fewest_frames:
        return False
    return float(np.median(np.diff(scene.times))) > STIMULUS.coarsest_step


def with_scene_doubt(
    evidence: SplitMeasurement,
    scene: CameraScene,
    model: FittedModel,
    *,
    seed: int,
    settings: SceneDoubtSettings = SCENE_DOUBT,
) -> SplitMeasurement:
    """Return a measurement whose statistics may be off by what the scene is not known to.

    Args:
        evidence: The measurement.
        scene: What it is of.
        model: A model of the camera, fitted.
        seed: Of every random number.
        settings: How much is added.
    """
    thinned = scene.every(2)

    def doubted(part: PixelSubset) -> PixelSubset:
        off = _differences(part, thinned, evidence, model, seed, settings)
        return (
            part
            if off is None
            else replace(part, doubt=settings.share * off[0], drift=settings.share * off[1])
        )

    return replace(
        evidence,
        train=doubted(evidence.train),
        held=doubted(evidence.held),
        report=doubted(evidence.report),
        scout=doubted(evidence.scout),
    )


def _differences(
    part: PixelSubset,
    thinned: CameraScene,
    evidence: SplitMeasurement,
    model: FittedModel,
    seed: int,
    settings: SceneDoubtSettings,
) -> tuple[Array, Array] | None:
    """Return how far off the model is over half of the frames, beyond chance and with its sign, (J,) each."""
    seen = part.trials.stimulus
    events = _own_events(seen, model, SimulationStream.SCENE_DOUBT.seed(seed))
    times = evidence.when[: seen.grid.steps]
    inside = np.clip(times, thinned.times[0], thinned.times[-1])
    light = light_of(thinned, inside, seen.pixels)
    good = thinned.is_trusted(times, seen.pixels).T & (seen.cell != MASKED)
    good[:, 1:] &= good[:, :-1]
    cell = sort_into_cells(light, seen.grid.step, evidence.bands, seen.log_eps)
    cell[~good] = MASKED
    cell[:, 0] = MASKED
    if not len(events) or not np.any(cell != MASKED):
        return None
    other = Stimulus(
        seen.pixels, seen.width, seen.height, seen.grid, light, cell, seen.log_eps, seen.device, True
    )
    subset = make_subset(
        other, events, part.frame.first, TimestampStructure(), highest_rate=part.trials.highest_rate
    )
    subset = replace(subset, frame=replace(subset.frame, peak=part.frame.peak))
    judged = model.calibrate(
        subset, repeats=settings.repeats, seed=SimulationStream.SCENE_DOUBT.seed(seed, 1)
    )
    off = np.where(judged.seen.used, judged.repeats.mean(0) - judged.seen.target, 0.0)
    return misfit_beyond_chance(judged), off


def _own_events(seen: Stimulus, model: FittedModel, seed: int) -> Events:
    """Return the events that a model sends of the light of some pixels, at the places of these pixels."""
    # the pixels in one row: each knows of its own light alone
    row = VideoScene(np.ascontiguousarray(seen.intensity.T[:, None, :]), seen.grid.times)
    made = simulate(row, replace(model.sensor, size=None), seed=seed)
    place = seen.pixels[made.x]
    x, y = (place % seen.width).astype(np.uint16), (place // seen.width).astype(np.uint16)
    return Events(made.t, x, y, made.p, seen.width, seen.height)


def misfit_beyond_chance(judged: CalibratedSubset) -> Array:
    """Return how far each statistic of a model is off beyond its sampling error, shape (J,).

    Half of it, in squares, is its own, half the mean of its family: a statistic may be right by chance where
    its kin are not.

    Args:
        judged: With the model as its present one.
    """
    scale = judged.seen
    z = scale.z(judged.repeats.mean(0))
    square = np.maximum(z * z - 1.0, 0.0)
    for part in LAYOUT.values():
        used = scale.used[part]
        family = float(square[part][used].mean()) if used.any() else 0.0
        square[part] = 0.5 * square[part] + 0.5 * family
    out: Array = np.sqrt(square) * scale.sigma
    return out
