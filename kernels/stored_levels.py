"""Stored pictures of 8 bits: light is looked up by level, so that pictures stay a quarter as large.

Only on a CPU do kernels read levels themselves; a GPU turns them into light once they are there.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

LEVELS = 256


@wp.struct
class Levels:
    """Stored samples as levels of light."""

    values: wp.array2d[wp.uint8]  # (K, N)
    light: wp.array[float]  # (256,) linear intensity of each level


@wp.kernel(enable_backward=False)
def look_up(
    first: int,
    # in
    values: wp.array2d[wp.uint8],  # (K, N)
    light: wp.array[float],  # (256,)
    # out
    out: wp.array2d[float],  # (K, N)
):
    """Turn levels into light."""
    k, i = wp.tid()
    i += first
    out[k, i] = light[int(values[k, i])]


def upload_levels(values: NDArray[np.uint8], light: NDArray[np.float32], device: wp.Device) -> Levels:
    """Return stored levels on a device; on a CPU they are `values` themselves.

    Args:
        values: Shape (K, N), each row without gaps.
        light: Linear intensity of each level, shape (256,).
        device: Where to.
    """
    out = Levels()
    out.values = wp.array(values, dtype=wp.uint8, device=device, copy=False)
    out.light = wp.array(light, dtype=float, device=device)
    return out


def light_of_levels(levels: Levels, device: wp.Device) -> wp.array:
    """Return linear intensities, float32, shape (K, N)."""
    samples, pixels = levels.values.shape
    out = launch.new_array((samples, pixels), wp.float32, device)
    launch.run_kernel(look_up, pixels, [levels.values, levels.light, out], device, batch=samples)
    return out
