"""Double events some hundred microseconds late, which the light between them does not explain.

Where light moves fast, two events of a pixel are as close together. Where it hardly changes from two frames
before the first to two frames behind the second, nothing is due after an event, and what comes all the same
is noise or a double. Noise comes as often at all times, a double some time after its event: pairs of nearly
one interval stand out between two octaves of shorter and of longer ones; or all that come up to some time
after their event, as a simulator may draw them, with hardly any later. Whole frames are asked, not light
between them: a simulator may hold a frame, or send all events of a change at its end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.fitting.frame_steps import clip_step_of
from dase.formatting import format_count, format_percent, format_seconds
from dase.probes.stimulus import log_light_beside, log_light_of
from dase.scenes.video import VideoScene
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.chance import poisson_interval
from dase.signatures.double_events import times_of_many
from dase.signatures.kinds import DOUBLE_EVENTS
from dase.signatures.result import Answer, Signature, judge_signature


@dataclass(frozen=True)
class LateDoubleSettings:
    """Where light makes no pair of events, and which pairs are doubles.

    Of 540 clips of other simulators with 21 that have doubles (development) the 20 that are found are within
    half of each limit but that of their least share.
    """

    small: float = 0.5
    """Light goes by less in all, in thresholds: a fourth and a whole one find the same."""

    frames: int = 2
    """Frames before the first event and behind the second in which it does; one and three find the same."""

    dark: float = 0.1
    """Intensity, relative to the brightest, below which noise of the dark takes over."""

    floor: float = 0.02
    """Of the brightest, added to intensities before the logarithm."""

    apart: float = 4e-3
    """[s] Events farther apart than this, and than two frames, tell how far light goes between them."""

    busy: float = 4.0
    """Times the events of the median pixel, from which on a pixel is not asked: it may be hot."""

    shortest: float = 5e-6
    """[s] Begin of the first window of intervals; a window is two octaves, as are those beside it."""

    longest: float = 5e-3
    """[s] End of the last."""

    fewest: int = 30
    """Pairs."""

    beside: float = 0.125
    """Pairs in the windows beside it per pair, at most: 0.05 of doubles, 1.2 and more of noise."""

    least: float = 0.008
    """Share of OFF and of ON events in slow light that have a double, at least."""

    least_shared: float = 0.03
    """The same of seconds whose times many pixels share: a simulator sends the events of a frame at a few."""

    shared: float = 0.5
    """Share of the seconds at such times from which on that is so."""

    balance: float = 2.5
    """Ratio of the shares of OFF and ON, at most: a lamp has one of them."""

    alike: float = 0.25
    """Logarithm by which median intervals of OFF and ON, of bright and dim pixels, differ at most."""

    width: float = 0.9
    """Logarithm of the ninth over the first tenth of the intervals, at most: that of noise is 1 and more."""

    none_later: float = 0.15
    """Pairs in the two octaves after the last double per pair, at most, where doubles come at any time up to
    then: none in 17 clips, 0.01 and 0.06 in two beside shot noise, which has pairs of any interval."""

    evenly: float = 0.1
    """How far the shares of the pairs up to a time may be off from those of times that are drawn evenly, at
    most, beside chance: 0.05 and less there."""

    chained: float = 0.125
    """Share of the pairs with another event as soon before or after, at most."""

    same: float = 0.25
    """Share of the pairs within 1 % of one interval, at most, where times are shared or it is of frames."""


LATE_DOUBLES = LateDoubleSettings()


@dataclass(frozen=True)
class _InSlowLight:
    """Events one pixel after the other, N of them, and the pairs that light does not explain.

    Args:
        t: Times [s], shape (N,).
        on: Which are ON.
        pixel: Row-major.
        level: Log light at each.
        slow: Which are in slow light.
        first: The first event of each pair, shape (K,).
    """

    t: NDArray[np.float64]
    on: NDArray[np.bool_]
    pixel: NDArray[np.int64]
    level: NDArray[np.float32]
    slow: NDArray[np.bool_]
    first: NDArray[np.int64]


@dataclass(frozen=True)
class _Window:
    """Pairs of a window of intervals, K of them, of the same polarity or of opposite ones.

    Args:
        opposite: Whether the second has the other polarity.
        first: The first event of each, shape (K,).
        interval: Of each [s].
        beside: Pairs of the two octaves below and above.
        end: Of the window [s].
        evenly: Whether it is of all intervals up to the end, as if drawn evenly; none are below it then.
    """

    opposite: bool
    first: NDArray[np.int64]
    interval: NDArray[np.float64]
    beside: tuple[int, int]
    end: float
    evenly: bool = False


def find_late_doubles(
    events: Events, scene: VideoScene, level: float = 1e-5, settings: LateDoubleSettings = LATE_DOUBLES
) -> Signature:
    """Look for events that come some time after another one of their pixel where light explains none.

    The null has as many pairs per octave in a window as in the fuller one beside it: binomial, times windows.

    Args:
        events: Of the scene.
        scene: A clip.
        level: p below which there are doubles.
        settings: Which pairs are doubles.
    """
    unseen = "no pairs of one interval where light does not change"
    nothing = Signature(
        name=DOUBLE_EVENTS, answer=Answer.NOT_SEEN, p=1.0, least=settings.least, sentence=unseen
    )
    step = clip_step_of(scene)
    found = _in_slow_light(events, scene, step, settings) if step and len(events) > 100 else None
    if found is None:
        return nothing
    for window in _likely_windows(found, settings):
        entry = _judge_window(found, window, step, level, settings)
        if entry is not None and entry.found:
            return entry
    return nothing


def _in_slow_light(
    events: Events, scene: VideoScene, step: float, s: LateDoubleSettings
) -> _InSlowLight | None:
    """Return the events by pixel, and pairs that light does not explain; None where it tells no threshold."""
    pixel = row_major_pixels(events).astype(np.int64)
    order = np.argsort(pixel, kind="stable")
    level, low, high = (light[order] for light in _light_around(events.t, pixel, scene, step, s))
    t, on, pixel = events.t[order], events.p[order].astype(bool), pixel[order]
    times = scene.sample_times()
    lit = (low > math.log(s.dark)) & (t > times[0]) & (t < times[-1])
    same = (pixel[1:] == pixel[:-1]) & lit[1:] & lit[:-1]
    interval, went = np.diff(t), np.diff(level)
    thresholds = []
    for polarity in (False, True):
        alone = same & (on[1:] == polarity) & (on[:-1] == polarity) & (interval > max(2 * step, s.apart))
        if alone.sum() >= 50:
            thresholds.append(float(np.median(went[alone])) * (1 if polarity else -1))
    if not thresholds or min(thresholds) <= 0:
        return None
    number = np.bincount(pixel, minlength=events.width * events.height)
    way = np.bincount(pixel[1:], np.where(pixel[1:] == pixel[:-1], np.abs(went), 0.0), minlength=len(number))
    # pixels with low thresholds take less, and send where others rest
    own = np.where(number >= 4, way / np.maximum(number - 1, 1), min(thresholds))
    limit = s.small * np.minimum(own, min(thresholds))[pixel]
    usual = number <= s.busy * max(float(np.median(number[number > 0])), 5.0)
    slow = lit & (high - low < limit) & usual[pixel]
    range_ = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1])
    pair = same & slow[1:] & slow[:-1] & (range_ < limit[1:]) & (interval < 4 * s.longest)
    return _InSlowLight(t, on, pixel, level, slow, np.flatnonzero(pair))


def _light_around(
    t: NDArray[np.float64], pixel: NDArray[np.int64], scene: VideoScene, step: float, s: LateDoubleSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return log light at events, its lowest and its highest in the frames around each, of shape (N,).

    Relative to the brightest hundredth of the pixels.

    Args:
        t: Times of events, ascending [s], shape (N,).
        pixel: Of each, row-major, shape (N,).
        scene: A clip.
        step: From frame to frame [s].
        s: How many frames are looked at.
    """
    times, number = scene.sample_times(), scene.width * scene.height
    some = np.arange(0, number, max(1, number // 2000), dtype=np.int32)
    tiny = 1e-6
    seen = log_light_of(scene, times[:: max(1, len(times) // 20)], some, log_eps=tiny)
    top = max(float(np.exp(np.quantile(seen, 0.99))) - tiny, tiny)
    around = s.frames * max(1, round(step / float(np.median(np.diff(times)))))
    at = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    part = np.clip((t - times[at]) / (times[at + 1] - times[at]), 0.0, 1.0).astype(np.float32)
    pixels = np.arange(number, dtype=np.int32)
    light = log_light_beside(scene, times, pixels, at, pixel, log_eps=s.floor * top, reach=around)
    light -= np.float32(math.log(top))
    before = light[around - 1]
    return before + (light[around] - before) * part, light.min(0), light.max(0)


def _likely_windows(found: _InSlowLight, s: LateDoubleSettings) -> Iterator[_Window]:
    """Yield what stands out most, of pairs of one polarity and of opposite ones.

    The window of two octaves, and the longest interval up to which pairs come, with hardly any later.
    """
    octave = 4  # windows begin a quarter of one apart
    count = octave * math.ceil(math.log2(4 * s.longest / s.shortest)) + 1
    edges = s.shortest * 2.0 ** (np.arange(count) / octave)
    for opposite in (False, True):
        first = found.first[(found.on[found.first] != found.on[found.first + 1]) == opposite]
        interval = found.t[first + 1] - found.t[first]
        sums = np.concatenate(([0], np.cumsum(np.histogram(interval, edges)[0])))
        two = 2 * octave
        begins = np.arange(len(edges) - 2 * two)
        begins = begins[edges[begins + two] <= 1.001 * s.longest]
        inside = sums[begins + two] - sums[begins]
        sooner, later = (
            sums[begins] - sums[np.maximum(begins - two, 0)],
            sums[begins + 2 * two] - sums[begins + two],
        )
        clear = np.where(inside >= s.fewest, inside / (sooner + later + 3), 0.0)
        if not len(clear) or clear.max() == 0:
            continue
        best = int(clear.argmax())
        kept = (interval >= edges[best]) & (interval < edges[best + two])
        yield _Window(
            opposite, first[kept], interval[kept], (int(sooner[best]), int(later[best])), edges[best + two]
        )
        end = edges[begins + two]
        before = sums[begins + two]
        best = int(np.where(before >= s.fewest, before / (later + 3), 0.0).argmax())
        kept = (interval >= edges[0]) & (interval < end[best])
        yield _Window(opposite, first[kept], interval[kept], (0, int(later[best])), end[best], evenly=True)


def _judge_window(
    found: _InSlowLight, window: _Window, step: float, level: float, s: LateDoubleSettings
) -> Signature | None:
    """Return double events if the pairs of a window are; None where a rule says that they are not."""
    pairs, logs = len(window.first), np.log(window.interval)
    delay = math.exp(float(np.median(logs)))
    width = float(np.diff(np.quantile(logs, (0.1, 0.9)))[0])
    on = found.on[window.first]
    slow = np.array([np.count_nonzero(found.slow & (found.on == one)) for one in (False, True)])
    seconds = np.array([pairs - on.sum(), on.sum()])
    shares = seconds / np.maximum(slow - seconds, 1)
    # of a polarity that would have fewer than ten nothing is asked
    both = bool(np.all(shares.max() * slow >= 10))
    every = np.sort(found.t)
    shared = float(times_of_many(every, np.searchsorted(every, found.t[window.first + 1])).mean())
    least = s.least_shared if shared > s.shared else s.least
    few = max(float(seconds.min()), 1.0)
    # medians of so few are as uncertain
    doubt = s.alike + 1.5 * width / 2.56 * math.sqrt(float((1 / np.maximum(seconds, 1)).sum()))
    light = found.level[window.first]
    near = np.sort(window.interval)
    if not _keeps_its_time(window, near, width, s):
        return None
    one_interval = (np.searchsorted(near, 1.01 * near + 5e-7, side="right") - np.arange(pairs)).max() / pairs
    if (
        (shares if both else shares.max()).min() < least
        or (both and shares.max() > s.balance * (1 + 2 / math.sqrt(few)) * shares.min())
        or (both and _differ(logs, on) > doubt)
        or _differ(logs, light > np.median(light)) > doubt
        or max(_chained(found, window)) > s.chained
        or ((shared > s.shared or _is_of_frames(delay, step)) and one_interval > s.same)
    ):
        return None
    events = int(slow.sum())
    low, high = (limit / (events - pairs) for limit in poisson_interval(pairs))
    # every quarter of an octave has been looked at, of both kinds
    chance = 70 * float(stats.binom.sf(pairs - 1, pairs + max(window.beside), 0.5))
    kind = "of the other polarity" if window.opposite else "of the same polarity"
    at = f"up to {format_seconds(_longest(near))}" if window.evenly else f"about {format_seconds(delay)}"
    entry = Signature(
        name=DOUBLE_EVENTS, answer=Answer.NOT_SEEN, p=min(chance, 1.0), size=pairs / (events - pairs),
        low=low, high=high, unit="share of the events", least=s.least,
        sentence=f"{format_percent(pairs / (events - pairs))} of the events where light does not change have "
        f"another {kind} {at} later, {format_count(sum(window.beside))} pairs "
        f"sooner or later beside {format_count(pairs)}",
        details={
            "near": pairs, "later": window.beside[1], "at_once": 0, "opposite": window.opposite,
            "gap": 0.5 * _longest(near) if window.evenly else delay,
            "spread": _longest(near) if window.evenly else 0.0,
        },
    )  # fmt: skip
    return judge_signature(entry, level, "")


def _keeps_its_time(
    window: _Window, interval: NDArray[np.float64], width: float, s: LateDoubleSettings
) -> bool:
    """Whether pairs of a window come about one time after their event, or evenly up to one, and few others.

    Args:
        window: The pairs.
        interval: From event to event, ascending [s].
        width: Logarithm of the ninth over the first tenth of these.
        s: Which pairs are doubles.
    """
    pairs = len(interval)
    if not window.evenly:
        return sum(window.beside) <= s.beside * pairs and width <= s.width
    last = _longest(interval)
    off = np.abs((np.arange(pairs) + 0.5) / pairs - np.minimum(interval / last, 1.0)).max()
    return window.beside[1] <= s.none_later * pairs and off <= s.evenly + 1.2 / math.sqrt(pairs)


def _longest(interval: NDArray[np.float64]) -> float:
    """Return the longest of some intervals, ascending, but for one in two hundred [s]."""
    return float(interval[max(0, math.ceil(0.995 * len(interval)) - 1)])


def _differ(logs: NDArray[np.float64], some: NDArray[np.bool_]) -> float:
    """Return by how much the medians of some and of the others differ; 0 where there are too few."""
    if min(np.count_nonzero(some), np.count_nonzero(~some)) < 5:
        return 0.0
    return abs(float(np.median(logs[some]) - np.median(logs[~some])))


def _chained(found: _InSlowLight, window: _Window) -> tuple[float, float]:
    """Return the shares of the pairs with another event as soon behind and before."""
    t, pixel, first = found.t, found.pixel, window.first
    behind, before = np.minimum(first + 2, len(t) - 1), np.maximum(first - 1, 0)
    third = (behind > first + 1) & (pixel[behind] == pixel[first]) & (t[behind] - t[first + 1] < window.end)
    zeroth = (before < first) & (pixel[before] == pixel[first]) & (t[first] - t[before] < window.end)
    return float(third.mean()), float(zeroth.mean())


def _is_of_frames(delay: float, step: float) -> bool:
    """Whether a delay is as long as some quarters of a frame, to 1 %."""
    quarters = round(4 * delay / step)
    return quarters > 0 and abs(delay - 0.25 * quarters * step) < max(0.01 * delay, 1.5e-6)
