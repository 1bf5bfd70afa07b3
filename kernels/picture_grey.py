"""Grey values of pictures with three colours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

# as NumPy has it: each product is rounded, then each sum
wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "fuse_fp": False})


@wp.func_native(
    """
    const unsigned char* __restrict__ from = (const unsigned char*)pictures.data[picture];
    float* __restrict__ to = (float*)greys.data[picture];
    for (int i = 0; i < size; ++i) {
        float sum = (float)from[3 * i] * blue;
        sum += (float)from[3 * i + 1] * green;
        to[i] = sum + (float)from[3 * i + 2] * red;
    }
"""
)
def sum_colours(
    pictures: wp.array[wp.uint64],
    picture: int,
    size: int,
    blue: float,
    green: float,
    red: float,
    greys: wp.array[wp.uint64],
):
    """Do what `weigh_colours` does with one picture; arguments have the shape that it says."""
    ...


@wp.kernel(enable_backward=False)
def weigh_colours(
    first: int,
    # in
    pictures: wp.array[wp.uint64],  # (K,) addresses of N times blue, green and red, 8 bits each
    size: int,  # N
    blue: float,  # weights
    green: float,
    red: float,
    # out
    greys: wp.array[wp.uint64],  # (K,) addresses of N float32
):
    """Sum up the weighted colours of one picture per thread of a CPU."""
    _, k = wp.tid()
    sum_colours(pictures, first + k, size, blue, green, red, greys)


def write_greys(
    pictures: Sequence[NDArray[np.uint8]],
    weights: Sequence[np.float32],
    greys: Sequence[NDArray[np.float32]],
) -> None:
    """Write what weights of blue, green and red make of pictures.

    Args:
        pictures: Each of shape (H, W, 3), without gaps.
        weights: Of the three.
        greys: Where the sums go, each of shape (H, W), without gaps.
    """
    cpu = launch.find_device("cpu")
    places = [
        wp.array(np.array([a.__array_interface__["data"][0] for a in arrays], np.uint64), device=cpu)
        for arrays in (pictures, greys)
    ]
    inputs = [places[0], greys[0].size, *weights, places[1]]
    launch.run_kernel(weigh_colours, len(greys), inputs, cpu)
