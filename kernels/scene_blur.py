"""Blur of pictures by a symmetric kernel, along rows and then along columns."""

from __future__ import annotations

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.func
def mirrored_index(n: int, size: int) -> int:
    """Fold an index into a line of `size`, as reflect-101 does."""
    if n >= 0 and n < size:
        return n
    period = wp.max(2 * (size - 1), 1)
    n = wp.abs(n) % period
    return wp.min(n, period - n) % size


@wp.kernel(enable_backward=False)
def blur_rows(
    first: int,
    # in
    pictures: wp.array2d[float],  # (K, H · W)
    weights: wp.array[float],  # (R + 1,) middle, first neighbours, second neighbours and so on
    width: int,
    # out
    out: wp.array2d[float],  # (K, H · W)
):
    """Blur along rows, one pixel and picture per thread."""
    k, i = wp.tid()
    i += first
    x = i % width
    row = i - x
    total = weights[0] * pictures[k, i]
    for n in range(1, weights.shape[0]):
        left = pictures[k, row + mirrored_index(x - n, width)]
        total += weights[n] * (left + pictures[k, row + mirrored_index(x + n, width)])
    out[k, i] = total


@wp.kernel(enable_backward=False)
def blur_columns(
    first: int,
    # in
    pictures: wp.array2d[float],  # (K, H · W)
    weights: wp.array[float],  # (R + 1,)
    pixels: wp.array[int],  # (N,)
    width: int,
    # out
    out: wp.array2d[float],  # (K, N)
):
    """Blur along columns at the pixels asked for."""
    k, i = wp.tid()
    i += first
    pixel = pixels[i]
    x = pixel % width
    y = pixel / width
    height = pictures.shape[1] / width
    total = weights[0] * pictures[k, pixel]
    for n in range(1, weights.shape[0]):
        above = pictures[k, mirrored_index(y - n, height) * width + x]
        total += weights[n] * (above + pictures[k, mirrored_index(y + n, height) * width + x])
    out[k, i] = total


def blur_frames(
    pictures: wp.array, weights: NDArray[np.float32], width: int, pixels: NDArray[np.int32], device: wp.Device
) -> wp.array:
    """Return blurred pictures at some pixels, shape (K, N).

    Args:
        pictures: Shape (K, H · W), on `device`; continued by reflection about the outermost pixels.
        weights: Of the middle, the first neighbours, the second neighbours and so on.
        width: Columns of a picture.
        pixels: Row-major indices, shape (N,).
        device: Where to work.
    """
    # on the CPU ten times as fast as the kernels, whose loads the compiler does not gather into vectors
    return (_blur_by_opencv if device.is_cpu else blur_by_kernels)(pictures, weights, width, pixels, device)


def blur_by_kernels(
    pictures: wp.array, weights: NDArray[np.float32], width: int, pixels: NDArray[np.int32], device: wp.Device
) -> wp.array:
    """Do `blur_frames` on any device; arguments have the shape that it says."""
    samples, size = pictures.shape
    on, where = (wp.array(a, dtype=d, device=device) for a, d in ((weights, float), (pixels, int)))
    half = wp.empty((samples, size), dtype=float, device=device)
    launch.run_kernel(blur_rows, size, [pictures, on, width, half], device, batch=samples)
    out = wp.empty((samples, len(pixels)), dtype=float, device=device)
    launch.run_kernel(blur_columns, len(pixels), [half, on, where, width, out], device, batch=samples)
    return out


def _blur_by_opencv(
    pictures: wp.array, weights: NDArray[np.float32], width: int, pixels: NDArray[np.int32], device: wp.Device
) -> wp.array:
    samples, size = pictures.shape
    out = blur_pictures(pictures.numpy().reshape(samples, size // width, width), weights)
    out = out.reshape(samples, size)
    every = len(pixels) == size and np.array_equal(pixels, np.arange(size))
    # NumPy chooses columns into memory that runs down them, and kernels read along rows
    chosen = out if every else np.ascontiguousarray(out[:, pixels])
    return wp.array(chosen, dtype=float, device=device, copy=False)


def blur_pictures(pictures: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return blurred pictures, shape (K, H, W), as `blur_frames` does, on the host.

    Args:
        pictures: Shape (K, H, W); continued by reflection about the outermost pixels.
        weights: Of the middle, the first neighbours, the second neighbours and so on, shape (R + 1,).
    """
    line = np.concatenate([weights[:0:-1], weights])
    out = np.empty_like(pictures)
    for picture, place in zip(pictures, out, strict=True):
        cv2.sepFilter2D(picture, -1, line, line, dst=place, borderType=cv2.BORDER_REFLECT_101)
    return out
