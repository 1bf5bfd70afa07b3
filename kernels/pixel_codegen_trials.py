"""One kernel that simulates many models of a sensor over the same stimulus and sums up their events.

The kernel has every effect that any of the models has. An effect whose parameters are at their off values is
skipped, which changes nothing, bit for bit; so all models run through one compiled kernel. It differs from
the kernel of `dase.kernels.pixel_codegen_cuda` in two more ways. Its time samples are the pixel's own: none
where the light of the pixel does not change, unless an effect needs samples in between. And an event is not
stored but looked at, see `dase.kernels.event_probes`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.event_probes import (
    LANES,
    QUEUE,
    ProbeSums,
    observe_event,
    observe_queued_events,
    queue_event,
)
from dase.kernels.pixel_codegen import (
    Block,
    Line,
    Part,
    Statement,
    acting,
    if_block,
    lines,
    print_kernel,
    resolve_guards,
)
from dase.kernels.pixel_codegen_cpu import Lanes, lane_kinds, lane_scope
from dase.kernels.pixel_codegen_cuda import OnePixel, place_pixel
from dase.kernels.pixel_codegen_model import Outlet, PixelModel, pixel_scope
from dase.kernels.pixel_codegen_program import VOLTAGE, Program, draw_numbers, make_program, pixel_places
from dase.kernels.pixel_compile import compile_text
from dase.kernels.pixel_stages import REST, EffectStages

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.struct
class LightHistory:
    """Light of some pixels, each at times of its own; between them its logarithm runs straight."""

    start: wp.array[int]  # (N + 1,) first sample of each pixel, and the end
    stamp: wp.array[int]  # (M,) time of each sample [steps]; that of a pixel's first is 0
    intensity: wp.array[float]  # (M,) linear
    voltage: wp.array[float]  # (M,) logarithm of intensity + log_eps
    log_eps: float  # added to intensities before the logarithm
    finer: int  # samples that are taken per step of a stamp; 0 for those that are here alone
    step: float  # time between these, that of a stamp if there are none [s]


@lru_cache(maxsize=64)
def compose_trials(stages: tuple[EffectStages, ...], *, lanes: int = 1) -> wp.Kernel:
    """Return the kernel of all models with these effects, over (blocks of `lanes` models, N) threads.

    Its arguments are `first`, a `LightHistory`, pixels (N,), width, height, seeds (B,), parameters (B, P),
    maps (M, N) where an effect has any, `ProbeSums`.
    """
    scope = pixel_scope(_model(stages, lanes))
    if lanes > 1:
        scope |= lane_scope(LANES, "frames")
    scope |= {
        "Source": LightHistory,
        "Sink": ProbeSums,
        "observe": observe_event,
        "put_off": queue_event,
        "look_back": observe_queued_events,
        "instant": event_instant,
    }
    return compile_text(source_text(stages, lanes=lanes), "pixel_trials", scope)


def source_text(stages: tuple[EffectStages, ...], *, lanes: int = 1) -> str:
    """Return the text of the kernel that `compose_trials` compiles."""
    program = make_program(_model(stages, lanes))
    return _print_with_lanes(program) if lanes > 1 else _print_alone(program)


@wp.func
def event_instant(begin: int, steps: int, step: float, share: float, late: float) -> wp.int64:
    """When an event leaves [ns]: `share` of `steps` after `begin`, and `late` [s]."""
    nanoseconds = wp.float64(step) * wp.float64(1.0e9)
    at = wp.float64(begin) + wp.float64(wp.min(share, 1.0)) * wp.float64(steps)
    time = wp.int64(at * nanoseconds)
    if late > 0.0:
        time += wp.int64(wp.round(late * 1.0e9))
    return time


@wp.kernel(enable_backward=False)
def sum_pixel_groups(
    # in
    first: int,
    sums: wp.array3d[float],  # (B, G, SIZE)
    groups: int,  # that one thread adds up
    # out
    out: wp.array3d[float],  # (B, parts, SIZE)
):
    """Add up sums over groups of pixels, `groups` of them per thread."""
    row, i = wp.tid()
    i += first
    place = i % sums.shape[2]
    part = i / sums.shape[2]
    value = float(0.0)
    for g in range(part * groups, wp.min((part + 1) * groups, sums.shape[1])):
        value += sums[row, g, place]
    out[row, part, place] = value


def _model(stages: tuple[EffectStages, ...], lanes: int) -> PixelModel:
    """Return what the kernel is made from; its events are observed, on a CPU after a while."""
    instant = "instant(stamp, steps, source.step, {share}, {late})"
    if lanes == 1:
        observed = "observe(sink, row, i, {time}, {code})"
        outlet = Outlet(instant, observed, resumes=False, presets_noise=True)
    else:
        # what becomes of one event depends on few others; looked at together, they overlap
        queued = "met = put_off(sink, slot, met, lane, {time}, {code})"
        full = if_block(f"met == {QUEUE}", "met = look_back(sink, start, i, met)")
        outlet = Outlet(instant, queued, (full,), resumes=False)
    return PixelModel(stages, "frames", "keys", outlet)


def _head(model: PixelModel) -> list[str]:
    """Return the lines that name the kernel and its arguments."""
    return [
        "def pixel_trials(first: int, source: Source, pixels: wp.array[int], width: int, height: int,",
        "                 seeds: wp.array[int], parameters: wp.array2d[float],",
        *(["                 maps: wp.array2d[float],"] if model.maps else []),
        "                 sink: Sink):",
    ]


def _print_alone(program: Program) -> str:
    """Return the text of the kernel for CUDA: one model of one pixel per thread."""
    body = (
        *lines("row, i = wp.tid()", "i += first", "seed = seeds[row]"),
        *place_pixel(program),
        *(line for effect in program.model.stages for line in _acts(effect)),
        *lines("begin_at = source.start[i]", "end_at = source.start[i + 1]"),
        Line("size = pixels.shape[0]"),
        *resolve_guards(program.begin, ask=True),
        *_samples(program, OnePixel(asks=True)),
    )
    return print_kernel(_head(program.model), body)


def _print_with_lanes(program: Program) -> str:
    """Return the text of the kernel for a CPU: a thread works on one pixel of several models.

    They see the same light, so its samples are read once, and what becomes of it is worked out in the CPU's
    own vectors. What none of the models of a thread has is skipped.
    """
    model = program.model
    kinds = lane_kinds(
        program,
        before=("on", "off", "mean_on", "mean_off", "nominal_on", "nominal_off"),
        maps=model.parameters,
        ints=[f"{effect.name}_acts" for effect in model.stages],
    )
    busy = "bits = busy_bits(busy_lanes, 0) & mine"
    layout = Lanes(LANES, kinds, index="row = start + lane", busy=busy, asks=True)
    body = (
        *_prepare_models(program, layout),
        *lines("met = int(0)", "slot = i / sink.group"),
        *_samples(program, layout),
        Line("look_back(sink, start, i, met)"),
    )
    return print_kernel(_head(model), body)


def _prepare_models(program: Program, layout: Lanes) -> tuple[Statement, ...]:
    """Return what the models know of the pixel before its first sample.

    Lanes behind the last model are given its parameters, and `mine` leaves them out where there are events.
    """
    model, size = program.model, layout.size
    asked: list[Statement] = []
    for effect in model.stages:
        acts, some = _acts(effect), f"{effect.name}_some"
        asked += [*acts, Line(f"{some} = {some} | {effect.name}_acts" if acts else f"{some} = int(1)")]
    own = (
        *lines("of = wp.min(start + lane, last)", "seed = seeds[of]"),
        *lines(*(f"{name} = parameters[of, {at}]" for at, name in enumerate(model.parameters))),
        *lines("nominal_on = on", "nominal_off = off"),
        *asked,
        # most effects are off, and a normal number takes as long as an event
        *draw_numbers(program.draws, presets=True),
        *program.begin,
    )
    return (
        *lines("block, i = wp.tid()", "i += first", f"start = block * {size}"),
        *lines("last = parameters.shape[0] - 1", f"mine = (1 << wp.min({size}, last + 1 - start)) - 1"),
        *lines("pixel = pixels[i]", "x = pixel % width", "y = pixel / width"),
        *lines("begin_at = source.start[i]", "end_at = source.start[i + 1]"),
        *layout.declare(),
        *lines(*(f"{effect.name}_some = int(0)" for effect in model.stages)),
        *pixel_places(model),
        layout.loop(own),
    )


def _acts(effect: EffectStages) -> tuple[Line, ...]:
    """Return the line that says whether an effect is on, none where it always is."""
    differs = [
        f"{effect.name}_{name} != {'wp.inf' if value == math.inf else f'float({value!r})'}"
        for name, value in effect.off
    ]
    return lines(f"{effect.name}_acts = wp.where({' or '.join(differs)}, 1, 0)") if differs else ()


def _samples(program: Program, layout: OnePixel | Lanes) -> tuple[Statement, ...]:
    """Return the loop over the samples of the pixel: where its light changes, and in between if asked for."""
    model = program.model
    times = ("t64 = wp.float64(stamp + steps) * wp.float64(source.step)", "t = float(t64)")
    seen = Part(lines("intensity = seen + 0.0", "voltage = level + 0.0"))
    body = (
        *lines("dt = float(steps) * source.step"),
        if_block("sample == 0", f"dt = {REST}"),
        *(lines(*times) if model.asks("t", "t64") else ()),
        *lines("seen = source.intensity[k]", "level = source.voltage[k]"),
        # between the samples that are stored, where these differ
        if_block(
            "part + 1 < parts and level != level_before",
            "level = level_before + (level - level_before) * (float(part + 1) / float(parts))",
            "seen = wp.max(exponential(level) - source.log_eps, 0.0)",
        ),
        *layout.lay_out(seen),
        *layout.lay_out_all(program.light),
        *layout.lay_out_all(_voltage_of_light(model)),
        *layout.lay_out_all(program.respond),
        *layout.lay_out_all(program.change),
        *layout.lay_out_events(program),
        *layout.lay_out(program.settle),
        *lines("stamp += steps", "sample += 1"),
    )
    stored = (
        *lines("gap = source.stamp[k] * wp.max(source.finer, 1) - stamp"),
        # a pixel's first sample is at time 0
        Line("parts = wp.where(source.finer == 0, 1, wp.max(gap, 1))"),
        # gap / parts, without a division for which all lanes would wait
        Line("steps = wp.where(source.finer == 0, gap, wp.min(gap, 1))"),
        Block("for part in range(parts):", body),
        Line("level_before = source.voltage[k]"),
    )
    return (
        *lines("stamp = int(0)", "sample = int(0)", "level_before = float(0.0)"),
        Block("for k in range(begin_at, end_at):", stored),
    )


def _voltage_of_light(model: PixelModel) -> tuple[Part, ...]:
    """Return the part that takes the logarithm of light which an effect has changed; the others' is known."""
    effects = tuple(effect for stage in ("light", "current") for effect, _ in model.of(stage))
    if not effects:
        return ()
    asked = all(effect.off for effect in effects)
    condition = " or ".join(acting(effect) if effect.off else "True" for effect in effects)
    return (Part((Block(f"if {condition}:", lines(VOLTAGE), acting=effects if asked else ()),)),)
