"""Noise of the photoreceptor's voltage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.bandwidth import Bandwidth
from dase.effects.base import ANY_SAMPLES, Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.photocurrent import USUAL, idle_beside, photocurrent
from dase.effects.second_order import impulse_response
from dase.kernels.pixel_stages import REST, EffectStages
from dase.kernels.vector_math import cosine_and_sine, exponential, logarithm

POLE = wp.constant(2.0 * math.pi / math.sqrt(math.sqrt(2.0) - 1.0))
"""Frequency of either of two equal poles [rad/s] at which together they lose 3 dB at 1 Hz."""


@wp.func
def fresh_variance(x: float, kept: float):
    """Variance, covariance and variance of noise and its speed that are new after x time constants.

    In units of the stationary variance; the speed in units of the pole. `kept` is exp(-2x).
    """
    y = 2.0 * x
    mixed = 0.5 * y * y * kept
    var = 1.0 - kept * (1.0 + y + 0.5 * y * y)
    if y < 0.2:
        # the closed form loses digits
        var = y * y * y * (1.0 / 6.0 - y * (1.0 / 8.0 - y * (1.0 / 20.0 - y / 72.0)))
    return wp.max(var, 1.0e-30), mixed, 1.0 - kept * (1.0 - y + 0.5 * y * y)


STEEP = wp.constant(2.0)
"""Time constants in a step up to which the speeds at its ends tell where the voltage has been in between."""

CREST = wp.constant(0.05)
"""How far the voltage gets beyond its likeliest way at a turn, after a step of one time constant [sigma].

A third of what that way is uncertain by in the middle of a step, x^1.5 / sqrt(48). Chosen so that steps of
0.3 to 1.5 time constants give the event rates of steps of 0.05, for thresholds of 1 to 4 standard deviations.
"""


@wp.func
def turning_voltage(before: float, slope: float, after: float, slope_after: float):
    """Where a voltage turns in a step, and where to; `after` and 0 if it ends as it has begun.

    The likeliest way between two states of white noise behind two poles is, for short steps, the cubic with
    their values and slopes [1/step]. If one slope is up and one down, it turns once.
    """
    rise = after - before
    a = 3.0 * (slope + slope_after) - 6.0 * rise
    b = 6.0 * rise - 4.0 * slope - 2.0 * slope_after
    turns = slope * slope_after < 0.0
    way = wp.where(slope > 0.0, 1.0, -1.0)
    # of slope + b t + a t²; this form of the root has no difference of nearly equal numbers
    root = wp.sqrt(wp.max(b * b - 4.0 * a * slope, 0.0))
    t = wp.clamp(2.0 * slope / wp.where(turns, way * root - b, 1.0), 0.0, 1.0)
    top = before + t * (slope + t * (0.5 * b + t * a / 3.0))
    return wp.where(turns, top, after), wp.where(turns, way, 0.0)


@wp.func
def noisy_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    sigma: float,
    cutoff: float,
    knee: float,
    dark: float,
    dark_current: float,
    noise: float,
    speed: float,
    uniform: float,
    uniform_2: float,
):
    """Voltage with white noise behind two equal poles, its turns between samples included.

    The noise at the samples is exact at any sampling. Where it has turned in between, the step ends at the
    turn instead of at the sample, since events come of the extremes.
    """
    light = photocurrent(intensity, dark, dark_current)
    share = light / (light + knee)
    # beyond 100 time constants nothing is remembered
    x = wp.min(POLE * cutoff * share * dt, 100.0)
    kept = exponential(-x)
    var, mixed, speed_var = fresh_variance(x, kept * kept)
    first = wp.sqrt(var)
    cross = mixed / first
    then = wp.sqrt(wp.max(speed_var - cross * cross, 0.0))
    # both normals of one Box-Muller pair
    normal, normal_2 = cosine_and_sine(uniform_2)
    scale = sigma * wp.sqrt(-2.0 * logarithm(1.0 - uniform) * (1.0 - share))
    now = kept * (noise + x * (noise + speed)) + scale * first * normal
    speed_now = kept * (speed - x * (noise + speed)) + scale * (cross * normal + then * normal_2)
    # slopes of steps so long that they tell nothing of the way would lead astray
    near = wp.min(x, STEEP)
    top, way = turning_voltage(noise, near * speed, now, near * speed_now)
    top += way * CREST * near * wp.sqrt(near * (1.0 - share)) * sigma
    return voltage + top, now, speed_now


@wp.func
def noise_by_samples(
    voltage: float, dt: float, sigma: float, cutoff: float, noise: float, uniform: float, uniform_2: float
):
    """Voltage with noise behind one pole as it is at the samples, whatever the light."""
    # steps of Euler's; beyond the time constant the noise turns at each sample, beyond two it would grow
    kept = wp.max(1.0 - 2.0 * wp.pi * cutoff * dt, -0.9)
    normal, _ = cosine_and_sine(uniform_2)
    scale = sigma * wp.sqrt(-2.0 * logarithm(1.0 - uniform) * (1.0 - kept * kept))
    # the memory begins at the light alone: there is no noise before the first sample
    now = wp.where(dt < REST, kept * noise + scale * normal, 0.0)
    return voltage + now, now, float(0.0)


STILL = wp.constant(1.0e-6)
"""Change of light in a step below which there is none [log intensity]; float32 resolves 5e-7 of voltages."""

SAMPLES_PER_PERIOD = 4
"""Of a walk: with one, strong noise has a tenth too few events, and most at its end."""

SHORTEST_PERIOD = 1.5e-3
"""Time between frames from which on walks are tried [s]: others take many samples and are like fast noise."""

LONGEST_PERIOD = 0.1
"""Time between frames up to which walks are tried [s]: pictures further apart show no motion."""

PAST = wp.constant(1.0e-5)
"""How far the line of a step goes beyond a threshold that it passes [log intensity]."""


@wp.func
def walked_voltage(
    voltage: float,
    intensity: float,
    dt: float,
    signal: float,
    before: float,
    on: float,
    off: float,
    sigma: float,
    knee: float,
    dark: float,
    dark_current: float,
    period: float,
    floor: float,
    walked: float,
    pace: float,
    left: float,
    was: float,
    slip: float,
    uniform: float,
    uniform_2: float,
    uniform_3: float,
):
    """Voltage at the end of a step in which it walks at random, beside steady changes of the light.

    At the begin of each period, and after each event for what is left of it, it is drawn which threshold a
    Brownian motion with drift passes first, and when; up to then the voltage goes there in a straight line.
    `walked` is how far it is from the light, `pace` at what rate it leaves it, `left` the time to the end of
    the period [s], `was` what it was above the memory at the end of the last step, and `slip` the rate at
    which a leak has moved the memory since, which the walk knows as it knows the light; voltages are
    log intensities, rates per second.
    """
    light = photocurrent(intensity, dark, dark_current)
    # an event moves the memory by more than any leak in a step
    event = wp.abs(before - was) > 0.5 * wp.min(on, off)
    slip_now = wp.where(event, slip, (before - was) / dt)
    steady = voltage + walked - signal
    move = steady + slip_now * dt
    fresh = left < 0.5 * dt
    horizon = wp.max(wp.where(fresh, period, left), dt)
    share = floor + (1.0 - floor) * knee / (light + knee)
    spread = wp.max(sigma * wp.sqrt(share * horizon / period), 1.0e-6)
    drift = wp.abs(move) * (horizon / dt)
    way_on = wp.max(on - before, 1.0e-6)
    way_off = wp.max(off + before, 1.0e-6)
    # exponents of one sign, as the others overflow
    steep = 2.0 * drift / (spread * spread)
    way_along = wp.where(move > 0.0, way_on, way_off)
    way_back = wp.where(move > 0.0, way_off, way_on)
    never_back = exponential(-steep * way_back)
    neither = never_back * exponential(-steep * way_along)
    still = wp.abs(move) < STILL
    along = wp.where(still, 0.5, (1.0 - never_back) / wp.max(1.0 - neither, 1.0e-30))
    goes_along = uniform_3 < along
    # what is left of a number that has decided is as good as another
    again = wp.where(goes_along, uniform_3, uniform_3 - along) / wp.where(goes_along, along, 1.0 - along)
    sign = wp.where(goes_along, 1.0, -1.0) * wp.where(move > 0.0, 1.0, -1.0)
    way = wp.where(sign > 0.0, way_on, way_off)
    # the way over an inverse Gaussian time (Michael, Schucany, Haas 1976); a walk that has come against the
    # drift has taken as long as one along it
    cosine, _ = cosine_and_sine(uniform_2)
    square = -2.0 * logarithm(1.0 - uniform) * cosine * cosine  # of a normal number
    half = wp.where(still, 0.25, 0.5) * square * spread * spread / way
    fast = drift + half + wp.sqrt(half * (half + 2.0 * drift))
    slow = drift * drift / wp.max(fast, 1.0e-30)
    part = wp.where(again * (fast + drift) < fast, fast, slow)
    drawn = (sign * part - move * (horizon / dt)) / horizon
    pace_now = wp.where(fresh, drawn, wp.where(event, drawn, pace))
    change = steady + pace_now * dt
    ends = before + change
    # beyond a threshold that it passes the light alone goes on
    rest = wp.abs(steady) * (1.0 - wp.where(change > 0.0, way_on, way_off) / wp.max(wp.abs(change), 1.0e-12))
    passes = wp.where(ends > on, 1.0, wp.where(ends < -off, 1.0, 0.0))
    rest = wp.where(steady * change > 0.0, rest, 0.0) + PAST
    ends = wp.where(passes > 0.0, wp.where(ends > on, on + rest, -off - rest), ends)
    now = signal + (ends - before)
    begins = dt >= REST
    # a pace that an event has ended is drawn anew: `was` is beyond the threshold, where the memory comes to
    return (
        wp.where(begins, voltage, now),
        wp.where(begins, 0.0, now - voltage),
        wp.where(begins, 0.0, pace_now),
        wp.where(begins, 0.0, horizon - dt),
        wp.where(begins, 0.0, ends),
        wp.where(begins, 0.0, slip_now),
    )


@wp.func
def fresh_variance_of_poles(x: float, damping: float, h: float, dh: float):
    """Variance, covariance and variance of noise and its speed that are new after x, behind any two poles.

    In units of the stationary variance; x and the speed in units of the natural frequency. `h` and `dh` are
    the impulse response there.
    """
    rest = dh + 2.0 * damping * h
    mixed = 2.0 * damping * h * h
    var = 1.0 - rest * rest - h * h
    speed_var = 1.0 - h * h - dh * dh
    if x * wp.max(2.0 * damping, 1.0) < 2.0:
        # the closed forms lose digits; four Gauss points of h² and dh², of which they are the integrals
        var = float(0.0)
        speed_var = float(0.0)
        for n in range(4):
            away = wp.where(n == 0 or n == 3, 0.4305681557970263, 0.1699905217924281)
            weight = wp.where(n == 0 or n == 3, 0.1739274225687269, 0.3260725774312731)
            g, dg = impulse_response((0.5 + wp.where(n < 2, -away, away)) * x, damping)
            var += 4.0 * damping * x * weight * g * g
            speed_var += 4.0 * damping * x * weight * dg * dg
    return wp.max(var, 1.0e-30), mixed, speed_var


@wp.func
def photoreceptor_noise(
    voltage: float,
    intensity: float,
    dt: float,
    sigma: float,
    cutoff: float,
    knee: float,
    dark: float,
    dark_current: float,
    gain: float,
    noise: float,
    speed: float,
    uniform: float,
    uniform_2: float,
):
    """Voltage with noise of a node that the light charges, in a loop with a fixed pole; turns as above.

    `speed` is the slope in units of the fixed pole, which goes on where the light changes.
    """
    light = photocurrent(intensity, dark, dark_current)
    share = light / (light + knee)
    fixed = 2.0 * wp.pi * cutoff
    node = fixed * (light / knee)
    omega = wp.sqrt((1.0 + gain) * fixed * node)
    damping = 0.5 * (fixed + node) / omega
    # beyond this nothing is remembered
    x = wp.min(omega * dt, 1.0e8)
    h, dh = impulse_response(x, damping)
    var, mixed, speed_var = fresh_variance_of_poles(x, damping, h, dh)
    first = wp.sqrt(var)
    cross = mixed / first
    then = wp.sqrt(wp.max(speed_var - cross * cross, 0.0))
    # both normals of one Box-Muller pair
    normal, normal_2 = cosine_and_sine(uniform_2)
    scale = sigma * wp.sqrt(-2.0 * logarithm(1.0 - uniform) * (1.0 - share))
    unit = fixed / omega
    now = (dh + 2.0 * damping * h) * noise + h * unit * speed + scale * first * normal
    speed_now = dh * speed + (scale * (cross * normal + then * normal_2) - h * noise) / unit
    a = wp.min(node * dt, 100.0)
    b = wp.min(fixed * dt, 100.0)
    # slopes of steps so long that they tell nothing of the way would lead astray
    near = wp.min(1.0, STEEP / wp.max(wp.max(a, b), wp.max(x, 1.0e-6)))
    top, way = turning_voltage(noise, near * b * speed, now, near * b * speed_now)
    # of equal poles this is `CREST` as above: in a step white noise moves the slope by 2 a b² sigma²
    top += way * CREST * near * b * wp.sqrt(0.5 * near * a * (1.0 + gain)) * sigma
    return voltage + top, now, speed_now


@dataclass(frozen=True, kw_only=True)
class VoltageNoise(Effect):
    """Noise of the photoreceptor's voltage.

    Photons come at random, so the photocurrent fluctuates, relatively the more the darker it is. The
    photoreceptor smooths the fluctuations; what is left wanders about, and now and then crosses a threshold.
    Such noise events often come in pairs of opposite polarity, since the voltage returns.

    Two poles filter the white shot noise: one grows with the photocurrent, the other is fixed by the bias at
    `cutoff`; they are alike at intensity `knee`. The corner is cutoff · I / (I + knee), the variance
    sigma² · knee / (I + knee), where I includes the dark current: that of the effect `dark`, pixel by pixel,
    or where the sensor has none `dark` here. In light above the knee the amplitude falls
    with the light, and noise events become rarer; far below it the amplitude is constant, and noise events
    become rarer with the bandwidth. In between they are most frequent. The spectrum is that of two equal
    poles which together lose 3 dB at the corner: noise of a single pole would be so rough that its event rate
    grows with ever finer sampling. Scenes are sampled eight times per period of `cutoff` where they can be,
    and a turn of the voltage between two samples is seen, too: event rates are right within 3 % from
    thresholds of one standard deviation on. A level far above its rest the voltage passes
    1.55 · corner · exp(-level² / 2 variance) times per second (Rice's formula).

    With `poles = "apart"` the noise has the photoreceptor's own two poles: that of its node, which the
    photocurrent charges, at cutoff · I / knee, and the fixed one at `cutoff`, with a loop of `gain` around
    both, as `second_order` with `poles = "apart"` has them. The variance is as above, and the voltage passes
    its mean sqrt((1 + gain) I / knee) · cutoff times per second upwards. Its crossings come in
    clusters where the node is the faster one, and most of a cluster make no event, so events are fewer than
    Rice's formula has crossings. Scenes are sampled so finely that at intensity 1 the node has at most two
    time constants between samples: pi / knee samples per period of `cutoff`, which costs much for a low knee.
    A loop asks for some sqrt(25 (1 + gain) / knee) samples, where that is more. The node's pole is that of
    `bandwidth` where that has cutoff · (1 + dark) / knee and dark / (1 + dark), see `of_photoreceptor`.

    With `poles = "one"` it is what other simulators draw (v2e's photoreceptor noise): noise behind one pole
    at `cutoff` in Euler's steps, of the same variance sigma² in all light, drawn once at each sample of the
    scene but the first, where memories begin at the light alone; in between it goes in a straight line. Noise
    of one pole is so rough that its events depend on the sampling: it belongs to scenes whose frames are
    those that the other simulator has seen.

    With `poles = "none"` it is what DVS-Voltmeter draws: the voltage does a random walk that never returns.
    Its variance after one `period` is the one above, of which no light takes away the share `floor`; from
    period to period, which are the frames of a clip, and from event to event it goes straight to where and
    when it would pass a threshold next. Walks get to a threshold that light comes near, so slow changes make
    their events early, and more of them. A leak counts as light here. At rest the walk has half the variance,
    as the code of that simulator has.

    An ideal memory moves by whole thresholds, so a pixel keeps the phase that it began with, and pixels which
    are alike differ in their rates. One that is held in reset after its events (`refractory`) memorises the
    noise of a later moment: a dead time of a time constant, 1 / (9.8 · corner), forgets the phase within some
    events, a shorter one, or `jitter`, more slowly.
    """

    name: ClassVar[str] = "voltage_noise"
    source: ClassVar[str] = (
        "Graca, Delbruck: Unraveling the paradox of intensity-dependent DVS pixel noise, 2021; "
        "Lin, Ma, Guo, Wen: DVS-Voltmeter, stochastic process-based event simulator, 2022 (walk)"
    )
    stages: ClassVar = {"respond": noisy_voltage}
    states: ClassVar = ("noise", "speed")
    signatures: ClassVar = (
        Makes("noise at rest", tells=True, by="returning"),
        Makes("opposite pairs"),
    )
    screen_limits: ClassVar = {
        "cutoff": "the noise's cutoff wants constant light: an LED on DC, not a backlight",
    }

    sigma: float = parameter(
        0.05,
        unit="log intensity",
        off=0.0,
        bounds=(0.0, 2.0),
        plausible=(0.01, 0.2),
        about="standard deviation in the dark",
        # where little decides of many events what is sent, as beside a limit of the rate, any chance will do:
        # 0.004 in a clip without noise, 0.024 and more of 35 that were said in others
        clear_from=0.01,
    )
    cutoff: float = parameter(
        200.0,
        unit="Hz",
        bounds=(0.01, 1e6),
        plausible=(10.0, 3000.0),
        about="corner frequency in bright light, set by the bias",
        starts="ends",
        # light is known each millisecond: faster noise of as many events looks the same, and costs more
        farthest=1000.0,
    )
    knee: float = parameter(
        0.1,
        unit="intensity",
        bounds=(1e-6, 1e6),
        plausible=(1e-3, 1.0),
        about="where the corner of the photocurrent equals that of the bias",
        starts="ends",
    )
    dark: float = parameter(
        0.003,
        unit="intensity",
        bounds=(1e-6, 10.0),
        plausible=(1e-4, 0.1),
        about="dark current, as the intensity that makes as much; keeps the corner above 0; unused "
        "beside `dark`",
        fitted=False,  # it shows in the darkest pixels only, which hardly send events
    )
    gain: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1e4),
        plausible=(0.0, 300.0),
        about="of the loop around both poles, if they are apart; 0 for one behind the other",
        fitted=False,  # it shows in the spectrum alone
    )
    period: float = parameter(
        0.01,
        unit="s",
        bounds=(1e-6, 1.0),
        plausible=(1e-3, 0.1),
        about="from draw to draw of a walk: the time between frames",
        fitted=False,  # it is that of the clip
    )
    floor: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 1.0),
        about="share of the variance of a walk in the dark that no light takes away",
    )
    poles: str = choice(
        "alike",
        among=("alike", "apart", "one", "none"),
        about="two equal ones at the corner of both, or one that follows the light and a fixed one, or a "
        "single fixed one whose noise is drawn at each sample of the scene, or none and a walk from "
        "period to period",
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the noise of equal poles: spectra of poles alike and apart differ less than recordings tell.

        Where events are of a simulator that works frame by frame, that which it draws once a frame, from a
        slow and a usual corner on: a descent that begins with a fast one ends with white noise. Beside
        slower clips a walk from frame to frame, too, that light takes nothing away of, and one that
        it does.
        """
        if observed.clip_step:
            return [cls(poles="one"), cls(poles="one", cutoff=30.0)]
        if not SHORTEST_PERIOD <= observed.clip_frames <= LONGEST_PERIOD:
            return [cls()]
        walk = cls(poles="none", sigma=0.03, period=observed.clip_frames)
        return [cls(), replace(walk, floor=1.0), replace(walk, sigma=0.1, knee=0.03)]

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return noise of two equal poles for that of one, of the same variance and corner in usual light.

        And the other way round beside what goes on at each sample of the scene: another simulator's low-pass
        that was not there yet may have made its noise look like that of two poles.
        """
        share = USUAL / (USUAL + self.knee)
        if self.poles == "one":
            sigma, cutoff = self.sigma / math.sqrt(1 - share), self.cutoff / share
            return [replace(self, sigma=sigma, cutoff=cutoff, poles="alike")]
        if self.poles == "alike" and any(effect.longest_step() == ANY_SAMPLES for effect in beside):
            sigma, cutoff = self.sigma * math.sqrt(1 - share), self.cutoff * share
            return [replace(self, sigma=sigma, cutoff=cutoff, poles="one")]
        return []

    def begins_at_the_light(self) -> bool:
        """Whether memories begin at the first light, as where noise is drawn from then on."""
        return self.poles in ("one", "none")

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing by its rule."""
        walks = ("period", "floor")
        by_rule = {
            "alike": ("gain", *walks),
            "apart": walks,
            "one": ("knee", "dark", "gain", *walks),
            "none": ("cutoff", "gain"),
        }[self.poles]
        return tuple(dict.fromkeys((*by_rule, *idle_beside(beside))))

    @classmethod
    def of_photoreceptor(cls, pole: Bandwidth, *, sigma: float, cutoff: float, gain: float = 0.0) -> Self:
        """Return the noise of the photoreceptor that `SecondOrder.of_poles` returns.

        Args:
            pole: That of the node, its cutoff and its dark current.
            sigma: Standard deviation in the dark [log intensity].
            cutoff: Of the fixed pole [Hz].
            gain: Of the loop around both.
        """
        # pole.cutoff (dark + (1 - dark) light) is cutoff (light + dark current) / knee
        slope = pole.cutoff * (1 - pole.dark)
        dark = pole.dark / (1 - pole.dark)
        return cls(sigma=sigma, cutoff=cutoff, knee=cutoff / slope, dark=dark, gain=gain, poles="apart")

    def compiled(self) -> EffectStages:
        """Return what the kernel composer needs to know."""
        if self.poles == "none":
            return replace(
                super().compiled(),
                functions=(("respond", walked_voltage),),
                states=("walked", "pace", "left", "was", "slip"),
            )
        respond = {"alike": noisy_voltage, "apart": photoreceptor_noise, "one": noise_by_samples}[self.poles]
        return replace(super().compiled(), functions=(("respond", respond),))

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        if not self.sigma:
            return math.inf
        step = 1 / (8 * self.cutoff)
        if self.poles == "alike":
            return step
        if self.poles == "one":
            return ANY_SAMPLES
        if self.poles == "none":
            return self.period / SAMPLES_PER_PERIOD
        # slopes tell where the voltage turns up to so many time constants of the node, in the brightest
        # light; the loop's pace is the geometric mean of those of the poles, and faster by the gain
        node = STEEP * self.knee / (2 * math.pi * self.cutoff * (1 + self.dark))
        return min(step, node, math.sqrt(step * node / (1 + self.gain)))
