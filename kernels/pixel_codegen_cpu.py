"""The kernel of a sensor, several neighbouring pixels per thread, for the CPU.

The lines are those of `dase.kernels.pixel_codegen_cuda`, in loops over the pixels of a block: what a pixel
remembers lies in Warp vectors, one lane per pixel, which the compiler turns into the CPU's own vectors
wherever a stage has no branches that it cannot turn into choices. Only pixels that have events are worked off
one by one. The events are the same, to the last bit, whatever the number of lanes.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import warp as wp

from dase.kernels.pixel_codegen_cuda import Writer
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.threshold_counts import block_functions, light_of
from dase.kernels.vector_math import lane_functions, lane_type, native_function

NAME = re.compile(r"[A-Za-z_]\w*")

BITS = """
typedef float V __attribute__((ext_vector_type({length})));
typedef bool B __attribute__((ext_vector_type({length})));
V all;
__builtin_memcpy(&all, &busy, sizeof(V));
const unsigned bits = __builtin_bit_cast(unsigned short, __builtin_convertvector(all != 0.0f, B));
return bits & (~0u << first);
"""


def _bits(lanes: int) -> object:
    """Return the function from a vector of 1 or 16 lanes to bits: which are not 0, from lane `first` on."""
    snippet = BITS.format(length=lanes) if lanes > 1 else "return busy[0] != 0.0f && first == 0;"
    return native_function(
        f"busy_bits_{lanes}", snippet, {"Lanes": lane_type(lanes)}, "busy: Lanes, first: int", "int"
    )


@wp.func_native("return __builtin_ctz((unsigned int)bits);")
def lowest_bit(bits: int) -> int:
    """Place of the lowest set bit; there must be one."""
    ...


@wp.func_native("__builtin_assume(lane >= 0 && lane < lanes); return lane;")
def within(lane: int, lanes: int) -> int:
    """Return the place of a lane, of which the compiler then knows that it does not count from the end."""
    ...


class Blocks(Writer):
    """Writes the text of one kernel; it runs over (B, blocks of `lanes` pixels) threads.

    The last block ends with the last pixel and may overlap the one before; the lanes in front of `new` are
    the other thread's.
    """

    def __init__(self, stages: tuple[EffectStages, ...], source: str, sink: str, *, lanes: int):
        super().__init__(stages, source, sink, cuda=False)
        self.size = lanes
        f, start = lane_functions(lanes), block_functions(lanes)
        self.scope |= {
            "Floats": f.Lanes,
            "Ints": lane_type(lanes, wp.int32),
            "Longs": lane_type(lanes, wp.int64),
            "load": f.load,
            "logarithms": f.logarithm,
            "columns": start.columns,
            "rows": start.rows,
            "layers_of": start.layers_of,
            "light_of": light_of(lanes, source),
            "busy_bits": _bits(lanes),
            "lowest_bit": lowest_bit,
            "within": within,
        }

    def types(self) -> dict[str, str]:
        """Return the Warp type of the lanes of every quantity that differs from pixel to pixel."""
        floats = ["x", "y", "on", "off", "mean_on", "mean_off", "radius", "intensity", "voltage"]
        floats += ["before", "after", "leaked_before", "asleep", "busy", *self.states, *self.maps]
        floats += [f"{effect.name}_{q}" for effect, _ in self.of("noise") for q in ("on", "off", "spend")]
        floats += [local for local in self.draws if self.once(local)]
        ints = ["pixel", "on_count", "off_count", *(f"{local}_key" for local in self.draws)]
        kinds = {"Floats": floats, "Ints": ints, "Longs": ["leaves"]}
        return {name: kind for kind, names in kinds.items() for name in names}

    def part(self, write: Callable[[], None], *, when: str = "", then: tuple[str, ...] = ()) -> None:
        """Write what every pixel of the block does."""
        super().part(lambda: self.lanes(self.written(write)), when=when, then=then)

    def written(self, write: Callable[[], None]) -> list[str]:
        """Return the lines that `write` adds."""
        (lines, self.lines), (depth, self.depth) = (self.lines, []), (self.depth, 0)
        write()
        written, self.lines, self.depth = self.lines, lines, depth
        return written

    def lanes(self, lines: list[str], *, head: str = "", lane: str = "") -> None:
        """Write lines for one lane after the other, or for the one that `lane` finds while `head`."""
        used = list(dict.fromkeys(NAME.findall("\n".join(lines))))
        known = self.types()
        laned = [name for name in used if name in known]
        self.add(head or f"for each in range({self.size}):")
        self.depth += 1
        self.add(lane or f"lane = within(each, {self.size})")
        self.add(self.whose())
        self.add(*(f"{name} = {name}_lanes[lane]" for name in laned if self.is_read(name, lines)))
        self.add(*lines)
        self.add(*(f"{name}_lanes[lane] = {name}" for name in laned if self.is_set(name, lines)))
        self.depth -= 1

    def whose(self) -> str:
        """Return the line that says what a lane is."""
        return "i = start + lane"

    @staticmethod
    def is_set(name: str, lines: list[str]) -> bool:
        """Return whether lines give a name a value."""
        targets = re.compile(rf"\s*(\w+, )*{name}(, \w+)* [-+]?= ")
        return any(targets.match(line) for line in lines)

    @staticmethod
    def is_read(name: str, lines: list[str]) -> bool:
        """Return whether lines ask for a name before they have given it a value on every way."""
        first = next(line for line in lines if re.search(rf"\b{name}\b", line))
        given = re.match(rf"(\w+, )*{name}(, \w+)* = (.*)", first)
        return not given or re.search(rf"\b{name}\b", given.group(3)) is not None

    def prologue(self) -> None:
        """What the pixels of the block know before their first sample."""
        start = self.starts()
        self.add("row, thread = wp.tid()", "size = pixels.shape[0]")
        self.add(f"start = wp.min((first + thread) * {self.size}, size - {self.size})")
        self.add(f"new = (first + thread) * {self.size} - start")
        nominal = {"on": "nominal_on", "off": "nominal_off"}
        self.add(*(f"{nominal.get(name, name)} = parameters[row, {at}]" for name, at in self.places.items()))
        types = self.types()
        # what nobody uses costs nothing
        self.add(*(f"{name}_lanes = {kind}()" for name, kind in types.items()))
        self.add("x_lanes = columns(pixels, start, width)", "y_lanes = rows(pixels, start, width)")
        self.add("near = int(0)", "ground = Ground()")
        if self.source in ("layers", "background"):
            self.add("ground = ground_of(source)")
        if self.source == "layers":
            self.add("near = layers_of(source, x_lanes, y_lanes)")

        def own() -> None:
            self.add("pixel = pixels[i]", "on = nominal_on", "off = nominal_off")
            self.own()
            self.add(*start)

        self.lanes(self.written(own))

    def look(self) -> None:
        """What the pixels see."""
        quantity = "voltage" if self.source == "log" else "intensity"
        if self.source in ("frames", "log"):
            self.add(f"{quantity}_lanes = load(source.values, k, start)")
        else:
            self.add(f"{quantity}_lanes = light_of(source, ground, k, start, x_lanes, y_lanes, near)")

    def logarithm(self) -> None:
        """Logarithms of the light."""
        self.add("voltage_lanes = logarithms(intensity_lanes, log_eps)")

    def events(self) -> None:
        """Events of the pixels that have any."""
        self.lanes([*self.asleep(), f"busy = wp.where({self.busy_when()}, 1.0, 0.0)"])
        self.add(self.which())
        found = f"lane = within(lowest_bit(bits), {self.size})"
        self.lanes(
            ["bits = bits & (bits - 1)", *self.written(self.busy)], head="while bits != 0:", lane=found
        )

    def which(self) -> str:
        """Return the line that says which lanes have events."""
        return "bits = busy_bits(busy_lanes, new)"

    def put_counts(self) -> None:
        """Hand the counts of a window over."""
        self.ours(super().put_counts)

    def keep_states(self) -> None:
        """Keep what the next chunk needs."""
        self.ours(super().keep_states)

    def ours(self, write: Callable[[], None]) -> None:
        """Write lines for the lanes that are no other thread's."""
        self.add("if lane >= new:")
        self.depth += 1
        write()
        self.depth -= 1
