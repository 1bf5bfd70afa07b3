"""Whole pictures of moving layers, and the flow in them, several neighbouring pixels per thread.

Light is that of the pixel kernels, to the bit. A block of pixels is asked once which layers can cover it.
"""

# no postponed annotations: those of the kernels made here name types of the functions around them
from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels import launch
from dase.kernels.scene_layers import Affine, Layers, background_geometry
from dase.kernels.threshold_counts import block_count, block_functions, light_of, widest_block
from dase.kernels.vector_math import lane_functions, lane_options


@lru_cache(maxsize=8)
def _places(lanes: int) -> tuple[Any, Any]:
    """Return Warp functions for the columns and rows of the pixels from `n` on."""
    Lanes = lane_functions(lanes).Lanes

    @wp.func
    def columns(n: int, width: int):
        x = Lanes()
        for lane in range(wp.static(lanes)):
            x[lane] = float((n + lane) % width)
        return x

    @wp.func
    def rows(n: int, width: int):
        y = Lanes()
        for lane in range(wp.static(lanes)):
            y[lane] = float((n + lane) / width)
        return y

    return columns, rows


@lru_cache(maxsize=8)
def rendering_kernel(lanes: int, grey: bool = False) -> wp.Kernel:
    """Return the kernel that renders light, over blocks of `lanes` pixels, or greys of 8 bits."""
    f, start_of, light = lane_functions(lanes), block_functions(lanes), light_of(lanes, "layers")
    columns, rows = _places(lanes)
    layers_of, store = start_of.layers_of, f.store_grey if grey else f.store
    Level = wp.uint8 if grey else wp.float32

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def render_light(
        first: int,
        # in
        layers: Layers,
        size: int,  # N
        width: int,
        # out
        out: wp.array2d[Level],  # (K, N) linear intensity, or its share of 255
    ):
        """Render the intensity of a block of pixels at all samples."""
        _, i = wp.tid()
        n = wp.min((first + i) * wp.static(lanes), size - wp.static(lanes))
        x = columns(n, width)
        y = rows(n, width)
        near = layers_of(layers, x, y)
        ground = background_geometry(layers)
        for k in range(out.shape[0]):
            store(out[k], n, light(layers, ground, k, n, x, y, near))

    return render_light


@lru_cache(maxsize=8)
def flow_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel that renders flow, over blocks of `lanes` pixels."""
    f, start_of = lane_functions(lanes), block_functions(lanes)
    columns, rows = _places(lanes)
    layers_of, foremost = start_of.layers_of, f.foremost

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def render_velocity(
        first: int,
        # in
        layers: Layers,
        velocity: wp.array2d[Affine],  # (K, L) sensor coordinates to velocity [px/s]
        size: int,  # N
        width: int,
        # out
        out: wp.array3d[float],  # (K, 2, N) [px/s], x then y
    ):
        """Render the velocity of the foremost layer with alpha > 0 for a block of pixels at all samples."""
        _, i = wp.tid()
        n = wp.min((first + i) * wp.static(lanes), size - wp.static(lanes))
        x = columns(n, width)
        y = rows(n, width)
        near = layers_of(layers, x, y)
        for k in range(out.shape[0]):
            top = foremost(x, y, layers.texels, layers.start, layers.size, layers.place, k, near)
            for lane in range(wp.static(lanes)):
                flow = velocity[k, int(top[lane])] * wp.vec3(x[lane], y[lane], 1.0)
                out[k, 0, n + lane] = flow[0]
                out[k, 1, n + lane] = flow[1]

    return render_velocity


def render_frames(
    layers: Layers, width: int, height: int, device: wp.Device, *, grey: bool = False
) -> wp.array:
    """Return intensities of all samples, shape (K, H · W), or greys of 8 bits with 255 for intensity 1."""
    samples, size = layers.place.shape[0], height * width
    out = launch.new_array((samples, size), wp.uint8 if grey else wp.float32, device)
    lanes = widest_block(size, device, "layers")
    inputs = [layers, size, width, out]
    launch.run_kernel(rendering_kernel(lanes, grey), block_count(size, lanes), inputs, device)
    return out


def render_flow(layers: Layers, velocity: wp.array, width: int, height: int, device: wp.Device) -> wp.array:
    """Return the flow of all samples [px/s], shape (K, 2, H · W), x then y."""
    samples, size = layers.place.shape[0], height * width
    out = launch.new_array((samples, 2, size), wp.float32, device)
    lanes = widest_block(size, device, "layers")
    inputs = [layers, velocity, size, width, out]
    launch.run_kernel(flow_kernel(lanes), block_count(size, lanes), inputs, device)
    return out
