"""Where the layers of many scenes are: from paths of a camera and of things to maps of textures.

A path has five quantities: x and y of the middle [widths of the view], angle [rad], scales of x and y. Each
runs straight from begin to end and is swayed by waves; in a pause everything stands still. A camera's path
moves all layers, each of which has a straight path of its own. Double precision, as in
`dase.scenes.layers.LayerScene`, whose maps these are.
"""

from __future__ import annotations

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.scene_layers import Affine

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

POSE = 12
"""Numbers of a pose: 5 quantities of a camera, their rates [1/s], the share of the way that things have made
until then, and the rate of that [1/s]."""

NOWHERE = 1.0e9
"""Coordinate that no pixel has [px]: a layer that is not there stays inside of an empty box out there."""


@wp.kernel(enable_backward=False)
def camera_poses(
    first: int,
    # in
    times: wp.array[wp.float64],  # (K,) [s] since the begin of the scenes
    duration: wp.float64,  # in which paths go from begin to end [s]
    ends: wp.array3d[wp.float64],  # (B, 5, 2) of the camera's path
    waves: wp.array4d[wp.float64],  # (B, 5, J, 3) amplitude, frequency [Hz], phase [rad]
    pauses: wp.array3d[wp.float64],  # (B, P, 2) begin and end [s]
    # out
    pose_out: wp.array3d[wp.float64],  # (B, K, POSE)
):
    """Pose of the camera of a scene at a time."""
    b, k = wp.tid()
    k += first
    now = times[k]
    moving = wp.float64(1.0)
    awake = now
    for p in range(pauses.shape[1]):
        begin = pauses[b, p, 0]
        end = pauses[b, p, 1]
        awake -= wp.clamp(now - begin, wp.float64(0.0), end - begin)
        if now >= begin and now < end:
            moving = wp.float64(0.0)
    share = awake / duration
    pace = moving / duration
    for q in range(5):
        way = ends[b, q, 1] - ends[b, q, 0]
        value = ends[b, q, 0] + share * way
        rate = pace * way
        for j in range(waves.shape[2]):
            turn = wp.float64(2.0 * wp.pi) * waves[b, q, j, 1]
            angle = turn * awake + waves[b, q, j, 2]
            value += waves[b, q, j, 0] * wp.sin(angle)
            rate += moving * waves[b, q, j, 0] * turn * wp.cos(angle)
        pose_out[b, k, q] = value
        pose_out[b, k, 5 + q] = rate
    pose_out[b, k, 10] = share
    pose_out[b, k, 11] = pace


@wp.func
def stretched_turn(angle: wp.float64, scale_x: wp.float64, scale_y: wp.float64) -> wp.mat22d:
    """Scaling, then rotation."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.mat22d(scale_x * c, -scale_y * s, scale_x * s, scale_y * c)


@wp.func
def turn_rate(
    angle: wp.float64,
    scale_x: wp.float64,
    scale_y: wp.float64,
    spin: wp.float64,
    grow_x: wp.float64,
    grow_y: wp.float64,
) -> wp.mat22d:
    """Time derivative of `stretched_turn`."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.mat22d(
        grow_x * c - scale_x * s * spin,
        -grow_y * s - scale_y * c * spin,
        grow_x * s + scale_x * c * spin,
        grow_y * c - scale_y * s * spin,
    )


@wp.kernel(enable_backward=False)
def place_layers(
    first: int,
    # in
    pose: wp.array3d[wp.float64],  # (B, K, POSE)
    ends: wp.array4d[wp.float64],  # (B, L, 5, 2) of the layers' own paths
    size: wp.array2d[wp.vec2i],  # (B, L) width, height [texel]; 0 for a layer that is not there
    view: wp.vec2d,  # width and height of the view [px]
    run: wp.array[int],  # (R + 1,) samples at which runs begin, and K
    # out
    place_out: wp.array3d[Affine],  # (B, K, L) sensor to texture coordinates
    box_out: wp.array3d[wp.vec4],  # (B, R, L) x0, y0, x1, y1 [px] that the layer stays inside of in a run
    velocity_out: wp.array3d[Affine],  # (B, R, L) sensor coordinates to velocity [px/s] at the end of a run
):
    """Maps of one layer of a scene at all samples of one run."""
    b, i = wp.tid()
    i += first
    layers = size.shape[1]
    r = i / layers
    l = i % layers
    low = wp.vec2d(wp.float64(NOWHERE), wp.float64(NOWHERE))
    high = -low
    texels = size[b, l]
    if texels[0] > 0:
        wide = wp.float64(texels[0])
        tall = wp.float64(texels[1])
        # at scale 1 a background covers the view, and anything else is as long as the view is wide
        unit = wp.max(wide, tall)
        if l == 0:
            unit = wp.min(wide, tall * view[0] / view[1])
        middle = wp.float64(0.5) * wp.vec2d(wide - wp.float64(1.0), tall - wp.float64(1.0))
        centre_of_view = wp.float64(0.5) * (view - wp.vec2d(wp.float64(1.0), wp.float64(1.0)))
        way = wp.vector(length=5, dtype=wp.float64)
        for q in range(5):
            way[q] = ends[b, l, q, 1] - ends[b, l, q, 0]
        for k in range(run[r], run[r + 1]):
            share = pose[b, k, 10]
            at = wp.vec2d(ends[b, l, 0, 0] + share * way[0], ends[b, l, 1, 0] + share * way[1])
            angle = ends[b, l, 2, 0] + share * way[2]
            scale_x = ends[b, l, 3, 0] + share * way[3]
            scale_y = ends[b, l, 4, 0] + share * way[4]
            own = stretched_turn(angle, scale_x, scale_y)
            camera = stretched_turn(pose[b, k, 2], pose[b, k, 3], pose[b, k, 4])
            both = camera * own
            offset = centre_of_view + view[0] * (camera * at + wp.vec2d(pose[b, k, 0], pose[b, k, 1]))
            back = wp.inverse(both) * (unit / view[0])
            shift = middle - back * offset
            place_out[b, k, l] = Affine(
                float(back[0, 0]), float(back[0, 1]), float(shift[0]),
                float(back[1, 0]), float(back[1, 1]), float(shift[1]),
            )  # fmt: skip
            forth = both * (view[0] / unit)
            for corner in range(4):
                u = wp.where(corner % 2 == 0, wp.float64(-1.0), wide) - middle[0]
                v = wp.where(corner < 2, wp.float64(-1.0), tall) - middle[1]
                pixel = forth * wp.vec2d(u, v) + offset
                low = wp.min(low, pixel)
                high = wp.max(high, pixel)
            if k == run[r + 1] - 1:
                pace = pose[b, k, 11]
                own_rate = turn_rate(angle, scale_x, scale_y, pace * way[2], pace * way[3], pace * way[4])
                camera_rate = turn_rate(
                    pose[b, k, 2], pose[b, k, 3], pose[b, k, 4], pose[b, k, 7], pose[b, k, 8], pose[b, k, 9]
                )
                rate = (camera_rate * own + camera * own_rate) * wp.inverse(both)
                along = camera_rate * at + camera * (pace * wp.vec2d(way[0], way[1]))
                along = view[0] * (along + wp.vec2d(pose[b, k, 5], pose[b, k, 6])) - rate * offset
                velocity_out[b, r, l] = Affine(
                    float(rate[0, 0]), float(rate[0, 1]), float(along[0]),
                    float(rate[1, 0]), float(rate[1, 1]), float(along[1]),
                )  # fmt: skip
    # the pixel is for float32
    box_out[b, r, l] = wp.vec4(
        float(low[0]) - 1.0, float(low[1]) - 1.0, float(high[0]) + 1.0, float(high[1]) + 1.0
    )
