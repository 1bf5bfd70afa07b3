"""One kernel that simulates many models of a sensor over the same stimulus and sums up their events.

The kernel has every effect that any of the models has. An effect whose parameters are at their off values is
skipped, which changes nothing, bit for bit; so all models run through one compiled kernel. It differs from
the kernel of `dase.kernels.pixel` in two more ways. Its time samples are the pixel's own: none where the
light of the pixel does not change. And an event is not stored but looked at, see `dase.kernels.probes`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import warp as wp

from dase.kernels import pixel
from dase.kernels.compose import compiled
from dase.kernels.probes import Probes, observe
from dase.kernels.writer import VOLTAGE, Writer


@wp.struct
class History:
    """Light of some pixels, each at times of its own; between them its logarithm runs straight."""

    start: wp.array[int]  # (N + 1,) first sample of each pixel, and the end
    stamp: wp.array[int]  # (M,) time of each sample [steps]; that of a pixel's first is 0
    intensity: wp.array[float]  # (M,) linear
    voltage: wp.array[float]  # (M,) logarithm of intensity + log_eps
    step: float  # [s]


@lru_cache(maxsize=64)
def compose(stages: tuple[pixel.Stages, ...]) -> wp.Kernel:
    """Return the kernel of all models with these effects, over (B, N) threads.

    Its arguments are `first`, a `History`, pixels (N,), width, height, seeds (B,), parameters (B, P), maps
    (M, N) where an effect has any, `Probes`.
    """
    writer = _Writer(stages)
    return compiled(writer.kernel(), "pixel_trials", writer.scope)


def source_text(stages: tuple[pixel.Stages, ...]) -> str:
    """Return the text of the kernel that `compose` compiles."""
    return _Writer(stages).kernel()


def _number(value: float) -> str:
    return "wp.inf" if value == math.inf else f"float({value!r})"


@wp.func
def instant(begin: int, steps: int, step: float, share: float, late: float) -> wp.int64:
    """When an event leaves [ns]: `share` of `steps` after `begin`, and `late` [s]."""
    nanoseconds = wp.float64(step) * wp.float64(1.0e9)
    at = wp.float64(begin) + wp.float64(wp.min(share, 1.0)) * wp.float64(steps)
    return wp.int64(at * nanoseconds) + wp.int64(wp.round(late * 1.0e9))


@wp.kernel(enable_backward=False)
def total(
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


class _Writer(Writer):
    """Writes the text of the kernel."""

    def __init__(self, stages: tuple[pixel.Stages, ...]):
        super().__init__(stages, "frames", "keys", cuda=False)
        self.scope |= {"Source": History, "Sink": Probes, "observe": observe, "instant": instant}

    def unless_off(self, effect: pixel.Stages, *lines: str) -> list[str]:
        if not effect.off:
            return list(lines)
        return [f"if {effect.name}_acts:", *(f"    {line}" for line in lines)]

    def head(self) -> list[str]:
        return [
            "def pixel_trials(first: int, source: Source, pixels: wp.array[int], width: int, height: int,",
            "                 seeds: wp.array[int], parameters: wp.array2d[float],",
            *(["                 maps: wp.array2d[float],"] if self.maps else []),
            "                 sink: Sink):",
        ]

    def begin(self) -> None:
        super().begin()
        self.add("seed = seeds[row]")

    def pixel(self) -> None:
        super().pixel()
        for effect in self.stages:
            differs = [f"{effect.name}_{p} != {_number(value)}" for p, value in effect.off]
            self.add(*([f"{effect.name}_acts = {' or '.join(differs)}"] if differs else []))
        self.add("begin_at = source.start[i]", "end_at = source.start[i + 1]")

    def ahead(self) -> None:
        """Samples of one pixel lie side by side in memory."""

    def restore(self) -> None:
        self.add(*(f"{name} = float(0.0)" for name in self.states))
        self.add("stamp = int(0)", *(["leaving = 0.0"] if "leaving" in self.states else []))

    def loop(self) -> None:
        """One sample after the other."""
        self.add("for k in range(begin_at, end_at):")
        self.depth += 1
        self.add(
            "steps = source.stamp[k] - stamp", "dt = float(steps) * source.step", "sample = k - begin_at"
        )
        self.add("if sample == 0:", f"    dt = {pixel.REST}")
        if self.asks("t") or self.asks("t64"):
            self.add("t64 = wp.float64(source.stamp[k]) * wp.float64(source.step)", "t = float(t64)")
        self.add("intensity = source.intensity[k]", "voltage = source.voltage[k]")
        self.light()
        lights = [effect for effect, _ in self.of("light")]
        if lights:
            acts = [f"{effect.name}_acts" if effect.off else "True" for effect in lights]
            self.add(f"if {' or '.join(acts)}:", f"    {VOLTAGE}")
        self.respond()
        self.sample()
        self.add("stamp = source.stamp[k]")
        self.depth -= 1

    def start_noise(self, effect: pixel.Stages) -> None:
        self.add(*(f"{effect.name}_{name} = float(0.0)" for name in ("on", "off", "spend")))

    def instant(self, share: str, late: str) -> str:
        return f"instant(stamp, steps, source.step, {share}, {late})"

    def keep(self, time: str, polarity: str, label: str) -> str:
        return f"observe(sink, row, i, {time}, {polarity})"
