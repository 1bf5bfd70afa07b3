"""A photoreceptor of two poles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.bandwidth import Bandwidth, time_constants
from dase.effects.base import ANY_SAMPLES, Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.photocurrent import USUAL, dark_share, idle_beside, relative_photocurrent
from dase.kernels.pixel_stages import EffectStages
from dase.kernels.vector_math import cosine_and_sine, exponential

FAR_APART = 1000.0
"""Times as fast as the other that a pole is, at most, of two that are seen."""


@wp.func
def impulse_response(x: float, damping: float):
    """Impulse response h of 1 / (s² + 2 damping s + 1) after x, and its derivative."""
    h = float(0.0)
    dh = float(0.0)
    decay = exponential(-damping * x)
    if damping < 1.0:
        w = wp.sqrt((1.0 - damping) * (1.0 + damping))
        turn = w * x / (2.0 * wp.pi)
        cosine, sine = cosine_and_sine(turn - wp.floor(turn))
        h = decay * sine / w
        dh = decay * cosine - damping * h
    else:
        w = wp.sqrt((damping - 1.0) * (damping + 1.0))
        fast = exponential(-(damping + w) * x)
        slow = exponential(-x / (damping + w))
        z = w * x
        # the difference of nearly equal numbers loses digits
        h = decay * x * (1.0 + z * z / 6.0 * (1.0 + z * z / 20.0))
        if z > 0.3:
            h = 0.5 * (slow - fast) / w
        dh = 0.5 * (slow + fast) - damping * h
    return h, dh


@wp.func
def settled_share(x: float):
    """Mean of e^-t for t from 0 to x: (1 - e^-x) / x, with all digits."""
    mean = 1.0 - 0.5 * x * (1.0 - x / 3.0 * (1.0 - 0.25 * x))
    if x > 0.05:
        mean = (1.0 - exponential(-x)) / x
    return mean


@wp.func
def ramp_lag(x: float, damping: float, h: float, rest: float):
    """Shares of a ramp's step by which the output lags, and by which it has got up to speed.

    `rest` is what is left after x of a displacement, p; the shares are the mean of p from 0 to x, and
    (1 - p) / x.
    """
    behind = (2.0 * damping * (1.0 - rest) + h) / x
    speed = (1.0 - rest) / x
    if x * wp.max(1.0, 2.0 * damping) < 0.1:
        # series; the closed forms lose digits
        a = damping / 3.0
        b = (1.0 - 4.0 * damping * damping) / 24.0
        c = -(8.0 * damping * b + a) / 20.0
        behind = 1.0 + x * x * (-1.0 / 6.0 + x * (a / 4.0 + x * (b / 5.0 + x * c / 6.0)))
        speed = x * (0.5 - x * (a + x * (b + x * c)))
    if damping >= 1.5:
        # two real poles, whose sums lose no digits when one is much slower than the other
        w = wp.sqrt((damping - 1.0) * (damping + 1.0))
        quick = damping + w
        slow = 1.0 / quick
        mean_quick = settled_share(quick * x)
        mean_slow = settled_share(slow * x)
        behind = (quick * mean_slow - slow * mean_quick) / (2.0 * w)
        speed = (mean_slow - mean_quick) / (2.0 * w)
    return behind, speed


@wp.func
def behind_two_poles(
    voltage: float, dt: float, omega: float, damping: float, input: float, output: float, slope: float
):
    """Output of a second-order low-pass after a step, and its slope; exact for a straight input."""
    x = omega * dt
    step = voltage - input
    settled = voltage
    speed = step / dt
    # beyond this it follows at once; infinity would make not-a-numbers below
    if x < 1.0e8:
        h, dh = impulse_response(x, damping)
        rest = dh + 2.0 * damping * h
        behind, reached = ramp_lag(x, damping, h, rest)
        settled = voltage - step * behind + (output - input) * rest + slope / omega * h
        speed = omega * (step * reached - (output - input) * h) + slope * dh
    return settled, speed


@wp.func
def second_order_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    cutoff: float,
    damping: float,
    dark: float,
    dark_current: float,
    spread: float,
    input: float,
    output: float,
    slope: float,
    pixel_normal: float,
):
    """Two poles that follow the photocurrent alike."""
    omega = 2.0 * wp.pi * cutoff * relative_photocurrent(intensity, dark, dark_current)
    omega *= wp.max(1.0 + spread * pixel_normal, 0.1)
    settled, speed = behind_two_poles(voltage, dt, omega, damping, input, output, slope)
    return settled, voltage, settled, speed


@wp.func
def photoreceptor_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    cutoff: float,
    damping: float,
    dark: float,
    dark_current: float,
    fixed: float,
    spread: float,
    input: float,
    output: float,
    slope: float,
    pixel_normal: float,
):
    """A pole that follows the photocurrent and a fixed one: damping changes with the light."""
    light = relative_photocurrent(intensity, dark, dark_current)
    root = wp.sqrt(light)
    omega = 2.0 * wp.pi * cutoff * root
    omega *= wp.max(1.0 + spread * pixel_normal, 0.1)
    # the sum of the poles, of which one share follows the light, over that of two equal ones
    damped = damping * (fixed + (1.0 - fixed) * light) / root
    settled, speed = behind_two_poles(voltage, dt, omega, damped, input, output, slope)
    return settled, voltage, settled, speed


@wp.func
def stepped_voltage_twice(
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
    """Two low-passes in a row that go a share of the way at each sample; `input` is the first one's state."""
    x = time_constants(intensity, dt, cutoff, dark, dark_current, spread, pixel_normal)
    between = input + wp.min(x, 1.0) * (voltage - input)
    settled = output + wp.min(x, 1.0) * (between - output)
    return settled, between, settled, 0.0


@dataclass(frozen=True, kw_only=True)
class SecondOrder(Effect):
    """A photoreceptor of two poles.

    The photoreceptor's feedback loop has two time constants, one set by the photocurrent, one by the bias
    current of its amplifier. When they are alike the response is steeper than that of one low-pass, and in
    bright light it may overshoot, so that a sharp edge is followed by a few events of the other polarity.

    H(s) = ω² / (s² + 2 damping ω s + ω²), with ω/2π = `cutoff` and the damping `damping` at intensity 1
    (white). The quality factor is Q = 1 / (2 damping); at damping 0.71 the natural frequency is the -3 dB
    frequency. Exact at any sampling, for under-, over- and critical damping. Strongly damped it is one
    low-pass with the cutoff `cutoff / (2 damping)`: `bandwidth`. The natural frequency differs from pixel to
    pixel by `spread`.

    With `poles = "alike"` both poles follow the photocurrent, of which L is left (1 at intensity 1, `dark` at
    intensity 0; of a sensor with the effect `dark` (I + current) / (1 + median current)): ω goes with L and
    the damping is the same in all light, as other simulators have it.

    With `poles = "apart"` it is the circuit. Its node, which the photocurrent charges, has the pole a L, its
    amplifier the fixed pole b, and a loop of gain A goes round both: v'' + (a L + b) v' =
    (1 + A) a b L (u - v) for the logarithm u of the light. So ω goes with sqrt(L), and the damping is that at
    intensity 1 times (`fixed` + (1 - `fixed`) L) / sqrt(L), where `fixed` = b / (a + b) is the amplifier's
    share of it: with a high gain nearly all, and damping falls as light rises. Without a loop it is one
    low-pass behind another, such as a buffer. `of_poles` takes the poles and the gain. With a fixed pole far
    above the other it is `bandwidth` in all light.

    With `poles = "steps"` it is what another simulator makes of two equal ones (Metavision): two low-passes
    in a row, each of which goes ω dt of the way from one sample of the scene to the next, and all of it where
    that is above 1. It belongs to scenes whose frames are those that the other simulator has seen.
    """

    name: ClassVar[str] = "second_order"
    source: ClassVar[str] = (
        "Delbruck, Mead: Analog VLSI adaptive, logarithmic, wide-dynamic-range photoreceptor, 1994; "
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008"
    )
    stages: ClassVar = {"respond": second_order_voltage}
    states: ClassVar = ("input", "output", "slope")
    includes: ClassVar = ("bandwidth",)
    signatures: ClassVar = (Makes("late events", tells=True, by="poles", absence=False),)
    screen_limits: ClassVar = {
        "": (
            "a cutoff above about {highest_cutoff:g} Hz and the damping want an LED, as the screen rings and "
            "lags itself"
        ),
    }

    cutoff: float = parameter(
        300.0,
        unit="Hz",
        off=math.inf,
        bounds=(0.01, math.inf),
        plausible=(3.0, 10000.0),
        about="natural frequency at intensity 1",
    )
    damping: float = parameter(
        0.7,
        unit="1",
        bounds=(0.05, 20.0),
        plausible=(0.3, 5.0),
        about="below 1 the response overshoots",
        starts="ends",
    )
    dark: float = dark_share(
        "photocurrent at intensity 0 relative to that at intensity 1, which the poles follow; 1 makes them "
        "constant"
    )
    spread: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 0.3),
        about="standard deviation of the natural frequency over pixels, relative to it",
        fitted=False,  # as that of `bandwidth`
    )
    fixed: float = parameter(
        1.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.1, 1.0),
        about="share of the damping at intensity 1 that is the fixed pole's, if poles are apart",
        fitted=False,  # it shows only where the response rings or not by the light
    )
    poles: str = choice(
        "alike",
        among=("alike", "apart", "steps"),
        about="both follow the light; one does and one is fixed, so that damping changes with light; or two "
        "equal ones in steps of a sample",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return that of constant damping: `dase.fit` asks for the circuit's, too.

        Where events are of a simulator that works frame by frame, it goes in steps; where they are behind a
        pole that goes with the light and one that does not, it is of these.
        """
        if observed.unlike_poles:
            first, dark, second = observed.unlike_poles
            least, most = next(p.bounds for p in Bandwidth.parameters() if p.name == "dark")
            node = Bandwidth(cutoff=first, dark=min(max(dark, least), most))
            # one that is so much faster is none
            second = min(max(second, first / FAR_APART), first * FAR_APART)
            return [cls.of_poles(node, cutoff=second)]
        return [cls(poles="steps", damping=1.0) if observed.clip_step else cls()]

    def by_other_laws(self) -> list[Self]:
        """Return the other law of the poles, of the same frequency and damping in usual light."""
        if self.poles == "steps":
            return [replace(self, poles="alike")]
        root = math.sqrt(USUAL)
        if self.poles == "alike":
            return [self._changed(self.cutoff * root, self.damping * root / self._share(), "apart")]
        return [self._changed(self.cutoff / root, self.damping * self._share() / root, "alike")]

    def _share(self) -> float:
        """Return the sum of the poles in usual light relative to that at intensity 1, if poles are apart."""
        return self.fixed + (1 - self.fixed) * USUAL

    def _changed(self, cutoff: float, damping: float, poles: str) -> Self:
        low, high = next(p.bounds for p in self.parameters() if p.name == "damping")
        return replace(self, cutoff=max(cutoff, 0.01), damping=min(max(damping, low), high), poles=poles)

    @classmethod
    def of_poles(cls, pole: Bandwidth, *, cutoff: float, gain: float = 0.0) -> Self:
        """Return the photoreceptor of a pole that follows the light, as a `Bandwidth`, and a fixed one.

        Args:
            pole: That of the node; of a loop, that without the loop.
            cutoff: Of the fixed pole [Hz].
            gain: Of the loop around both; 0 for one low-pass behind the other.
        """
        natural = math.sqrt((1 + gain) * pole.cutoff * cutoff)
        return cls(
            cutoff=natural, damping=(pole.cutoff + cutoff) / (2 * natural), dark=pole.dark,
            spread=pole.spread, fixed=cutoff / (pole.cutoff + cutoff), poles="apart",
        )  # fmt: skip

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing by its law."""
        idle = {"alike": ("fixed",), "apart": (), "steps": ("fixed", "damping")}[self.poles]
        return (*idle, *idle_beside(beside))

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        return ANY_SAMPLES if self.poles == "steps" and self.cutoff < math.inf else math.inf

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know."""
        respond = {
            "alike": second_order_voltage, "apart": photoreceptor_voltage, "steps": stepped_voltage_twice
        }[self.poles]  # fmt: skip
        return replace(super().compiled(), functions=(("respond", respond),))

    def simpler(self) -> tuple[Effect, ...]:
        """Return the one low-pass that is as late behind a ramp: by 2 damping / (2π cutoff)."""
        cutoff = max(self.cutoff / (2 * self.damping), 0.01)
        signal = "steps" if self.poles == "steps" else "small"
        return (Bandwidth(cutoff=cutoff, dark=self.dark, spread=self.spread, signal=signal),)
