"""Pictures of which every pixel shows the one behind its own colour filter."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.kernel(enable_backward=False)
def choose_colours(
    first: int,
    # in
    red: wp.array2d[float],  # (K, H · W) linear intensity
    green: wp.array2d[float],  # (K, H · W)
    blue: wp.array2d[float],  # (K, H · W)
    colours: wp.array[wp.uint8],  # (H · W,) 0 for red, 1 for green, 2 for blue
    pixels: wp.array[int],  # (N,)
    # out
    out: wp.array2d[float],  # (K, N) linear intensity
):
    """Take each pixel from the picture of its colour, one pixel and sample per thread."""
    k, i = wp.tid()
    i += first
    pixel = pixels[i]
    colour = int(colours[pixel])
    if colour == 0:
        out[k, i] = red[k, pixel]
    elif colour == 1:
        out[k, i] = green[k, pixel]
    else:
        out[k, i] = blue[k, pixel]


def mosaic_pictures(
    pictures: tuple[wp.array, wp.array, wp.array],
    colours: NDArray[np.uint8],
    pixels: NDArray[np.int32],
    device: wp.Device,
) -> wp.array:
    """Return what pixels behind colour filters see, shape (K, N).

    Args:
        pictures: In red, green and blue light, shape (K, H · W) each, on `device`.
        colours: 0, 1 or 2 for red, green or blue, shape (H · W,).
        pixels: Row-major indices, shape (N,).
        device: Where to work.
    """
    samples = pictures[0].shape[0]
    out = launch.new_array((samples, len(pixels)), wp.float32, device)
    inputs = [wp.array(a, dtype=d, device=device) for a, d in ((colours, wp.uint8), (pixels, int))]
    launch.run_kernel(choose_colours, len(pixels), [*pictures, *inputs, out], device, batch=samples)
    return out
