"""The kernel of a sensor, several neighbouring pixels per thread, for the CPU.

The statements are those of `dase.kernels.pixel_codegen_cuda`, in loops over the pixels of a block: what a
pixel remembers lies in Warp vectors, one lane per pixel, which the compiler turns into the CPU's own vectors
wherever a stage has no branches that it cannot turn into choices. Only pixels that have events are worked off
one by one. The events are the same, to the last bit, whatever the number of lanes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp

from dase.kernels.pixel_codegen import (
    Block,
    Line,
    Part,
    Statement,
    if_block,
    lines,
    names_needed,
    names_written,
    print_kernel,
    resolve_guards,
)
from dase.kernels.pixel_codegen_cuda import kernel_head, loop_over_windows, step_quantities
from dase.kernels.pixel_codegen_model import PixelModel
from dase.kernels.pixel_codegen_program import (
    Program,
    intensity_of_log,
    keep_states,
    make_program,
    numbers_drawn_once,
    pixel_places,
    put_counts,
    take_numbers,
    zero_counts,
)
from dase.kernels.threshold_counts import block_functions, light_of
from dase.kernels.vector_math import lane_functions, lane_type, native_function


def busy_bits(lanes: int) -> Any:
    """Return the function from a vector of 1 or 16 lanes to bits: which are not 0, from lane `first` on."""
    snippet = """
        typedef float V __attribute__((ext_vector_type({length})));
        typedef bool B __attribute__((ext_vector_type({length})));
        V all;
        __builtin_memcpy(&all, &busy, sizeof(V));
        // 16 lanes make 16 bits, which is what the cast asks for
        const unsigned bits = __builtin_bit_cast(unsigned short, __builtin_convertvector(all != 0.0f, B));
        return bits & (~0u << first);
    """
    text = snippet.format(length=lanes) if lanes > 1 else "return busy[0] != 0.0f && first == 0;"
    arguments = "busy: Lanes, first: int"
    return native_function(f"busy_bits_{lanes}", text, {"Lanes": lane_type(lanes)}, arguments, "int")


@wp.func_native("return __builtin_ctz((unsigned int)bits);")
def lowest_bit(bits: int) -> int:
    """Place of the lowest set bit; there must be one."""
    ...


@wp.func_native("__builtin_assume(lane >= 0 && lane < lanes); return lane;")
def within_lanes(lane: int, lanes: int) -> int:
    """Return the place of a lane, of which the compiler then knows that it does not count from the end."""
    ...


@dataclass(frozen=True)
class Lanes:
    """How a thread that has a block of pixels does things: each part in a loop over its lanes.

    A quantity that differs from lane to lane lies in a vector called after it. A loop takes from the vectors
    what its statements need and puts back what they change; in between they are written as for one pixel.

    Args:
        size: Lanes of a block.
        kinds: Type of the vector of every quantity that differs from lane to lane.
        index: Line that says what a lane is.
        busy: Line that says which lanes have events, as bits.
        asks: Whether an effect may be off for some lanes. What none of them has is skipped as a whole.
    """

    size: int
    kinds: Mapping[str, str]
    index: str = "i = start + lane"
    busy: str = "bits = busy_bits(busy_lanes, new)"
    asks: bool = False

    def declare(self) -> tuple[Statement, ...]:
        """Return the statements that make the vectors, all 0; what nobody uses costs nothing."""
        return lines(*(f"{name}_lanes = {kind}()" for name, kind in self.kinds.items()))

    def loop(
        self, body: Iterable[Statement], *, head: str = "", lane: str = "", ask: bool | None = None
    ) -> Block:
        """Return statements for one lane after the other, or for the one that `lane` finds while `head`."""
        body = resolve_guards(body, ask=self.asks if ask is None else ask)
        # a name that the body sets before it reads it need not be fetched; one that it sets must be put back
        needed, written = names_needed(body), names_written(body)
        # all else is the same for all lanes, or is born and dies in the body
        shared = [name for name in needed if name in self.kinds]
        return Block(
            head or f"for each in range({self.size}):",
            (
                # `within` spares Warp's question whether an index counts from the end, which no vector has
                *lines(lane or f"lane = within(each, {self.size})", self.index),
                *lines(*(f"{name} = {name}_lanes[lane]" for name in shared if needed[name])),
                *body,
                *lines(*(f"{name}_lanes[lane] = {name}" for name in shared if name in written)),
            ),
        )

    def lay_out(self, part: Part) -> tuple[Statement, ...]:
        """Return the statements of a part."""
        body: tuple[Statement, ...] = part.body
        if part.handover:
            # the lanes before have worked along, but must not write: the other thread may be ahead
            body = (if_block("lane >= new", *body),)
        # `then` is of the whole block, such as the length of the step: it comes once, after the last lane
        loops = (*self._loops(body), *part.then)
        # a condition that lanes do not share cannot stand around the loop
        when = [condition for condition in part.when if not self._differs(condition)]
        return (if_block(" and ".join(when), *loops),) if when else loops

    def lay_out_all(self, parts: Iterable[Part]) -> tuple[Statement, ...]:
        """Return the statements of parts one after the other."""
        return tuple(statement for part in parts for statement in self.lay_out(part))

    def lay_out_events(self, program: Program) -> tuple[Statement, ...]:
        """Return the events of the lanes that have any, one lane after the other."""
        # a number, not a truth value: so the loop that asks becomes vectors, and few lanes answer yes
        condition = Line(f"busy = wp.where({program.busy}, 1.0, 0.0)")
        found = f"lane = within(lowest_bit(bits), {self.size})"
        # takes the lowest bit away, whose lane `found` has just fetched: `head` ends with the last busy lane
        events = (Line("bits = bits & (bits - 1)"), *program.events)
        return (
            *self._loops((*program.asleep, condition)),
            # lanes before `new` are left out: the thread of the block before has written their events
            Line(self.busy),
            self.loop(events, head="while bits != 0:", lane=found),
        )

    def _differs(self, condition: str) -> bool:
        return any(name in self.kinds for name in Line(condition).reads)

    def _loops(self, body: Iterable[Statement]) -> tuple[Statement, ...]:
        """Return a loop over the lanes, or several, so that effects which no lane has are skipped."""
        if not self.asks:
            return (self.loop(body),)
        # a question around a loop costs one branch for the block, inside of it one per lane and no vectors
        found: list[Statement] = []
        together: list[Statement] = []
        for statement in resolve_guards(body, ask=True):
            if not (isinstance(statement, Block) and statement.acting):
                together.append(statement)
                continue
            # what came before keeps its place in the order
            found += [self.loop(together)] if together else []
            together = []
            some = " or ".join(f"{effect.name}_some != 0" for effect in statement.acting)
            found.append(if_block(some, self.loop(self._chosen_by_lane(statement))))
        return (*found, self.loop(together)) if together else tuple(found)

    def _chosen_by_lane(self, statement: Block) -> tuple[Statement, ...]:
        """Return a condition as statements for all lanes, of which each then takes the new values or the old.

        Left as a condition, it becomes stores of some lanes alone, and the next loop, which loads the whole
        vector, would have to wait until they are in the cache.
        """
        condition = statement.head.removeprefix("if ").removesuffix(":")
        changed = [name for name in names_written(statement.body) if name in self.kinds]
        return (
            *lines(*(f"{name}_was = {name}" for name in sorted(changed))),
            *statement.body,
            *lines(*(f"{name} = wp.where({condition}, {name}, {name}_was)" for name in sorted(changed))),
        )


def lane_scope(lanes: int, source: str) -> dict[str, Any]:
    """Return what the names mean that only kernels with lanes have."""
    f, start = lane_functions(lanes), block_functions(lanes)
    return {
        "Floats": f.Lanes,
        "Ints": lane_type(lanes, wp.int32),
        "Longs": lane_type(lanes, wp.int64),
        "load": f.load,
        "logarithms": f.logarithm,
        "columns": start.columns,
        "rows": start.rows,
        "layers_of": start.layers_of,
        "light_of": light_of(lanes, source),
        "busy_bits": busy_bits(lanes),
        "lowest_bit": lowest_bit,
        "within": within_lanes,
    }


def lane_kinds(
    program: Program, *, before: Iterable[str], maps: Iterable[str], ints: Iterable[str]
) -> dict[str, str]:
    """Return the Warp types of the vectors of quantities that differ from lane to lane.

    Args:
        program: What the pixels do.
        before: Numbers that lanes have before the first sample.
        maps: Further ones that depend on the effects.
        ints: Whole numbers.
    """
    model = program.model
    floats = [
        *before,
        "intensity",
        "illumination",
        "voltage",
        "before",
        "after",
        "leaked_before",
        "asleep",
        "busy",
    ]
    floats += [*model.states, *maps]
    floats += [f"{effect.name}_{q}" for effect, _ in model.of("noise") for q in ("on", "off", "spend")]
    floats += [draw.name for draw in program.draws if draw.per_pixel]
    # keys of streams are of a pixel, so every lane has its own; events come at times in whole nanoseconds,
    # which 32 bits hold for 2 s only
    whole = [*ints, *(draw.key for draw in program.draws)]
    kinds = {"Floats": floats, "Ints": whole, "Longs": ["leaves"]}
    return {name: kind for kind, names in kinds.items() for name in names}


def print_block_kernel(model: PixelModel, lanes: int) -> str:
    """Return the text of the kernel of a sensor, over (B, blocks of `lanes` pixels) threads.

    The last block ends with the last pixel and may overlap the one before; the lanes in front of `new` are
    the other thread's.
    """
    program = make_program(model)
    kinds = lane_kinds(
        program,
        before=("x", "y", "on", "off", "mean_on", "mean_off", "radius"),
        maps=model.maps,
        ints=("pixel", "on_count", "off_count"),
    )
    layout = Lanes(lanes, kinds)
    samples = (
        *_look(model),
        *layout.lay_out_all(intensity_of_log(model)),
        *layout.lay_out_all(program.light),
        # of all lanes at once, as one by one they cost most of a step without events
        *(lines("voltage_lanes = logarithms(intensity_lanes, log_eps)") if model.source != "log" else ()),
        *layout.lay_out_all(program.respond),
        *layout.lay_out_all(program.change),
        *layout.lay_out_events(program),
        *layout.lay_out(program.settle),
    )
    windows = loop_over_windows(
        layout.lay_out_all(zero_counts(model)),
        (*step_quantities(model), *samples),
        layout.lay_out_all(put_counts(model)),
    )
    body = (*_prepare_block(program, layout), windows, *layout.lay_out(keep_states(model)))
    return print_kernel(kernel_head(model, drawn=bool(numbers_drawn_once(program.draws))), body)


def _prepare_block(program: Program, layout: Lanes) -> tuple[Statement, ...]:
    """Return what the pixels of the block know before their first sample."""
    model, size = program.model, layout.size
    # thresholds differ from pixel to pixel; `on` and `off` are the names of their lanes
    nominal = {"on": "nominal_on", "off": "nominal_off"}
    names = [nominal.get(name, name) for name in model.parameters]
    own = (
        *lines("pixel = pixels[i]", "on = nominal_on", "off = nominal_off"),
        *pixel_places(model),
        # cosines and logarithms of the C library, one pixel after the other, took a fifth of a chunk
        *take_numbers(program.draws),
        *program.begin,
    )
    return (
        # the last block is pushed back rather than cut, so that every loop has `size` turns
        *lines(
            "row, thread = wp.tid()",
            "size = pixels.shape[0]",
            f"start = wp.min((first + thread) * {size}, size - {size})",
            f"new = (first + thread) * {size} - start",
            *(f"{name} = parameters[row, {at}]" for at, name in enumerate(names)),
        ),
        *layout.declare(),
        *lines(
            "x_lanes = columns(pixels, start, width)",
            "y_lanes = rows(pixels, start, width)",
            # Warp wants a value and a type of names that sources without layers never set
            "near = int(0)",
            "ground = Ground()",
        ),
        *(lines("ground = ground_of(source)") if model.source in ("layers", "background") else ()),
        # bits of the layers that may come near any of the lanes; all others are never looked at
        *(lines("near = layers_of(source, x_lanes, y_lanes)") if model.source == "layers" else ()),
        layout.loop(own),
    )


def _look(model: PixelModel) -> tuple[Statement, ...]:
    """Return what the pixels see."""
    if model.source in ("frames", "log"):
        quantity = "voltage" if model.source == "log" else "intensity"
        return lines(f"{quantity}_lanes = load(source.values, k, start)")
    return lines("intensity_lanes = light_of(source, ground, k, start, x_lanes, y_lanes, near)")
