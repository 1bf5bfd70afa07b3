"""Derivative of the rendering of moving textured layers, by their textures and their places."""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.scene_layers import (
    MAX_LAYERS,
    Affine,
    Layers,
    background_at,
    background_geometry,
    foreground_at,
    reflected_coordinate,
)

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

PerLayer = wp.types.vector(length=MAX_LAYERS, dtype=wp.float32)


@wp.func
def fold_slope(u: float, last: float, inverse: float) -> float:
    """Derivative of `reflected_coordinate`: where the fold runs backwards, so does the derivative."""
    if last == 0.0:
        return 0.0
    return wp.where(u < 2.0 * last * wp.floor(u * inverse + 0.5), -1.0, 1.0)


@wp.func
def spread_gradient(
    layers: Layers,
    layer: int,
    corner: wp.vec2i,  # upper left of the four texels
    u: float,
    v: float,
    gradient: wp.vec2,  # of the objective by (intensity · alpha, alpha) at (u, v)
    slot: int,
    texel_gradient_out: wp.array2d[wp.vec2],
) -> wp.vec2:
    """Add a gradient to the four texels around a point; return the gradient by the point [1/texel]."""
    size = layers.size[layer]
    by_u = float(0.0)
    by_v = float(0.0)
    for j in range(2):
        for i in range(2):
            tu = corner[0] + i
            tv = corner[1] + j
            if tu >= 0 and tv >= 0 and tu < size[0] and tv < size[1]:
                n = layers.start[layer] + tv * size[0] + tu
                wu = 1.0 - wp.abs(u - float(tu))
                wv = 1.0 - wp.abs(v - float(tv))
                share = wp.dot(gradient, layers.texels[n])
                by_u += float(2 * i - 1) * wv * share
                by_v += float(2 * j - 1) * wu * share
                if texel_gradient_out.shape[1] > 0:
                    wp.atomic_add(
                        texel_gradient_out, slot % texel_gradient_out.shape[0], n, (wu * wv) * gradient
                    )
    return wp.vec2(by_u, by_v)


@wp.func
def spread_layer(
    layers: Layers,
    layer: int,
    at: wp.vec2,  # unfolded [texel]
    gradient: wp.vec2,
    slot: int,
    texel_gradient_out: wp.array2d[wp.vec2],
) -> wp.vec2:
    """Spread a gradient where a look at a layer took its texels; return the gradient by `at` [1/texel]."""
    size = layers.size[layer]
    if layer > 0:
        if at[0] <= -1.0 or at[1] <= -1.0 or at[0] >= float(size[0]) or at[1] >= float(size[1]):
            return wp.vec2(0.0, 0.0)
        corner = wp.vec2i(int(wp.floor(at[0])), int(wp.floor(at[1])))
        return spread_gradient(layers, layer, corner, at[0], at[1], gradient, slot, texel_gradient_out)
    ground = background_geometry(layers)
    u = reflected_coordinate(at[0], ground.last[0], ground.inverse[0])
    v = reflected_coordinate(at[1], ground.last[1], ground.inverse[1])
    corner = wp.vec2i(wp.min(int(u), ground.corner[0]), wp.min(int(v), ground.corner[1]))
    slope = wp.vec2(
        fold_slope(at[0], ground.last[0], ground.inverse[0]),
        fold_slope(at[1], ground.last[1], ground.inverse[1]),
    )
    return wp.cw_mul(slope, spread_gradient(layers, layer, corner, u, v, gradient, slot, texel_gradient_out))


@wp.kernel(enable_backward=False)
def render_gradient(
    # in
    first: int,
    layers: Layers,
    gradient: wp.array2d[float],  # (K, H · W) of the objective by `render`
    width: int,
    stretch: int,  # consecutive pixels that add to the same copy of an output
    # out
    texel_gradient_out: wp.array2d[wp.vec2],  # (C, texels), zero on entry; summed over C, by (c, alpha)
    place_gradient_out: wp.array3d[Affine],  # (D, K, L), zero on entry; summed over D
):
    """Differentiate `render`, one pixel and sample per thread.

    light = Σ_l T_l c_l with premultiplied c_l and T_l = Π (1 - alpha) over the layers in front, so that
    ∂light/∂c_l = T_l and ∂light/∂alpha_l = -T_l · (composite of all behind l). Empty outputs are not wanted.
    """
    k, i = wp.tid()
    i += first
    through = gradient[k, i]
    x = float(i % width)
    y = float(i / width)
    behind = PerLayer()
    passes = PerLayer()
    light = background_at(layers, background_geometry(layers), k, x, y)
    for layer in range(1, layers.count):
        front = foreground_at(layers, layer, k, x, y)
        behind[layer] = light
        passes[layer] = 1.0 - front[1]
        light = front[0] + passes[layer] * light
    for back in range(1, layers.count + 1):
        if through == 0.0:
            return
        layer = layers.count - back
        at = layers.place[k, layer] * wp.vec3(x, y, 1.0)
        gain = wp.vec2(through, -through * behind[layer])
        by_at = spread_layer(layers, layer, at, gain, i / stretch, texel_gradient_out)
        if (by_at[0] != 0.0 or by_at[1] != 0.0) and place_gradient_out.shape[1] > 0:
            slot = (i / stretch) % place_gradient_out.shape[0]
            wp.atomic_add(place_gradient_out, slot, k, layer, wp.outer(by_at, wp.vec3(x, y, 1.0)))
        through *= passes[layer]
