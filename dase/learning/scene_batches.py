"""Random moving scenes for training, rendered by the batch on the device that learns.

The scenes are those of `dase.scenes.random_scenes` (S2R's statistics of objects, speeds, rotations and
scales), but their textures are drawn once, into a pool that stays on the device; each step then costs a few
numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dase.errors import InputError, nearest
from dase.kernels import autograd_training as bridge
from dase.scenes import image_sources
from dase.scenes.random_scenes import MIXED, REGIME_NAMES, REGIMES, Regime
from dase.scenes.scene import LOG_EPS

BACKGROUND = (320, 480)
"""Rows and columns of the backgrounds in the pool [texel]."""

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
        regime: One of `dase.scenes.random_scenes.REGIME_NAMES`, or `shaken`.
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
        known = (*REGIME_NAMES, "shaken")
        if self.regime not in known:
            raise InputError(f"there is no regime '{self.regime}': {nearest(self.regime, known)}")


class Scenery:
    """A pool of textures on a device, and random scenes made of them.

    Args:
        source: Textures.
        looks: What scenes look like.
        device: PyTorch device.
        seed: Draws the pool.
        backgrounds: Textures in the pool for backgrounds.
        objects: Textures in the pool for things in front.
    """

    def __init__(
        self,
        source: image_sources.ImageSource,
        looks: SceneSettings,
        *,
        device: str | torch.device = "cpu",
        seed: int = 0,
        backgrounds: int = 48,
        objects: int = 96,
    ):
        self.scene_settings, self.device = looks, torch.device(device)
        rng = np.random.default_rng([seed, 0])
        grounds = [_fit_background(source.background(rng).grey) for _ in range(backgrounds)]
        self._fill(grounds, [source.foreground(rng) for _ in range(objects)])

    def _fill(self, grounds: list[NDArray[np.float32]], fronts: list[image_sources.Picture]) -> None:
        flat, start, size, total = [], [], [], 0
        for front in fronts:
            alpha = np.ones_like(front.grey) if front.alpha is None else front.alpha
            flat.append(np.stack([front.grey * alpha, alpha], -1).reshape(-1, 2).astype(np.float32))
            start.append(total)
            size.append(front.grey.shape[::-1])
            total += front.grey.size
        # intensities of layers in front are stored times their alpha, as compositing wants them; the last
        # texture is one transparent texel, for the layers that a scene lacks
        self.grey = torch.from_numpy(np.stack(grounds).reshape(len(grounds), -1)).to(self.device)
        self.texels = torch.from_numpy(np.concatenate([*flat, np.zeros((1, 2), np.float32)])).to(self.device)
        self.start = np.array([*start, total], np.int32)
        self.size = np.array([*size, (1, 1)], np.int32)

    def with_looks(self, looks: SceneSettings) -> Scenery:
        """Return scenery of the same textures."""
        other = object.__new__(Scenery)
        other.__dict__.update(self.__dict__, looks=looks)
        return other

    def split(self, share: float) -> tuple[Scenery, Scenery]:
        """Return two pools without a texture in common; the first gets `share` of the backgrounds."""
        cut = int(round(share * len(self.grey)))
        first, second = self.with_looks(self.scene_settings), self.with_looks(replace(self.scene_settings))
        first.grey, second.grey = self.grey[:cut].contiguous(), self.grey[cut:].contiguous()
        cut = int(round(share * (len(self.size) - 1)))
        # the last one is empty
        first.start, first.size = self.start[[*range(cut), -1]], self.size[[*range(cut), -1]]
        second.start, second.size = self.start[cut:], self.size[cut:]
        return first, second

    def draw(self, rng: np.random.Generator, count: int) -> torch.Tensor:
        """Return log intensities of `count` random scenes, shape (count, samples, height, width)."""
        return self.render(send_words(self.draw_numbers(rng, count), self.device), count)

    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Draw `count` scenes; return all that is random in them for `render`, as words of 4 bytes, (N,)."""
        looks = self.scene_settings
        motion = draw_motion(rng, looks, count)
        layers = motion.x.shape[1]
        front = rng.integers(len(self.size) - 1, size=(count, layers)) if len(self.size) > 1 else 0
        which = np.where(motion.there, front, len(self.size) - 1)
        size = self.size[which]
        size[:, 0] = BACKGROUND[::-1]
        place, box = motion.texture_maps(looks, size)
        ground = rng.integers(len(self.grey), size=count).astype(np.int32)
        return pack_words(ground, self.start[which], size, place, box)

    def render(self, numbers: torch.Tensor, count: int) -> torch.Tensor:
        """Return log intensities (count, samples, height, width) of what `numbers` drew, on the device."""
        looks, layers = self.scene_settings, most_layers(self.scene_settings)
        pair = (count, layers)
        shapes = (count,), pair, (*pair, 2), (count, looks.samples, layers, 2, 3), (*pair, 4)
        ground, start, size, place, box = unpack_words(numbers, *shapes)
        return bridge.render_log(
            self.grey, self.texels, ground, start, size, place.view(torch.float32), box.view(torch.float32),
            width=looks.width, height=looks.height, eps=LOG_EPS,
        )  # fmt: skip


def pack_words(*arrays: NDArray[Any]) -> NDArray[np.int32]:
    """Return arrays of 4-byte numbers, of any shape, one behind the other, as words (N,).

    Each begins with a line of GPU memory: vectors on a GPU may ask for that.
    """
    begin = np.cumsum([0, *(_whole_lines(a.size) for a in arrays)])
    flat = np.zeros(begin[-1], np.int32)
    for array, start in zip(arrays, begin, strict=False):
        flat[start : start + array.size] = np.ascontiguousarray(array).view(np.int32).ravel()
    return flat


def _whole_lines(words: int) -> int:
    """Return how many words of 4 bytes the lines of a GPU's memory have that so many words fill."""
    line = 32
    return -(-words // line) * line


def unpack_words(words: torch.Tensor, *shapes: tuple[int, ...]) -> list[torch.Tensor]:
    """Return the arrays of these shapes that `pack_words` put into int32 words (N,)."""
    out, begin = [], 0
    for shape in shapes:
        size = math.prod(shape)
        out.append(words[begin : begin + size].view(shape))
        begin += _whole_lines(size)
    return out


def send_words(
    words: NDArray[np.int32], device: torch.device, to: torch.Tensor | None = None
) -> torch.Tensor:
    """Return words (N,) on a device, in the memory of `to` (N,) if given; nobody waits for the copy."""
    here = torch.from_numpy(words)
    if device.type == "cuda":
        here = here.pin_memory()
    return here.to(device, non_blocking=True) if to is None else to.copy_(here, non_blocking=True)


def middle_intensity(log: torch.Tensor) -> torch.Tensor:
    """Return the intensity at the middle sample of log intensities (B, K, H, W), shape (B, H, W)."""
    return torch.exp(log[:, log.shape[1] // 2]) - LOG_EPS


def _fit_background(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a texture as a background of the pool: turned upright, cut and scaled to one size."""
    # heavy, and wanted only where a pool is made: recordings bring their own scenes
    import cv2

    if grey.shape[0] > grey.shape[1]:
        grey = np.rot90(grey)
    rows, columns = BACKGROUND
    scale = max(rows / grey.shape[0], columns / grey.shape[1])
    size = max(columns, round(scale * grey.shape[1])), max(rows, round(scale * grey.shape[0]))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(np.ascontiguousarray(grey), size, interpolation=way)
    top, left = (scaled.shape[0] - rows) // 2, (scaled.shape[1] - columns) // 2
    return np.ascontiguousarray(np.clip(scaled[top : top + rows, left : left + columns], 0, 1), np.float32)


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
        self, looks: SceneSettings, size: NDArray[np.int32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return maps from sensor to texture (B, K, L, 2, 3) and boxes (B, L, 4), as `LayerScene` has them.

        Args:
            looks: Size of the sensor and number of samples.
            size: Width and height of the textures [texel], shape (B, L, 2).
        """
        share = np.linspace(0, 1, looks.samples)[None, :, None]

        def at(ends: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(ends[:, None, :, 0] + share * (ends[:, None, :, 1] - ends[:, None, :, 0]))

        x, y, angle, sx, sy = (at(a) for a in (self.x, self.y, self.angle, self.scale_x, self.scale_y))
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
    table = np.array(
        [(*h.objects, *h.speed, *h.spin, *h.background_speed, *h.background_spin) for h in hows], float
    )[kind]
    objects = rng.integers(table[:, 0].astype(int), table[:, 1].astype(int) + 1)
    there = np.arange(most_layers(looks))[None] <= objects[:, None]
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
