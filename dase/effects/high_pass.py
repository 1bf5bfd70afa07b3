"""The pixel's high-pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, choice, parameter
from dase.kernels.pixel_stages import REST, EffectStages
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


@wp.func
def fading_change(
    voltage: float, dt: float, signal: float, before: float, cutoff: float, input: float, output: float
):
    """A voltage that comes back to the pixel's memory as the change since its last event fades."""
    memory = signal - before  # what acts behind this one is in both
    passed, _, _ = highpass(voltage, dt, cutoff, input, output - memory)
    passed += memory
    # the memory begins at the first voltage, from which nothing has faded
    passed = wp.where(dt >= REST, voltage, passed)
    if cutoff == 0.0:
        passed = voltage
    return passed, voltage, passed


@dataclass(frozen=True, kw_only=True)
class HighPass(Effect):
    """Slow changes are forgotten before they make events.

    Some sensors, such as Prophesee's with their bias `bias_hpf`, couple the photoreceptor to the change
    detector through a high-pass. Changes slower than its cutoff fade before they reach a threshold: slow
    motion, drifting light and the background go, fast motion and flicker stay.

    Where it stands is `at`. At the `"input"` of the change detector it is a filter of its own: the voltage v
    behind it follows dv/dt = du/dt - 2π cutoff v, u being the photoreceptor's, whatever events come. A step
    of contrast c leaves c · exp(-2π cutoff t) after the time t, so a pixel sends as many events of the other
    polarity after a bright object has come to rest on it. A ramp of slope s ends at s / (2π cutoff), below
    the threshold if it is slow enough.

    At the `"memory"` it is a resistor across the capacitor of the change detector, which each event
    discharges: the change d since the last event follows dd/dt = du/dt - 2π cutoff d and begins at 0 anew.
    What a step leaves below a threshold is forgotten without an event; a ramp of slope s sends an event each
    -log(1 - 2π cutoff threshold / s) / (2π cutoff), and none below s = 2π cutoff threshold. A leak, which
    moves the memory at a speed of its own, sends nothing either if it is as slow. What Prophesee's pixel does
    is not published; other simulators have the one or the other.
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
    at: str = choice(
        "input",
        among=("input", "memory"),
        about="what fades: the input of the change detector, or the change since its last event",
    )

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know: each place has a function of its own."""
        respond = highpass if self.at == "input" else fading_change
        return replace(super().compiled(), functions=(("respond", respond),))
