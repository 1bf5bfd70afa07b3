"""Moving textured layers: bilinear warping, alpha compositing.

A layer is a texture and, at every time sample, an affine map from sensor to texture coordinates (pixel
centres at integers). Layer 0 is the opaque background, continued by reflection about its outermost texels
(reflect-101); the others are transparent outside their texture. Higher layers lie in front.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

# as in the kernels of `dase.kernels.scene_render`: pictures are the same, to the last bit, on a GPU as well
wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "fuse_fp": False})

MAX_LAYERS = 32
"""A pixel keeps one bit per layer."""

Affine = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.struct
class Frames:
    """Stored samples."""

    values: wp.array2d[float]  # (K, N) linear intensity, or log intensity for the `log` source


@wp.struct
class Layers:
    """Textures and motion of all layers, L layers at K time samples."""

    grey: wp.array[float]  # intensities of layer 0, which most looks go to, once more on their own; and a 0
    texels: wp.array[wp.vec2]  # all textures, row by row: (intensity · alpha, alpha)
    start: wp.array[int]  # (L,) first texel of each layer
    size: wp.array[wp.vec2i]  # (L,) width, height [texel]
    place: wp.array2d[Affine]  # (K, L) sensor to texture coordinates
    box: wp.array[wp.vec4]  # (L,) x0, y0, x1, y1 [px] that the layer stays inside of during these samples
    count: int  # L


@wp.struct
class BackgroundGeometry:
    """What every look at the background needs; a thread works it out once."""

    width: int
    last: wp.vec2  # coordinates of the last texel
    corner: wp.vec2i  # greatest upper left texel to interpolate from
    step: wp.vec2i  # from a texel to its right and to its lower neighbour
    inverse: wp.vec2  # 1 / period of the reflection


@wp.func
def background_geometry(layers: Layers) -> BackgroundGeometry:
    """Geometry of layer 0."""
    size = layers.size[0]
    ground = BackgroundGeometry()
    ground.width = size[0]
    ground.last = wp.vec2(float(size[0] - 1), float(size[1] - 1))
    ground.corner = wp.vec2i(wp.max(size[0] - 2, 0), wp.max(size[1] - 2, 0))
    ground.step = wp.vec2i(wp.min(1, size[0] - 1), wp.min(1, size[1] - 1) * size[0])
    ground.inverse = wp.vec2(1.0 / wp.max(2.0 * ground.last[0], 1.0), 1.0 / wp.max(2.0 * ground.last[1], 1.0))
    return ground


@wp.func
def reflected_coordinate(u: float, last: float, inverse: float) -> float:
    """Fold a coordinate into [0, last] as reflect-101 does; `inverse` is 1 / (2 last)."""
    return wp.min(wp.abs(u - 2.0 * last * wp.floor(u * inverse + 0.5)), last)


@wp.func
def background_at(layers: Layers, ground: BackgroundGeometry, k: int, x: float, y: float) -> float:
    """Intensity of layer 0."""
    at = layers.place[k, 0] * wp.vec3(x, y, 1.0)
    u = reflected_coordinate(at[0], ground.last[0], ground.inverse[0])
    v = reflected_coordinate(at[1], ground.last[1], ground.inverse[1])
    iu = wp.min(int(u), ground.corner[0])
    iv = wp.min(int(v), ground.corner[1])
    fu = u - float(iu)
    fv = v - float(iv)
    i = iv * ground.width + iu
    top = layers.grey[i]
    top += fu * (layers.grey[i + ground.step[0]] - top)
    i += ground.step[1]
    bottom = layers.grey[i]
    bottom += fu * (layers.grey[i + ground.step[0]] - bottom)
    return top + fv * (bottom - top)


@wp.func
def texel_at(layers: Layers, layer: int, u: int, v: int) -> wp.vec2:
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
    top = wp.vec2()
    bottom = wp.vec2()
    if iu >= 0 and iv >= 0 and iu + 1 < size[0] and iv + 1 < size[1]:
        i = layers.start[layer] + iv * size[0] + iu
        top = layers.texels[i] + fu * (layers.texels[i + 1] - layers.texels[i])
        i += size[0]
        bottom = layers.texels[i] + fu * (layers.texels[i + 1] - layers.texels[i])
    else:
        top = texel_at(layers, layer, iu, iv)
        top += fu * (texel_at(layers, layer, iu + 1, iv) - top)
        bottom = texel_at(layers, layer, iu, iv + 1)
        bottom += fu * (texel_at(layers, layer, iu + 1, iv + 1) - bottom)
    return top + fv * (bottom - top)


@wp.func_native(
    """
#ifdef __CUDA_ARCH__
    return 31 - __clz(bits);
#else
    return 31 - __builtin_clz((unsigned int)bits);
#endif
"""
)
def highest_bit(bits: int) -> int:
    """Place of the highest set bit; there must be one."""
    ...


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
def in_front(layers: Layers, near: int, k: int, x: float, y: float) -> wp.vec2:
    """Intensity of the layers in front of the background, and how much of it they let through."""
    # the same law stands in `vector_math` for blocks of pixels, layer by layer, and in the gradient, which
    # has to remember every layer: one loop for all three would make this one slow
    light = float(0.0)
    through = float(1.0)
    left = int(near)
    while left != 0:
        layer = highest_bit(left)
        left ^= 1 << layer
        front = foreground_at(layers, layer, k, x, y)
        light += through * front[0]
        through *= 1.0 - front[1]
        if through == 0.0:
            left = 0
    return wp.vec2(light, through)


@wp.func
def layer_intensity(
    layers: Layers, ground: BackgroundGeometry, near: int, k: int, x: float, y: float
) -> float:
    """Intensity of a pixel at sample k, composited front to back."""
    front = in_front(layers, near, k, x, y)
    if front[1] == 0.0:
        return front[0]
    return front[0] + front[1] * background_at(layers, ground, k, x, y)


@wp.kernel(enable_backward=False)
def render_intensity(
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
    intensity_out[k, i] = layer_intensity(
        layers, background_geometry(layers), layers_near(layers, x, y), k, x, y
    )


def upload_textures(
    textures: list[tuple[np.ndarray, np.ndarray | None]], device: wp.Device
) -> tuple[wp.array, wp.array, wp.array, wp.array]:
    """Move textures to `device`.

    Args:
        textures: (intensity, alpha) per layer, each float32 (h, w); alpha None is opaque.
        device: Where to.

    Returns:
        grey, texels, start and size of `Layers`.
    """
    flat, start, size, total = [], [], [], 0
    for grey, alpha in textures:
        opacity = np.ones_like(grey) if alpha is None else alpha
        flat.append(np.stack([grey * opacity, opacity], axis=-1).reshape(-1, 2))
        start.append(total)
        size.append(grey.shape[::-1])
        total += grey.size
    return (
        # one more, as the neighbour of the last texel is looked at even where it does not count
        wp.array(np.append(flat[0][:, 0], np.float32(0.0)), dtype=float, device=device),
        wp.array(np.concatenate([*flat, np.zeros((1, 2), np.float32)]), dtype=wp.vec2, device=device),
        wp.array(start, dtype=int, device=device),
        wp.array(np.array(size), dtype=wp.vec2i, device=device),
    )


@wp.kernel(enable_backward=False)
def mix_frames(
    first: int,
    # in
    frames: wp.array2d[float],  # (F, N) linear intensity
    at: wp.array2d[int],  # (2, K) frames before and after each sample
    share: wp.array[float],  # (K,) of the way from one to the other
    eps: float,
    # out
    out: wp.array2d[float],  # (K, N)
):
    """Interpolate stored frames; log(intensity + eps) runs straight between two of them."""
    k, i = wp.tid()
    i += first
    before = frames[at[0, k], i]
    after = frames[at[1, k], i]
    out[k, i] = before
    if at[0, k] != at[1, k] and before != after:
        step = wp.log((after + eps) / (before + eps))
        out[k, i] = wp.max((before + eps) * wp.exp(share[k] * step) - eps, 0.0)


def interpolate_frames(
    frames: NDArray[np.float32],
    at: NDArray[np.int32],
    share: NDArray[np.float64],
    eps: float,
    device: wp.Device,
) -> wp.array:
    """Return intensities between frames, shape (K, N); see `mix_frames`."""
    samples, pixels = len(share), frames.shape[1]
    out = wp.empty((samples, pixels), dtype=float, device=device)
    arrays = [
        wp.array(a, dtype=kind, device=device)
        for a, kind in ((frames, float), (at, int), (share.astype(np.float32), float))
    ]
    launch.run_kernel(mix_frames, pixels, [*arrays, eps, out], device, batch=samples)
    return out
