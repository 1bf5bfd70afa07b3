"""The pixel's high-pass."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import ANY_SAMPLES, Effect, Observations, choice, parameter
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


@wp.func
def change_from_frame(
    voltage: float, dt: float, signal: float, before: float, cutoff: float, input: float, output: float
):
    """A voltage of which the step of the last sample is whole, and what was there before that has faded."""
    memory = signal - before
    passed = memory + (output - memory) * exponential(-2.0 * wp.pi * cutoff * dt) + voltage - input
    passed = wp.where(dt >= REST, voltage, passed)
    if cutoff == 0.0:
        passed = voltage  # sums of differences would round
    return passed, voltage, passed


@wp.func
def change_since_sending(
    voltage: float,
    dt: float,
    signal: float,
    before: float,
    cutoff: float,
    input: float,
    output: float,
    memory: float,
):
    """The same, where fades what is left to a pixel that has sent since the sample before."""
    now = signal - before
    # a leak moves the memory by less in a step, and no threshold is as small
    has_sent = wp.abs(now - memory) > 2.0e-2
    kept = wp.where(has_sent, exponential(-2.0 * wp.pi * cutoff * dt), 1.0)
    passed = now + (output - now) * kept + voltage - input
    passed = wp.where(dt >= REST, voltage, passed)
    if cutoff == 0.0:
        passed = voltage  # sums of differences would round
    return passed, voltage, passed, now


CHANGES_OF_FRAMES = {"frames": change_from_frame, "sending frames": change_since_sending}
CHANGES = {"memory": fading_change, **CHANGES_OF_FRAMES}


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

    Simulators that know the light at the frames of a clip alone forget from frame to frame, which is what the
    last two do from sample to sample of such a clip: what a frame changes is whole, and of what was left
    before that a share of exp(-2π cutoff T) stays, T being the time between two. At the highest cutoff
    nothing stays. With `"frames"` each frame is then compared with the one before alone (AirSim); with
    `"sending frames"` a pixel that has sent takes the light of its frame for its memory, and one that has not
    goes on (PIX2NVS). They are no property of a camera.
    """

    name: ClassVar[str] = "high_pass"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "Finateu et al.: A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor "
        "with 4.86 um pixels, 2020; Prophesee: Metavision documentation, biases (bias_hpf), 2024; frames: "
        "Shah et al.: AirSim, 2017; Bi, Andreopoulos: PIX2NVS, 2017"
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
        among=("input", "memory", "frames", "sending frames"),
        about="what fades: the input of the change detector, or the change since its last event, or what is "
        "left of that from one frame of a clip to the next",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return what a camera may have; what a simulator forgets from frame to frame is no effect."""
        return [cls(at="input"), cls(at="memory")]

    def knows_samples_alone(self) -> bool:
        """Whether it forgets from one sample of the scene to the next."""
        return self.at in CHANGES_OF_FRAMES and self.cutoff > 0.0

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return ANY_SAMPLES if self.knows_samples_alone() else math.inf

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know: each place has a function of its own."""
        respond, states = CHANGES.get(self.at, highpass), self.states
        if self.at == "sending frames":
            states = (*states, "memory")
        return replace(super().compiled(), functions=(("respond", respond),), states=states)
