"""The kernel of a sensor before many scenes at once, each with parameters and random numbers of its own.

The statements are those of a sensor before one scene, and so are the events, to the last bit. A row is a
scene with its parameters, its seed and the places of its pixels on the camera; an event goes into the grid of
its window (`dase.kernels.window_sinks`) instead of being stored.
"""

from __future__ import annotations

from functools import lru_cache

import warp as wp

from dase.kernels.pixel_codegen import Line, Statement, lines, print_kernel, resolve_guards
from dase.kernels.pixel_codegen_cpu import Lanes, lane_kinds, lane_scope
from dase.kernels.pixel_codegen_cuda import OnePixel, loop_over_windows, place_pixel, step_quantities
from dase.kernels.pixel_codegen_model import PixelModel, pixel_scope
from dase.kernels.pixel_codegen_program import (
    VOLTAGE,
    Program,
    draw_numbers,
    keep_states,
    make_program,
    pixel_places,
)
from dase.kernels.pixel_compile import compile_text, register_bound
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.scene_layers import Frames
from dase.kernels.scene_windows import LayerScenes, layers_of_scene
from dase.kernels.vector_math import lane_functions
from dase.kernels.window_sinks import DEPOSITS, WindowGrids


@wp.struct
class StoredScenes:
    """B scenes of stored intensities."""

    values: wp.array3d[float]  # (B, K, N)
    light: wp.array2d[float]  # (B, K) all intensities are multiplied by


@wp.func
def frames_of_scene(scenes: StoredScenes, row: int) -> Frames:
    """Stored intensities of one scene, shape (K, N)."""
    frames = Frames()
    frames.values = scenes.values[row]
    return frames


SCENES = {"layers": (LayerScenes, layers_of_scene), "frames": (StoredScenes, frames_of_scene)}
"""What pixels see, by the name of its source: the scenes of all rows, and what gives those of one row."""


@lru_cache(maxsize=64)
def compose_scenes(
    stages: tuple[EffectStages, ...], source: str, deposit: str, *, lanes: int = 0
) -> wp.Kernel:
    """Return the kernel of a sensor before many scenes, over (B, N) threads, or (B, blocks of pixels).

    Its arguments are `first`, the scenes of `SCENES`, a `SampleClock` whose runs are the windows, places of
    pixels (B, N), width, height, samples seen before, seeds (B,), parameters (B, P), maps (B, M, N) where an
    effect has any, states before and after (S, B, N), intensities at the ends of windows (W, B, N), and
    `WindowGrids`.

    Args:
        stages: Effects, in order.
        source: `layers` or `frames`.
        deposit: One of `dase.kernels.window_sinks.DEPOSITS`.
        lanes: Pixels per thread on the CPU; 0 for CUDA, where a thread has one.
    """
    model = PixelModel(stages, source, "keys")
    kind, of_row = SCENES[source]
    scope = pixel_scope(model)
    # a light of layers or of frames, never of logarithms: the windows' ends are handed over as intensities
    if lanes:
        scope |= lane_scope(lanes, source) | {"store": lane_functions(lanes).store}
    scope |= {"Scenes": kind, "scene_of": of_row, "Sink": WindowGrids, "deposit": DEPOSITS[deposit]}
    registers = register_bound(stages, lanes)
    text = source_text(stages, source, lanes=lanes)
    return compile_text(text, "pixel_scenes", scope, registers=registers)


def source_text(stages: tuple[EffectStages, ...], source: str, *, lanes: int = 0) -> str:
    """Return the text of the kernel that `compose_scenes` compiles."""
    program = make_program(PixelModel(stages, source, "keys"))
    return _print_blocks(program, lanes) if lanes else _print_pixels(program)


def _head(model: PixelModel) -> list[str]:
    """Return the lines that name the kernel and its arguments."""
    return [
        "def pixel_scenes(first: int, scenes: Scenes, clock: Clock, places: wp.array2d[int], width: int,",
        "                 height: int, begin: int, seeds: wp.array[int], parameters: wp.array2d[float],",
        *(["                 all_maps: wp.array3d[float],"] if model.maps else []),
        "                 state_in: wp.array3d[float], state_out: wp.array3d[float],",
        "                 frames: wp.array3d[float], sink: Sink):",
    ]


def _of_row(model: PixelModel) -> tuple[Statement, ...]:
    """Return what a row has of its own, under the names that statements of one scene ask for."""
    # views and numbers, no copies: the statements of one scene then serve as they are
    return lines(
        "seed = seeds[row]",
        "pixels = places[row]",
        "size = places.shape[1]",
        "source = scene_of(scenes, row)",
        *(("maps = all_maps[row]",) if model.maps else ()),
        *(("near = int(0)", "ground = ground_of(source)") if model.source == "layers" else ()),
    )


def _lit(intensity: str) -> str:
    """Return the expression of what reaches a pixel of an intensity."""
    return f"{intensity} * scenes.light[row, k]"


def _print_pixels(program: Program) -> str:
    """Return the text of the kernel for CUDA: one pixel of a scene per thread."""
    model, layout = program.model, OnePixel()
    # a box holds what a layer covers during one window: which layers are near is asked anew for each
    if model.source == "layers":
        look = _lit("layer_intensity(source, ground, near, k, float(x), float(y))")
        window = ("source.box = scenes.box[row, part]", "near = layers_near(source, float(x), float(y))")
    else:
        look, window = _lit("stored(source.values, k, i)"), ()
    samples = (
        *step_quantities(model),
        # a copy: effects change the intensity, and `seen` is what the window hands over
        *lines(f"seen = {look}", "intensity = seen + 0.0"),
        *layout.lay_out_all(program.light),
        Line(VOLTAGE),
        *layout.lay_out_all(program.respond),
        *layout.lay_out_all(program.change),
        *layout.lay_out_events(program),
        *layout.lay_out(program.settle),
    )
    body = (
        *lines("row, i = wp.tid()", "i += first"),
        *_of_row(model),
        *place_pixel(program),
        *resolve_guards(program.begin, ask=False),
        # a window without samples hands 0 over; Warp wants the name to have a value before the loop
        Line("seen = float(0.0)"),
        loop_over_windows(lines(*window), samples, lines("frames[part, row, i] = seen")),
        *layout.lay_out(keep_states(model)),
    )
    return print_kernel(_head(model), body)


def _print_blocks(program: Program, size: int) -> str:
    """Return the text of the kernel for a CPU: a block of `size` pixels of a scene per thread."""
    model = program.model
    kinds = lane_kinds(
        program,
        before=("x", "y", "on", "off", "mean_on", "mean_off", "radius"),
        maps=model.maps,
        ints=("pixel",),
    )
    layout = Lanes(size, kinds)
    # as in `_print_pixels`, for all lanes at once: a layer is near the block where it is near any of them
    if model.source == "layers":
        look = "light_of(source, ground, k, start, x_lanes, y_lanes, near)"
        window = ("source.box = scenes.box[row, part]", "near = layers_of(source, x_lanes, y_lanes)")
    else:
        look, window = "load(source.values, k, start)", ()
    samples = (
        *step_quantities(model),
        # one factor for the row: the same expression serves numbers and vectors
        *lines(f"seen_lanes = {_lit(look)}", "intensity_lanes = seen_lanes + Floats()"),
        *layout.lay_out_all(program.light),
        Line("voltage_lanes = logarithms(intensity_lanes, log_eps)"),
        *layout.lay_out_all(program.respond),
        *layout.lay_out_all(program.change),
        *layout.lay_out_events(program),
        *layout.lay_out(program.settle),
    )
    body = (
        *_prepare_block(program, layout),
        Line("seen_lanes = Floats()"),
        # of two blocks that overlap both write the same
        loop_over_windows(lines(*window), samples, lines("store(frames[part, row], start, seen_lanes)")),
        *layout.lay_out(keep_states(model)),
    )
    return print_kernel(_head(model), body)


def _prepare_block(program: Program, layout: Lanes) -> tuple[Statement, ...]:
    """Return what the pixels of a block know before their first sample."""
    model, size = program.model, layout.size
    # thresholds differ from pixel to pixel; `on` and `off` are the names of their lanes
    nominal = {"on": "nominal_on", "off": "nominal_off"}
    names = [nominal.get(name, name) for name in model.parameters]
    own = (
        *lines("pixel = pixels[i]", "on = nominal_on", "off = nominal_off"),
        *pixel_places(model),
        *draw_numbers(program.draws),
        *program.begin,
    )
    return (
        Line("row, thread = wp.tid()"),
        *_of_row(model),
        # the last block is pushed back rather than cut, so that every loop has `size` turns
        *lines(
            f"start = wp.min((first + thread) * {size}, size - {size})",
            f"new = (first + thread) * {size} - start",
            *(f"{name} = parameters[row, {at}]" for at, name in enumerate(names)),
        ),
        *layout.declare(),
        *lines(
            "x_lanes = columns(pixels, start, width)",
            "y_lanes = rows(pixels, start, width)",
        ),
        layout.loop(own),
    )
