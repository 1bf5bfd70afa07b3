"""Intensity between two frames that are matched by dense motion.

What is at p in the first frame is at p + s u(p) after the share s of the time to the second, u being its way
to the second frame; likewise backwards from the second. A pixel x finds its p by iterating p = x - s u(p).
The logarithms found in the two frames are blended linearly in time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

STEPS = 2
"""Iterations towards the origin of a pixel; more change nothing (docs/scenes.md)."""


@wp.struct
class MatchedFrames:
    """J + 1 successive frames and the motion between them."""

    frames: wp.array3d[float]  # (J + 1, H, W) linear intensity
    logs: wp.array3d[float]  # (J + 1, H, W) log(intensity + eps)
    ahead: wp.array3d[wp.vec2]  # (J, H, W) way from frame j to frame j + 1 [px]
    back: wp.array3d[wp.vec2]  # (J, H, W) way from frame j + 1 to frame j [px]


@wp.func
def way_at(ways: wp.array3d[wp.vec2], j: int, at: wp.vec2) -> wp.vec2:
    """Way [px] at a place, of ways (J, H, W), bilinear, constant beyond the border."""
    bottom = ways.shape[1] - 1
    right = ways.shape[2] - 1
    x = wp.clamp(at[0], 0.0, float(right))
    y = wp.clamp(at[1], 0.0, float(bottom))
    x0 = int(x)
    y0 = int(y)
    x1 = wp.min(x0 + 1, right)
    y1 = wp.min(y0 + 1, bottom)
    fx = x - float(x0)
    upper = ways[j, y0, x0] + fx * (ways[j, y0, x1] - ways[j, y0, x0])
    lower = ways[j, y1, x0] + fx * (ways[j, y1, x1] - ways[j, y1, x0])
    return upper + (y - float(y0)) * (lower - upper)


@wp.func
def origin_of_pixel(ways: wp.array3d[wp.vec2], j: int, share: float, x: wp.vec2) -> wp.vec2:
    """Place [px] from which the content of pixel `x`, at integers, came, after this share of its way."""
    way = ways[j, int(x[1]), int(x[0])]
    if way[0] == 0.0 and way[1] == 0.0:
        return x  # where the iteration would stay
    p = x - share * way
    for _ in range(STEPS):
        p = x - share * way_at(ways, j, p)
    return p


@wp.func
def cubic_weights(f: float) -> wp.vec4:
    """Weights of four neighbours, Catmull-Rom; `f` from the second to the third."""
    return wp.vec4(
        f * (-0.5 + f * (1.0 - 0.5 * f)),
        1.0 + f * f * (-2.5 + 1.5 * f),
        f * (0.5 + f * (2.0 - 1.5 * f)),
        f * f * (-0.5 + 0.5 * f),
    )


@wp.func
def value_at(maps: wp.array3d[float], j: int, at: wp.vec2) -> float:
    """Value at a place [px], of maps (J, H, W), bicubic, constant beyond the border."""
    bottom = maps.shape[1] - 1
    right = maps.shape[2] - 1
    x = wp.clamp(at[0], 0.0, float(right))
    y = wp.clamp(at[1], 0.0, float(bottom))
    x1 = int(x)
    y1 = int(y)
    if x == float(x1) and y == float(y1):
        return maps[j, y1, x1]
    wx = cubic_weights(x - float(x1))
    wy = cubic_weights(y - float(y1))
    x0 = wp.max(x1 - 1, 0)
    x2 = wp.min(x1 + 1, right)
    x3 = wp.min(x1 + 2, right)
    total = float(0.0)
    for n in range(4):
        row = wp.clamp(y1 - 1 + n, 0, bottom)
        line = wx[0] * maps[j, row, x0] + wx[1] * maps[j, row, x1]
        line += wx[2] * maps[j, row, x2] + wx[3] * maps[j, row, x3]
        total += wy[n] * line
    return total


@wp.func
def inside_weight(maps: wp.array3d[float], at: wp.vec2) -> float:
    """1 inside the frame, of maps (J, H, W), falling to almost 0 over a pixel beyond its border."""
    x = wp.max(-at[0], at[0] - float(maps.shape[2] - 1))
    y = wp.max(-at[1], at[1] - float(maps.shape[1] - 1))
    return wp.clamp(1.0 - wp.max(x, y), 1.0e-3, 1.0)


@wp.kernel(enable_backward=False)
def blend_frames(
    first: int,
    # in
    matches: MatchedFrames,
    pixels: wp.array[int],  # (N,) row-major
    interval: wp.array[int],  # (K,) frame before each sample
    share: wp.array[float],  # (K,) of the time to the frame after it, below 1
    eps: float,
    # out
    out: wp.array2d[float],  # (K, N) linear intensity
):
    """Intensities at some pixels, one pixel and sample per thread."""
    k, i = wp.tid()
    i += first
    j = interval[k]
    s = share[k]
    row = pixels[i] / matches.frames.shape[2]
    column = pixels[i] % matches.frames.shape[2]
    if s == 0.0:
        out[k, i] = matches.frames[j, row, column]
        return
    x = wp.vec2(float(column), float(row))
    p = origin_of_pixel(matches.ahead, j, s, x)
    q = origin_of_pixel(matches.back, j, 1.0 - s, x)
    before = (1.0 - s) * inside_weight(matches.logs, p)
    after = s * inside_weight(matches.logs, q)
    level = before * value_at(matches.logs, j, p) + after * value_at(matches.logs, j + 1, q)
    out[k, i] = wp.max(wp.exp(level / (before + after)) - eps, 0.0)


@wp.kernel(enable_backward=False)
def carry_doubts(
    first: int,
    # in
    matches: MatchedFrames,
    doubts: wp.array4d[float],  # (J, 2, H, W) of the frame before and of the one after
    pixels: wp.array[int],  # (N,) row-major
    interval: wp.array[int],  # (K,)
    share: wp.array[float],  # (K,)
    # out
    out: wp.array2d[float],  # (K, N)
):
    """Carry doubts along with what they are about, nearest neighbour; mean square of both frames' in time."""
    k, i = wp.tid()
    i += first
    j = interval[k]
    s = share[k]
    bottom = doubts.shape[2] - 1
    right = doubts.shape[3] - 1
    x = wp.vec2(float(pixels[i] % doubts.shape[3]), float(pixels[i] / doubts.shape[3]))
    p = origin_of_pixel(matches.ahead, j, s, x)
    q = origin_of_pixel(matches.back, j, 1.0 - s, x)
    a = doubts[j, 0, wp.clamp(int(p[1] + 0.5), 0, bottom), wp.clamp(int(p[0] + 0.5), 0, right)]
    b = doubts[j, 1, wp.clamp(int(q[1] + 0.5), 0, bottom), wp.clamp(int(q[0] + 0.5), 0, right)]
    out[k, i] = wp.sqrt((1.0 - s) * a * a + s * b * b)


def upload_matches(
    frames: NDArray[np.float32],
    ahead: NDArray[np.float32],
    back: NDArray[np.float32],
    eps: float,
    device: wp.Device,
) -> MatchedFrames:
    """Move frames, shape (J + 1, H, W), and the ways between them [px], (J, H, W, 2), to `device`."""
    out = MatchedFrames()
    out.frames = wp.array(frames, dtype=float, device=device)
    out.logs = wp.array(np.log(frames + np.float32(eps)), dtype=float, device=device)
    out.ahead = wp.array(ahead, dtype=wp.vec2, device=device)
    out.back = wp.array(back, dtype=wp.vec2, device=device)
    return out


def render_between(
    matches: MatchedFrames,
    pixels: NDArray[np.int32],
    interval: NDArray[np.int32],
    share: NDArray[np.float32],
    eps: float,
    device: wp.Device,
) -> Any:
    """Return intensities, Warp array of shape (K, N); see `blend_frames`."""
    out = wp.empty((len(share), len(pixels)), dtype=float, device=device)
    given = [wp.array(a, dtype=t, device=device) for a, t in ((pixels, int), (interval, int), (share, float))]
    launch.run_kernel(blend_frames, len(pixels), [matches, *given, eps, out], device, batch=len(share))
    return out


def render_doubt(
    matches: MatchedFrames,
    doubts: NDArray[np.float32],
    pixels: NDArray[np.int32],
    interval: NDArray[np.int32],
    share: NDArray[np.float32],
    device: wp.Device,
) -> NDArray[np.float32]:
    """Return doubts, shape (K, N); see `carry_doubts`."""
    out = wp.empty((len(share), len(pixels)), dtype=float, device=device)
    given = [wp.array(a, dtype=t, device=device) for a, t in ((pixels, int), (interval, int), (share, float))]
    maps = wp.array(doubts, dtype=float, device=device)
    launch.run_kernel(carry_doubts, len(pixels), [matches, maps, *given, out], device, batch=len(share))
    return np.asarray(out.numpy())
