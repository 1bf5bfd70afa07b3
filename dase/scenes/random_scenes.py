"""Random scenes: the motion regimes of S2R.

Numbers of objects, speeds, rotations and scales are those of the 281 scene files that Stoffregen et al.
published with Reducing the sim-to-real gap for event cameras, 2020. Their speeds are normally distributed;
the widths here reproduce the published percentiles. Speeds are in px/s whatever the size of the sensor. There
things go straight on; the regime `shake` has a camera that moves as in a hand or on a vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dase.errors import InputError, nearest
from dase.scenes.camera_motions import Shake, draw_cameras
from dase.scenes.image_sources import ImageSource
from dase.scenes.layers import Layer, LayerScene, Motion
from dase.scenes.scene import SamplingSettings


@dataclass(frozen=True)
class Regime:
    """How the layers of a scene move.

    Args:
        scenes: Scenes of this kind among S2R's 281; their shares of `mixed`.
        objects: Least and greatest number of foreground objects.
        speed: Standard deviation of the foreground's half-normal speed, and its cut-off [px/s].
        spin: Least and greatest foreground rotation [°/s].
        background_speed: Least and greatest [px/s].
        background_spin: Least and greatest [°/s].
        clip: Duration of S2R's clips [s], over which a layer goes from its first to its second scale.
        shake: How the camera moves, None where it is at rest.
    """

    scenes: int
    objects: tuple[int, int]
    speed: tuple[float, float]
    spin: tuple[float, float]
    background_speed: tuple[float, float]
    background_spin: tuple[float, float]
    clip: float = 10.0
    shake: Shake | None = None


REGIMES = {
    "background": Regime(15, (0, 0), (0.0, 0.0), (0.0, 0.0), (0.5, 9.4), (0.3, 4.8)),
    "slow": Regime(57, (2, 5), (31.0, 98.0), (0.0, 5.8), (0.6, 14.0), (0.2, 11.0)),
    "medium": Regime(69, (5, 9), (85.0, 268.0), (0.0, 15.0), (5.0, 25.0), (0.0, 15.0)),
    "fast": Regime(70, (5, 19), (340.0, 1386.0), (10.0, 45.0), (5.0, 25.0), (0.0, 15.0)),
    "variety": Regime(70, (10, 29), (598.0, 1961.0), (0.0, 60.0), (0.3, 40.0), (1.0, 44.5)),
}
MIXED = "mixed"
"""Each scene of a regime drawn by its share of S2R's scenes."""

SHAKEN = {
    "shake": Regime(1, (0, 9), (85.0, 268.0), (0.0, 15.0), (0.0, 15.0), (0.0, 11.0), shake=Shake()),
}
"""Regimes with a moving camera, which are no part of `mixed`."""

REGIME_NAMES = (*REGIMES, MIXED, *SHAKEN)


def draw_scene(
    rng: np.random.Generator,
    images: ImageSource,
    regime: str,
    *,
    width: int,
    height: int,
    duration: float,
    travel: float = SamplingSettings.travel,
) -> LayerScene:
    """Return a random scene of a regime.

    Args:
        rng: Draws everything.
        images: Textures.
        regime: One of `REGIME_NAMES`.
        width: Columns [px].
        height: Rows [px].
        duration: Length [s].
        travel: Share of a pixel that anything moves between two samples; the shortest time between them goes
            with it.

    Raises:
        InputError: There is no such regime.
    """
    if regime == MIXED:
        shares = np.array([r.scenes for r in REGIMES.values()], float)
        regime = str(rng.choice(list(REGIMES), p=shares / shares.sum()))
    known = REGIMES | SHAKEN
    if regime not in known:
        raise InputError(f"there is no regime '{regime}': {nearest(regime, REGIME_NAMES)}")
    how = known[regime]
    layers = [_draw_background(rng, images, how, width, height, duration)]
    for _ in range(rng.integers(how.objects[0], how.objects[1] + 1)):
        layers.append(_draw_foreground(rng, images, how, width, height, duration))
    camera = None
    if how.shake is not None:
        camera = draw_cameras(rng, [how.shake], width=width, duration=duration).motion(0)
        # in a pause everything stands still
        layers = [replace(one, motion=replace(one.motion, pauses=camera.pauses)) for one in layers]
    return LayerScene(
        layers, width=width, height=height, duration=duration, camera=camera, travel=travel,
        shortest=SamplingSettings.shortest * travel / SamplingSettings.travel,
    )  # fmt: skip


def draw_speed(rng: np.random.Generator, deviation: float, most: float) -> float:
    """Return a half-normal speed below `most` [px/s]."""
    while True:
        speed = abs(rng.normal(0.0, deviation))
        if speed <= most:
            return float(speed)


def _draw_background(
    rng: np.random.Generator, images: ImageSource, how: Regime, width: int, height: int, duration: float
) -> Layer:
    speed = rng.uniform(*how.background_speed)
    motion = _draw_motion(rng, speed, how.background_spin, (1.0, 1.5), width, height, duration)
    return Layer(images.background(rng), motion)


def _draw_foreground(
    rng: np.random.Generator, images: ImageSource, how: Regime, width: int, height: int, duration: float
) -> Layer:
    speed = draw_speed(rng, *how.speed)
    return Layer(
        images.foreground(rng), _draw_motion(rng, speed, how.spin, (0.2, 1.2), width, height, duration)
    )


def _draw_motion(
    rng: np.random.Generator,
    speed: float,
    spin: tuple[float, float],
    scale: tuple[float, float],
    width: int,
    height: int,
    duration: float,
) -> Motion:
    """Return a straight path through a uniform point of the middle of the picture at a uniform time."""
    at = rng.uniform(0, duration)
    x, y = rng.uniform(-0.45, 0.45, 2) * (1, height / width)
    heading = rng.uniform(0, 2 * np.pi)
    vx, vy = speed / width * np.cos(heading), speed / width * np.sin(heading)
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.radians(rng.uniform(*spin)) * rng.choice((-1, 1)) * duration
    # a short scene is a piece of S2R's clip, so that it does not zoom faster
    clip = max(Regime.clip, duration)
    begin = rng.uniform(0, clip - duration) if clip > duration else 0.0
    first, second = rng.uniform(*scale, (2, 2))
    begin_scale, end_scale = (first + (second - first) * t / clip for t in (begin, begin + duration))
    return Motion(
        x=(float(x - vx * at), float(x + vx * (duration - at))),
        y=(float(y - vy * at), float(y + vy * (duration - at))),
        angle=(float(angle), float(angle + turn)),
        scale_x=(float(begin_scale[0]), float(end_scale[0])),
        scale_y=(float(begin_scale[1]), float(end_scale[1])),
    )
