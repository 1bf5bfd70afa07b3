"""From recordings to a sensor file: the work behind `dase train`."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from dase.effects.mismatch import Mismatch
from dase.effects.threshold import Threshold
from dase.errors import InputError, checked_seed, nearest
from dase.files.atomic_file import replacing
from dase.files.text_files import parse_json, read_text_file
from dase.learning import distributed
from dase.learning.adversarial import AdversarialObjective, AdversarialSettings, PatchHash
from dase.learning.baselines import RandomThresholds, esim_thresholds, match_event_rate
from dase.learning.known_physics import KnownPhysics, with_learned_thresholds
from dase.learning.moment_objective import MomentObjective
from dase.learning.random_streams import TrainingDraw, TrainingStream
from dase.learning.recipe import Recipe
from dase.learning.recorded_target import ReplayedScenes, open_target
from dase.learning.run import RunFile
from dase.learning.scene_batches import Scenery, SceneSettings, middle_intensity, send_words
from dase.learning.targets import FiniteTarget, Target, Truth, draw_noise, simulate_counts, store_pairs
from dase.learning.training import Objective, Training, make_network
from dase.networks.threshold_network import NetworkShape, ThresholdNet
from dase.networks.weights_file import save_net
from dase.scenes import image_sources
from dase.scenes.scene import LOG_EPS
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import dump_sensor, load_sensor, read_presets
from dase.simulation.simulate import count


class JobFile(StrEnum):
    """Files in the folder of a job, beside those of its training."""

    JOB = "job.json"
    SENSOR = "sensor.toml"
    WEIGHTS = "learned.safetensors"
    EXAMPLES = "examples.npz"


PRESETS: dict[str, Recipe] = {
    "default": Recipe(
        objective="moments", steps=600, rate=1e-4, anchor=1.0,
        network=NetworkShape(table=(6, 5), split=True),
    ),
    "tiny": Recipe(
        objective="moments", steps=120, warmup=20, batch=4, rate=1e-4, anchor=1.0, ramp=20,
        network=NetworkShape(channels=8, depth=2, table=(6, 5), split=True),
    ),
    "paper": Recipe(
        objective="wgan", steps=20_000, warmup=0, batch=48, optimizer="adabelief", rate=4e-4,
        rate_scalars=4e-4, anchor=0.0, average=0.0, surrogate="interval", network=NetworkShape(literal=True),
        adversarial=AdversarialSettings(
            critic_rate=4e-4, critic_optimizer="adabelief", critic_cosine=True, steepness=1.0,
            plain_counts=True, hash=PatchHash(contrast_from="events"),
        ),
    ),
}  # fmt: skip
"""Recipes by name. `default` is the best found, `tiny` for a CPU; `paper` is the paper's setting;
the penalty is that of WGAN-GP, where the paper tells none."""

SHORTEST_STEP = 1e-3
"""δ of Eq. 5: however fast things move, its samples do not follow each other faster [s]."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a run learns from, and what that was learned with.

    Args:
        targets: Recordings, or one sensor file or preset.
        images: Textures of the simulator's scenes, as `dase.scenes.image_sources.open_images` takes them;
            `frames` for the windows of the recordings themselves; "" for `frames`, or `builtin` if there are
            none.
        preset: One of `PRESETS`.
        objective: `moments`, `wgan`, or "" for that of the preset.
        window: Duration of a window [s].
        size: Columns and rows of scenes of textures [px].
        sequences: Simulated by a sensor file as the target.
        pattern: Whether to learn an offset for every column and row.
        steps: Generator steps; 0 for those of the preset.
        seed: Of everything random.
        backend: `cpu` or `cuda`.
        begin: Time of the recordings from which on is learned [s]; None for their begin.
        end: Time at which learning stops [s]; None for their end.
        region: First column and row, columns and rows of what is learned from; None for all pixels.
        sensor: Preset or sensor file of what is known of the camera beside its thresholds; "" for nothing.
        samples: Of the scenes of textures in a window; 0 for those of the preset: 24, 12 with `tiny`, and
            with `paper` one in SHORTEST_STEP, which Eq. 5 never asks more than.
    """

    targets: tuple[str, ...]
    images: str = ""
    preset: str = "default"
    objective: Literal["", "moments", "wgan"] = ""
    window: float = 0.05
    size: tuple[int, int] | None = None
    sequences: int = 300
    pattern: bool = False
    steps: int = 0
    seed: int = 0
    backend: str = "cpu"
    begin: float | None = None
    end: float | None = None
    region: tuple[int, int, int, int] | None = None
    sensor: str = ""
    samples: int = 0

    def __post_init__(self) -> None:
        if not self.images:
            object.__setattr__(
                self, "images", "builtin" if self.targets and self.targets_sensor else "frames"
            )
        checked_seed(self.seed)
        if self.preset not in PRESETS:
            raise InputError(f"there is no preset '{self.preset}': {nearest(self.preset, PRESETS)}")
        if self.objective not in ("", "moments", "wgan"):
            raise InputError(f"objective must be moments or wgan, got '{self.objective}'")
        if not np.isfinite(self.window) or self.window <= 0:
            raise InputError(f"window must be a number > 0 s, got {self.window:g}")
        if self.steps < 0 or self.sequences < 5:
            raise InputError(f"steps must be >= 0 and sequences >= 5, got {self.steps} and {self.sequences}")
        if self.samples != 0 and not 2 <= self.samples <= 4096:
            raise InputError(f"samples must lie in 2 to 4096, or be 0, got {self.samples}")
        if not self.targets:
            raise InputError("name at least one recording, or a sensor file")
        if self.targets_sensor and (self.begin, self.end, self.region) != (None, None, None):
            raise InputError("a part of time or of the pixels is that of a recording; a sensor file has none")
        if self.backend.startswith("cuda") and not torch.cuda.is_available():
            raise InputError(f"device '{self.backend}' needs an NVIDIA GPU that PyTorch can use; use 'cpu'")

    @property
    def targets_sensor(self) -> bool:
        """Whether the target is a sensor file."""
        first = self.targets[0]
        return first in read_presets() or first.endswith(".toml")

    def recipe(self) -> Recipe:
        """Return how to learn."""
        recipe = PRESETS[self.preset]
        # small patches learn best; a tiny scene has too few of them for so many classes
        how = PatchHash(size=8)
        if self.preset == "tiny":
            how = PatchHash(size=16, orientations=8, coherence=1)
        if self.objective == "wgan" and recipe.objective != "wgan":
            recipe = replace(
                recipe, objective="wgan", anchor=5.0, steps=600 if self.preset == "tiny" else 3000, ramp=100,
                warmup=50, adversarial=AdversarialSettings(hash=how),
            )  # fmt: skip
        elif self.objective:
            recipe = replace(recipe, objective=self.objective)
        if not self.targets_sensor:
            # by about so much the moments of a recording differ for what its frames do not show
            recipe = replace(recipe, moments=replace(recipe.moments, doubt=0.2))
        return replace(recipe, seed=self.seed, steps=self.steps or recipe.steps)

    def scene_settings(self) -> SceneSettings:
        """Return what scenes of textures look like."""
        small = self.preset == "tiny"
        width, height = self.size or ((96, 96) if small else (240, 240))
        samples = 12 if small else 24
        if self.preset == "paper":
            samples = 1 + math.ceil(self.window / SHORTEST_STEP - 1e-6)
        return SceneSettings(
            width=width, height=height, window=self.window, samples=self.samples or samples, regime="mixed"
        )

    def text(self) -> str:
        """Return the job as JSON."""
        return json.dumps(asdict(self), indent=1)


def open_training(
    job: Job, *, progress: Callable[[str, int, int], None] = lambda what, done, total: None
) -> Training:
    """Open what a job names and return the run, at its beginning.

    Args:
        job: What to learn from.
        progress: Told what is being opened, how much of it is done, and of how much.

    Raises:
        InputError: Something is missing, damaged, or does not fit.
    """
    target: Target
    if job.targets_sensor:
        if len(job.targets) > 1:
            raise InputError(f"one sensor file is one target, got {len(job.targets)}")
        looks = job.scene_settings()
        _check_patches(job, looks)  # before the work of making textures
        scenery = _textured_scenery(job, looks)
        target = simulate_target(
            load_sensor(job.targets[0]), scenery, job.sequences, seed=job.seed, backend=job.backend,
            progress=lambda done, total: progress("simulating the target", done, total),
        )  # fmt: skip
    else:
        target, scenery = _open_recorded(job, progress)
        _check_patches(job, scenery.scene_settings)
    recipe = job.recipe()
    if job.pattern:
        size = scenery.scene_settings.width, scenery.scene_settings.height
        recipe = replace(recipe, network=replace(recipe.network, pattern=size))
    return compose_training(recipe, target, scenery, load_sensor(job.sensor) if job.sensor else None)


def _check_patches(job: Job, looks: SceneSettings) -> None:
    """Raise InputError where not one patch fits on the sensor."""
    recipe = job.recipe()
    size = recipe.adversarial.hash.size
    if recipe.objective == "wgan" and min(looks.width, looks.height) < size:
        raise InputError(f"patches are {size} px wide, the sensor {looks.width}x{looks.height}")


def compose_training(
    recipe: Recipe, target: Target, scenery: Scenery, sensor: Sensor | None = None
) -> Training:
    """Return a run at its beginning: the loop with a new network and the objective that the recipe names.

    Args:
        recipe: How to learn.
        target: What to become like.
        scenery: Draws the simulator's scenes, on the device that learns.
        sensor: What is known of the camera beside its thresholds; None for nothing.
    """
    physics = None
    if sensor is not None:
        # processes differ as their scenes do
        physics = KnownPhysics(
            sensor, scenery.scene_settings, lead=scenery.lead, batch=recipe.batch, device=scenery.device,
            seed=TrainingStream.KNOWN_PHYSICS.seed(recipe.seed, distributed.process_rank()),
        )  # fmt: skip
    net = make_network(recipe, scenery.device)
    objective: Objective
    if recipe.objective == "moments":
        objective = MomentObjective(recipe.moments, net, scenes=target.scenes, trains_network=recipe.rate > 0)
    else:
        objective = AdversarialObjective(
            recipe.adversarial, device=scenery.device, seed=TrainingStream.CRITICS.seed(recipe.seed)
        )
    return Training(recipe, net, objective, target, scenery, physics)


def _textured_scenery(job: Job, looks: SceneSettings, lead: NDArray[np.float64] | None = None) -> Scenery:
    if job.images == "frames":
        raise InputError("images: frames are those of recordings; a sensor file has none", argument="images")
    source = image_sources.open_images(job.images)
    small = job.preset == "tiny"
    # a scene shows ten objects, so few of them make few different scenes, unlike the target's
    backgrounds = 24 if small else 96
    return Scenery(
        source, looks, device=job.backend, seed=job.seed, backgrounds=backgrounds, objects=8 * backgrounds,
        lead=lead,
    )  # fmt: skip


def _open_recorded(job: Job, progress: Callable[[str, int, int], None]) -> tuple[Target, Scenery]:
    target, scenery = open_target(
        [Path(name) for name in job.targets],
        window=job.window,
        samples=12 if job.preset == "tiny" else 16,
        begin=job.begin,
        end=job.end,
        region=job.region,
        device=job.backend,
        progress=lambda done, total: progress("reading the recordings", done, total),
    )
    if job.images == "frames":
        return target, scenery
    looks = replace(
        job.scene_settings(), width=scenery.scene_settings.width, height=scenery.scene_settings.height
    )
    # a camera's pixels come to a window with a past
    return target, _textured_scenery(job, looks, scenery.lead)


def simulate_target(
    sensor: Sensor,
    scenery: Scenery,
    sequences: int,
    *,
    seed: int = 0,
    backend: str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FiniteTarget:
    """Simulate sequences with a sensor, as the target of the synthetic experiment.

    Its thresholds are known where it has no effect but `threshold` and `mismatch`.
    """
    rng = TrainingDraw.SIMULATED_TARGET.generator(seed)
    looks = scenery.scene_settings
    times = np.linspace(0, looks.window, looks.samples)
    grey, counts = [], []
    for n in range(sequences):
        log = scenery.draw(rng, 1)
        frames = torch.exp(log[0]).cpu().numpy() - np.float32(LOG_EPS)
        scene = VideoScene(np.clip(frames, 0, 1), times)
        found = count(scene, sensor, (-1.0, looks.window), seed=int(rng.integers(2**31)), device=backend)
        counts.append(torch.from_numpy(found[0, 0].reshape(2, looks.height, looks.width)))
        grey.append(middle_intensity(log)[0].cpu())
        progress(n + 1, sequences)
    pairs = store_pairs(torch.stack(grey), torch.stack(counts), backend)
    return FiniteTarget(pairs, truth=_true_thresholds(sensor))


def _true_thresholds(sensor: Sensor) -> Truth | None:
    """Return the thresholds of a sensor, None where other effects change what they mean."""
    known = {"threshold", "mismatch"}
    if any(effect.name not in known and not effect.is_off() for effect in sensor.effects):
        return None
    threshold = sensor["threshold"]
    assert isinstance(threshold, Threshold)
    both = [threshold.off, threshold.on]
    spread = max((effect.spread for effect in sensor.effects if isinstance(effect, Mismatch)), default=0.0)

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mu = torch.tensor(both, device=grey.device).view(1, 2, 1, 1).expand(len(grey), 2, *grey.shape[1:])
        return mu, max(spread, 1e-3) * mu

    return truth


def record_job(job: Job, out: Path, *, resume: bool) -> None:
    """Leave the record of a job in its folder; raises InputError where another one has a checkpoint there."""
    record = out / JobFile.JOB
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} must be a folder, but it is a file")
    if resume and not record.is_file():
        raise InputError(f"{out} holds no run to resume")
    if resume and read_text_file(record, "the record", 1 << 24) != job.text():
        raise InputError(f"{out} was begun with other options (see {record}); to resume takes the same ones")
    if not resume and (out / RunFile.CHECKPOINT).exists():
        raise InputError(f"{out} already holds a run; resume it, or give another folder", argument="resume")
    out.mkdir(parents=True, exist_ok=True)
    with replacing(record) as temporary:
        temporary.write_text(job.text(), "utf-8")


def read_job(out: Path) -> Job:
    """Return the job of a run; raises InputError where there is none."""
    record = out / JobFile.JOB
    if not record.is_file():
        raise InputError(f"{out} holds no training run: {JobFile.JOB} is missing")
    table = parse_json(read_text_file(record, "the record", 1 << 24), str(record))
    try:
        table["targets"] = tuple(table["targets"])
        for name in ("size", "region"):
            table[name] = None if table[name] is None else tuple(table[name])
        return Job(**table)
    except (TypeError, KeyError) as error:
        raise InputError(f"{record} is no record of a training run: {error}") from error


@torch.no_grad()
def write_sensor(
    out: Path, net: ThresholdNet, *, mu: float, name: str, size: tuple[int, int] | None = None,
    known: Sensor | None = None,
) -> Path:  # fmt: skip
    """Write what was learned as a sensor file with its weights beside it; return its path.

    Args:
        out: Folder.
        net: What was learned.
        mu: Typical mean threshold [log intensity], which becomes the level that the maps are relative to.
        name: Of the sensor.
        size: Columns and rows of the camera [px], if it is one.
        known: What the thresholds were learned on top of; None for nothing.
    """
    net = net.with_level(mu)
    level, ratio = float(net.level[0].exp()), float(net.asymmetry.exp())
    on, off = (float(np.clip(level * ratio**share, 0.01, 10.0)) for share in (0.5, -0.5))
    save_net(out / JobFile.WEIGHTS, net)
    learned = with_learned_thresholds(known or Sensor(), on=on, off=off, weights=JobFile.WEIGHTS.value)
    sensor = replace(learned, name=name, size=size or learned.size)
    with replacing(out / JobFile.SENSOR) as temporary:
        temporary.write_text(dump_sensor(sensor), "utf-8")
    return out / JobFile.SENSOR


@torch.no_grad()
def write_examples(out: Path, training: Training, *, scenes: int = 3, seed: int = 0) -> None:
    """Write what `dase show` draws: some scenes, their events of both sides, and the learned maps.

    The events of the target are those of the same scenes where it saw them, else of others.
    """
    scenery, net = training.scenery, training.mean
    rng, generator = np.random.default_rng(seed), torch.Generator(scenery.device).manual_seed(seed)
    if isinstance(scenery, ReplayedScenes) and isinstance(training.target, FiniteTarget):
        busy = training.target.recorded.counts.float().sum((1, 2, 3))
        index = torch.sort(torch.topk(busy, min(4 * scenes, len(busy))).indices).values
        index = index[:: max(len(index) // scenes, 1)][:scenes]
        numbers, real = index.int(), training.target.recorded.select(index)
    else:
        numbers = send_words(scenery.draw_numbers(rng, scenes), scenery.device)
        real = training.target.draw(rng, scenes)
    log, lead = scenery.render(numbers, scenes), len(scenery.lead)
    grey = middle_intensity(log, lead)
    maps = net(grey)
    mu, sigma = maps.by_polarity()
    counts = simulate_counts(log, mu, sigma, draw_noise(log, generator, lead))
    if training.physics is not None:
        known = scenery.known(numbers, scenes)
        counts = training.physics.with_batch(len(log), seed).count(log, maps, known)
    arrays = dict(
        grey=grey, real_grey=real.grey, real=real.counts, simulated=counts, mu=maps.mu, sigma=maps.sigma
    )
    with replacing(out / JobFile.EXAMPLES) as temporary:
        np.savez_compressed(temporary, **{name: value.cpu().numpy() for name, value in arrays.items()})


def make_baseline(
    kind: Literal["esim", "rate", "random"], target: Target, scenery: Scenery, *, seed: int = 0
) -> Any:
    """Return thresholds without learning, see `dase.learning.baselines`."""
    if kind == "esim":
        return esim_thresholds().to(scenery.device)
    if kind == "random":
        return RandomThresholds(seed)
    pairs = (
        target.recorded if isinstance(target, FiniteTarget) else target.draw(np.random.default_rng(seed), 96)
    )
    return match_event_rate(pairs, scenery, seed=seed).to(scenery.device)
