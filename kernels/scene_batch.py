"""Many small scenes of moving layers at once, rendered to log intensity from one pool of textures.

`scene.render` shows one scene; training draws a dozen anew in every step, and a launch for each would cost
more than the pixels do. Layer 0 of every scene is one of the pool's backgrounds, which all have one size.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.scene_layers import Affine, Layers, background_geometry, layer_intensity, layers_near

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.kernel(enable_backward=False)
def render_log(
    first: int,
    # in
    grey: wp.array2d[float],  # (G, h · w) intensities of the backgrounds
    texels: wp.array[wp.vec2],  # all other textures: (intensity · alpha, alpha)
    background: wp.array[int],  # (B,) which background
    start: wp.array2d[int],  # (B, L) first texel of each layer; not looked at for layer 0
    size: wp.array2d[wp.vec2i],  # (B, L) width, height [texel]
    place: wp.array3d[Affine],  # (B, K, L) sensor to texture coordinates
    box: wp.array2d[wp.vec4],  # (B, L) x0, y0, x1, y1 [px] that the layer stays inside of
    width: int,
    eps: float,  # added to the intensity before the logarithm
    # out
    log_out: wp.array3d[float],  # (B, K, H · W) [log intensity]
):
    """Log intensity of one pixel at all samples."""
    b, i = wp.tid()
    i += first
    layers = Layers()
    layers.grey = grey[background[b]]
    layers.texels = texels
    layers.start = start[b]
    layers.size = size[b]
    layers.place = place[b]
    layers.box = box[b]
    layers.count = start.shape[1]
    x = float(i % width)
    y = float(i / width)
    near = layers_near(layers, x, y)
    ground = background_geometry(layers)
    for k in range(place.shape[1]):
        log_out[b, k, i] = wp.log(layer_intensity(layers, ground, near, k, x, y) + eps)
