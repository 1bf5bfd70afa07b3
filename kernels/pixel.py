"""The effects of a sensor, composed into one kernel per pixel.

A pixel turns light into events in this order; each effect adds Warp functions at some of these stages:

    light      (intensity, ...)           -> intensity            what reaches the photodiode
    log        voltage = log(intensity + log_eps)
    respond    (voltage, intensity, log_eps, ...) -> voltage      photoreceptor
    threshold  (on, off, ...)             -> on, off              once per pixel [log intensity]
    redraw     (on, off, ...)             -> on, off              anew after each event; random numbers too
    drift      (intensity, on, off, ...)  -> drift                of the change towards ON [log intensity/s]
    noise      (intensity, on, off, ...)  -> rate_on, rate_off    of events without a change [Hz]
    count      exact threshold crossings of the change since the last event
    gate       (age, ...)                 -> wait                 time the pixel stays dead [s]
    delay      (intensity, polarity, ...) -> delay                until the event leaves the pixel [s]

A stage function asks for what it needs by the names of its arguments: the quantities above, `t`, `dt`, `x`,
`y`, `t64` (t in double precision, for phases of long recordings), `radius` (distance from the middle of the
sensor to its corner is 1), `nominal_on`, `nominal_off` (thresholds before any effect), parameters and states
of its effect, random numbers (`uniform`, `normal`: new ones at every sample; `pixel_uniform`, `pixel_normal`:
one for each pixel; `_2` and so on for more), maps of its effect (one value for each pixel). It returns its
quantity, then the new values of its states.
`compose` writes the kernel that calls all of them, one line each, so that a sensor costs one pass over its
samples whatever effects it has. Random numbers are counter-based, keyed by seed, effect, pixel and sample:
they do not depend on the other effects, on chunks, threads or the batch.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import warp as wp

from dase.kernels.counts import SOURCES
from dase.kernels.lanes import from_text, functions, whole
from dase.kernels.random import key, normal, stream, uniform, waiting
from dase.kernels.scene import Frames as Frames
from dase.kernels.scene import background_at, ground_of, layer_intensity, layers_near

REST = 1e30
"""Duration of the rest before the first sample [s]: filters start settled."""

AHEAD = 4
"""Stored samples of a pixel that are under way from memory at a time."""

LATEST = 1.0
"""Longest time from a crossing to its event's leaving the pixel [s]."""

SIGNAL, LEAK, SHOT = 0, 1, 2
"""Labels of events: places in `dase.events.LABELS`."""

STAGES = ("light", "respond", "threshold", "redraw", "drift", "noise", "gate", "delay")
CORE = ("on", "off", "phase", "log_eps")
"""Parameters of the change detector itself; they lead the parameter vector."""

QUANTITIES = {
    "light": ("intensity",),
    "respond": ("voltage", "intensity", "log_eps"),
    "threshold": ("on", "off"),
    "redraw": ("on", "off"),
    "drift": ("intensity", "on", "off"),
    "noise": ("intensity", "on", "off"),
    "gate": ("age",),
    "delay": ("intensity", "polarity"),
}
"""What the functions of a stage may ask for beside parameters, states, random numbers and `ANYWHERE`."""

ANYWHERE = ("x", "y", "t", "dt", "t64", "radius", "nominal_on", "nominal_off")
"""What the functions of every stage may ask for; `t`, `dt` and `t64` only where there are samples."""

COUNT_ON = "{0} = wp.where({0} < 8388608.0, {0} + 1.0, 1.0)"
"""Counts events in float32 without coming to a halt where it resolves no more; random numbers then repeat."""

VOLTAGE = "voltage = logarithm(Lane(intensity), log_eps)[0]"

DRAW = re.compile(r"(pixel_)?(uniform|normal)(_\d)?")


@dataclass(frozen=True)
class Stages:
    """The part of an effect that the composer sees.

    Args:
        name: Of the effect, a Python identifier.
        functions: (stage, Warp function) pairs.
        parameters: Names, in the order of their places in the parameter vector.
        states: Names of what a pixel remembers from sample to sample; all zero at the start.
        delays: Whether the events that `gate` holds back come later; otherwise they are lost.
        label: Of the events that `noise` makes.
        off: (parameter, value) pairs; an effect with all of them changes nothing.
        maps: Names of quantities that every pixel has its own value of, handed over as arrays.
    """

    name: str
    functions: tuple[tuple[str, Any], ...]
    parameters: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    delays: bool = False
    label: int = SHOT
    off: tuple[tuple[str, float], ...] = ()
    maps: tuple[str, ...] = ()


@wp.struct
class Clock:
    """Time samples of one chunk; sample k ends the step that begins at sample k - 1."""

    t: wp.array[float]  # (K,) [s]
    t64: wp.array[wp.float64]  # (K,) [s]
    dt: wp.array[float]  # (K,) [s], REST at the first sample of all
    begin: wp.array[wp.int64]  # (K,) begin of the step [ns since the chunk's begin]
    length: wp.array[float]  # (K,) duration of the step [ns]
    span: wp.int64  # of the chunk [ns]
    run: wp.array[int]  # (R + 1,) samples at which runs of one window begin, and K
    window: wp.array[int]  # (R,) window that a run is counted in; -1 for none


@wp.struct
class Counts:
    """Sink that counts events."""

    counts: wp.array4d[int]  # (B, W, 2, N) OFF, ON


@wp.struct
class Keys:
    """Sink that keeps every event as one sortable 64-bit key: time, place, polarity, label if asked for."""

    keys: wp.array3d[wp.int64]  # (B, slabs, capacity)
    used: wp.array2d[int]  # (B, slabs) events met; more than the capacity asks for another run
    slab: int  # pixels per slab, as a power of 2
    bits: int  # of row · N + i
    low: int  # bits below: 1 of the polarity, 2 more of the label


@wp.func_native("return a.data[k];")
def element(a: wp.array[float], k: int) -> float:
    """Return a[k]; Warp's own look-up asks whether k is negative, in the innermost loop."""
    ...


@wp.func_native(
    "return *(const float*)((const char*)a.data + (size_t)k * (size_t)a.strides[0] + 4 * (size_t)i);"
)
def stored(a: wp.array2d[float], k: int, i: int) -> float:
    """Return a[k, i], as `element` does."""
    ...


@wp.func
def leaving_time(clock: Clock, k: int, at: float, late: float) -> wp.int64:
    """When an event of the share `at` of step k leaves, `late` [s] after it [ns since the chunk's begin]."""
    time = clock.begin[k] + wp.int64(wp.min(at * clock.length[k], clock.length[k]))
    return time + wp.int64(wp.round(late * 1.0e9))


@wp.func_native(
    """
    const int slab = i >> shift;
    int* met = used.data + row * used.shape[1] + slab;
#ifdef __CUDA_ARCH__
    const int slot = atomicAdd(met, 1);
#else
    const int slot = (*met)++;  // a slab has one thread
#endif
    if (slot < keys.shape[2]) keys.data[((size_t)row * keys.shape[1] + slab) * keys.shape[2] + slot] = key;
"""
)
def append(keys: wp.array3d[wp.int64], used: wp.array2d[int], row: int, i: int, shift: int, key: wp.int64):
    """Append a key to those of the pixel's slab, or only count it where there is no room."""
    ...


@wp.func
def deposit(sink: Keys, row: int, i: int, size: int, time: wp.int64, code: int):
    """Keep one event that leaves its pixel at `time` [ns since the chunk's begin]."""
    place = wp.int64(row) * wp.int64(size) + wp.int64(i)
    place |= time << wp.int64(sink.bits)
    append(sink.keys, sink.used, row, i, sink.slab, (place << wp.int64(sink.low)) | wp.int64(code))


SINKS = {"counts": Counts, "keys": Keys, "labels": Keys}


@lru_cache(maxsize=256)
def compose(stages: tuple[Stages, ...], source: str, sink: str, *, cuda: bool = False) -> wp.Kernel:
    """Return the kernel of a sensor.

    Args:
        stages: Effects, in order.
        source: `frames`, `log`, `both`, `layers`, or `background` for a scene of one layer.
        sink: `counts`, `keys`, or `labels` for keys with labels.
        cuda: Whether it is for CUDA, which asks memory for samples ahead.

    Returns:
        A kernel over (B, N) threads; `Writer.kernel` writes its arguments.
    """
    writer = Writer(stages, source, sink, cuda=cuda)
    return compiled(writer.kernel(), "pixel_events", writer.scope)


@lru_cache(maxsize=256)
def compose_thresholds(stages: tuple[Stages, ...]) -> wp.Kernel:
    """Return a kernel over (B, N) threads that writes the thresholds of every pixel."""
    writer = Writer(stages, "frames", "counts", cuda=True)
    return compiled(writer.thresholds(), "pixel_thresholds", writer.scope)


def compiled(text: str, name: str, scope: dict[str, Any]) -> wp.Kernel:
    """Return the kernel of a text."""
    options = {"fuse_fp": False}  # see dase.kernels.lanes
    kernel: wp.Kernel = wp.kernel(
        from_text(text, name, scope), enable_backward=False, module="unique", module_options=options
    )
    return kernel


def source_text(stages: tuple[Stages, ...], source: str, sink: str, *, cuda: bool = False) -> str:
    """Return the text of the kernel that `compose` compiles."""
    return Writer(stages, source, sink, cuda=cuda).kernel()


def states(stages: Sequence[Stages], sink: str = "keys") -> list[str]:
    """Return the names of what a pixel with these effects remembers, in the order of the state array."""
    kinds = {stage for effect in stages for stage, _ in effect.functions}
    names = ["signal", "reference"]
    names += ["leaked", "leaked_rest"] if "drift" in kinds else []
    names += ["age"] if "gate" in kinds else []
    names += ["redraws"] if "redraw" in kinds else []
    names += ["leaving"] if "delay" in kinds else []
    names += ["drained"] if "drift" in kinds and sink == "labels" else []
    for effect in stages:
        if any(stage == "noise" for stage, _ in effect.functions):
            names += [f"{effect.name}_hazard", f"{effect.name}_rest", f"{effect.name}_events"]
        names += [f"{effect.name}_{state}" for state in effect.states]
    return names


class Writer:
    """Writes the text of one kernel, top to bottom."""

    def __init__(self, stages: tuple[Stages, ...], source: str, sink: str, *, cuda: bool):
        self.stages, self.source, self.sink = stages, source, sink
        self.prefetches = cuda and source in ("frames", "log")
        self.lines: list[str] = []
        self.depth = 0
        self.states = states(stages, sink)
        self.places = {name: i for i, name in enumerate(CORE)}
        for effect in stages:
            for parameter in effect.parameters:
                self.places[f"{effect.name}_{parameter}"] = len(self.places)
        self.maps = [f"{effect.name}_{name}" for effect in stages for name in effect.maps]
        self.draws: dict[str, str] = {}
        self.scope: dict[str, Any] = {
            "wp": wp,
            "Source": SOURCES[source],
            "Sink": SINKS[sink],
            "Clock": Clock,
            "deposit": deposit,
            "element": element,
            "stored": stored,
            "leaving_time": leaving_time,
            "key": key,
            "uniform": uniform,
            "normal": normal,
            "waiting": waiting,
            "layer_intensity": layer_intensity,
            "layers_near": layers_near,
            "ground_of": ground_of,
            "background_at": background_at,
            "logarithm": functions(1).logarithm,
            "Lane": functions(1).Lanes,
            "whole": whole,
        }

    def add(self, *lines: str) -> None:
        """Append lines at the present depth."""
        self.lines += ["    " * self.depth + line for line in lines]

    def of(self, stage: str) -> list[tuple[Stages, Any]]:
        """Return the functions of a stage with their effects."""
        return [(effect, f) for effect in self.stages for kind, f in effect.functions if kind == stage]

    def call(self, stage: str, effect: Stages, function: Any) -> str:
        """Return the call of a stage function, arguments resolved by name."""
        name = f"{stage}_of_{effect.name}"  # no name of a parameter
        self.scope[name] = function
        arguments = [self.argument(stage, effect, a) for a in inspect.signature(function.func).parameters]
        return f"{name}({', '.join(arguments)})"

    def unless_off(self, effect: Stages, *lines: str) -> list[str]:
        """Return the lines of an effect; a kernel for many models skips them where it is off."""
        return list(lines)

    def argument(self, stage: str, effect: Stages, name: str) -> str:
        """Return what a stage function gets for an argument of this name."""
        if name in (*effect.parameters, *effect.states, *effect.maps):
            return f"{effect.name}_{name}"
        if name in QUANTITIES[stage] or (name in ANYWHERE and name not in ("x", "y")):
            return name
        if name in ("x", "y"):
            return f"float({name})"
        draw = DRAW.fullmatch(name)
        if draw:
            local = f"{effect.name}_{stage}_{name}"
            self.draws[local] = draw.group(2)
            index = "int(redraws)" if stage == "redraw" else "sample"
            return f"{local}" if draw.group(1) else f"{draw.group(2)}({local}_key, {index})"
        quantities = *effect.parameters, *effect.states, *effect.maps, *QUANTITIES[stage]
        known = *quantities, *ANYWHERE, "normal", "uniform"
        raise ValueError(
            f"effect '{effect.name}': stage '{stage}' has no quantity '{name}'; there are {', '.join(known)}"
        )

    def asks(self, name: str) -> bool:
        """Return whether any function asks for the quantity `name`."""
        functions = (f for effect in self.stages for _, f in effect.functions)
        return any(name in inspect.signature(f.func).parameters for f in functions)

    def kernel(self) -> str:
        """Return the whole text."""
        self.depth = 1
        self.loop()
        body, self.lines = self.lines, []
        self.depth = 0
        self.add(
            "def pixel_events(first: int, source: Source, clock: Clock, pixels: wp.array[int], width: int,",
            "                 height: int, begin: int, seed: int, parameters: wp.array2d[float],",
            *(["                 maps: wp.array2d[float],"] if self.maps else []),
            "                 state_in: wp.array3d[float], state_out: wp.array3d[float], sink: Sink):",
        )
        self.depth = 1
        self.prologue()
        return "\n".join([*self.lines, *body]) + "\n"

    def thresholds(self) -> str:
        """Return the text of the kernel that writes thresholds."""
        self.add(
            "def pixel_thresholds(first: int, pixels: wp.array[int], width: int, height: int, seed: int,",
            "                     parameters: wp.array2d[float],",
            *(["                     maps: wp.array2d[float],"] if self.maps else []),
            "                     out: wp.array3d[float]):",
        )
        self.depth = 1
        # resolves which random numbers the threshold functions ask for
        calls = [self.call("threshold", effect, function) for effect, function in self.of("threshold")]
        self.pixel()
        self.add(*(f"on, off = {call}" for call in calls))
        self.add("out[row, 0, i] = off", "out[row, 1, i] = on")
        return "\n".join(self.lines) + "\n"

    def begin(self) -> None:
        """Which row of the batch and which pixel the thread works on."""
        self.add("row, i = wp.tid()", "i += first")

    def pixel(self) -> None:
        """Where the pixel is, its parameters and its own random numbers."""
        self.begin()
        self.add("pixel = pixels[i]", "x = pixel % width", "y = pixel / width")
        self.add(*(f"{name} = parameters[row, {at}]" for name, at in self.places.items()))
        self.add(*(f"{name} = maps[{at}, i]" for at, name in enumerate(self.maps)))
        for local, kind in self.draws.items():
            self.add(f"{local}_key = key(seed, {stream(local)}, pixel)")
            if re.search("_pixel_(uniform|normal)", local):
                self.add(f"{local} = {kind}({local}_key, 0)")
        if self.asks("radius"):
            self.add(
                "middle = wp.vec2(float(x) - 0.5 * float(width - 1), float(y) - 0.5 * float(height - 1))"
            )
            self.add("radius = 2.0 * wp.length(middle) / wp.length(wp.vec2(float(width), float(height)))")
        if self.asks("nominal_on") or self.asks("nominal_off"):
            self.add("nominal_on = on", "nominal_off = off")

    def prologue(self) -> None:
        """What a pixel knows before its first sample."""
        calls = [(effect, self.call("threshold", effect, f)) for effect, f in self.of("threshold")]
        anew = self.redrawn()
        self.pixel()
        self.add("size = pixels.shape[0]")
        if self.source == "layers":
            self.add("near = layers_near(source, float(x), float(y))", "ground = ground_of(source)")
        elif self.source == "background":
            self.add("ground = ground_of(source)")
        else:
            self.ahead()
        for effect, call in calls:
            self.add(*self.unless_off(effect, f"on, off = {call}"))
        self.restore()
        if anew:
            self.add("mean_on = on", "mean_off = off", *anew[2:])

        if "leaving" in self.states and self.sink != "counts":
            # the state holds the bits of whole nanoseconds, which float32 would round
            self.add("leaves = wp.int64(wp.cast(leaving, wp.int32))")

    def ahead(self) -> None:
        """Ask memory for the first samples."""
        if not self.prefetches:
            return
        self.add("last = source.values.shape[0] - 1")
        self.add(*(f"ahead_{n} = source.values[wp.min({n}, last), i]" for n in range(AHEAD)))

    def restore(self) -> None:
        """What the pixel remembers from the chunk before."""
        self.add(*(f"{name} = float(0.0)" for name in self.states), "if begin > 0:")
        self.add(*(f"    {name} = state_in[{at}, row, i]" for at, name in enumerate(self.states)))

    def redrawn(self) -> list[str]:
        """Return the lines that draw the thresholds of the next event, none without such an effect."""
        draws = [
            line
            for effect, function in self.of("redraw")
            for line in self.unless_off(effect, f"on, off = {self.call('redraw', effect, function)}")
        ]
        return ["on = mean_on", "off = mean_off", *draws] if draws else []

    def loop(self) -> None:
        """One sample after the other, then the state is kept."""
        self.add("for part in range(clock.window.shape[0]):")
        self.depth += 1
        if self.sink == "counts":
            self.add("on_count = int(0)", "off_count = int(0)")
        self.add("for k in range(clock.run[part], clock.run[part + 1]):")
        self.depth += 1
        self.add("dt = element(clock.dt, k)", "sample = begin + k")
        self.add(*(["t = element(clock.t, k)"] if self.asks("t") else []))
        self.add(*(["t64 = clock.t64[k]"] if self.asks("t64") else []))
        self.sense()
        self.sample()
        self.depth -= 1
        if self.sink == "counts":
            self.add("window = clock.window[part]", "if window >= 0:")
            self.add("    sink.counts[row, window, 0, i] = off_count")
            self.add("    sink.counts[row, window, 1, i] = on_count")
        self.depth -= 1
        if "leaving" in self.states and self.sink != "counts":
            self.add("leaving = wp.cast(wp.int32(wp.max(leaves - clock.span, wp.int64(0))), float)")
        self.add(*(f"state_out[{at}, row, i] = {name}" for at, name in enumerate(self.states)))

    def sample(self) -> None:
        """What follows from one sample."""
        self.add("if sample == 0:")
        self.depth += 1
        self.add("signal = voltage", "reference = voltage")
        if "age" in self.states:
            self.add("age = 1.0e6")
        for effect, _ in self.of("noise"):
            self.add(
                f"{effect.name}_hazard = waiting({self.noise_key(effect)}, 0)", f"{effect.name}_events = 1.0"
            )
        # rest ends here: no time passes in which anything could leak or fire
        self.add("dt = 0.0")
        self.depth -= 1
        self.step()

    def sense(self) -> None:
        """Light to photoreceptor voltage."""
        quantity = "voltage" if self.source == "log" else "intensity"
        if self.source == "layers":
            self.add("intensity = layer_intensity(source, ground, near, k, float(x), float(y))")
        elif self.source == "background":
            self.add("intensity = background_at(source, ground, k, float(x), float(y))")
        elif not self.prefetches:
            self.add(f"{quantity} = stored(source.values, k, i)")
        else:
            # memory is asked for the samples to come while the present one is worked on
            self.add(f"{quantity} = ahead_0")
            self.add(*(f"ahead_{n} = ahead_{n + 1}" for n in range(AHEAD - 1)))
            self.add(f"ahead_{AHEAD - 1} = stored(source.values, wp.min(k + {AHEAD}, last), i)")
        if self.source == "log":
            if self.of("light"):
                raise ValueError("effects on light need intensities, not log intensities")
            kinds = ("respond", "drift", "noise", "delay")
            if any("intensity" in inspect.signature(f.func).parameters for s in kinds for _, f in self.of(s)):
                self.add("intensity = wp.exp(voltage) - log_eps")
        self.light()
        if self.source == "both":
            self.add("voltage = stored(source.logs, k, i)")
        elif self.source != "log":
            self.add(VOLTAGE)
        self.respond()

    def light(self) -> None:
        """What becomes of the light before it is sensed."""
        for effect, function in self.of("light"):
            line = f"{self.returns('intensity', effect)} = {self.call('light', effect, function)}"
            self.add(*self.unless_off(effect, line))

    def respond(self) -> None:
        """What becomes of the voltage."""
        for effect, function in self.of("respond"):
            line = f"{self.returns('voltage', effect)} = {self.call('respond', effect, function)}"
            self.add(*self.unless_off(effect, line))

    @staticmethod
    def returns(quantity: str, effect: Stages) -> str:
        """Return the left side of a stage that may change the effect's states."""
        return ", ".join([quantity, *(f"{effect.name}_{state}" for state in effect.states)])

    def noise_key(self, effect: Stages) -> str:
        """Name of the random stream of an effect's noise events."""
        self.draws[f"{effect.name}_noise"] = "uniform"
        return f"{effect.name}_noise_key"

    def step(self) -> None:
        """Events of one step, along the straight line from the last sample to this one."""
        self.add(self.change("signal", "before"))
        self.add(*(["leaked_before = leaked + 0.0"] if "drained" in self.states else []))
        for effect, function in self.of("drift"):
            # what rounding loses of a short step is kept for the next (Kahan), or slow leaks would stall
            leak = f"leak = {self.call('drift', effect, function)} * dt + leaked_rest"
            rest = "leaked_rest = leak - (total - leaked)"
            self.add(*self.unless_off(effect, leak, "total = leaked + leak", rest, "leaked = total"))
        self.add(self.change("voltage", "after"))
        self.start_phase()
        noisy = self.of("noise")
        for effect, function in noisy:
            n = effect.name
            self.start_noise(effect)
            rates = f"{n}_on, {n}_off = {self.call('noise', effect, function)}"
            self.add(*self.unless_off(effect, rates, f"{n}_spend = ({n}_on + {n}_off) * dt + {n}_rest"))
        busy = ["after >= on", "after <= -off", *(f"{e.name}_spend > {e.name}_hazard" for e, _ in noisy)]
        # a crossing that waits for the end of the dead time may come although the signal returns
        busy += ["before >= on", "before <= -off"] if self.delays() else []
        self.add(f"if {' or '.join(busy)}:")
        self.depth += 1
        self.busy([effect for effect, _ in noisy])
        self.depth -= 1
        for effect, _ in noisy:
            n = effect.name
            self.add(f"{n}_left = {n}_hazard - {n}_spend", f"{n}_rest = {n}_spend - ({n}_hazard - {n}_left)")
            self.add(f"{n}_hazard = {n}_left")
        self.add("signal = voltage")
        if "age" in self.states:
            self.add("age += dt")

    def start_noise(self, effect: Stages) -> None:
        """What the noise of an effect is before its rates are known: nothing here, they always are."""

    def delays(self) -> bool:
        """Whether events that a gate holds back come later."""
        return any(effect.delays for effect, _ in self.of("gate"))

    def change(self, end: str, name: str) -> str:
        """Return the line that sets `name` to the change since the pixel's last event."""
        return f"{name} = {end} - reference" + (" + leaked" if "leaked" in self.states else "")

    def start_phase(self) -> None:
        """Spread the memories at the start as if the first change had been going on before."""
        self.draws["initial_phase"] = "uniform"
        self.add("if sample == 1 and phase != 0.0:")
        self.depth += 1
        self.add("lead = phase * uniform(initial_phase_key, 0)")
        self.add("if after < 0.0 or (after == 0.0 and uniform(initial_phase_key, 1) < 0.5):")
        labelled = "drained" in self.states
        # a pixel that starts half way is done with half of the way, whatever of it the leak will make
        self.add("    reference += lead * off", *(["    drained -= 0.5 * lead * off"] if labelled else []))
        self.add("else:", "    reference -= lead * on")
        self.add(*(["    drained += 0.5 * lead * on"] if labelled else []))
        self.add(self.change("signal", "before").replace(" + leaked", ""), self.change("voltage", "after"))
        self.depth -= 1

    def busy(self, noisy: list[Stages]) -> None:
        """Events of a step that has any: crossings, cut at the noise events between them."""
        self.add("moved = float(0.0)", "begun = float(0.0)")
        if not noisy:
            self.add("stop = 1.0", "value = after")
            self.crossings()
        else:
            self.add("while begun < 1.0:")
            self.depth += 1
            self.add("stop = float(1.0)", "cause = int(0)")
            for number, effect in enumerate(noisy, start=1):
                n = effect.name
                self.add(f"if {n}_spend > {n}_hazard and {n}_hazard < stop * {n}_spend:")
                self.add(f"    stop = {n}_hazard / {n}_spend", f"    cause = {number}")
            self.add("value = after", "if cause != 0:", "    value = before + (after - before) * stop")
            self.crossings()
            for number, effect in enumerate(noisy, start=1):
                self.noise_event(number, effect)
            self.add("begun = stop", "if cause == 0:", "    break")
            self.depth -= 1
        self.add("reference += moved")
        if "leaked" in self.states:
            self.add(*(["drained += leaked"] if "drained" in self.states else []))
            # keeps `leaked` small, where float32 resolves slow leaks
            self.add("reference -= leaked", "leaked = 0.0")

    def crossings(self) -> None:
        """Exact crossings between `begun` and `stop`, times interpolated; Eqs. (2)-(4) of the paper."""
        delays = self.delays()
        begin = "at" if delays else "begun"
        if delays:
            self.add("at = begun + 0.0")
            self.pending()
        self.add("change = value - moved")
        self.add(
            "theta = on", "polarity = int(1)", "if change < 0.0:", "    theta = -off", "    polarity = 0"
        )
        self.add(
            "crossed = int(whole(wp.abs(change), wp.abs(theta), 1.0 / wp.abs(theta)))",
            *(["passed = int(0)"] if delays else []),
        )
        if self.of("redraw"):
            self.one_by_one(begin)
            return
        if self.sink == "counts" and not self.of("gate"):
            # nobody asks when they happened
            self.add("on_count += polarity * crossed", "off_count += (1 - polarity) * crossed")
            self.add("moved += float(crossed) * theta")
            return
        self.add(*(["if at > stop:", "    crossed = 0"] if delays else []))
        self.add("for n in range(crossed):")
        self.depth += 1
        self.add(f"share = {begin}", "if after != before:")
        self.add("    share = (moved + float(n + 1) * theta - before) / (after - before)")
        self.add(f"share = wp.clamp(share, {begin}, stop)")
        if delays:
            self.wait("share")
            self.add(
                "if wait > 0.0:", "    share += wait / dt", "if share > stop:", "    break", "passed += 1"
            )
            label = self.leaks("share")
            self.event("share", "polarity", label)
        else:
            label = self.leaks("share")
            self.gated("share", "polarity", label)
        self.add(*self.memorise())
        self.depth -= 1
        self.add(f"moved += float({'passed' if delays else 'crossed'}) * theta")

    def one_by_one(self, begin: str) -> None:
        """Crossings with thresholds drawn anew; equal ones are counted as without drawing, bit for bit."""
        if not self.delays():
            self.add("passed = int(0)")
        else:
            self.add("if at > stop:", "    crossed = 0")
        self.add("while passed < crossed:")
        self.depth += 1
        self.add(f"share = {begin}", "if after != before:")
        self.add("    share = (moved + float(passed + 1) * theta - before) / (after - before)")
        self.add(f"share = wp.clamp(share, {begin}, stop)")
        if self.delays():
            self.wait("share")
            self.add("if wait > 0.0:", "    share += wait / dt", "if share > stop:", "    break")
            self.event("share", "polarity", self.leaks("share"))
        else:
            self.gated("share", "polarity", self.leaks("share"))
        self.add("passed += 1", *self.memorise(), *self.next_draw())
        self.add("drawn = on", "if polarity == 0:", "    drawn = -off", "if drawn != theta:")
        self.add("    moved += float(passed) * theta", "    passed = 0", "    theta = drawn")
        self.add("    crossed = int(wp.floor((value - moved) / theta))")
        self.depth -= 1
        self.add("moved += float(passed) * theta")

    def next_draw(self) -> list[str]:
        """Return the lines that draw new thresholds after an event."""
        anew = self.redrawn()
        return [COUNT_ON.format("redraws"), *anew] if anew else []

    def pending(self) -> None:
        """Crossings from before `begun` that still stand when the pixel comes back to life at `at`."""
        self.wait("at")
        self.add("while wait > 0.0:")
        self.depth += 1
        self.add("at += wait / dt", "if at > stop:", "    break")
        self.add("change = before + (after - before) * at - moved")
        self.add("theta = float(0.0)", "polarity = int(0)")
        self.add("if change >= on:", "    theta = on", "    polarity = 1")
        self.add("if change <= -off:", "    theta = -off", "if theta == 0.0:", "    break")
        self.event("at", "polarity", self.leaks("at"))
        self.add("moved += theta", *self.memorise(), *self.next_draw())
        self.wait("at")
        self.depth -= 1

    def wait(self, share: str) -> None:
        """Set `wait` to the time the pixel stays dead after `share` of the step."""
        self.add("wait = float(0.0)", "now = age")
        self.add(f"age = now + {share} * dt")
        for effect, function in self.of("gate"):
            self.add(*self.unless_off(effect, f"wait = wp.max(wait, {self.call('gate', effect, function)})"))
        self.add("age = now")

    def leaks(self, share: str) -> str:
        """Return the label of a crossing: whether the leak did more for it than the light did."""
        if "drained" not in self.states:
            return str(SIGNAL)
        self.add(f"slipped = leaked_before + (leaked - leaked_before) * {share}", f"label = int({SIGNAL})")
        self.add("if polarity == 1 and drained + slipped > 0.5 * on:", f"    label = {LEAK}")
        return "label"

    def memorise(self) -> list[str]:
        """Return the line that begins to count the leak anew, the memory being set where `leaks` looked."""
        return ["drained = -slipped"] if "drained" in self.states else []

    def leave(self, share: str) -> str:
        """Return the time at which an event leaves; events of one pixel do not overtake each other."""
        delays = self.of("delay")
        if not delays:
            return self.instant(share, "0.0")
        self.add("late = float(0.0)")
        for effect, function in delays:
            self.add(*self.unless_off(effect, f"late += {self.call('delay', effect, function)}"))
        self.add(f"late = wp.clamp(late, 0.0, {LATEST})")
        self.add(f"leaves = wp.max(leaves, {self.instant(share, 'late')})")
        return "leaves"

    def instant(self, share: str, late: str) -> str:
        """Return the time `late` after `share` of the step."""
        return f"leaving_time(clock, k, {share}, {late})"

    def keep(self, time: str, polarity: str, label: str) -> str:
        """Return the call that keeps an event."""
        code = f"{polarity} * 4 + {label}" if self.sink == "labels" else polarity
        return f"deposit(sink, row, i, size, {time}, {code})"

    def event(self, share: str, polarity: str, label: str) -> None:
        """Emit an event after `share` of the step."""
        if self.sink == "counts":
            self.add(f"on_count += {polarity}", f"off_count += 1 - {polarity}")
        else:
            self.add(self.keep(self.leave(share), polarity, label))
        if "age" in self.states:
            self.add(f"age = -{share} * dt")

    def gated(self, share: str, polarity: str, label: str, *then: str) -> None:
        """Emit an event unless the pixel is dead, and do `then`."""
        if not self.of("gate"):
            self.event(share, polarity, label)
            self.add(*then)
            return
        self.wait(share)
        self.add("if wait <= 0.0:")
        self.depth += 1
        self.event(share, polarity, label)
        self.add(*then)
        self.depth -= 1

    def noise_event(self, number: int, effect: Stages) -> None:
        """Emit the noise event at `stop`; like any event it makes the pixel memorise the present signal."""
        n = effect.name
        self.draws[f"{n}_polarity"] = "uniform"
        self.add(f"if cause == {number}:")
        self.depth += 1
        self.add("polarity = int(0)")
        self.add(
            f"if uniform({n}_polarity_key, int({n}_events)) * ({n}_on + {n}_off) < {n}_on:",
            "    polarity = 1",
        )
        if "drained" in self.states:
            self.add("slipped = leaked_before + (leaked - leaked_before) * stop")
        then = ["moved = value", *self.memorise(), *self.next_draw()]
        self.gated("stop", "polarity", str(effect.label), *then)
        self.add(f"{n}_hazard += waiting({self.noise_key(effect)}, int({n}_events))")
        self.add(COUNT_ON.format(f"{n}_events"))
        self.depth -= 1
