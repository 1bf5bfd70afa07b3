"""Kernels of sensors, written and compiled on demand."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels.pixel_codegen_cpu import lane_scope, print_block_kernel
from dase.kernels.pixel_codegen_cuda import print_pixel_kernel, print_threshold_kernel
from dase.kernels.pixel_codegen_model import PixelModel, pixel_scope
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import function_from_text, lane_options


@lru_cache(maxsize=256)
def compose_pixels(stages: tuple[EffectStages, ...], source: str, sink: str, *, lanes: int = 0) -> wp.Kernel:
    """Return the kernel of a sensor.

    Args:
        stages: Effects, in order.
        source: `frames`, `log`, `layers`, or `background` for a scene of one layer.
        sink: `counts`, `keys`, or `labels` for keys with labels.
        lanes: Pixels per thread on the CPU; 0 for CUDA, where a thread has one.

    Returns:
        A kernel over (B, N) threads, or (B, blocks of pixels); `kernel_head` of
        `dase.kernels.pixel_codegen_cuda` names its arguments.
    """
    scope = pixel_scope(PixelModel(stages, source, sink))
    scope |= lane_scope(lanes, source) if lanes else {}
    options = lane_options() if lanes else {}
    return compile_text(source_text(stages, source, sink, lanes=lanes), "pixel_events", scope, **options)


@lru_cache(maxsize=256)
def compose_thresholds(stages: tuple[EffectStages, ...]) -> wp.Kernel:
    """Return a kernel over (B, N) threads that writes the thresholds of every pixel."""
    scope = pixel_scope(PixelModel(stages, "frames", "counts"))
    return compile_text(thresholds_text(stages), "pixel_thresholds", scope)


def compile_text(
    text: str, name: str, scope: dict[str, Any], *, registers: int | None = None, **more: Any
) -> wp.Kernel:
    """Return the kernel of a text.

    Args:
        text: Of a function.
        name: Of the function.
        scope: What its names mean.
        registers: Most registers of a thread on a GPU; None for as many as the compiler takes.
        **more: Options of its module.
    """
    # contraction: see dase.kernels.vector_math; loops over lanes stay loops, which the compiler turns into
    # vectors
    options = {"fuse_fp": False, "max_unroll": 0, **more}
    kernel: wp.Kernel = wp.kernel(
        function_from_text(text, name, scope), enable_backward=False, module="unique", module_options=options,
        cuda_max_registers=registers,
    )  # fmt: skip
    return kernel


def source_text(stages: tuple[EffectStages, ...], source: str, sink: str, *, lanes: int = 0) -> str:
    """Return the text of the kernel that `compose_pixels` compiles."""
    model = PixelModel(stages, source, sink)
    return print_block_kernel(model, lanes) if lanes else print_pixel_kernel(model)


def thresholds_text(stages: tuple[EffectStages, ...]) -> str:
    """Return the text of the kernel that `compose_thresholds` compiles."""
    return print_threshold_kernel(PixelModel(stages, "frames", "counts"))
