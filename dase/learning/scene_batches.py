"""Random moving scenes for training, rendered by the batch on the device that learns.

The scenes are those of `dase.scenes.random_scenes` (S2R's statistics of objects, speeds, rotations and
scales), but their textures are drawn once, into a pool that stays on the device; each step then costs a few
numbers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dase.kernels import autograd_training as bridge
from dase.learning.random_streams import TrainingDraw
from dase.scenes import image_sources
from dase.scenes.scene import LOG_EPS
from dase.scenes.scene_motions import LayerMotions as LayerMotions
from dase.scenes.scene_motions import SceneSettings as SceneSettings
from dase.scenes.scene_motions import draw_motion as draw_motion
from dase.scenes.scene_motions import most_layers


class Scenery:
    """A pool of textures on a device, and random scenes made of them.

    Args:
        source: Textures.
        looks: What scenes look like.
        device: PyTorch device.
        seed: Draws the pool.
        backgrounds: Textures in the pool for backgrounds.
        objects: Textures in the pool for things in front.
        lead: Times of the samples that lead up to a window, from its begin [s], below 0, shape (L,); events
            in them do not count. None for none: nothing was there before, as before a simulated target's.
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
        lead: NDArray[np.float64] | None = None,
    ):
        self.scene_settings, self.device = looks, torch.device(device)
        self.lead = np.empty(0) if lead is None else lead
        rng = TrainingDraw.TEXTURES.generator(seed)
        grounds = [
            image_sources.fit_picture(source.background(rng).grey, *image_sources.BACKGROUND)
            for _ in range(backgrounds)
        ]
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
        other.__dict__.update(self.__dict__, scene_settings=looks)
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
        """Return log intensities of `count` random scenes, shape (count, L + samples, height, width)."""
        return self.render(send_words(self.draw_numbers(rng, count), self.device), count)

    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Draw `count` scenes; return all that is random in them for `render`, as words of 4 bytes, (N,)."""
        looks = self.scene_settings
        motion = draw_motion(rng, looks, count)
        layers = motion.x.shape[1]
        front = rng.integers(len(self.size) - 1, size=(count, layers)) if len(self.size) > 1 else 0
        which = np.where(motion.there, front, len(self.size) - 1)
        size = self.size[which]
        size[:, 0] = image_sources.BACKGROUND[::-1]
        place, box = motion.texture_maps(looks, size, self.lead)
        ground = rng.integers(len(self.grey), size=count).astype(np.int32)
        return pack_words(ground, self.start[which], size, place, box)

    def render(self, numbers: torch.Tensor, count: int) -> torch.Tensor:
        """Return log intensities of what `numbers` drew, shape (count, L + samples, height, width)."""
        looks, layers = self.scene_settings, most_layers(self.scene_settings)
        pair = (count, layers)
        samples = len(self.lead) + looks.samples
        shapes = (count,), pair, (*pair, 2), (count, samples, layers, 2, 3), (*pair, 4)
        ground, start, size, place, box = unpack_words(numbers, *shapes)
        return bridge.render_log(
            self.grey, self.texels, ground, start, size, place.view(torch.float32), box.view(torch.float32),
            width=looks.width, height=looks.height, eps=LOG_EPS,
        )  # fmt: skip

    def known(self, numbers: torch.Tensor, count: int) -> torch.Tensor | None:
        """Return which pixels' scenes are known, shape (count, height, width); None for all."""
        return None


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


def middle_intensity(log: torch.Tensor, lead: int = 0) -> torch.Tensor:
    """Return the intensity at the middle sample of windows, shape (B, H, W).

    Args:
        log: Log intensities, shape (B, lead + K, H, W).
        lead: Samples that lead up to the windows.
    """
    return torch.exp(log[:, lead + (log.shape[1] - lead) // 2]) - LOG_EPS
