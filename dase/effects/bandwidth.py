"""The photoreceptor's limited speed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.kernels.vector_math import exponential


@wp.func
def lowpass_voltage(
    voltage: float, intensity: float, dt: float, cutoff: float, dark: float, input: float, output: float
):
    """First-order low-pass, exact for an input that runs straight between samples."""
    x = 2.0 * wp.pi * cutoff * (dark + (1.0 - dark) * wp.clamp(intensity, 0.0, 1.0)) * dt
    decay = exponential(-x)
    # share of the input's step by which the output lags behind a ramp; (1 - e^-x)/x loses digits near 0
    lag = 1.0 - 0.5 * x
    if x > 1.0e-3:
        lag = (1.0 - decay) / x
    settled = voltage - (voltage - input) * lag + (output - input) * decay
    return settled, voltage, settled


@dataclass(frozen=True, kw_only=True)
class Bandwidth(Effect):
    """The photoreceptor's limited speed, slower in the dark.

    The photoreceptor is a low-pass: it charges its node with the photocurrent, so its bandwidth grows with
    the light. Fast changes are smoothed and come late, most of all in dark pixels, where edges trail long
    tails of events.

    The cutoff is `cutoff` at intensity 1 (white) and falls linearly to `dark * cutoff` at intensity 0.
    """

    name: ClassVar[str] = "bandwidth"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (finite bandwidth)"
    )
    stages: ClassVar = {"respond": lowpass_voltage}
    states: ClassVar = ("input", "output")

    cutoff: float = parameter(
        200.0,
        unit="Hz",
        off=math.inf,
        bounds=(0.01, math.inf),
        plausible=(3.0, 3000.0),
        about="-3 dB frequency at intensity 1",
    )
    dark: float = parameter(
        20 / 275,
        unit="1",
        bounds=(1e-4, 1.0),
        plausible=(0.01, 1.0),
        about="cutoff at intensity 0 relative to that at intensity 1; 1 makes the bandwidth constant",
        starts="ends",
    )
