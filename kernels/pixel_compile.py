"""Kernels of sensors, written and compiled on demand."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.pixel_codegen_cpu import lane_scope, print_block_kernel
from dase.kernels.pixel_codegen_cuda import print_pixel_kernel, print_threshold_kernel
from dase.kernels.pixel_codegen_model import PixelModel, pixel_scope
from dase.kernels.pixel_codegen_program import make_program, numbers_drawn_once
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.random import normal, stream_key, stream_number, uniform
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
        `dase.kernels.pixel_codegen_cuda` names its arguments. With lanes it takes what `streams_drawn_once`
        says and `draw_once` draws, if that is anything.
    """
    scope = pixel_scope(PixelModel(stages, source, sink))
    scope |= lane_scope(lanes, source) if lanes else {}
    text, registers = source_text(stages, source, sink, lanes=lanes), register_bound(stages, lanes)
    return compile_text(text, "pixel_events", scope, registers=registers)


@lru_cache(maxsize=256)
def streams_drawn_once(
    stages: tuple[EffectStages, ...], source: str, sink: str
) -> tuple[tuple[int, bool], ...]:
    """Return the streams of which a pixel takes one number for good, and whether that is a normal one.

    A GPU draws them anew in every chunk, which costs it no more than to read them would.
    """
    draws = numbers_drawn_once(make_program(PixelModel(stages, source, sink)).draws)
    return tuple((stream_number(draw.name), draw.kind == "normal") for draw in draws)


@lru_cache(maxsize=1)
def drawing_kernel() -> wp.Kernel:
    """Return the kernel of the numbers that pixels draw once, over (D, N) threads."""

    @wp.kernel(enable_backward=False, module="unique", module_options=lane_options())
    def draw_once(
        first: int,
        # in
        pixels: wp.array[int],  # (N,) row-major indices
        seed: int,
        stream: wp.array[int],  # (D,)
        is_normal: wp.array[int],  # (D,) 0 for a uniform number
        # out
        drawn_out: wp.array2d[float],  # (D, N)
    ):
        """Draw the number of one stream and pixel."""
        d, i = wp.tid()
        i += first
        key = stream_key(seed, stream[d], pixels[i])
        if is_normal[d] != 0:
            drawn_out[d, i] = normal(key, 0)
        else:
            drawn_out[d, i] = uniform(key, 0)

    return draw_once


def register_bound(stages: tuple[EffectStages, ...], lanes: int) -> int | None:
    """Return the most registers that a thread of a sensor's kernel may take on a GPU, None for any number."""
    # left alone, the compiler takes 137 for a noisy DAVIS346 and 190 for one in a stream, and a
    # multiprocessor then runs 8 warps; with 128 it runs 16, of which a stream took two thirds of the time on
    # an H100, and some 12 bytes of a pixel go to memory. Streams without noise were slower with a bound
    noisy = any(stage == "noise" for effect in stages for stage, _ in effect.functions)
    return 128 if noisy and not lanes else None


@lru_cache(maxsize=256)
def compose_thresholds(stages: tuple[EffectStages, ...]) -> wp.Kernel:
    """Return a kernel over (B, N) threads that writes the thresholds of every pixel."""
    scope = pixel_scope(PixelModel(stages, "frames", "counts"))
    return compile_text(thresholds_text(stages), "pixel_thresholds", scope)


def compile_text(text: str, name: str, scope: dict[str, Any], *, registers: int | None = None) -> wp.Kernel:
    """Return the kernel of a text.

    Args:
        text: Of a function.
        name: Of the function.
        scope: What its names mean.
        registers: Most registers of a thread on a GPU; None for as many as the compiler takes.
    """
    # contraction: see dase.kernels.vector_math; loops over lanes stay loops, which the compiler turns into
    # vectors
    options = {"fuse_fp": False, "max_unroll": 0, "cpu_compiler_flags": CPU_FLAGS}
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
