"""A pool of textures on the device that scenes are made on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.scenes.image_sources import BACKGROUND, ImageSource, Picture, fit_picture


@dataclass(frozen=True)
class TexturePool:
    """Textures of many scenes.

    Args:
        grounds: Backgrounds, all of one size.
        fronts: What moves before them.
        grey: Backgrounds on the device, each with a 0 behind it, shape (G, rows · columns + 1).
        texels: All other textures on the device: (intensity · alpha, alpha).
        start: First texel of each of `fronts`, shape (F,).
        size: Width and height of each of them [texel], shape (F, 2).
    """

    grounds: tuple[Picture, ...]
    fronts: tuple[Picture, ...]
    grey: wp.array
    texels: wp.array
    start: NDArray[np.int32]
    size: NDArray[np.int32]


@dataclass(frozen=True)
class DecodedPictures:
    """Textures as arrays of NumPy: what a thread prepares while others work."""

    grounds: tuple[Picture, ...]
    fronts: tuple[Picture, ...]
    grey: NDArray[np.float32]
    texels: NDArray[np.float32]

    def upload(self, device: wp.Device) -> TexturePool:
        """Return the textures on a device."""
        sizes = np.array([front.grey.shape[::-1] for front in self.fronts], np.int32).reshape(-1, 2)
        start = np.concatenate([[0], np.cumsum(sizes[:, 0] * sizes[:, 1])[:-1]]).astype(np.int32)
        return TexturePool(
            self.grounds,
            self.fronts,
            wp.array(self.grey, dtype=float, device=device),
            wp.array(self.texels, dtype=wp.vec2, device=device),
            start[: len(sizes)],
            sizes,
        )


def decode_pictures(
    source: ImageSource, rng: np.random.Generator, backgrounds: int, objects: int
) -> DecodedPictures:
    """Draw textures from a source of pictures and decode them."""
    grounds = tuple(
        Picture(fit_picture(source.background(rng).grey, *BACKGROUND)) for _ in range(backgrounds)
    )
    fronts = tuple(source.foreground(rng) for _ in range(objects))
    flat = []
    for front in fronts:
        alpha = np.ones_like(front.grey) if front.alpha is None else front.alpha
        # intensities of layers in front are stored times their alpha, as compositing wants them
        flat.append(np.stack([front.grey * alpha, alpha], -1).reshape(-1, 2).astype(np.float32))
    # the neighbour of the last texel is looked at even where it does not count
    grey = np.stack([np.append(ground.grey.ravel(), np.float32(0)) for ground in grounds])
    texels = np.concatenate([*flat, np.zeros((1, 2), np.float32)])
    return DecodedPictures(grounds, fronts, grey, texels)
