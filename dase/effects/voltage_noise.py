"""Noise of the photoreceptor's voltage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter


@wp.func
def noisy(
    voltage: float,
    intensity: float,
    dt: float,
    sigma: float,
    cutoff: float,
    knee: float,
    dark: float,
    noise: float,
    normal: float,
):
    """Voltage with low-pass filtered white noise: an Ornstein-Uhlenbeck process, exact at any sampling."""
    light = wp.max(intensity, 0.0) + dark
    share = light / (light + knee)
    x = 2.0 * wp.pi * cutoff * share * dt
    kept = wp.exp(-x)
    fresh = 2.0 * x * (1.0 - x)  # 1 - kept² loses digits near 0
    if x > 1.0e-3:
        fresh = 1.0 - kept * kept
    now = noise * kept + sigma * wp.sqrt((1.0 - share) * fresh) * normal
    return voltage + now, now


@dataclass(frozen=True, kw_only=True)
class VoltageNoise(Effect):
    """Noise of the photoreceptor's voltage.

    Photons come at random, so the photocurrent fluctuates, relatively the more the darker it is. The
    photoreceptor smooths the fluctuations; what is left wanders about, and now and then crosses a threshold.
    Such noise events often come in pairs of opposite polarity, since the voltage returns.

    Two poles filter the white shot noise: one grows with the photocurrent, the other is fixed by the bias at
    `cutoff`; they are alike at intensity `knee`. The corner is cutoff · I / (I + knee), the variance
    sigma² · knee / (I + knee), where I includes the dark current. In light above the knee the amplitude falls
    with the light, and noise events become rarer; far below it the amplitude is constant, and noise events
    become rarer with the bandwidth. In between they are most frequent. The filter is taken as of first order.
    Samples must be closer than the correlation time, or crossings between them are missed.
    """

    name: ClassVar[str] = "voltage_noise"
    source: ClassVar[str] = (
        "Graca, Delbruck: Unraveling the paradox of intensity-dependent DVS pixel noise, 2021"
    )
    stages: ClassVar = {"respond": noisy}
    states: ClassVar = ("noise",)

    sigma: float = parameter(
        0.05,
        unit="log intensity",
        off=0.0,
        bounds=(0.0, 2.0),
        plausible=(0.01, 0.2),
        about="standard deviation in the dark",
    )
    cutoff: float = parameter(
        200.0,
        unit="Hz",
        bounds=(0.01, 1e6),
        plausible=(10.0, 3000.0),
        about="corner frequency in bright light, set by the bias",
    )
    knee: float = parameter(
        0.1,
        unit="intensity",
        bounds=(1e-6, 1e6),
        plausible=(1e-3, 1.0),
        about="where the corner of the photocurrent equals that of the bias",
    )
    dark: float = parameter(
        0.003,
        unit="intensity",
        bounds=(1e-6, 10.0),
        plausible=(1e-4, 0.1),
        about="dark current, as the intensity that makes as much; keeps the corner above 0",
    )

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return 1 / (8 * self.cutoff) if self.sigma else math.inf
