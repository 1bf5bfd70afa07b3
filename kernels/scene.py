"""Moving textured layers: bilinear warping, alpha compositing, flow.

A layer is a texture and, at every time sample, an affine map from sensor to texture coordinates (pixel
centres at integers). Layer 0 is the opaque background, continued by reflection about its outermost texels
(reflect-101); the others are transparent outside their texture. Higher layers lie in front.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from dase.kernels import launch

MAX_LAYERS = 32
"""A pixel keeps one bit per layer."""

Affine = wp.types.matrix(shape=(2, 3), dtype=wp.float32)
PerLayer = wp.types.vector(length=MAX_LAYERS, dtype=wp.float32)


@wp.struct
class Layers:
    """Textures and motion of all layers, L layers at K time samples."""

    texels: wp.array[wp.vec2]  # all textures, row by row: (intensity · alpha, alpha)
    start: wp.array[int]  # (L,) first texel of each layer
    size: wp.array[wp.vec2i]  # (L,) width, height [texel]
    place: wp.array2d[Affine]  # (K, L) sensor to texture coordinates
    box: wp.array[wp.vec4]  # (L,) x0, y0, x1, y1 [px] that the layer stays inside of during these samples
    count: int  # L


@wp.func
def reflected(u: float, length: int) -> float:
    """Fold a coordinate into [0, length - 1] as reflect-101 does."""
    period = wp.max(2.0 * float(length - 1), 1.0)
    return wp.min(wp.abs(u - period * wp.floor(u / period + 0.5)), float(length - 1))


@wp.func
def background_at(layers: Layers, k: int, x: float, y: float) -> float:
    """Intensity of layer 0."""
    size = layers.size[0]
    at = layers.place[k, 0] * wp.vec3(x, y, 1.0)
    u = reflected(at[0], size[0])
    v = reflected(at[1], size[1])
    iu = wp.min(int(u), wp.max(size[0] - 2, 0))
    iv = wp.min(int(v), wp.max(size[1] - 2, 0))
    fu = u - float(iu)
    fv = v - float(iv)
    right = wp.min(1, size[0] - 1)
    below = wp.min(1, size[1] - 1) * size[0]
    i = layers.start[0] + iv * size[0] + iu
    top = layers.texels[i][0] + fu * (layers.texels[i + right][0] - layers.texels[i][0])
    i += below
    bottom = layers.texels[i][0] + fu * (layers.texels[i + right][0] - layers.texels[i][0])
    return top + fv * (bottom - top)


@wp.func
def texel(layers: Layers, layer: int, u: int, v: int) -> wp.vec2:
    """(intensity · alpha, alpha) of a texel, transparent outside."""
    size = layers.size[layer]
    if u < 0 or v < 0 or u >= size[0] or v >= size[1]:
        return wp.vec2(0.0, 0.0)
    return layers.texels[layers.start[layer] + v * size[0] + u]


@wp.func
def foreground_at(layers: Layers, layer: int, k: int, x: float, y: float) -> wp.vec2:
    """(intensity · alpha, alpha) of a layer in front of the background."""
    size = layers.size[layer]
    at = layers.place[k, layer] * wp.vec3(x, y, 1.0)
    u = at[0]
    v = at[1]
    if u <= -1.0 or v <= -1.0 or u >= float(size[0]) or v >= float(size[1]):
        return wp.vec2(0.0, 0.0)
    iu = int(wp.floor(u))
    iv = int(wp.floor(v))
    fu = u - float(iu)
    fv = v - float(iv)
    top = (1.0 - fu) * texel(layers, layer, iu, iv) + fu * texel(layers, layer, iu + 1, iv)
    bottom = (1.0 - fu) * texel(layers, layer, iu, iv + 1) + fu * texel(layers, layer, iu + 1, iv + 1)
    return (1.0 - fv) * top + fv * bottom


@wp.func
def layers_near(layers: Layers, x: float, y: float) -> int:
    """Bit l is set where layer l can cover the pixel during these samples."""
    near = int(0)
    for layer in range(1, layers.count):
        box = layers.box[layer]
        if x >= box[0] and y >= box[1] and x <= box[2] and y <= box[3]:
            near |= 1 << layer
    return near


@wp.func
def layer_intensity(layers: Layers, near: int, k: int, x: float, y: float) -> float:
    """Intensity of a pixel at sample k, composited front to back."""
    light = float(0.0)
    through = float(1.0)
    if near != 0:
        for back in range(1, layers.count):
            layer = layers.count - back
            if ((near >> layer) & 1) != 0:
                front = foreground_at(layers, layer, k, x, y)
                light += through * front[0]
                through *= 1.0 - front[1]
                if through == 0.0:
                    return light
    return light + through * background_at(layers, k, x, y)


@wp.kernel(enable_backward=False)
def render(
    # in
    first: int,
    layers: Layers,
    width: int,
    # out
    intensity_out: wp.array2d[float],  # (K, H · W)
):
    """Intensity of every pixel, one pixel and sample per thread."""
    k, i = wp.tid()
    i += first
    x = float(i % width)
    y = float(i / width)
    intensity_out[k, i] = layer_intensity(layers, layers_near(layers, x, y), k, x, y)


@wp.kernel(enable_backward=False)
def flow(
    # in
    first: int,
    layers: Layers,
    velocity: wp.array2d[Affine],  # (K, L) sensor coordinates to velocity [px/s]
    width: int,
    # out
    flow_out: wp.array2d[wp.vec2],  # (K, H · W) [px/s]
):
    """Velocity of the foremost layer with alpha > 0."""
    k, i = wp.tid()
    i += first
    x = float(i % width)
    y = float(i / width)
    near = layers_near(layers, x, y)
    top = int(0)
    for layer in range(1, layers.count):
        if ((near >> layer) & 1) != 0 and foreground_at(layers, layer, k, x, y)[1] > 0.0:
            top = layer
    flow_out[k, i] = velocity[k, top] * wp.vec3(x, y, 1.0)


def upload(
    textures: list[tuple[np.ndarray, np.ndarray | None]], device: wp.Device
) -> tuple[wp.array, wp.array, wp.array]:
    """Move textures to `device`.

    Args:
        textures: (intensity, alpha) per layer, each float32 (h, w); alpha None is opaque.
        device: Where to.

    Returns:
        texels, start and size of `Layers`.
    """
    flat, start, size, total = [], [], [], 0
    for grey, alpha in textures:
        opacity = np.ones_like(grey) if alpha is None else alpha
        flat.append(np.stack([grey * opacity, opacity], axis=-1).reshape(-1, 2))
        start.append(total)
        size.append(grey.shape[::-1])
        total += grey.size
    return (
        wp.array(np.concatenate(flat), dtype=wp.vec2, device=device),
        wp.array(start, dtype=int, device=device),
        wp.array(np.array(size), dtype=wp.vec2i, device=device),
    )


def render_frames(layers: Layers, width: int, height: int, device: wp.Device) -> wp.array:
    """Return intensities of all samples, shape (K, H · W)."""
    samples = layers.place.shape[0]
    out = wp.empty((samples, height * width), dtype=float, device=device)
    launch.run(render, height * width, [layers, width, out], device, batch=samples)
    return out


def render_flow(layers: Layers, velocity: wp.array, width: int, height: int, device: wp.Device) -> wp.array:
    """Return the flow of all samples [px/s], shape (K, H · W) of vec2."""
    samples = layers.place.shape[0]
    out = wp.empty((samples, height * width), dtype=wp.vec2, device=device)
    launch.run(flow, height * width, [layers, velocity, width, out], device, batch=samples)
    return out
