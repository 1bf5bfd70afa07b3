"""What training hands to kernels without a gradient: rendering batches, hashing patches, moving critics."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
import warp as wp

from dase.kernels import patch_structure as _patches
from dase.kernels import scene_batch as _scenery
from dase.kernels.autograd_counts import launch_on_tensors
from dase.kernels.launch import lend_tensor
from dase.kernels.scene_layers import Affine


def render_log(
    grey: torch.Tensor,
    texels: torch.Tensor,
    background: torch.Tensor,
    start: torch.Tensor,
    size: torch.Tensor,
    place: torch.Tensor,
    box: torch.Tensor,
    *,
    width: int,
    height: int,
    eps: float,
) -> torch.Tensor:
    """Render B scenes of L layers at K samples.

    Args:
        grey: Backgrounds, shape (G, h · w).
        texels: All other textures, (intensity · alpha, alpha), shape (T, 2).
        background: Which background, int32 (B,).
        start: First texel of each layer, int32 (B, L).
        size: Width and height of each texture, int32 (B, L, 2).
        place: Sensor to texture coordinates, shape (B, K, L, 2, 3).
        box: Corners that a layer stays inside of [px], shape (B, L, 4).
        width: Columns [px].
        height: Rows [px].
        eps: Added to intensities before the logarithm.

    Returns:
        Log intensity, shape (B, K, height, width) float32.
    """
    out = torch.empty(*place.shape[:2], height * width, device=place.device)
    inputs = [
        grey, lend_tensor(texels, dtype=wp.vec2), background, start, lend_tensor(size, dtype=wp.vec2i),
        lend_tensor(place, dtype=Affine), lend_tensor(box, dtype=wp.vec4), width, eps,
    ]  # fmt: skip
    launch_on_tensors(_scenery.render_log, inputs, [out])
    return out.view(*place.shape[:2], height, width)


def patch_structure(image: torch.Tensor, *, size: int, stride: int) -> dict[str, torch.Tensor]:
    """Return angle, coherence, strength and energy of every patch.

    Gradients are central differences. Means over a patch have Gaussian weights about its centre, of sigma =
    size/4 [px] and sum 1. λ1 >= λ2 are the eigenvalues of the mean of [gx gy]ᵀ[gx gy] (Romano et al., RAISR:
    Rapid and Accurate Image Super Resolution, 2017).

    Args:
        image: Intensity, shape (B, H, W).
        size: Side of a patch [px].
        stride: Step from patch to patch [px].

    Returns:
        Name to float32 of shape (B, patches), row by row of the grid: `angle`, the direction of the strongest
        gradient, across the edge, in [0, π), 0 along x [rad]; `coherence`, (√λ1 - √λ2)/(√λ1 + √λ2), 1 for
        stripes, 0 for isotropic and flat patches; `strength`, √λ1 [intensity/px]; `energy`, λ1 + λ2
        [intensity²/px²].
    """
    batch, columns, number = _patch_grid(image, size, stride)
    weight = _gaussian_window(size, image.device)
    rows = image.new_empty(batch, number * size, 3, dtype=torch.float32)
    lent = lend_tensor(rows, dtype=wp.vec3)
    out = [image.new_empty(batch, number, dtype=torch.float32) for _ in range(4)]
    inputs = [image.float().contiguous(), weight, stride, columns]
    launch_on_tensors(_patches.structure_rows, inputs, [lent], over=rows[..., 0])
    launch_on_tensors(_patches.structure_of_patches, [lent, weight], out)
    return dict(zip(("angle", "coherence", "strength", "energy"), out, strict=True))


@lru_cache(maxsize=16)
def _gaussian_window(size: int, device: torch.device) -> torch.Tensor:
    """Return Gaussian weights along one axis of a patch, sigma = size/4, sum 1."""
    weight = np.exp(-0.5 * ((np.arange(size) - (size - 1) / 2) / (size / 4)) ** 2)
    return torch.tensor(weight / weight.sum(), dtype=torch.float32, device=device)


def patch_contrast(counts: torch.Tensor, *, size: int, stride: int) -> torch.Tensor:
    """Return the contrast of Eq. 12 of every patch of counts (B, C, H, W), shape (B, patches) [events]."""
    batch, columns, number = _patch_grid(counts, size, stride)
    out = counts.new_empty(batch, number, dtype=torch.float32)
    inputs = [counts.detach().float().contiguous(), size, stride, columns]
    launch_on_tensors(_patches.contrast_of_patches, inputs, [out])
    return out


def _patch_grid(maps: torch.Tensor, size: int, stride: int) -> tuple[int, int, int]:
    rows, columns = ((side - size) // stride + 1 for side in maps.shape[-2:])
    return maps.shape[0], columns, rows * columns
