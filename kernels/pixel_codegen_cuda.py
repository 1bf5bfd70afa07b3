"""The kernel of a sensor, one pixel per thread, for CUDA."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable

from dase.kernels.pixel_codegen_events import Crossings
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.random import stream_number

AHEAD = 4
"""Stored samples of a pixel that are under way from memory at a time."""

LONGER = 1.0001
"""A pixel whose dead time lasts so many times what is left of a step, or longer, sleeps through it."""

VOLTAGE = "voltage = logarithm(Lane(intensity), log_eps)[0]"


class Writer(Crossings):
    """Writes the text of one kernel, top to bottom."""

    def kernel(self) -> str:
        """Return the whole text."""
        self.depth = 1
        self.loop()
        body, self.lines = self.lines, []
        self.depth = 0
        self.add(*self.head())
        self.depth = 1
        self.prologue()
        return "\n".join([*self.lines, *body]) + "\n"

    def head(self) -> list[str]:
        """Return the line that names the kernel and its arguments."""
        return [
            "def pixel_events(first: int, source: Source, clock: Clock, pixels: wp.array[int], width: int,",
            "                 height: int, begin: int, seed: int, parameters: wp.array2d[float],",
            *(["                 maps: wp.array2d[float],"] if self.maps else []),
            "                 state_in: wp.array3d[float], state_out: wp.array3d[float], sink: Sink):",
        ]

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
        if self.asks("nominal_on") or self.asks("nominal_off"):
            self.add("nominal_on = on", "nominal_off = off")
        self.own()

    def own(self) -> None:
        """What differs from pixel to pixel before any light comes."""
        self.where()
        self.own_draws()

    def own_draws(self) -> None:
        """The pixel's own random numbers."""
        for local, kind in self.draws.items():
            self.add(f"{local}_key = key(seed, {stream_number(local)}, pixel)")
            if self.once(local):
                self.add(*self.drawn(local, f"{local} = {kind}({local}_key, 0)"))

    def drawn(self, local: str, line: str) -> list[str]:
        """Return the lines that draw a number of the pixel."""
        return [line]

    def where(self) -> None:
        """What depends on where the pixel is."""
        self.add(*(f"{name} = maps[{at}, i]" for at, name in enumerate(self.maps)))
        if self.asks("radius"):
            self.add(
                "middle = wp.vec2(float(x) - 0.5 * float(width - 1), float(y) - 0.5 * float(height - 1))"
            )
            self.add("radius = 2.0 * wp.length(middle) / wp.length(wp.vec2(float(width), float(height)))")

    @staticmethod
    def once(local: str) -> bool:
        """Return whether a random number is drawn once for each pixel."""
        return re.search("_pixel_(uniform|normal)", local) is not None

    def prologue(self) -> None:
        """What a pixel knows before its first sample."""
        start = self.starts()
        self.pixel()
        self.add("size = pixels.shape[0]")
        if self.source == "layers":
            self.add("near = layers_near(source, float(x), float(y))", "ground = ground_of(source)")
        elif self.source == "background":
            self.add("ground = ground_of(source)")
        else:
            self.ahead()
        self.add(*start)

    def starts(self) -> list[str]:
        """Return the lines that set thresholds and memories at the begin of a chunk."""
        calls = [(effect, self.call("threshold", effect, f)) for effect, f in self.of("threshold")]
        anew = self.redrawn()
        (lines, self.lines), (depth, self.depth) = (self.lines, []), (self.depth, 0)
        for effect, call in calls:
            self.add(*self.unless_off(effect, f"on, off = {call}"))
        self.restore()
        if anew:
            self.add("mean_on = on", "mean_off = off", *anew[2:])
        if "leaving" in self.states and self.sink != "counts":
            # the state holds the bits of whole nanoseconds, which float32 would round
            self.add("leaves = wp.int64(wp.cast(leaving, wp.int32))")
        written, self.lines, self.depth = self.lines, lines, depth
        return written

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

    def part(self, write: Callable[[], None], *, when: str = "", then: tuple[str, ...] = ()) -> None:
        """Write what a pixel does, on the condition `when` that is the same for all, and the lines `then`."""
        if when:
            self.add(f"if {when}:")
            self.depth += 1
        write()
        self.add(*then)
        self.depth -= bool(when)

    def loop(self) -> None:
        """One sample after the other, then the state is kept."""
        self.add("for part in range(clock.window.shape[0]):")
        self.depth += 1
        if self.sink == "counts":
            self.part(lambda: self.add("on_count = int(0)", "off_count = int(0)"))
        self.add("for k in range(clock.run[part], clock.run[part + 1]):")
        self.depth += 1
        self.add("dt = element(clock.dt, k)", "sample = begin + k")
        self.add(*(["t = element(clock.t, k)"] if self.asks("t") else []))
        self.add(*(["t64 = clock.t64[k]"] if self.asks("t64") else []))
        self.sense()
        self.sample()
        self.depth -= 1
        if self.sink == "counts":
            self.add("window = clock.window[part]")
            self.part(self.put_counts, when="window >= 0")
        self.depth -= 1
        self.part(self.keep_states)

    def put_counts(self) -> None:
        """Hand the counts of a window over."""
        self.add("sink.counts[row, window, 0, i] = off_count", "sink.counts[row, window, 1, i] = on_count")

    def keep_states(self) -> None:
        """Keep what the next chunk needs."""
        if "leaving" in self.states and self.sink != "counts":
            self.add("leaving = wp.cast(wp.int32(wp.max(leaves - clock.span, wp.int64(0))), float)")
        self.add(*(f"state_out[{at}, row, i] = {name}" for at, name in enumerate(self.states)))

    def sense(self) -> None:
        """Light to photoreceptor voltage."""
        self.look()
        if self.source == "log":
            if self.of("light"):
                raise ValueError("effects on light need intensities, not log intensities")
            kinds = ("respond", "drift", "noise", "delay")
            if any("intensity" in inspect.signature(f.func).parameters for s in kinds for _, f in self.of(s)):
                self.part(lambda: self.add("intensity = exponential(voltage) - log_eps"))
        self.light()
        if self.source != "log":
            self.logarithm()
        self.respond()

    def look(self) -> None:
        """What the pixel sees."""
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

    def logarithm(self) -> None:
        """Logarithm of the light."""
        self.add(VOLTAGE)

    def light(self) -> None:
        """What becomes of the light before it is sensed."""
        self.each("light", "intensity")

    def respond(self) -> None:
        """What becomes of the voltage."""
        self.each("respond", "voltage")

    def each(self, stage: str, quantity: str) -> None:
        """Pass a quantity through all functions of a stage."""
        for effect, function in self.of(stage):
            line = f"{self.returns(quantity, effect)} = {self.call(stage, effect, function)}"
            lines = self.unless_off(effect, line)
            self.part(lambda lines=lines: self.add(*lines))

    def sample(self) -> None:
        """Events of one step, along the straight line from the last sample to this one."""
        # rest ends here: no time passes in which anything could leak or fire
        self.part(self.first, when="sample == 0", then=("dt = 0.0",))
        self.part(self.drift)
        self.draws["initial_phase"] = "uniform"
        self.part(self.start_phase, when="sample == 1 and phase != 0.0")
        if self.of("noise"):
            self.part(self.noise)
        self.events()
        self.part(self.settle)

    def first(self) -> None:
        """Take the first sample as it is."""
        self.add("signal = voltage", "reference = voltage")
        if "age" in self.states:
            self.add("age = 1.0e6")
        for effect, _ in self.of("noise"):
            self.add(
                f"{effect.name}_hazard = waiting({self.noise_key(effect)}, 0)", f"{effect.name}_events = 1.0"
            )

    def drift(self) -> None:
        """Change since the last event at both ends of the step."""
        self.add(self.change("signal", "before"))
        self.add(*(["leaked_before = leaked + 0.0"] if "drained" in self.states else []))
        for effect, function in self.of("drift"):
            # what rounding loses of a short step is kept for the next (Kahan), or slow leaks would stall
            leak = f"leak = {self.call('drift', effect, function)} * dt + leaked_rest"
            rest = "leaked_rest = leak - (total - leaked)"
            self.add(*self.unless_off(effect, leak, "total = leaked + leak", rest, "leaked = total"))
        self.add(self.change("voltage", "after"))

    def noise(self) -> None:
        """What of its waiting time each noise spends in the step."""
        for effect, function in self.of("noise"):
            n = effect.name
            self.start_noise(effect)
            rates = f"{n}_on, {n}_off = {self.call('noise', effect, function)}"
            self.add(*self.unless_off(effect, rates, f"{n}_spend = ({n}_on + {n}_off) * dt + {n}_rest"))

    def busy_when(self) -> str:
        """Return the condition on which the step can have events."""
        noisy = (effect.name for effect, _ in self.of("noise"))
        crossed = "after >= on or after <= -off"
        if self.delays():
            # a crossing that waits for the end of the dead time may come although the signal returns
            crossed += " or before >= on or before <= -off"
            awake = f"asleep <= {LONGER} * dt" + (" or leaked != 0.0" if "leaked" in self.states else "")
            crossed = f"({crossed}) and ({awake})"
        return " or ".join([crossed, *(f"{n}_spend > {n}_hazard" for n in noisy)])

    def asleep(self) -> list[str]:
        """Return the lines that set `asleep` to the rest of the dead time, where events wait for its end."""
        if not self.delays():
            return []
        lines = ["asleep = float(0.0)"]
        for effect, function in self.of("gate"):
            rest = self.call("gate", effect, function)
            lines += self.unless_off(effect, f"asleep = wp.max(asleep, {rest})")
        return lines

    def events(self) -> None:
        """Events of the step, if there are any."""
        self.part(lambda: self.add(*self.asleep()))
        self.part(self.busy, when=self.busy_when())

    def settle(self) -> None:
        """What is left when the step is over."""
        for effect, _ in self.of("noise"):
            n = effect.name
            left = f"{n}_left = {n}_hazard - {n}_spend", f"{n}_rest = {n}_spend - ({n}_hazard - {n}_left)"
            self.add(*self.unless_off(effect, *left, f"{n}_hazard = {n}_left"))
        self.add("signal = voltage")
        if "age" in self.states:
            self.add("age += dt")

    def start_noise(self, effect: EffectStages) -> None:
        """What the noise of an effect is before its rates are known: nothing here, they always are."""

    def start_phase(self) -> None:
        """Spread the memories at the start as if the first change had been going on before."""
        self.add("lead = phase * uniform(initial_phase_key, 0)")
        self.add("if after < 0.0 or (after == 0.0 and uniform(initial_phase_key, 1) < 0.5):")
        labelled = "drained" in self.states
        # a pixel that starts half way is done with half of the way, whatever of it the leak will make
        self.add("    reference += lead * off", *(["    drained -= 0.5 * lead * off"] if labelled else []))
        self.add("else:", "    reference -= lead * on")
        self.add(*(["    drained += 0.5 * lead * on"] if labelled else []))
        self.add(self.change("signal", "before").replace(" + leaked", ""), self.change("voltage", "after"))
