"""Kernels of sensors, written and compiled on demand."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels.pixel_codegen_cpu import Blocks
from dase.kernels.pixel_codegen_cuda import Writer
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import function_from_text


@lru_cache(maxsize=256)
def compose_pixels(stages: tuple[EffectStages, ...], source: str, sink: str, *, lanes: int = 0) -> wp.Kernel:
    """Return the kernel of a sensor.

    Args:
        stages: Effects, in order.
        source: `frames`, `log`, `layers`, or `background` for a scene of one layer.
        sink: `counts`, `keys`, or `labels` for keys with labels.
        lanes: Pixels per thread on the CPU; 0 for CUDA, where a thread has one.

    Returns:
        A kernel over (B, N) threads, or (B, blocks of pixels); `Writer.kernel` writes its arguments.
    """
    writer = writer_of(stages, source, sink, lanes)
    return compile_text(writer.kernel(), "pixel_events", writer.scope)


def writer_of(stages: tuple[EffectStages, ...], source: str, sink: str, lanes: int) -> Writer:
    """Return what writes the kernel that `compose_pixels` compiles."""
    return Blocks(stages, source, sink, lanes=lanes) if lanes else Writer(stages, source, sink, cuda=True)


@lru_cache(maxsize=256)
def compose_thresholds(stages: tuple[EffectStages, ...]) -> wp.Kernel:
    """Return a kernel over (B, N) threads that writes the thresholds of every pixel."""
    writer = Writer(stages, "frames", "counts", cuda=True)
    return compile_text(writer.thresholds(), "pixel_thresholds", writer.scope)


def compile_text(text: str, name: str, scope: dict[str, Any], **more: Any) -> wp.Kernel:
    """Return the kernel of a text; `more` are options of its module."""
    # contraction: see dase.kernels.vector_math; loops over lanes stay loops, which the compiler turns into
    # vectors
    options = {"fuse_fp": False, "max_unroll": 0, **more}
    kernel: wp.Kernel = wp.kernel(
        function_from_text(text, name, scope), enable_backward=False, module="unique", module_options=options
    )
    return kernel


def source_text(stages: tuple[EffectStages, ...], source: str, sink: str, *, lanes: int = 0) -> str:
    """Return the text of the kernel that `compose_pixels` compiles."""
    return writer_of(stages, source, sink, lanes).kernel()
