"""The photoreceptor's limited speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import ANY_SAMPLES, Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.photocurrent import dark_share, idle_beside, relative_photocurrent
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import exponential, logarithm


@wp.func
def time_constants(
    intensity: float,
    dt: float,
    cutoff: float,
    dark: float,
    dark_current: float,
    spread: float,
    pixel_normal: float,
):
    """Length of a step in time constants of the pixel's photoreceptor."""
    x = 2.0 * wp.pi * cutoff * relative_photocurrent(intensity, dark, dark_current) * dt
    # a pixel of hardly any bandwidth would be a dead one
    return x * wp.max(1.0 + spread * pixel_normal, 0.1)


@wp.func
def lowpass_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    cutoff: float,
    dark: float,
    dark_current: float,
    spread: float,
    input: float,
    output: float,
    pixel_normal: float,
):
    """First-order low-pass, exact for an input that runs straight between samples."""
    x = time_constants(intensity, dt, cutoff, dark, dark_current, spread, pixel_normal)
    decay = exponential(-x)
    # share of the input's step by which the output lags behind a ramp; (1 - e^-x)/x loses digits near 0
    lag = 1.0 - 0.5 * x
    if x > 1.0e-3:
        lag = (1.0 - decay) / x
    settled = voltage - (voltage - input) * lag + (output - input) * decay
    return settled, voltage, settled


@wp.func
def follower_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    cutoff: float,
    dark: float,
    dark_current: float,
    spread: float,
    input: float,
    output: float,
    pixel_normal: float,
):
    """Source follower, exact for an input that runs straight between samples.

    Its equation is linear in e^(input - output): the photocurrent over what the voltage lets through.
    """
    x = time_constants(intensity, dt, cutoff, dark, dark_current, spread, pixel_normal)
    # in a ramp upwards the photocurrent runs away from that current
    left = x - (voltage - input)
    decay = exponential(-left)
    mean = wp.where(wp.abs(left) > 1.0e-3, (1.0 - decay) / left, 1.0 - 0.5 * left)
    excess = exponential(input - output) * decay + x * mean
    # of infinity times nothing nothing is known, and who is that fast follows at once
    settled = wp.where(x > 1.0e6, voltage, voltage - logarithm(excess))
    return settled, voltage, settled


@wp.func
def stepped_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    cutoff: float,
    dark: float,
    dark_current: float,
    spread: float,
    output: float,
    pixel_normal: float,
):
    """Low-pass that goes a share of the way at each sample, all of it where a step has a time constant."""
    x = time_constants(intensity, dt, cutoff, dark, dark_current, spread, pixel_normal)
    settled = output + wp.min(x, 1.0) * (voltage - output)
    return settled, voltage, settled


@dataclass(frozen=True, kw_only=True)
class Bandwidth(Effect):
    """The photoreceptor's limited speed, slower in the dark.

    The photoreceptor is a low-pass: it charges its node with the photocurrent, so its bandwidth grows with
    the light. Fast changes are smoothed and come late, most of all in dark pixels, where edges trail long
    tails of events.

    The cutoff is `cutoff` at intensity 1 (white) and falls linearly to `dark * cutoff` at intensity 0: what
    flows without light, dark current, charges the node as photocurrent does. A sensor with the effect `dark`
    has that current, pixel by pixel, and `dark` here changes nothing: the cutoff is `cutoff` · (I + current)
    / (1 + median current), at most `cutoff`. It differs from pixel to pixel by `spread`, too.

    With `signal = "small"` the voltage v follows the logarithm u of the light by dv/dt = w (u - v), where
    w is 2π times the cutoff at the present light: an edge of a factor c downwards is slower than one upwards
    by c. That holds for small contrasts only. With `signal = "large"` it is the equation of a source
    follower, whose node is charged by the photocurrent and discharged by one that grows as e^v: dv/dt =
    w (1 - e^(v - u)). Half way through an edge of a decade it is after 0.143 / w upwards and 0.274 / w
    downwards, w at the darker light: 1.9 times as long. Small contrasts it treats alike.

    With `signal = "steps"` it is what another simulator makes of the first (v2e): from one sample of the
    scene to the next the voltage goes w dt of the way to the light of the later one, and all of it where that
    is above 1. At frames of 1 kHz and 100 Hz it is as fast as 160 Hz are, and 200 Hz are not seen in bright
    light. It belongs to scenes whose frames are those that the other simulator has seen.
    """

    name: ClassVar[str] = "bandwidth"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (finite bandwidth); "
        "Delbruck, Mead: Analog VLSI adaptive, logarithmic, wide-dynamic-range photoreceptor, 1994 "
        "(source follower)"
    )
    stages: ClassVar = {"respond": lowpass_voltage}
    states: ClassVar = ("input", "output")
    signatures: ClassVar = (Makes("late events", tells=True, by="pole", absence=False),)
    screen_limits: ClassVar = {
        "cutoff": (
            "a cutoff above about {highest_cutoff:g} Hz wants an LED, as a screen of {refresh:g} Hz needs "
            "1 to 10 ms for a change itself"
        ),
    }

    cutoff: float = parameter(
        200.0,
        unit="Hz",
        off=math.inf,
        bounds=(0.01, math.inf),
        plausible=(3.0, 3000.0),
        about="-3 dB frequency at intensity 1",
    )
    dark: float = dark_share(
        "cutoff at intensity 0 relative to that at intensity 1; 1 makes the bandwidth constant"
    )
    spread: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 0.3),
        about="standard deviation of the cutoff over pixels, relative to it",
        fitted=False,  # it shows as blurred edges do, which a fit takes for another cutoff
    )
    signal: str = choice(
        "small",
        among=("small", "large", "steps"),
        about="equation: linear in log light, or a source follower's, or the first in steps of a sample",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the low-pass that is linear: contrasts at which the other differs are rare.

        Where events are of a simulator that works frame by frame, it goes in steps.
        """
        return [cls(signal="steps" if observed.clip_step else "small")]

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return the linear low-pass for the one in steps."""
        return [replace(self, signal="small")] if self.signal == "steps" else []

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing."""
        return idle_beside(beside)

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return ANY_SAMPLES if self.signal == "steps" and self.cutoff < math.inf else math.inf

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know."""
        respond = {"small": lowpass_voltage, "large": follower_voltage, "steps": stepped_voltage}[self.signal]
        return replace(super().compiled(), functions=(("respond", respond),))
