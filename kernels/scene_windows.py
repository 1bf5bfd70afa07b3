"""Many scenes of moving layers at once, window after window: what their pixels see, and its flow.

`dase.kernels.scene_batch` renders short scenes whole for training; here pixels look the layers up themselves,
as for one scene in `dase.kernels.scene_layers`.
"""

# no postponed annotations: those of the kernel made here name types of the function around it
from functools import lru_cache

import warp as wp

from dase.kernels.scene_layers import Affine, Layers, background_geometry
from dase.kernels.threshold_counts import block_functions, light_of
from dase.kernels.vector_math import lane_functions, lane_options


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


@lru_cache(maxsize=4)
def rendering_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel that renders scenes, over (B, runs · blocks of `lanes` pixels) threads.

    The last block of a run ends with the last pixel and may overlap the one before.
    """
    start_of, light = block_functions(lanes), light_of(lanes, "layers")
    columns, rows, layers_of = start_of.columns, start_of.rows, start_of.layers_of
    store = lane_functions(lanes).store

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def render_runs(
        first: int,
        # in
        scenes: LayerScenes,
        run: wp.array[int],  # (R + 1,) samples at which runs begin, and K
        places: wp.array2d[int],  # (B, N) row-major indices of pixels of the view
        width: int,  # of the view
        # out
        out: wp.array3d[float],  # (B, K, N)
    ):
        """Render the intensity of a block of pixels in full light, at all samples of a run."""
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
        ground = background_geometry(layers)
        for k in range(run[r], run[r + 1]):
            store(out[b, k], n, light(layers, ground, k, n, x, y, near))

    return render_runs


@lru_cache(maxsize=4)
def flow_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel of the flow at the ends of runs, over (B, runs · blocks of `lanes` pixels) threads.

    The last block of a run ends with the last pixel and may overlap the one before.
    """
    start_of = block_functions(lanes)
    columns, rows, layers_of = start_of.columns, start_of.rows, start_of.layers_of
    foremost = lane_functions(lanes).foremost

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
