"""All that is random in the scenes of a batch, as a few arrays of numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError, nearest
from dase.scenes.camera_motions import CameraMotions, draw_cameras
from dase.scenes.image_sources import Picture
from dase.scenes.layers import QUANTITIES, Layer, LayerScene, Lighting, Motion
from dase.scenes.scene_motions import SceneSettings, draw_motion_of, regimes_of
from dase.simulation.sensor import Sensor

Randomise = (
    Mapping[str, tuple[float, float]]
    | Callable[[np.random.Generator, int], Mapping[str, NDArray[np.float64]]]
)
"""Ranges of parameters by `effect.parameter`, or a function that draws values (B,) of them."""

BOTH = "threshold"
"""Name for both thresholds at once."""


@dataclass(frozen=True, kw_only=True)
class Augment:
    """What is done to batches beside simulating them, as in S2R's training.

    Args:
        flips: Odds that a scene is mirrored, left to right and top to bottom.
        noise: Standard deviation of normal noise on all numbers of a representation.
        hot: Largest share of hot pixels; that of a scene is drawn uniformly up to it.
        hot_noise: Standard deviation of what a hot pixel has in all windows.
        pause: Odds that a scene stands still from a window on.
        paused: Odds that it still stands in the next window.
    """

    flips: float = 0.0
    noise: float = 0.0
    hot: float = 0.0
    hot_noise: float = 0.1
    pause: float = 0.0
    paused: float = 0.9

    def __post_init__(self) -> None:
        for name in ("flips", "hot", "pause", "paused"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"augment: {name} must lie in [0, 1], got {getattr(self, name)}")
        if not min(self.noise, self.hot_noise) >= 0:
            raise InputError(f"augment: noise must be >= 0, got {min(self.noise, self.hot_noise)}")


S2R = Augment(flips=0.5, noise=0.1, hot=1e-3, pause=0.05)
"""The augmentations of S2R's training of reconstruction networks."""


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """How the scenes of batches are drawn.

    Args:
        batch: Scenes B.
        size: Columns and rows of what is simulated [px].
        view: Columns and rows of the camera [px], of which each scene shows a part of `size`.
        windows: Of a scene.
        window: Duration of each [s].
        regimes: Names of regimes of motion, equally likely.
        speed: All speeds in straight lines are multiplied by this.
        lighting: Share of the scenes whose light changes.
        randomise: Parameters that differ from scene to scene.
        augment: Further changes.
    """

    batch: int
    size: tuple[int, int]
    view: tuple[int, int]
    windows: int
    window: float
    regimes: tuple[str, ...]
    speed: float = 1.0
    lighting: float = 0.0
    randomise: Randomise | None = None
    augment: Augment = Augment()

    @property
    def duration(self) -> float:
        """Of a scene [s]."""
        return self.windows * self.window

    def most_layers(self) -> int:
        """Return how many layers a scene has room for: the background and the most objects of any regime."""
        return 1 + max(int(how.objects[1]) for how, _ in regimes_of(self.regimes))


@dataclass(frozen=True)
class SceneNumbers:
    """B scenes of up to L layers.

    Args:
        ground: Which background of the pool, int32, shape (B,).
        front: Which other texture each layer has, shape (B, L); not looked at for layer 0.
        there: Which layers there are, shape (B, L).
        ends: Straight paths of the layers, shape (B, L, 5, 2), see `CameraMotions`.
        cameras: Motions of the cameras; in a pause everything stands still.
        lighting: Light on each scene, None for full light.
        corner: Column and row of the upper left pixel on the camera, shape (B, 2).
        parameters: Parameter vectors, float32, shape (B, P).
        seeds: Of the sensors, int32, shape (B,).
        flips: Whether a scene is mirrored left to right and top to bottom, shape (B, 2).
    """

    ground: NDArray[np.int32]
    front: NDArray[np.int64]
    there: NDArray[np.bool_]
    ends: NDArray[np.float64]
    cameras: CameraMotions
    lighting: tuple[Lighting | None, ...]
    corner: NDArray[np.int64]
    parameters: NDArray[np.float32]
    seeds: NDArray[np.int32]
    flips: NDArray[np.bool_]

    def layer_scene(
        self, slot: int, plan: ScenePlan, grounds: Sequence[Picture], fronts: Sequence[Picture]
    ) -> LayerScene:
        """Return one of the scenes as `dase.simulate` takes it, whole view and all."""
        camera = self.cameras.motion(slot)
        layers = []
        for n in np.flatnonzero(self.there[slot]):
            picture = fronts[self.front[slot, n]] if n else grounds[self.ground[slot]]
            ends = {
                name: (float(a), float(b))
                for name, (a, b) in zip(QUANTITIES, self.ends[slot, n], strict=True)
            }
            motion = replace(Motion(**ends), pauses=camera.pauses)  # type: ignore[arg-type]
            layers.append(Layer(picture, motion))
        return LayerScene(
            layers, width=plan.view[0], height=plan.view[1], duration=plan.duration, camera=camera,
            lighting=self.lighting[slot],
        )  # fmt: skip

    def places(self, plan: ScenePlan) -> NDArray[np.int32]:
        """Return row-major indices of the pixels on the camera, shape (B, N)."""
        columns = self.corner[:, None, :1] + np.arange(plan.size[0])
        rows = self.corner[:, 1:, None] + np.arange(plan.size[1])[:, None]
        places = rows * plan.view[0] + columns
        return np.ascontiguousarray(places.reshape(plan.batch, -1), np.int32)


def draw_scene_numbers(
    rng: np.random.Generator, plan: ScenePlan, sensor: Sensor, grounds: int, fronts: int
) -> SceneNumbers:
    """Draw the scenes of a batch.

    Args:
        rng: Draws everything.
        plan: How.
        sensor: Whose parameters they start from.
        grounds: Backgrounds in the pool.
        fronts: Other textures in the pool.
    """
    regimes = regimes_of(plan.regimes)
    odds = np.array([share for _, share in regimes])
    kind = rng.choice(len(regimes), size=plan.batch, p=odds / odds.sum())
    hows = [regimes[k][0] for k in kind]
    width, height = plan.view
    looks = SceneSettings(width=width, height=height, window=plan.duration, samples=2, speed=plan.speed)
    motion = draw_motion_of(rng, looks, hows, plan.most_layers())
    ends = np.stack([motion.x, motion.y, motion.angle, motion.scale_x, motion.scale_y], 2)
    cameras = draw_cameras(rng, [how.shake for how in hows], width=width, duration=plan.duration)
    there = motion.there if fronts else motion.there & (np.arange(motion.there.shape[1]) == 0)
    room = np.array(plan.view) - np.array(plan.size)
    parameters = draw_parameters(rng, plan, sensor)
    flips = rng.random((plan.batch, 2)) < plan.augment.flips
    return SceneNumbers(
        ground=rng.integers(grounds, size=plan.batch).astype(np.int32),
        front=rng.integers(max(fronts, 1), size=there.shape),
        there=there,
        ends=ends,
        cameras=_with_pauses(rng, cameras, plan),
        lighting=tuple(_draw_lighting(rng, plan) for _ in range(plan.batch)),
        corner=rng.integers(room + 1, size=(plan.batch, 2)),
        parameters=parameters,
        seeds=rng.integers(1 << 31, size=plan.batch).astype(np.int32),
        flips=flips,
    )


def _draw_lighting(rng: np.random.Generator, plan: ScenePlan) -> Lighting | None:
    """Draw light that sways or is switched: nothing here was taken from a recording."""
    changes = rng.random() < plan.lighting
    stops, frequency = rng.uniform(0.2, 2.0), float(np.exp(rng.uniform(np.log(0.2), np.log(5.0))))
    phase, when = rng.uniform(0, 2 * np.pi), np.sort(rng.uniform(0, plan.duration, 2))
    drop, switched = rng.uniform(0.3, 3.0), rng.random() < 0.3
    if not changes:
        return None
    drops = ((float(when[0]), -drop), (float(when[1]), drop)) if switched else ()
    return Lighting(stops=stops, frequency=frequency, phase=phase, drops=drops)


def _with_pauses(rng: np.random.Generator, cameras: CameraMotions, plan: ScenePlan) -> CameraMotions:
    """Return cameras that stand still in more windows: S2R's pauses, of the world, not of a file."""
    how = plan.augment
    if not how.pause:
        return cameras
    chance = rng.random((plan.batch, plan.windows))
    still = np.zeros((plan.batch, plan.windows + 2), bool)
    for n in range(plan.windows):
        still[:, n + 1] = chance[:, n] < np.where(still[:, n], how.paused, how.pause)
    rows = []
    for b in range(plan.batch):
        turns = np.flatnonzero(np.diff(still[b])).reshape(-1, 2) * plan.window
        rows.append(_union([*cameras.pauses[b].tolist(), *turns.tolist()]))
    most = max(map(len, rows))
    end = plan.duration
    padded = [row + [(end, end)] * (most - len(row)) for row in rows]
    return replace(cameras, pauses=np.array(padded, np.float64).reshape(plan.batch, most, 2))


def _union(spans: list[list[float]]) -> list[tuple[float, float]]:
    """Return spans, one after the other, that cover what any of them covers."""
    out: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        if end <= begin:
            continue
        if out and begin <= out[-1][1]:
            out[-1] = out[-1][0], max(end, out[-1][1])
        else:
            out.append((begin, end))
    return out


def draw_parameters(rng: np.random.Generator, plan: ScenePlan, sensor: Sensor) -> NDArray[np.float32]:
    """Return parameter vectors of the sensors of a batch, shape (B, P).

    Raises:
        InputError: There is no such parameter, or a range is none.
    """
    names = sensor.parameter_names()
    out = np.repeat(sensor.parameters()[None], plan.batch, 0)
    given = plan.randomise or {}
    if callable(given):
        drawn = {name: np.asarray(value, np.float32) for name, value in given(rng, plan.batch).items()}
    else:
        drawn = {name: rng.uniform(*span, plan.batch).astype(np.float32) for name, span in given.items()}
    for name, values in drawn.items():
        places = ["threshold.on", "threshold.off"] if name == BOTH else [name]
        for place in places:
            if place not in names:
                raise InputError(
                    f"randomise: sensor '{sensor.name}' has no parameter '{name}': "
                    f"{nearest(name, [*names, BOTH])}"
                )
            out[:, names.index(place)] = values
    return out


def sensor_of(sensor: Sensor, parameters: NDArray[np.float32]) -> Sensor:
    """Return the sensor with a parameter vector (P,) put in."""
    made = sensor
    for name, value in zip(sensor.parameter_names(), parameters, strict=True):
        effect, parameter = name.split(".")
        if effect == "sensor":
            made = replace(made, log_eps=float(value))
        else:
            made = made.with_effect(replace(made[effect], **{parameter: float(value)}))
    return made
