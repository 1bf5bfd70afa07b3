"""Many scenes of moving layers at once, window after window: what their pixels see, frames, flow.

`dase.kernels.scene_batch` renders short scenes whole for training; here pixels look the layers up themselves,
as for one scene in `dase.kernels.scene_layers`, and only the ends of windows are rendered.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.scene_layers import (
    Affine,
    Layers,
    background_at,
    background_geometry,
    foreground_at,
    highest_bit,
    layers_near,
)


@wp.struct
class LayerScenes:
    """B scenes of L layers from one pool of textures, at K samples in R runs."""

    grey: wp.array2d[float]  # (G, h · w + 1) backgrounds of one size, and a 0
    texels: wp.array[wp.vec2]  # all other textures: (intensity · alpha, alpha)
    ground: wp.array[int]  # (B,) which background
    start: wp.array2d[int]  # (B, L) first texel of each layer; not looked at for layer 0
    size: wp.array2d[wp.vec2i]  # (B, L) width, height [texel]
    place: wp.array3d[Affine]  # (B, K, L) sensor to texture coordinates
    box: wp.array3d[wp.vec4]  # (B, R, L) x0, y0, x1, y1 [px] that a layer stays inside of in a run
    light: wp.array2d[float]  # (B, K) all intensities are multiplied by


@wp.func
def layers_of_scene(scenes: LayerScenes, row: int) -> Layers:
    """Layers of one scene, in its first run."""
    layers = Layers()
    layers.grey = scenes.grey[scenes.ground[row]]
    layers.texels = scenes.texels
    layers.start = scenes.start[row]
    layers.size = scenes.size[row]
    layers.place = scenes.place[row]
    layers.box = scenes.box[row, 0]
    layers.count = scenes.start.shape[1]
    return layers


@wp.kernel(enable_backward=False)
def render_window_ends(
    first: int,
    # in
    scenes: LayerScenes,
    velocity: wp.array3d[Affine],  # (B, R, L) sensor coordinates to velocity [px/s]
    run: wp.array[int],  # (R + 1,) samples at which runs begin, and K
    places: wp.array2d[int],  # (B, N) row-major indices of pixels of the view
    width: int,  # of the view
    # out
    frame_out: wp.array3d[float],  # (R, B, N)
    flow_out: wp.array4d[float],  # (R, B, 2, N) [px/s], x and y
):
    """Intensity of a pixel and velocity of the foremost layer with alpha > 0, at the last sample of a run."""
    b, n = wp.tid()
    n += first
    r = n / places.shape[1]
    i = n % places.shape[1]
    layers = layers_of_scene(scenes, b)
    layers.box = scenes.box[b, r]
    k = run[r + 1] - 1
    x = float(places[b, i] % width)
    y = float(places[b, i] / width)
    near = layers_near(layers, x, y)
    light = float(0.0)
    through = float(1.0)
    top = int(0)
    while near != 0:
        layer = highest_bit(near)
        near ^= 1 << layer
        front = foreground_at(layers, layer, k, x, y)
        if front[1] > 0.0 and top == 0:
            top = layer
        light += through * front[0]
        through *= 1.0 - front[1]
        if through == 0.0:
            near = 0
    if through != 0.0:
        light += through * background_at(layers, background_geometry(layers), k, x, y)
    frame_out[r, b, i] = light * scenes.light[b, k]
    flow = velocity[b, r, top] * wp.vec3(x, y, 1.0)
    flow_out[r, b, 0, i] = flow[0]
    flow_out[r, b, 1, i] = flow[1]
