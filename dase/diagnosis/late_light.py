"""Whether events are late, and in which way: by how far light goes from one event of a pixel to the next.

That is the threshold each time, of the light that the pixel sees when it decides. If events come later by a
fixed time, or light is behind a pole or two, which may go with it or not, it is so of that light and not of
the scene's. So the light is taken back by a latency, a pole, two poles and both, and the way and the values
are sought with which light goes equally far. No model is fitted: thresholds may be any, noise and leaks add
the same to all, and hundreds of thousands of steps tell ways apart that statistics do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dase.diagnosis.light_between_events import LightBetweenEvents, StepSettings
from dase.fitting.frame_steps import clip_step_of, is_held
from dase.fitting.measurement import Measurement
from dase.formatting import format_metric, format_percent, format_seconds
from dase.kernels.slow_light import SlowLight
from dase.signatures.kinds import LATE_EVENTS
from dase.signatures.result import Answer, Signature

Array = NDArray[np.float64]
Levels = NDArray[np.float32]

LOOKED_AT = StepSettings(samples=4_000_000, events=200_000)
"""Pixels, instants and events."""


@dataclass(frozen=True)
class LateLightSettings:
    """When events are late.

    Chosen on sets k to z of other simulators (development): with latencies and poles steps differed by 0.01
    to 0.68 of what they did without, with none by 0.88 and more.
    """

    quick: tuple[tuple[float, ...], tuple[float, ...]] = ((1e-3, 3e-3, 8e-3), (20.0, 80.0))
    """Latencies [s] and poles [Hz] that are looked at first."""

    few: int = 12_000
    """Events that tell where ways are; all of them tell which leaves least."""

    open: float = 1.15
    """Times what steps differ by in the best way, so far, that they do in those that all pixels look at."""

    begun: float = 0.93
    """Share of what steps differ by that they do with the best of these, at most, for others to be sought."""

    delays: tuple[float, float, int] = (3e-4, 2.4e-2, 10)
    """Latencies from which on they are sought: from, to [s], and how many."""

    poles: tuple[float, float, int] = (6.0, 800.0, 8)
    """The same of poles [Hz]."""

    darks: tuple[float, ...] = (0.03, 0.3)
    """Currents without light beside which these are."""

    most_dark: float = 30.0
    """Such a current, at most: poles then hang on the light no more."""

    soonest: float = 5e-4
    """Latency that is told, at least [s]: a bus makes events late by less."""

    fastest: float = 400.0
    """Pole that is told, at most [Hz]."""

    alike: float = 0.7
    """Share of what steps differ by that they do in the end, at most."""

    even: float = 0.1
    """What they then differ by, at most, relative to the threshold: with a latency that it was but for a lens
    it was 0.14, and two poles did as well."""

    even_in_frames: float = 0.4
    """The same where events come in step with frames, evenly in each: at none as far as light says."""

    decided: float = 1.08
    """Times what steps differ by in the best way that they do in every simpler way, and in every other of as
    many values, at least, for it to be told; two poles of either kind are two poles, and one of them is fixed
    if they differ as much more without."""

    least: int = 1000
    """Steps of a polarity, at least."""

    longest: float = 0.05
    """Time of one that counts, at most [s]: noise and leaks grow with time."""


LATE_LIGHT = LateLightSettings()

UNLIKE_POLES = ("following", "dark", "fixed")
"""Details of light behind a pole that goes with it and one that does not: cutoffs at intensity 1 [Hz], and
the photocurrent at intensity 0 relative to that at 1 between them."""


@dataclass(frozen=True)
class Way:
    """A way in which events are late.

    Args:
        delay: Latency [s].
        poles: Of the low-pass, that go with the light, at the brightest, ascending [Hz].
        fixed: Of a pole behind one of these that does not go with the light [Hz]; 0 for none.
        dark: Current without light beside which they go with it, relative to the brightest.
        differ: What steps of the light then differ by, relative to the threshold; infinite until it is known.
    """

    delay: float = 0.0
    poles: tuple[float, ...] = ()
    fixed: float = 0.0
    dark: float = 0.0
    differ: float = math.inf

    @property
    def kind(self) -> tuple[bool, int]:
        """Whether it has a latency, and how many poles it has, whatever they do with the light."""
        return self.delay > 0, len(self.poles) + (self.fixed > 0)

    @property
    def values(self) -> int:
        """How many values were sought; poles have a current without light, too."""
        return (self.delay > 0) + (self.fixed > 0) + len(self.poles) + (len(self.poles) > 0)


@dataclass(frozen=True, eq=False)
class _Steps:
    """Events of the rows that are looked at, pixel by pixel, and the light there.

    Args:
        level: Log intensity, shape (P, T).
        times: Of the instants [s], shape (T,).
        pixel: Of each event, shape (N,).
        t: Its time [s], shape (N,).
        on: Whether it is ON, shape (N,).
        brightest: Log intensity of full light; but one per cent is darker.
        settings: What counts.
        device: Where light is filtered.
    """

    level: Levels
    times: Array
    pixel: NDArray[np.int64]
    t: Array
    on: NDArray[np.bool_]
    brightest: float
    settings: LateLightSettings
    device: str

    @classmethod
    def of(cls, light: LightBetweenEvents, settings: LateLightSettings, device: str = "cpu") -> _Steps:
        """Return those of a measurement."""
        first, after = light.rows
        events = light.measurement.compared_events()
        events = events.select((events.y >= first) & (events.y < after))
        pixel = (events.y.astype(np.int64) - first) * events.width + events.x
        order = np.lexsort((events.t, pixel))
        level = np.ascontiguousarray(light.level().T, np.float32)
        brightest = float(np.quantile(level, 0.99))
        on = np.asarray(events.p, bool)[order]
        return cls(level, light.times, pixel[order], events.t[order], on, brightest, settings, device)

    def of_few(self) -> _Steps:
        """Return those of as many pixels, across all, as tell where ways are; these themselves if so few."""
        every = len(self.t) // self.settings.few
        if every < 2:
            return self
        mine = self.pixel % every == 0
        level = np.ascontiguousarray(self.level[::every])
        return replace(self, level=level, pixel=self.pixel[mine] // every, t=self.t[mine], on=self.on[mine])

    def differ(
        self, poles: Sequence[float] = (), dark: float = 0.0, delay: float = 0.0, fixed: float = 0.0
    ) -> float:
        """Return what steps differ by: half of what two thirds lie in, relative to their median.

        Infinite where too few count, and where light goes the other way as often as with the events.

        Args:
            poles: Behind which pixels see the light: none, one or two [Hz at the brightest light].
            dark: Current without light that adds to it, relative to the brightest.
            delay: How much earlier than its event a pixel decides [s].
            fixed: A pole behind one of these that does not go with the light [Hz]; 0 for none.
        """
        out = []
        for moved in self._moved(poles, dark, delay, fixed):
            low, middle, high = np.quantile(moved, [0.16, 0.5, 0.84])
            out.append(float(high - low) / 2 / float(middle) if middle > 0 else math.inf)
        return float(np.mean(out)) if out else math.inf

    @property
    def are_enough(self) -> bool:
        """Whether steps of a polarity are enough at once."""
        return bool(self._moved((), 0.0, 0.0, 0.0))

    def _moved(self, poles: Sequence[float], dark: float, delay: float, fixed: float) -> list[Levels]:
        """Return how far light goes from event to event, by the arguments of `differ`; (M,) of each polarity.

        Of polarities with enough steps.
        """
        level = self._slow_light.behind(poles, dark, fixed) if poles else self.level
        index, share = self._places(delay) if delay else self._places_at_once
        before, after = level.ravel()[index], level.ravel()[index + 1]
        here = before + (after - before) * share
        darkest = self.brightest + math.log(LOOKED_AT.darkest)
        out = []
        for last, sign in self._pairs:
            now, then = here[last], here[last - 1]
            moved = (sign * (now - then))[np.minimum(now, then) > darkest]
            if len(moved) >= self.settings.least:
                out.append(moved)
        return out

    def _places(self, delay: float) -> tuple[NDArray[np.int64], Levels]:
        """Return where in the light events were decided: the instant before, and how far on to the next.

        Args:
            delay: How much earlier than its event a pixel decides [s].

        Returns:
            Row-major index, shape (N,), and share of the way, shape (N,).
        """
        t = self.t - delay
        at = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        share = np.clip((t - self.times[at]) / (self.times[at + 1] - self.times[at]), 0.0, 1.0)
        return self.pixel * len(self.times) + at, share.astype(np.float32)

    @cached_property
    def _places_at_once(self) -> tuple[NDArray[np.int64], Levels]:
        return self._places(0.0)

    @cached_property
    def _pairs(self) -> list[tuple[NDArray[np.int64], int]]:
        """Events that follow one of the same pixel and polarity soon, of ON and of OFF, and the sign."""
        gap = np.diff(self.t)
        counts = (self.pixel[1:] == self.pixel[:-1]) & (self.on[1:] == self.on[:-1])
        counts &= (gap > 0) & (gap < self.settings.longest)
        return [
            (1 + np.flatnonzero(counts & (self.on[1:] == on)), sign) for on, sign in ((True, 1), (False, -1))
        ]

    @cached_property
    def _slow_light(self) -> SlowLight:
        between = 0.5 * (self.level[:, :-1] + self.level[:, 1:])
        light = np.exp(between - np.float32(self.brightest))
        return SlowLight(self.level, light, self.times, self.device)


def find_late_events(
    measurement: Measurement,
    *,
    log_eps: float,
    frame_step: float = 0.0,
    dead_time: float = 0.0,
    device: str = "cpu",
    settings: LateLightSettings = LATE_LIGHT,
) -> tuple[Signature, ...]:
    """Return in which ways events are late, each with its size; none where they are not, or that is not told.

    Args:
        measurement: Its light is known, and not held.
        log_eps: Added to intensities before the logarithm.
        frame_step: Time from frame to frame in step with which all events come [s]; 0 if they do not.
        dead_time: For which a pixel is seen to send nothing after an event [s]: what is due meanwhile comes
            up to as much later, so only what is later than that is told.
        device: Where light is filtered.
        settings: When they are late.
    """
    if is_held(measurement.scene):
        return ()
    light = LightBetweenEvents.of(measurement, log_eps=log_eps, settings=LOOKED_AT)
    if light is None:
        return ()
    steps = _Steps.of(light, settings, device)
    at_once = steps.differ()
    if not steps.are_enough or not _looks_late(steps, at_once, settings):
        return ()
    ways = _ways_of(steps, settings)
    best = min(ways, key=lambda one: one.differ)
    near = [one for one in ways if one.differ < settings.decided * best.differ]
    # that one of two poles is fixed must be told from two that go with the light
    best = next((one for one in near if best.fixed and len(one.poles) == 2), best)
    even = settings.even_in_frames if frame_step else settings.even
    if best.differ > min(settings.alike * at_once, even):
        return ()
    # a simulator that knows frames alone is late by a frame itself
    soonest = max(settings.soonest, 3 * frame_step)
    slowest = min((one for one in (*best.poles, best.fixed) if one), default=0.0)
    if slowest > settings.fastest:
        return ()
    if dead_time > max(best.delay, 1 / (2 * math.pi * slowest) if slowest else 0.0):
        return ()
    if any(one.kind != best.kind and one.values <= best.values for one in near):
        return ()  # a search tells more, or names both
    if best.poles and 0 < best.delay < clip_step_of(measurement.scene):
        # within a step the light is a guess: two poles of ESIM were one and 1.9 ms of the 5 between frames
        return ()
    if 0 < best.delay < soonest:
        # whoever is late by so little, a pole that leaves next to nothing beside it is one
        if not (best.poles and frame_step and best.differ <= settings.even):
            return ()
        best = replace(best, delay=0.0)
    return _signatures_of(best, at_once, math.exp(steps.brightest), log_eps)


def more_alike_if_late(measurement: Measurement, other: Measurement, *, log_eps: float) -> bool:
    """Return whether late events make steps more alike than another scene does.

    Args:
        measurement: Its light is known, and not held.
        other: The same events over another scene, at once.
        log_eps: Added to intensities before the logarithm.
    """
    seen = [LightBetweenEvents.of(one, log_eps=log_eps, settings=LOOKED_AT) for one in (measurement, other)]
    late, at_once = (None if light is None else _Steps.of(light, LATE_LIGHT) for light in seen)
    if late is None or at_once is None or not late.are_enough:
        return False
    return min(way.differ for way in _ways_of(late, LATE_LIGHT)) < at_once.differ()


def _looks_late(steps: _Steps, at_once: float, settings: LateLightSettings) -> bool:
    """Return whether some latency or pole makes steps more alike."""
    delays, poles = settings.quick
    looks = [steps.differ(delay=delay) for delay in delays]
    looks += [steps.differ([pole], settings.darks[-1]) for pole in poles]
    return min(looks) < settings.begun * at_once


def _ways_of(steps: _Steps, settings: LateLightSettings) -> list[Way]:
    """Return the best latency, pole, two poles, of which one may be fixed, and pole with a latency."""
    few = steps.of_few()
    low, high, count = settings.delays
    begin = min(np.geomspace(low, high, count), key=lambda delay: few.differ(delay=delay))
    found = {"latency": _least(partial(_differ, few, "latency"), [math.log(begin)], [0.15], 12)}
    low, high, count = settings.poles
    starts = [(math.log(f), math.log(d)) for f in np.geomspace(low, high, count) for d in settings.darks]
    pole = partial(_differ, few, "pole")
    found["pole"] = _least(pole, min(starts, key=pole), [0.25, 0.8], 22)
    first, dark = found["pole"][1]
    begins = {"poles": [first + 0.5, dark, 0.3]}
    begins["late pole"] = [first + 0.4, dark, math.log(0.3 / (2 * math.pi)) - first]
    begins["fixed pole"] = [first + 0.4, dark, first + 0.6]
    for kind, logs in begins.items():
        spread = [0.25, 0.8, 0.3 if kind == "poles" else 0.6]
        found[kind] = _least(partial(_differ, few, kind), logs, spread, 32)
    most = settings.open * min(differ for differ, _ in found.values())
    out = []
    for kind, (differ, logs) in found.items():
        whole = partial(_differ, steps, kind)
        if differ <= most and few is not steps:
            differ, logs = _least(whole, logs, [0.06, 0.2, 0.1][: len(logs)], 3 * len(logs))
        elif few is not steps:
            differ = whole(logs)
        out.append(replace(_way_at(kind, logs, steps.settings), differ=differ))
    return out


def _way_at(kind: str, logs: Sequence[float], settings: LateLightSettings) -> Way:
    """Return a way.

    Args:
        kind: "latency", "pole", "poles", "late pole" or "fixed pole".
        logs: Of the latency [s]; or of the first pole [Hz] and the dark current, and of how many times faster
            the other pole is, of the latency, or of the pole that does not go with the light [Hz].
        settings: Of the search.
    """
    first = math.exp(logs[0])
    if kind == "latency":
        return Way(delay=first)
    dark = min(math.exp(logs[1]), settings.most_dark)
    one = Way(poles=(first,), dark=dark)
    if kind == "late pole":
        return replace(one, delay=math.exp(logs[2]))
    if kind == "fixed pole":
        return replace(one, fixed=math.exp(logs[2]))
    return one if kind == "pole" else replace(one, poles=(first, first * math.exp(abs(logs[2]))))


def _differ(steps: _Steps, kind: str, logs: Sequence[float]) -> float:
    """Return what steps differ by if events are late in a way, see `_way_at`."""
    way = _way_at(kind, logs, steps.settings)
    return steps.differ(way.poles, way.dark, way.delay, way.fixed)


def _least(
    differ: Callable[[Sequence[float]], float], begin: Sequence[float], steps: Sequence[float], looks: int
) -> tuple[float, list[float]]:
    """Return the least of a function near a place, and where it is.

    Args:
        differ: The function.
        begin: Where the search begins.
        steps: How far it looks to begin with, in each direction.
        looks: Values that are taken, about.
    """
    corners = np.tile(np.asarray(begin, float), (len(begin) + 1, 1))
    corners[1:] += np.diag(steps)
    found = minimize(
        differ, corners[0], method="Nelder-Mead", options={"maxfev": looks, "initial_simplex": corners}
    )
    return float(found.fun), [float(one) for one in found.x]


def time_of_delay(entry: Signature) -> float:
    """Return how late events are [s] by a signature of `find_late_events`: its delay, or that of its pole."""
    return entry.size if entry.unit == "s" else 1 / (2 * math.pi * entry.size)


def unlike_poles_of(entry: Signature) -> tuple[float, ...]:
    """Return two poles of a signature of which one goes with the light, see `Observations`; none of others.

    Args:
        entry: A signature of `find_late_events`.
    """
    return tuple(entry.details[name] for name in UNLIKE_POLES if name in entry.details)


def _signatures_of(way: Way, at_once: float, brightest: float, log_eps: float) -> tuple[Signature, ...]:
    """Return what a way shows: a latency, a pole or two, or a pole and a latency.

    Args:
        way: The best.
        at_once: What steps of the scene's light differ by, relative to the threshold.
        brightest: Intensity of full light, and `log_eps`, at which the poles of the way are known.
        log_eps: Added to intensities before the logarithm.
    """
    usual = f"to within {format_percent(at_once)}" if math.isfinite(at_once) else "either way"
    alike = (
        f"from one event of a pixel to the next light then goes as far to within "
        f"{format_percent(way.differ)}, and {usual} at once"
    )
    said: list[tuple[dict[str, float], str, str]] = []
    if way.fixed:
        # of the light, L, the pole has (L + dark) / (1 + dark) where the brightest is 1
        black, white = log_eps / brightest + way.dark, (1 + log_eps) / brightest + way.dark
        first, fixed = way.poles[0], way.fixed
        named = f"{format_metric(first, 'Hz')}, which goes with it, and {format_metric(fixed, 'Hz')}"
        unlike = first * white / (1 + way.dark), black / white, fixed
        details = {"poles": min(first, fixed), **dict(zip(UNLIKE_POLES, unlike, strict=True))}
        said.append((details, "Hz", f"events are of light behind {named}: {alike}"))
    elif way.poles:
        named = " and ".join(format_metric(one, "Hz") for one in way.poles)
        kind = "pole" if len(way.poles) == 1 else "poles"
        said.append(({kind: way.poles[0]}, "Hz", f"events are of light behind {named}: {alike}"))
    if way.delay:
        late = f"events come {format_seconds(way.delay)} late: {alike}"
        said.append(({"delay": way.delay}, "s", late))
    return tuple(
        Signature(
            name=LATE_EVENTS, answer=Answer.FOUND, p=0.0, size=next(iter(details.values())), unit=unit,
            sentence=sentence, details=details,
        )
        for details, unit, sentence in said
    )  # fmt: skip
