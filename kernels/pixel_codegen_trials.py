"""One kernel that simulates many models of a sensor over the same stimulus and sums up their events.

The kernel has every effect that any of the models has. An effect whose parameters are at their off values is
skipped, which changes nothing, bit for bit; so all models run through one compiled kernel. It differs from
the kernel of `dase.kernels.pixel_stages` in two more ways. Its time samples are the pixel's own: none where
the light of the pixel does not change. And an event is not stored but looked at, see
`dase.kernels.event_probes`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache

import warp as wp

from dase.kernels import pixel_stages
from dase.kernels.event_probes import (
    LANES,
    QUEUE,
    ProbeSums,
    observe_event,
    observe_queued_events,
    queue_event,
)
from dase.kernels.pixel_codegen_cpu import Blocks
from dase.kernels.pixel_codegen_cuda import VOLTAGE, Writer
from dase.kernels.pixel_compile import compile_text

FLAGS = "-march=native -mprefer-vector-width=512 -mllvm=-inline-threshold=400"
"""On a CPU: 16 lanes fill its longest vectors, which compilers shun by themselves, and what looks at events
is not copied to all places where there are some. The bits are the same."""


@wp.struct
class LightHistory:
    """Light of some pixels, each at times of its own; between them its logarithm runs straight."""

    start: wp.array[int]  # (N + 1,) first sample of each pixel, and the end
    stamp: wp.array[int]  # (M,) time of each sample [steps]; that of a pixel's first is 0
    intensity: wp.array[float]  # (M,) linear
    voltage: wp.array[float]  # (M,) logarithm of intensity + log_eps
    step: float  # [s]


@lru_cache(maxsize=64)
def compose_trials(stages: tuple[pixel_stages.EffectStages, ...], *, lanes: int = 1) -> wp.Kernel:
    """Return the kernel of all models with these effects, over (blocks of `lanes` models, N) threads.

    Its arguments are `first`, a `LightHistory`, pixels (N,), width, height, seeds (B,), parameters (B, P), maps
    (M, N) where an effect has any, `ProbeSums`.
    """
    if lanes == 1:
        writer: _Trials = _Threads(stages)
        return compile_text(writer.kernel(), "pixel_trials", writer.scope)
    writer = _Lanes(stages)
    return compile_text(writer.kernel(), "pixel_trials", writer.scope, cpu_compiler_flags=FLAGS)


def source_text(stages: tuple[pixel_stages.EffectStages, ...], *, lanes: int = 1) -> str:
    """Return the text of the kernel that `compose_trials` compiles."""
    return (_Lanes(stages) if lanes > 1 else _Threads(stages)).kernel()


def _number(value: float) -> str:
    return "wp.inf" if value == math.inf else f"float({value!r})"


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


class _Trials(Writer):
    """What the kernels of many models have in common, whatever runs side by side."""

    def head(self) -> list[str]:
        return [
            "def pixel_trials(first: int, source: Source, pixels: wp.array[int], width: int, height: int,",
            "                 seeds: wp.array[int], parameters: wp.array2d[float],",
            *(["                 maps: wp.array2d[float],"] if self.maps else []),
            "                 sink: Sink):",
        ]

    def unless_off(self, effect: pixel_stages.EffectStages, *lines: str) -> list[str]:
        if not effect.off:
            return list(lines)
        return [f"if {effect.name}_acts != 0:", *(f"    {line}" for line in lines)]

    def acts(self, effect: pixel_stages.EffectStages) -> list[str]:
        """Return the line that says whether an effect is on."""
        differs = " or ".join(f"{effect.name}_{p} != {_number(value)}" for p, value in effect.off)
        return [f"{effect.name}_acts = wp.where({differs}, 1, 0)"] if differs else []

    def restore(self) -> None:
        self.add(*(f"{name} = float(0.0)" for name in self.states))
        self.add(*(["leaving = 0.0"] if "leaving" in self.states else []))

    def loop(self) -> None:
        """One sample after the other."""
        self.add("stamp = int(0)", "for k in range(begin_at, end_at):")
        self.depth += 1
        self.add(
            "steps = source.stamp[k] - stamp", "dt = float(steps) * source.step", "sample = k - begin_at"
        )
        self.add("if sample == 0:", f"    dt = {pixel_stages.REST}")
        if self.asks("t") or self.asks("t64"):
            self.add("t64 = wp.float64(source.stamp[k]) * wp.float64(source.step)", "t = float(t64)")
        self.add("seen = source.intensity[k]", "level = source.voltage[k]")
        self.part(lambda: self.add("intensity = seen + 0.0", "voltage = level + 0.0"))
        self.light()
        lights = [effect for effect, _ in self.of("light")]
        if lights:
            acts = " or ".join(f"{effect.name}_acts != 0" if effect.off else "True" for effect in lights)
            self.part(lambda: self.add(f"if {acts}:", f"    {VOLTAGE}"))
        self.respond()
        self.sample()
        self.add("stamp = source.stamp[k]")
        self.depth -= 1

    def start_noise(self, effect: pixel_stages.EffectStages) -> None:
        self.add(*(f"{effect.name}_{name} = float(0.0)" for name in ("on", "off", "spend")))

    def instant(self, share: str, late: str) -> str:
        return f"instant(stamp, steps, source.step, {share}, {late})"

    def keep(self, time: str, polarity: str, label: str) -> str:
        return f"observe(sink, row, i, {time}, {polarity})"


SCOPE = {
    "Source": LightHistory, "Sink": ProbeSums, "observe": observe_event, "put_off": queue_event, "look_back": observe_queued_events,
    "instant": event_instant,
}  # fmt: skip


class _Threads(_Trials):
    """Writes the text of the kernel for CUDA: one model of one pixel per thread."""

    def __init__(self, stages: tuple[pixel_stages.EffectStages, ...]):
        super().__init__(stages, "frames", "keys", cuda=False)
        self.scope |= SCOPE

    def begin(self) -> None:
        super().begin()
        self.add("seed = seeds[row]")

    def pixel(self) -> None:
        super().pixel()
        for effect in self.stages:
            self.add(*self.acts(effect))
        self.add("begin_at = source.start[i]", "end_at = source.start[i + 1]")

    def ahead(self) -> None:
        """Samples of one pixel lie side by side in memory."""


class _Lanes(_Trials, Blocks):
    """Writes the text of the kernel for a CPU: a thread works on one pixel of several models.

    They see the same light, so its samples are read once, and what becomes of it is worked out in the CPU's
    own vectors. What none of the models of a thread has is skipped.
    """

    def __init__(self, stages: tuple[pixel_stages.EffectStages, ...]):
        Blocks.__init__(self, stages, "frames", "keys", lanes=LANES)
        self.scope |= SCOPE

    def keep(self, time: str, polarity: str, label: str) -> str:
        # what becomes of one event depends on few others; looked at together, they overlap
        return f"met = put_off(sink, slot, met, lane, {time}, {polarity})"

    def event(self, share: str, polarity: str, label: str) -> None:
        super().event(share, polarity, label)
        self.add(f"if met == {QUEUE}:", "    met = look_back(sink, start, i, met)")

    def loop(self) -> None:
        self.add("met = int(0)", "slot = i / sink.group")
        super().loop()
        self.add("look_back(sink, start, i, met)")

    def types(self) -> dict[str, str]:
        floats = ["on", "off", "mean_on", "mean_off", "nominal_on", "nominal_off", "intensity", "voltage"]
        floats += ["before", "after", "leaked_before", "asleep", "busy", *self.states, *self.places]
        floats += [f"{effect.name}_{q}" for effect, _ in self.of("noise") for q in ("on", "off", "spend")]
        floats += [local for local in self.draws if self.once(local)]
        ints = [*(f"{effect.name}_acts" for effect in self.stages), *(f"{local}_key" for local in self.draws)]
        kinds = {"Floats": floats, "Ints": ints, "Longs": ["leaves"]}
        return {name: kind for kind, names in kinds.items() for name in names}

    def part(self, write: Callable[[], None], *, when: str = "", then: tuple[str, ...] = ()) -> None:
        # models differ in their phase; one of 0 changes nothing
        super().part(write, when=when.removesuffix(" and phase != 0.0"), then=then)

    def start_noise(self, effect: pixel_stages.EffectStages) -> None:
        """Lanes are 0 where nothing has been written."""

    def whose(self) -> str:
        return "row = start + lane"

    def which(self) -> str:
        return "bits = busy_bits(busy_lanes, 0) & mine"

    def drawn(self, local: str, line: str) -> list[str]:
        # most effects are off, and a normal number takes as long as an event
        effect = next((e for e in self.stages if e.off and local.startswith(f"{e.name}_")), None)
        return [line] if effect is None else [f"{local} = float(0.0)", *self.unless_off(effect, line)]

    def lanes(self, lines: list[str], *, head: str = "", lane: str = "") -> None:
        """Write lines for one lane after the other; those of effects that no lane has are skipped."""
        if head:
            super().lanes(lines, head=head, lane=lane)
            return
        for guards, part in _guarded(lines):
            if guards:
                self.add(f"if {' or '.join(f'{name}_some != 0' for name in guards)}:")
                self.depth += 1
            super().lanes(part)
            self.depth -= bool(guards)

    def prologue(self) -> None:
        """What the models know of the pixel before its first sample."""
        start = self.starts()
        self.add("block, i = wp.tid()", "i += first", f"start = block * {self.size}")
        self.add("last = parameters.shape[0] - 1")
        self.add(f"mine = (1 << wp.min({self.size}, last + 1 - start)) - 1")
        self.add("pixel = pixels[i]", "x = pixel % width", "y = pixel / width")
        self.add("begin_at = source.start[i]", "end_at = source.start[i + 1]")
        self.add(*(f"{name}_lanes = {kind}()" for name, kind in self.types().items()))
        self.add(*(f"{effect.name}_some = int(0)" for effect in self.stages))
        self.where()

        def own() -> None:
            self.add("of = wp.min(start + lane, last)", "seed = seeds[of]")
            self.add(*(f"{name} = parameters[of, {at}]" for name, at in self.places.items()))
            self.add("nominal_on = on", "nominal_off = off")
            for effect in self.stages:
                acts = self.acts(effect)
                self.add(*acts)
                self.add(
                    f"{effect.name}_some = {effect.name}_some | {effect.name}_acts"
                    if acts
                    else f"{effect.name}_some = int(1)"
                )
            self.own_draws()
            self.add(*start)

        Blocks.lanes(self, self.written(own))


def _guarded(lines: list[str]) -> list[tuple[list[str], list[str]]]:
    """Split lines into runs, each with the effects of which one must act for it to do anything."""
    runs: list[tuple[list[str], list[str]]] = []
    for line in lines:
        if line.startswith((" ", "elif", "else")):
            runs[-1][1].append(line)
            continue
        asked = re.fullmatch(r"if (\w+_acts != 0(?: or \w+_acts != 0)*):", line)
        guards = re.findall(r"(\w+)_acts", asked.group(1)) if asked else []
        if runs and not guards and not runs[-1][0]:
            runs[-1][1].append(line)
        else:
            runs.append((guards, [line]))
    return runs
