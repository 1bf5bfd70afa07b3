"""The pixel's high-pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.kernels.vector_math import exponential


@wp.func
def highpass(voltage: float, dt: float, cutoff: float, input: float, output: float):
    """First-order high-pass, exact for an input that runs straight between samples."""
    x = 2.0 * wp.pi * cutoff * dt
    decay = exponential(-x)
    # share of the input's step that has not leaked away at its end; (1 - e^-x)/x loses digits near 0
    left = 1.0 - 0.5 * x
    if x > 1.0e-3:
        left = (1.0 - decay) / x
    passed = output * decay + (voltage - input) * left
    if cutoff == 0.0:
        passed = voltage  # sums of differences would round
    return passed, voltage, passed


@dataclass(frozen=True, kw_only=True)
class HighPass(Effect):
    """Slow changes are forgotten before they make events.

    Some sensors, such as Prophesee's with their bias `bias_hpf`, couple the photoreceptor to the change
    detector through a high-pass. Changes slower than its cutoff fade before they reach a threshold: slow
    motion, drifting light and the background go, fast motion and flicker stay. What an edge left behind is
    forgotten, too, so a pixel sends events of the other polarity after a bright object has rested on it.

    Behind it the voltage v follows dv/dt = du/dt - 2π cutoff v, u being the photoreceptor's. A step of
    contrast c leaves c · exp(-2π cutoff t) after the time t; a ramp of slope s ends at s / (2π cutoff), below
    the threshold if it is slow enough.
    """

    name: ClassVar[str] = "high_pass"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "Finateu et al.: A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor "
        "with 4.86 um pixels, 2020; Prophesee: Metavision documentation, biases (bias_hpf), 2024"
    )
    stages: ClassVar = {"respond": highpass}
    states: ClassVar = ("input", "output")
    signatures: ClassVar = ()

    cutoff: float = parameter(
        1.0,
        unit="Hz",
        off=0.0,
        bounds=(0.0, 1e5),
        plausible=(0.05, 100.0),
        about="-3 dB frequency below which changes are lost",
    )
