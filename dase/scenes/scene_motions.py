"""Motions of many random scenes at once: all numbers of a batch are drawn in a few calls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError, nearest
from dase.scenes.random_scenes import MIXED, REGIMES, SHAKEN, Regime

MOTIONS = {
    **REGIMES,
    "shaken": Regime(1, (0, 8), (400.0, 1400.0), (0.0, 60.0), (20.0, 300.0), (0.0, 60.0)),
}
"""Regimes by name: those of `dase.scenes.random_scenes`, and a camera in motion before moving things, so that
most pixels see a change in a short window."""


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """What random scenes look like.

    Args:
        width: Columns [px].
        height: Rows [px].
        window: Duration [s].
        samples: Time samples, the first at 0 and the last at `window`.
        regime: One of `dase.scenes.random_scenes.REGIMES`, `mixed`, or `shaken`.
        speed: All speeds are multiplied by this.
    """

    width: int = 240
    height: int = 240
    window: float = 0.05
    samples: int = 24
    regime: str = "shaken"
    speed: float = 1.0

    def __post_init__(self) -> None:
        if self.width < 16 or self.height < 16:
            raise InputError(f"scenes must be at least 16x16, got {self.width}x{self.height}")
        if self.samples < 2 or not self.window > 0:
            raise InputError(
                f"a window needs 2 samples and more than 0 s, got {self.samples} in {self.window:g} s"
            )
        known = (*REGIMES, MIXED, "shaken")
        if self.regime not in known:
            raise InputError(f"there is no regime '{self.regime}': {nearest(self.regime, known)}")


@dataclass(frozen=True)
class LayerMotions:
    """Motion of the layers of many scenes; arrays of shape (B, L), and (B, L, 2) from begin to end."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    angle: NDArray[np.float64]
    scale_x: NDArray[np.float64]
    scale_y: NDArray[np.float64]
    there: NDArray[np.bool_]

    def texture_maps(
        self, looks: SceneSettings, size: NDArray[np.int32], lead: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return maps from sensor to texture (B, K, L, 2, 3) and boxes (B, L, 4), as `LayerScene` has them.

        Args:
            looks: Size of the sensor and number of samples.
            size: Width and height of the textures [texel], shape (B, L, 2).
            lead: Times of samples before the window, from its begin [s], below 0: layers come from where
                their paths lead back to, of which K then counts the samples, too. None for none.
        """
        before = np.empty(0) if lead is None else lead / looks.window
        share = np.concatenate([before, np.linspace(0, 1, looks.samples)])[None, :, None]

        def at(ends: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(ends[:, None, :, 0] + share * (ends[:, None, :, 1] - ends[:, None, :, 0]))

        x, y, angle, sx, sy = (at(a) for a in (self.x, self.y, self.angle, self.scale_x, self.scale_y))
        # zooming, followed far back, would turn a layer over
        sx, sy = (
            np.maximum(s, 0.5 * ends.min(-1)[:, None]) for s, ends in ((sx, self.scale_x), (sy, self.scale_y))
        )
        unit = size.max(-1).astype(np.float64)
        wide, high = size[:, 0, 0], size[:, 0, 1]
        unit[:, 0] = np.minimum(wide, high * looks.width / looks.height)
        unit = unit[:, None, :]
        c, s = np.cos(angle), np.sin(angle)
        # texel = unit · S⁻¹ R⁻¹ ((pixel - middle) / width - centre) + middle of the texture
        a, b = unit * c / sx / looks.width, unit * s / sx / looks.width
        d, e = -unit * s / sy / looks.width, unit * c / sy / looks.width
        left = x * looks.width + (looks.width - 1) / 2
        top = y * looks.width + (looks.height - 1) / 2
        mid = (size[:, None].astype(np.float64) - 1) / 2
        rows = [a, b, mid[..., 0] - a * left - b * top, d, e, mid[..., 1] - d * left - e * top]
        place = np.stack(rows, -1).reshape(*a.shape, 2, 3)
        # a circle around each layer, over all samples
        reach = np.hypot(*(np.moveaxis(size, -1, 0) / 2 + 1))[:, None] / unit * looks.width
        reach = reach * np.maximum(sx, sy)
        corners = [(left - reach).min(1), (top - reach).min(1), (left + reach).max(1), (top + reach).max(1)]
        box = np.where(self.there[..., None], np.stack(corners, -1), (1e9, 1e9, -1e9, -1e9))
        return place.astype(np.float32), box.astype(np.float32)


def drawn_regimes(looks: SceneSettings) -> list[Regime]:
    """Return the regimes that scenes are drawn from."""
    names = list(REGIMES) if looks.regime == MIXED else [looks.regime]
    return [MOTIONS[name] for name in names]


def most_layers(looks: SceneSettings) -> int:
    """Return how many layers a scene has room for: the background and the most objects of any regime."""
    return 1 + max(int(how.objects[1]) for how in drawn_regimes(looks))


def draw_motion(rng: np.random.Generator, looks: SceneSettings, count: int) -> LayerMotions:
    """Draw the motion of `count` scenes, all at once; see `dase.scenes.random_scenes` for the numbers."""
    hows = drawn_regimes(looks)
    odds = np.array([how.scenes for how in hows], float)
    kind = rng.choice(len(hows), size=count, p=odds / odds.sum())
    return draw_motion_of(rng, looks, [hows[k] for k in kind], most_layers(looks))


def regimes_of(names: Sequence[str]) -> list[tuple[Regime, float]]:
    """Return the regimes that these names stand for and their odds: names are equally likely.

    Raises:
        InputError: There is no such regime, or no name.
    """
    known = MOTIONS | SHAKEN
    found: list[tuple[Regime, float]] = []
    for name in names:
        if name == MIXED:
            total = sum(how.scenes for how in REGIMES.values())
            found += [(how, how.scenes / total / len(names)) for how in REGIMES.values()]
        elif name in known:
            found.append((known[name], 1 / len(names)))
        else:
            raise InputError(f"there is no regime '{name}': {nearest(name, (*known, MIXED))}")
    if not found:
        raise InputError("scenes need at least one regime, got none")
    return found


def draw_motion_of(
    rng: np.random.Generator, looks: SceneSettings, hows: Sequence[Regime], layers: int
) -> LayerMotions:
    """Draw the motions of scenes, each of a regime of its own, with room for so many layers."""
    table = np.array(
        [(*h.objects, *h.speed, *h.spin, *h.background_speed, *h.background_spin) for h in hows], float
    )
    objects = rng.integers(table[:, 0].astype(int), table[:, 1].astype(int) + 1)
    there = np.arange(layers)[None] <= objects[:, None]
    shape = there.shape
    speed = _half_normal(rng, table[:, 2:3], table[:, 3:4], shape)
    speed[:, 0] = rng.uniform(table[:, 6], table[:, 7])
    spin = rng.uniform(table[:, 4:5], table[:, 5:6], shape)
    spin[:, 0] = rng.uniform(table[:, 8], table[:, 9])
    low = np.where(np.arange(shape[1]) == 0, 1.0, 0.2)
    high = np.where(np.arange(shape[1]) == 0, 1.5, 1.2)
    return _straight_paths(rng, looks, looks.speed * speed, spin, low, high, there)


def _straight_paths(
    rng: np.random.Generator,
    looks: SceneSettings,
    speed: NDArray[np.float64],
    spin: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    there: NDArray[np.bool_],
) -> LayerMotions:
    """Return straight paths through uniform points of the middle of the picture at uniform times."""
    shape, window = speed.shape, looks.window
    when = rng.uniform(0, window, shape)
    x = rng.uniform(-0.45, 0.45, shape)
    y = rng.uniform(-0.45, 0.45, shape) * looks.height / looks.width
    heading = rng.uniform(0, 2 * np.pi, shape)
    vx, vy = speed / looks.width * np.cos(heading), speed / looks.width * np.sin(heading)
    angle = rng.uniform(0, 2 * np.pi, shape)
    turn = np.radians(spin) * rng.choice((-1, 1), shape) * window
    # a short window is a piece of S2R's clip, so that it does not zoom faster
    begin = rng.uniform(0, Regime.clip - window, shape) if window < Regime.clip else np.zeros(shape)
    scales = []
    for _ in range(2):
        first, second = rng.uniform(low, high, shape), rng.uniform(low, high, shape)
        ends = [first + (second - first) * t / max(Regime.clip, window) for t in (begin, begin + window)]
        scales.append(np.stack(ends, -1))
    return LayerMotions(
        np.stack([x - vx * when, x + vx * (window - when)], -1),
        np.stack([y - vy * when, y + vy * (window - when)], -1),
        np.stack([angle, angle + turn], -1),
        scales[0],
        scales[1],
        there,
    )


def _half_normal(
    rng: np.random.Generator,
    deviation: NDArray[np.float64],
    most: NDArray[np.float64],
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    """Return half-normal numbers up to `most`, drawn again where they are above it."""
    out = np.abs(rng.normal(size=shape)) * deviation
    # as good as certain to end before: 64 draws all above `most` would need a bound far below the deviation
    for _ in range(64):
        high = out > most
        if not high.any():
            break
        out = np.where(high, np.abs(rng.normal(size=shape)) * deviation, out)
    return np.minimum(out, most)
