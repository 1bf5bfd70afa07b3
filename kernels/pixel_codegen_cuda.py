"""The kernel of a sensor, one pixel per thread, for CUDA."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from dase.kernels.pixel_codegen import (
    Block,
    Line,
    Part,
    Statement,
    draws_of,
    if_block,
    lines,
    print_kernel,
    resolve_guards,
)
from dase.kernels.pixel_codegen_model import Outlet, PixelModel
from dase.kernels.pixel_codegen_program import (
    VOLTAGE,
    Program,
    assign_thresholds,
    draw_numbers,
    intensity_of_log,
    keep_states,
    make_program,
    pixel_places,
    put_counts,
    zero_counts,
)

# A load of a GPU takes hundreds of cycles, a sample without events some tens; more samples take registers
# from other threads
SAMPLES_AHEAD = 4
"""Stored samples of a pixel that are under way from memory at a time."""


@dataclass(frozen=True)
class OnePixel:
    """How a thread that has one pixel does things: as they stand.

    Args:
        asks: Whether an effect may be off, so that the kernel must ask.
    """

    asks: bool = False

    def lay_out(self, part: Part) -> tuple[Statement, ...]:
        """Return the statements of a part."""
        # a pixel is its own block: `then` belongs to the same condition, and no other thread may be
        # ahead, which is all that `handover` is about
        body = (*resolve_guards(part.body, ask=self.asks), *part.then)
        return (if_block(" and ".join(part.when), *body),) if part.when else body

    def lay_out_all(self, parts: Iterable[Part]) -> tuple[Statement, ...]:
        """Return the statements of parts one after the other."""
        return tuple(statement for part in parts for statement in self.lay_out(part))

    def lay_out_events(self, program: Program) -> tuple[Statement, ...]:
        """Return the events of a step, if it has any."""
        events = Part(program.events, when=(program.busy,))
        return *self.lay_out(Part(program.asleep)), *self.lay_out(events)


def print_pixel_kernel(model: PixelModel) -> str:
    """Return the text of the kernel of a sensor, over (B, N) threads."""
    emits = model.sink != "counts"
    if emits:
        # threads of a warp that reach an atomic addition one by one do not meet again behind it, and the rest
        # of the sample then runs once for each: events wait for the end of the sample, where all are together
        hold = "first_key = hold(sink, row, i, size, {time}, {code}, held, first_key)"
        model = replace(model, outlet=Outlet(emit=hold, emitted=lines("held += 1")))
    program, layout = make_program(model), OnePixel()
    samples = (
        *_look(model),
        *layout.lay_out_all(intensity_of_log(model)),
        *layout.lay_out_all(program.light),
        # light that is stored as logarithms already came as the voltage
        *(lines(VOLTAGE) if model.source != "log" else ()),
        *layout.lay_out_all(program.respond),
        *layout.lay_out_all(program.change),
        *layout.lay_out_events(program),
        *((if_block("held > 0", "keep_held(sink, row, i, held, first_key)", "held = 0"),) if emits else ()),
        *layout.lay_out(program.settle),
    )
    windows = loop_over_windows(
        layout.lay_out_all(zero_counts(model)),
        (*step_quantities(model), *samples),
        layout.lay_out_all(put_counts(model)),
    )
    begin = (
        # a launch may be a slab of the pixels, which begins at `first`
        *lines("row, i = wp.tid()", "i += first"),
        *place_pixel(program),
        Line("size = pixels.shape[0]"),
        *_prepare_look(model),
        *resolve_guards(program.begin, ask=False),
        *(lines("held = int(0)", "first_key = wp.int64(0)") if emits else ()),
    )
    return print_kernel(kernel_head(model), (*begin, windows, *layout.lay_out(keep_states(model))))


def print_threshold_kernel(model: PixelModel) -> str:
    """Return the text of the kernel that writes the thresholds of every pixel, over (B, N) threads."""
    head = [
        "def pixel_thresholds(first: int, pixels: wp.array[int], width: int, height: int, seed: int,",
        "                     parameters: wp.array2d[float],",
        *(["                     maps: wp.array2d[float],"] if model.maps else []),
        "                     out: wp.array3d[float]):",
    ]
    thresholds = assign_thresholds(model)
    body = (
        # keys of streams depend on names alone, so that these thresholds are those of the kernel of events
        # although nothing else is drawn here
        *lines("row, i = wp.tid()", "i += first"),
        *place_alone(model),
        *draw_numbers(draws_of(thresholds)),
        *resolve_guards(thresholds, ask=False),
        *lines("out[row, 0, i] = off", "out[row, 1, i] = on"),
    )
    return print_kernel(head, body)


def kernel_head(model: PixelModel, *, drawn: bool = False) -> list[str]:
    """Return the lines that name the kernel of a sensor and its arguments, whatever its threads do.

    Args:
        model: What the pixels are made from.
        drawn: Whether numbers that a pixel draws once are handed over, see `numbers_drawn_once`.
    """
    return [
        "def pixel_events(first: int, source: Source, clock: Clock, pixels: wp.array[int], width: int,",
        "                 height: int, begin: int, seed: int, parameters: wp.array2d[float],",
        *(["                 maps: wp.array2d[float],"] if model.maps else []),
        *(["                 numbers: wp.array2d[float],"] if drawn else []),
        "                 state_in: wp.array3d[float], state_out: wp.array3d[float], sink: Sink):",
    ]


def loop_over_windows(
    before: tuple[Statement, ...], samples: tuple[Statement, ...], after: tuple[Statement, ...]
) -> Block:
    """Return the loop over the samples of each window, with what a window begins and ends with."""
    # events that are kept one by one are of no window, and all samples one run
    window = lines("window = clock.window[part]") if after else ()
    body = (*before, Block("for k in range(clock.run[part], clock.run[part + 1]):", samples), *window, *after)
    return Block("for part in range(clock.window.shape[0]):", body)


def step_quantities(model: PixelModel) -> tuple[Statement, ...]:
    """Return what all pixels know of a step."""
    # `sample` counts over all chunks: it is the index of random numbers
    found = ["dt = element(clock.dt, k)", "sample = begin + k"]
    found += ["t = element(clock.t, k)"] if model.asks("t") else []
    found += ["t64 = clock.t64[k]"] if model.asks("t64") else []
    return lines(*found)


def place_alone(model: PixelModel) -> tuple[Statement, ...]:
    """Return where the pixel is, its parameters, and what depends on these."""
    found = ["pixel = pixels[i]", "x = pixel % width", "y = pixel / width"]
    found += [f"{name} = parameters[row, {at}]" for at, name in enumerate(model.parameters)]
    # before any effect changes them
    if model.asks("nominal_on", "nominal_off"):
        found += ["nominal_on = on", "nominal_off = off"]
    return *lines(*found), *pixel_places(model)


def place_pixel(program: Program) -> tuple[Statement, ...]:
    """Return where the pixel is, its parameters and its own random numbers."""
    return *place_alone(program.model), *draw_numbers(program.draws)


def _prepare_look(model: PixelModel) -> tuple[Statement, ...]:
    """Return what the pixel needs to know of its source, or asks memory for, before the first sample."""
    if model.source == "layers":
        return lines("near = layers_near(source, float(x), float(y))", "ground = ground_of(source)")
    if model.source == "background":
        return lines("ground = ground_of(source)")
    # the last sample again where there are fewer: no branch in the loop
    ahead = (f"ahead_{n} = source.values[wp.min({n}, last), i]" for n in range(SAMPLES_AHEAD))
    return lines("last = source.values.shape[0] - 1", *ahead)


def _look(model: PixelModel) -> tuple[Statement, ...]:
    """Return what the pixel sees."""
    if model.source == "layers":
        return lines("intensity = layer_intensity(source, ground, near, k, float(x), float(y))")
    if model.source == "background":
        return lines("intensity = background_at(source, ground, k, float(x), float(y))")
    # memory is asked for the samples to come while the present one is worked on
    return lines(
        f"{'voltage' if model.source == 'log' else 'intensity'} = ahead_0",
        *(f"ahead_{n} = ahead_{n + 1}" for n in range(SAMPLES_AHEAD - 1)),
        f"ahead_{SAMPLES_AHEAD - 1} = stored(source.values, wp.min(k + {SAMPLES_AHEAD}, last), i)",
    )
