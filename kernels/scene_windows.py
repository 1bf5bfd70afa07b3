"""Many scenes of moving layers at once, window after window: what their pixels see, and its flow.

`dase.kernels.scene_batch` renders short scenes whole for training; here pixels look the layers up themselves,
as for one scene in `dase.kernels.scene_layers`.
"""

# no postponed annotations: those of the kernel made here name types of the function around it
from functools import lru_cache

import warp as wp

from dase.kernels.scene_layers import (
    Affine,
    Layers,
    background_geometry,
    layer_intensity,
    layers_near,
)
from dase.kernels.threshold_counts import block_functions
from dase.kernels.vector_math import lane_options, lanewise_function


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
def render_scenes(
    first: int,
    # in
    scenes: LayerScenes,
    width: int,
    # out
    frame_out: wp.array3d[float],  # (K, B, N)
):
    """Intensity of a pixel of a whole view at all samples, which are one run."""
    b, i = wp.tid()
    i += first
    layers = layers_of_scene(scenes, b)
    x = float(i % width)
    y = float(i / width)
    near = layers_near(layers, x, y)
    ground = background_geometry(layers)
    for k in range(frame_out.shape[0]):
        frame_out[k, b, i] = layer_intensity(layers, ground, near, k, x, y) * scenes.light[b, k]


FOREMOST = """
// as dase.kernels.scene_layers.foremost_velocity looks for it, all pixels of the block layer by layer
V result = x * 0.0f;
I open = x == x;
unsigned left = (unsigned)near;
while (left != 0) {
    const int layer = HIGHEST(left);
    left ^= 1u << layer;
    const auto& m = wp::index(place, k, layer);
    const int width = size.data[layer][0];
    const int height = size.data[layer][1];
    V u = (x * m.data[0][0] + y * m.data[0][1]) + m.data[0][2];
    V v = (x * m.data[1][0] + y * m.data[1][1]) + m.data[1][2];
    I inside = open & (u > -1.0f) & (v > -1.0f) & (u < (float)width) & (v < (float)height);
    if (!ANY(inside)) continue;
    u = inside ? u : V(0.0f);
    v = inside ? v : V(0.0f);
    V whole_u = FLOOR(u);
    V whole_v = FLOOR(v);
    V fu = u - whole_u;
    V fv = v - whole_v;
    I iu = WHOLE(whole_u);
    I iv = WHOLE(whole_v);
    const float* alphas = (const float*)(texels.data + start.data[layer]) + 1;
    I at = 2 * (iv * width + iu);
    I west = inside & (iu >= 0);
    I east = inside & (iu + 1 < width);
    I north = iv >= 0;
    I south = iv + 1 < height;
    auto LOOK = [=](I ok, I i) { return ok ? AT(alphas, ok ? i : I(0)) : V(0.0f); };
    V upper = LOOK(west & north, at);
    upper = upper + fu * (LOOK(east & north, at + 2) - upper);
    V lower = LOOK(west & south, at + 2 * width);
    lower = lower + fu * (LOOK(east & south, at + 2 * width + 2) - lower);
    I found = inside & (upper + fv * (lower - upper) > 0.0f);
    result = found ? V((float)layer) : result;
    open = open & (found == 0);
    if (!ANY(open)) break;
}
"""
"""C++ of the number of the foremost layer with alpha > 0, see `dase.kernels.vector_math`."""


@lru_cache(maxsize=4)
def flow_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel of the flow at the ends of runs, over (B, runs · blocks of `lanes` pixels) threads.

    The last block of a run ends with the last pixel and may overlap the one before.
    """
    layers = "texels: wp.array[wp.vec2], start: wp.array[int], size: wp.array[wp.vec2i], "
    layers += "place: wp.array2d[Affine], k: int, near: int"
    foremost = lanewise_function(f"foremost_{lanes}", lanes, FOREMOST, "x y", layers)
    start_of = block_functions(lanes)
    columns, rows, layers_of = start_of.columns, start_of.rows, start_of.layers_of

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def flow_at_ends(
        first: int,
        # in
        scenes: LayerScenes,
        velocity: wp.array3d[Affine],  # (B, R, L) sensor coordinates to velocity [px/s]
        run: wp.array[int],  # (R + 1,) samples at which runs begin, and K
        places: wp.array2d[int],  # (B, N) row-major indices of pixels of the view
        width: int,  # of the view
        # out
        flow_out: wp.array4d[float],  # (R, B, 2, N) [px/s], x and y
    ):
        """Velocity of the foremost layer with alpha > 0, at the last sample of a run."""
        b, i = wp.tid()
        i += first
        size = places.shape[1]
        blocks = (size + wp.static(lanes - 1)) / wp.static(lanes)
        r = i / blocks
        n = wp.min((i % blocks) * wp.static(lanes), size - wp.static(lanes))
        layers = layers_of_scene(scenes, b)
        layers.box = scenes.box[b, r]
        x = columns(places[b], n, width)
        y = rows(places[b], n, width)
        near = layers_of(layers, x, y)
        top = foremost(x, y, layers.texels, layers.start, layers.size, layers.place, run[r + 1] - 1, near)
        for lane in range(wp.static(lanes)):
            flow = velocity[b, r, int(top[lane])] * wp.vec3(x[lane], y[lane], 1.0)
            flow_out[r, b, 0, n + lane] = flow[0]
            flow_out[r, b, 1, n + lane] = flow[1]

    return flow_at_ends
