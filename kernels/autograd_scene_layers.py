"""The bridge to PyTorch for scenes: moving layers, differentiable in their textures and their motion."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from dase.kernels import scene_layers as _scene
from dase.kernels.autograd_counts import check_tensor, indices_on_device, launch_on_tensors
from dase.kernels.launch import lend_tensor, thread_count
from dase.kernels.scene_layers_gradient import render_gradient

Texture = tuple[torch.Tensor, torch.Tensor | None]
"""Intensity and alpha of a layer, each of shape (h, w); alpha None is opaque."""


def render_layers(
    textures: Sequence[Texture], place: torch.Tensor, *, width: int, height: int
) -> torch.Tensor:
    """Render moving layers, differentiable in their textures and places: `LayerScene.frames` for training.

    Gradients are those of bilinear sampling: by `place` they jump where a pixel crosses a texel centre, and
    fully opaque texels at the border of a texture make an edge one texel wide. On a GPU they are summed in
    any order, so two runs agree to rounding only.

    Args:
        textures: Intensity and alpha of 1 to 32 layers, each (h, w). The first is the background, continued
            by reflection (its alpha, if any, darkens it); later ones lie in front, transparent outside.
        place: Maps from sensor to texture coordinates, pixel centres at integers [px to texel], shape
            (K, L, 2, 3); `affine_places` makes them.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].

    Returns:
        Intensities, shape (K, height, width) float32.

    Raises:
        ValueError: A shape, dtype or device does not fit.
    """
    check_tensor("place", place, None, None)
    _check_textures(textures, place.device)
    if place.ndim != 4 or tuple(place.shape[1:]) != (len(textures), 2, 3):
        raise ValueError(f"place must have shape (K, {len(textures)}, 2, 3), got {tuple(place.shape)}")
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be >= 1 px, got {width} and {height}")
    flat = []
    for grey, alpha in textures:
        opacity = torch.ones_like(grey) if alpha is None else alpha
        flat.append(torch.stack([grey.float() * opacity.float(), opacity.float()], -1).view(-1, 2))
    sizes = tuple((grey.shape[1], grey.shape[0]) for grey, _ in textures)
    frames = _Render.apply(torch.cat(flat), place.float(), sizes, width, width * height)
    return frames.view(-1, height, width)


def affine_places(
    motion: torch.Tensor,
    times: torch.Tensor | Sequence[float],
    sizes: Sequence[tuple[int, int]],
    *,
    width: int,
    height: int,
    duration: float,
) -> torch.Tensor:
    """Return the places of `dase.scenes.layers.Motion`, differentiable in the motion and the times.

    Args:
        motion: Fields of `Motion` in its order and units, at the beginning and at the end, shape (L, 5, 2).
        times: Samples [s], shape (K,).
        sizes: Height and width of the texture of each layer [texel]; the first is the background.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].
        duration: Length of the motion [s].

    Returns:
        Maps from sensor to texture coordinates [px to texel], shape (K, L, 2, 3) float32.

    Raises:
        ValueError: A shape or dtype does not fit.
    """
    check_tensor("motion", motion, ((len(sizes), 5, 2),), None)
    # float32 would leave errors of 1e-5 and more
    begin, end = motion.double().unbind(-1)  # each (L, 5)
    share = torch.as_tensor(times, dtype=torch.float64, device=motion.device)[:, None, None] / duration
    x, y, angle, scale_x, scale_y = (begin + share * (end - begin)).unbind(-1)  # each (K, L)
    # texels per unit of the plane: at scale 1 the background covers the sensor, others are as wide as it
    units = [max(h, w) if n else min(w, h * width / height) for n, (h, w) in enumerate(sizes)]
    zoom = motion.new_tensor(units, dtype=torch.float64) / width
    cosine, sine = zoom * torch.cos(angle), zoom * torch.sin(angle)
    centre_x, centre_y = x * width + (width - 1) / 2, y * width + (height - 1) / 2  # [px]
    rows = []  # u, then v
    for a, b, side in ((cosine / scale_x, sine / scale_x, 1), (-sine / scale_y, cosine / scale_y, 0)):
        middle = motion.new_tensor([(size[side] - 1) / 2 for size in sizes], dtype=torch.float64)
        rows.append(torch.stack([a, b, middle - a * centre_x - b * centre_y], -1))
    return torch.stack(rows, -2).float()


class _Render(torch.autograd.Function):
    """Frames of flat pixels; gradients to premultiplied texels and places."""

    @staticmethod
    def forward(
        ctx: Any,
        texels: torch.Tensor,
        place: torch.Tensor,
        sizes: tuple[tuple[int, int], ...],
        width: int,
        pixels: int,
    ) -> torch.Tensor:
        texels, place = texels.contiguous(), place.contiguous()
        frames = torch.empty(len(place), pixels, device=place.device)
        launch_on_tensors(_scene.render_intensity, [_lend_layers(texels, place, sizes), width], [frames])
        ctx.save_for_backward(texels, place)
        ctx.sizes, ctx.width = sizes, width
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        texels, place = ctx.saved_tensors
        gradient = gradient.float().contiguous()
        # adding is atomic on a GPU but not on the CPU, where every thread gets a copy and a run of pixels
        lots = min(thread_count(), 16)
        stretch = 1 if gradient.is_cuda else -(-gradient.shape[1] // lots)
        wanted = [bool(n) for n in ctx.needs_input_grad[:2]]
        # a GPU's pixels all add to few places: with copies, neighbours need not wait for each other
        copies = (1, 256) if gradient.is_cuda else (lots, lots)
        by_texels = texels.new_zeros(copies[0], len(texels) * wanted[0], 2)
        by_place = place.new_zeros(copies[1], len(place) * wanted[1], *place.shape[1:])
        outputs = [lend_tensor(by_texels, dtype=wp.vec2), lend_tensor(by_place, dtype=_scene.Affine)]
        inputs = [_lend_layers(texels, place, ctx.sizes), gradient, ctx.width, stretch]
        launch_on_tensors(render_gradient, inputs, outputs, over=gradient, align=stretch)
        sums = [by.sum(0) if want else None for by, want in zip((by_texels, by_place), wanted, strict=True)]
        return *sums, None, None, None


def _lend_layers(texels: torch.Tensor, place: torch.Tensor, sizes: tuple[tuple[int, int], ...]) -> Any:
    """Lend textures of `sizes` (width, height) and places to Warp; no layer is ruled out anywhere."""
    starts = (0, *accumulate(w * h for w, h in sizes))
    corner = place.new_full((len(sizes), 2), torch.inf)
    layers = _scene.Layers()
    layers.grey = lend_tensor(texels.detach()[: starts[1], 0].contiguous())
    layers.texels = lend_tensor(texels.detach(), dtype=wp.vec2)
    layers.start = lend_tensor(indices_on_device(starts[:-1], place.device))
    flat = indices_on_device(tuple(side for size in sizes for side in size), place.device)
    layers.size = lend_tensor(flat.view(-1, 2), dtype=wp.vec2i)
    layers.place = lend_tensor(place.detach(), dtype=_scene.Affine)
    layers.box = lend_tensor(torch.cat([-corner, corner], 1), dtype=wp.vec4)
    layers.count = len(sizes)
    return layers


def _check_textures(textures: Sequence[Texture], device: torch.device) -> None:
    """Raise ValueError unless `textures` are layers that `render_layers` takes, all on `device`."""
    if not 1 <= len(textures) <= _scene.MAX_LAYERS:
        raise ValueError(f"textures must be 1 to {_scene.MAX_LAYERS} layers, got {len(textures)}")
    for n, layer in enumerate(textures):
        if not isinstance(layer, (tuple, list)) or len(layer) != 2:
            raise ValueError(
                f"textures[{n}] must be a pair of intensity and alpha, got {type(layer).__name__}"
            )
        grey, alpha = layer
        check_tensor(f"intensity of textures[{n}]", grey, None, device)
        if grey.ndim != 2 or grey.numel() == 0:
            raise ValueError(f"intensity of textures[{n}] must have shape (h, w), got {tuple(grey.shape)}")
        if alpha is not None:
            check_tensor(f"alpha of textures[{n}]", alpha, (tuple(grey.shape),), device)
