"""What pixels send while their light rests, against a model without noise: background activity.

Light that rests sends nothing, whatever a simulator or a camera does with light that moves. So ON and OFF
events that go on for as long as it rests are noise, and ON events alone are a leak, however badly a model
describes the rest. Noise of the voltage crosses a threshold and returns, so its events take turns; those of
shot noise know nothing of each other. A low-pass, a dead time or a full bus send some events after the light
has come to rest, soon and of one polarity; hot pixels are a few that send much; a lamp makes all pixels send
together. Behind a lens that is less sharp than the scene a pixel sees its neighbours move. None of these is
taken for noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter1d

from dase.diagnosis.light_between_events import times_that_are_compared
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.formatting import format_count, format_metric, format_percent
from dase.probes.random_streams import Draw, SimulationStream
from dase.probes.stimulus import log_light_of
from dase.scenes.between_frames import CameraScene
from dase.scenes.video import VideoScene
from dase.signatures.chance import poisson_interval
from dase.signatures.kinds import LEAK_EVENTS, NOISE_AT_REST
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EventsAtRestSettings:
    """What is at rest, and what counts there.

    Chosen on sets a to s of other simulators: noise sends hundreds to thousands there, what has none a few.
    """

    still: float = 0.1
    """How far light at rest goes, as a share of the lower threshold."""

    least: float = 0.15
    """Time for which light must rest [s]."""

    settle: float = 0.08
    """Time after it came to rest in which nothing counts [s]."""

    lead: float = 0.02
    """Time before it moves again in which nothing counts [s]: a slow clock shows the tick before an event."""

    samples: int = 40_000_000
    """Intensities that are looked at, pixels times instants, at most."""

    instants: int = 4_000
    """Instants that are looked at, at most."""

    events: int = 40
    """Events in the later half of the rests that noise has, at least; half as many of a leak."""

    more: float = 5.0
    """Times as many as the model without it."""

    both: float = 0.2
    """Share of the rarer polarity of noise, at least."""

    one: float = 0.04
    """Share of OFF events beside a leak, at most."""

    goes_on: float = 0.25
    """Share of the events in the later half of the rests, at least, and beyond the time after motion up to
    which half of all rests lies: what is left of motion comes soon, and short rests have no later."""

    beside: int = 4
    """Pixels on all sides that must rest as well for a leak [px]: a lens makes a pixel see them."""

    inner: float = 0.5
    """Rate of a leak where they do, relative to that of all, at least ..."""

    inner_events: int = 20
    """... if so many events are to be expected there."""

    spread: float = 0.5
    """Pixels that send, as a share of as many as have events if all send alike: hot pixels are few."""

    hot: float = 10.0
    """Times as many events as others by which a pixel is a hot one, beyond ..."""

    hot_count: int = 5
    """... so many, which chance may make."""

    together: float = 1.5
    """How much more events come together in time than independent ones: a lamp's come at once."""

    swing: float = 0.03
    """Variance, relative to the square of the mean, by which that mean may be off: it rises and falls."""

    beat: float = 0.002
    """Time in which they come together [s]."""

    beats: int = 25
    """Such times over which the mean is taken that they are compared with."""

    fullest: float = 0.5
    """Share of the events in the fullest tenth of such times, at most, where they are two a time in the mean
    or more: bursts of frames of both polarities had 0.98, noise of six clips of others 0.12 to 0.23."""

    pairs: int = 60
    """Successive events of one pixel from which on these tell which noise it is."""

    near: float = 0.1
    """Time from one to the next of such a pair, at most [s]."""

    turns: float = 0.8
    """Share of pairs of opposite polarity of noise that returns, at least: it had 0.9 and more."""

    few: float = 0.5
    """Events of a pixel in the time in which opposite ones are counted, at most: of more, these come as often
    as there is room for."""

    returns: float = 1.5
    """Times as often as polarities that know nothing of each other such opposite events follow where noise
    returns, at least: 2.3 to 4.6 in five clips of v2e, 0.92 to 1.06 in six of IEBCS, which sends either
    polarity at nearly even intervals, so that in a short time there is one of each at most."""

    as_often: float = 0.25
    """By how much that may be off from once where noise does not return."""

    apart: float = 0.6
    """By how much noise of the two polarities differs from pixel to pixel, at least, each relative to its
    mean, where a pattern of ON and OFF events may be the noise's: 0.82 in IEBCS's, whose pixels have rates of
    their own for either; 0.05 of Metavision's where thresholds differ by 55 %, and no more than chance of
    v2e's."""

    sure: float = 5.0
    """The same, in its standard errors."""

    grows: float = 3.0
    """Times as often as the darker pixels the brighter ones send what no shot noise is, at least: that is
    rarer in bright light, or as frequent."""

    by_chance: float = 0.1
    """How far from the share of independent polarities that of shot noise is, at most: it was 0.02."""


AT_REST = EventsAtRestSettings()


@dataclass(frozen=True)
class Rests:
    """The longest rest of each of some pixels.

    Args:
        pixels: Row-major indices of those that rest long enough, shape (K,).
        begin: From when on their events count [s], shape (K,).
        end: Until when [s], shape (K,).
        level: Of their light then [log intensity], shape (K,).
    """

    pixels: NDArray[np.int32]
    begin: Array
    end: Array
    level: Array

    @property
    def seconds(self) -> float:
        """Time of all pixels together [s]."""
        return float((self.end - self.begin).sum())

    def where_neighbours_rest(self, width: int, height: int, reach: int) -> Rests:
        """Return the rests, as far as all pixels around rest as well.

        Args:
            width: Columns of the sensor.
            height: Rows of the sensor.
            reach: How far around, in rows and columns [px].
        """
        begin, end = np.full(width * height, np.inf), np.full(width * height, -np.inf)
        begin[self.pixels], end[self.pixels] = self.begin, self.end
        size = 2 * reach + 1
        begin = maximum_filter(begin.reshape(height, width), size).reshape(-1)[self.pixels]
        end = minimum_filter(end.reshape(height, width), size).reshape(-1)[self.pixels]
        kept = begin < end
        return Rests(self.pixels[kept], begin[kept], end[kept], self.level[kept])

    def events_in(
        self, events: Events
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
        """Return the events that come in the rests.

        Returns:
            Times [s], polarities, places in `pixels`, and whether each comes in the later half of its rest,
            shape (N,).
        """
        place = np.full(events.width * events.height, -1, np.int64)
        place[self.pixels] = np.arange(len(self.pixels))
        at = place[events.y.astype(np.int64) * events.width + events.x]
        inside = at >= 0
        t, p, at = events.t[inside], events.p[inside], at[inside]
        inside = (t >= self.begin[at]) & (t < self.end[at])
        t, p, at = t[inside], p[inside], at[inside]
        later = t >= 0.5 * (self.begin[at] + self.end[at])
        return t, p, at, later


def find_rests(
    measurement: Measurement,
    *,
    still: float,
    log_eps: float,
    seed: int,
    settings: EventsAtRestSettings = AT_REST,
) -> Rests:
    """Return where the light of a scene rests longest, for some pixels if there are many.

    Args:
        measurement: Of a scene that is known at all times.
        still: How far light at rest goes [log intensity].
        log_eps: Added to intensities before the logarithm.
        seed: Of which pixels are looked at.
        settings: How long a rest is.
    """
    scene = measurement.scene
    times = times_that_are_compared(measurement)
    times = times[:: max(1, math.ceil(len(times) / settings.instants))]
    size = scene.width * scene.height
    pixels = np.arange(size, dtype=np.int32)
    if len(times) < 2:
        return Rests(pixels[:0], *np.empty((3, 0)))
    if size * len(times) > settings.samples:
        count = max(1, settings.samples // len(times))
        draw = Draw.PIXELS_OF_RESTS.generator(seed)
        pixels = np.sort(draw.choice(size, count, replace=False)).astype(np.int32)
    level = log_light_of(scene, times, pixels, log_eps=log_eps)
    first, last = longest_rest(level, times, still)
    # noise of the voltage is new to a memory at the first sample, too
    begin, end = times[first] + settings.settle, times[last] - settings.lead
    long = times[last] - times[first] >= settings.least
    at_rest = level[first, np.arange(len(pixels))].astype(np.float64)
    return Rests(pixels[long], begin[long], end[long], at_rest[long])


def longest_rest(
    level: NDArray[np.float32], times: Array, still: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return between which instants the light of each pixel stays longest within a range.

    Args:
        level: Logarithms of intensities, shape (T, N).
        times: Of the instants [s], ascending, shape (T,).
        still: The range.

    Returns:
        The first and the last instant of the longest rest, shape (N,) each.
    """
    count = level.shape[1]
    begin = np.zeros(count, np.int64)
    low, high = level[0].copy(), level[0].copy()
    first, last = np.zeros(count, np.int64), np.zeros(count, np.int64)

    def keep(ended: NDArray[np.int64], at: int) -> None:
        longer = ended[times[at] - times[begin[ended]] > times[last[ended]] - times[first[ended]]]
        first[longer], last[longer] = begin[longer], at

    for k in range(1, len(times)):
        now = level[k]
        np.minimum(low, now, out=low)
        np.maximum(high, now, out=high)
        moved = np.flatnonzero(high - low > still)
        keep(moved, k - 1)
        begin[moved] = k
        low[moved] = high[moved] = now[moved]
    keep(np.arange(count), len(times) - 1)
    return first, last


def find_events_at_rest(
    measurement: Measurement,
    sensor: Sensor,
    *,
    thresholds: tuple[float, float],
    seed: int,
    settings: EventsAtRestSettings = AT_REST,
) -> Signature | None:
    """Return the noise, or the leak, of pixels whose light rests; None where a model lacks neither.

    Args:
        measurement: Its scene is simulated. Nothing is said where light is known in part only.
        sensor: The model.
        thresholds: Of the model, ON and OFF [log intensity].
        seed: Of every random number.
        settings: What is at rest.
    """
    if isinstance(measurement.scene, CameraScene) or measurement.trust is not None:
        return None
    still = settings.still * min(thresholds)
    rests = find_rests(measurement, still=still, log_eps=sensor.log_eps, seed=seed, settings=settings)
    if not len(rests.pixels):
        return None
    try:
        made = simulate(
            measurement.scene, sensor, seed=SimulationStream.EVENTS_AT_REST.seed(seed), pixels=rests.pixels
        )
    except InputError:
        return None
    model = int(rests.events_in(made)[3].sum())
    gap = measurement.scene.longest_gap() if isinstance(measurement.scene, VideoScene) else 0.0
    return judge_events_at_rest(rests, measurement.compared_events(), model, frame_gap=gap, settings=settings)


def noise_is_a_pattern(
    measurement: Measurement, sensor: Sensor, *, seed: int, settings: EventsAtRestSettings = AT_REST
) -> bool:
    """Whether pixels at rest have noise of either polarity at rates of their own.

    They then differ in the balance of ON and OFF, as if by their thresholds, whatever these are.

    Args:
        measurement: Its events are counted where its light rests.
        sensor: The model, whose thresholds say what rest is.
        seed: Of which pixels are looked at.
        settings: How much they differ.
    """
    threshold = sensor["threshold"]
    assert isinstance(threshold, Threshold)
    still = settings.still * min(threshold.on, threshold.off)
    rests = find_rests(measurement, still=still, log_eps=sensor.log_eps, seed=seed, settings=settings)
    _, p, at, _ = rests.events_in(measurement.compared_events())
    return differ_by_polarity(p, at, rests, settings)


def differ_by_polarity(
    p: NDArray[np.bool_], at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings = AT_REST
) -> bool:
    """Whether a pixel's share of the ON events in rests is not its share of the OFF events.

    Args:
        p: Polarities of the events, shape (N,).
        at: Places in `rests.pixels`, shape (N,).
        rests: Of the pixels.
        settings: How far apart they are.
    """
    on, off = (np.bincount(at[which], minlength=len(rests.pixels)) for which in (p, ~p))
    if min(on.sum(), off.sum()) < settings.events:
        return False
    share = (rests.end - rests.begin) / rests.seconds
    # less what chance makes of both
    excess = (on / on.sum() - off / off.sum()) ** 2 - (on / on.sum() ** 2 + off / off.sum() ** 2)
    total, error = float(excess.sum()), math.sqrt(float((excess**2).sum()))
    return total > settings.sure * error and total > settings.apart**2 * float((share**2).sum())


def judge_events_at_rest(
    rests: Rests,
    events: Events,
    model: int,
    *,
    frame_gap: float = 0.0,
    settings: EventsAtRestSettings = AT_REST,
) -> Signature | None:
    """Return what events in rests are; None where they are few, or not noise.

    Args:
        rests: Of the pixels.
        events: Of all pixels.
        model: Events of the model in the later halves of the rests.
        frame_gap: Time from frame to frame of a clip [s], 0 for a scene that has none.
        settings: What noise is.
    """
    t, p, at, later = rests.events_in(events)
    alike = ~_sent_by_hot_pixels(at, rests, settings)
    t, p, at, later = t[alike], p[alike], at[alike], later[alike]
    count, many = int(later.sum()), len(t)
    on = int(p[later].sum())
    if count < settings.events // 2 or count < settings.more * (model + 1) or count < settings.goes_on * many:
        return None
    if not _goes_on_after_motion(t, at, rests, settings):
        return None
    if not _sent_by_all(at, rests, settings):
        return None
    rarer, off = min(on, count - on) / count, 1 - on / count
    rate = 2 * count / rests.seconds
    low, high = (2 * end / rests.seconds for end in poisson_interval(count))
    details: dict[str, Any] = {"on": on, "off": count - on, "model": model, "seconds": rests.seconds / 2}
    if rarer >= settings.both and count >= settings.events:
        alone = _is_first(t, at, settings.near)
        if not _independent(t[alone], p[alone], rests, frame_gap, settings):
            return None
        name, words = NOISE_AT_REST, f"{format_percent(on / count)} of them ON"
        way, share, why = _way_of_noise(t, p, at, rests, settings)
        if way:
            details[way] = share
            words += f"; {why}"
        times = _growth_with_light(p, at, rests, settings)
        if times >= settings.grows:
            details["doubtful"] = True
            words += f"; bright pixels send {times:.2g} times as many as dark ones, which no shot noise does"
    elif off <= settings.one:
        if not _goes_on_inside(rests, events, rate, settings):
            return None
        name, words = LEAK_EVENTS, "all of them ON" if not off else f"{format_percent(1 - off)} of them ON"
    else:
        return None
    sentence = (
        f"pixels whose light rests send {format_metric(rate, 'Hz')}, {words} ({format_count(count)} events, "
        f"where the model has {format_count(model)})"
    )
    return Signature(
        name=name, answer=Answer.FOUND, p=float(stats.poisson.sf(count - 1, model + 1)), size=rate,
        low=low, high=high, unit="events per second of a pixel at rest", sentence=sentence, details=details,
    )  # fmt: skip


def _goes_on_after_motion(
    t: Array, at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings
) -> bool:
    """Whether events come long after light came to rest, too, as far as there are any.

    The rests are compared that begin after motion: others begin with a new memory, which a leak moves slowly.

    Args:
        t: Of the events [s], shape (N,).
        at: Which pixel sent each, shape (N,).
        rests: Of the pixels.
        settings: How many come later.
    """
    moved = rests.begin > rests.begin.min()
    length = np.append(0.0, np.sort((rests.end - rests.begin)[moved]))
    since = (t - rests.begin[at])[moved[at]]
    if len(since) < settings.events // 2:
        return True
    # time of all rests up to the length of each: all of the shorter ones, and as much of all others
    before = np.cumsum(length) + length * np.arange(len(length) - 1, -1, -1)
    half = np.interp(0.5 * before[-1], before, length)
    return bool(np.count_nonzero(since > half) >= settings.goes_on * len(since))


def _goes_on_inside(rests: Rests, events: Events, rate: float, settings: EventsAtRestSettings) -> bool:
    """Whether pixels whose neighbours rest send as others do, as far as there are any.

    Args:
        rests: Of the pixels.
        events: Of all pixels.
        rate: Of a pixel at rest [Hz].
        settings: How many they send.
    """
    inner = rests.where_neighbours_rest(events.width, events.height, settings.beside)
    expected = inner.seconds * rate
    if expected < settings.inner_events:
        return True
    return len(inner.events_in(events)[0]) >= settings.inner * expected


def _way_of_noise(
    t: Array, p: NDArray[np.bool_], at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings
) -> tuple[str, float, str]:
    """Return in which way noise comes, how much of successive events is opposite, and that in words.

    The way is one of `SignatureKind.ways`, "" where pairs of events do not tell.

    Args:
        t: Of the events [s], ascending, shape (N,).
        p: Whether each is ON, shape (N,).
        at: Which pixel sent it, shape (N,).
        rests: Of the pixels.
        settings: What pairs tell.
    """
    order = np.argsort(at, kind="stable")
    t, p, at = t[order], p[order], at[order]
    same_pixel, apart = at[1:] == at[:-1], np.diff(t)
    pair = same_pixel & (apart < settings.near)
    count = int(pair.sum())
    if count < settings.pairs:
        return "", 0.0, ""
    turn = p[1:] != p[:-1]
    opposite = float(turn[pair].mean())
    on = float(p.mean())
    words = f"{format_percent(opposite)} of {format_count(count)} successive events of a pixel are opposite"
    if opposite >= settings.turns:
        near = min(settings.near, settings.few * rests.seconds / len(t))
        often = np.count_nonzero(turn & same_pixel & (apart < near)) / _opposite_by_chance(p, rests, near)
        if often >= settings.returns:
            return "returning", opposite, words
        if abs(often - 1) > settings.as_often:
            return "", opposite, ""
        return "independent", opposite, f"{words}, {often:.2g} times as many as of independent ones"
    if abs(opposite - 2 * on * (1 - on)) <= settings.by_chance:
        return "independent", opposite, words
    return "", opposite, ""


def _opposite_by_chance(p: NDArray[np.bool_], rests: Rests, near: float) -> float:
    """Return how many events of a pixel come within a time of one of the other polarity by chance.

    Args:
        p: Whether each event is ON, shape (N,).
        rests: Of the pixels.
        near: The time [s].
    """
    length = rests.end - rests.begin
    short = np.minimum(near, length)
    on = int(np.count_nonzero(p))
    return float(2 * on * (len(p) - on) / rests.seconds**2 * (length * short - 0.5 * short**2).sum())


def _growth_with_light(
    p: NDArray[np.bool_], at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings
) -> float:
    """Return how many times as often as the darker ones the brighter pixels send, at least; 0 where few do.

    Of the rarer polarity: a leak beside the noise is of one, and grows with light.

    Args:
        p: Whether each event is ON, shape (N,).
        at: Which pixel sent it, shape (N,).
        rests: Of the pixels.
        settings: How many tell.
    """
    rarer = p if 2 * np.count_nonzero(p) <= len(p) else ~p
    length = rests.end - rests.begin
    order = np.argsort(rests.level, kind="stable")
    # of pixels of one level no half is darker
    middle = rests.level[order[np.searchsorted(np.cumsum(length[order]), 0.5 * rests.seconds)]]
    bright, dark = rests.level > middle, rests.level < middle
    sent = np.bincount(at[rarer], minlength=len(length))
    many, few = int(sent[bright].sum()), int(sent[dark].sum())
    if many < settings.events or min(length[bright].sum(), length[dark].sum()) < 0.2 * rests.seconds:
        return 0.0
    least = poisson_interval(many)[0] / length[bright].sum()
    return float(least / (poisson_interval(few)[1] / length[dark].sum()))


def _sent_by_hot_pixels(
    at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings
) -> NDArray[np.bool_]:
    """Return which events are of pixels that send far more than others, by the length of their rests.

    Their events are of both polarities, and a few of them hide that all others' are of one.

    Args:
        at: Which pixel sent each event, shape (N,).
        rests: Of the pixels.
        settings: How much more that is.
    """
    sent = np.bincount(at, minlength=len(rests.pixels))
    length = rests.end - rests.begin
    hot = np.zeros(len(sent), bool)
    for _ in range(2):  # a few hot pixels may send most of what is counted first
        usual = sent[~hot].sum() / length[~hot].sum()
        hot = sent > settings.hot_count + settings.hot * usual * length
    out: NDArray[np.bool_] = hot[at]
    return out


def _sent_by_all(at: NDArray[np.int64], rests: Rests, settings: EventsAtRestSettings) -> bool:
    """Whether about as many pixels send as if all sent alike, by the length of their rests.

    Args:
        at: Which pixel sent each event, shape (N,).
        rests: Of the pixels.
        settings: How many they must be.
    """
    expected = len(at) * (rests.end - rests.begin) / rests.seconds
    alike = float(-np.expm1(-expected).sum())
    return len(np.unique(at)) >= settings.spread * alike


def _is_first(t: Array, at: NDArray[np.int64], near: float) -> NDArray[np.bool_]:
    """Return which events have no other of their pixel shortly before: noise that returns sends in pairs.

    Args:
        t: Of the events [s], ascending, shape (N,).
        at: Which pixel sent each, shape (N,).
        near: How shortly [s].
    """
    order = np.argsort(at, kind="stable")
    out = np.ones(len(t), bool)
    out[order[1:]] = (at[order][1:] != at[order][:-1]) | (np.diff(t[order]) >= near)
    return out


def _independent(
    t: Array, p: NDArray[np.bool_], rests: Rests, frame_gap: float, settings: EventsAtRestSettings
) -> bool:
    """Whether events come by themselves: their number in short times varies as independent ones do.

    Or their polarities do, where a simulator draws more noise for some frames of a clip than for others
    (Metavision's): what a lamp, or light that moves, sends at one time is of one polarity. Bursts of both
    come at few times, and nothing in between.

    Args:
        t: Of the events [s], shape (N,).
        p: Whether each is ON, shape (N,).
        rests: Of the pixels.
        frame_gap: Time from frame to frame of a clip [s], 0 for a scene that has none.
        settings: How much more it may vary.
    """
    # what a simulator makes of a frame may come together
    beat = max(settings.beat, frame_gap)
    begin, end = float(rests.begin.min()), float(rests.end.max())
    edges = np.arange(begin - 0.5 * beat, end + beat, beat)  # frames in the middle
    resting = np.interp(edges, np.sort(rests.begin), np.arange(len(rests.begin)))
    resting -= np.interp(edges, np.sort(rests.end), np.arange(len(rests.end)))
    share = np.maximum(0.5 * (resting[1:] + resting[:-1]), 0.0)
    counts = np.histogram(t, edges)[0]
    # after motion all pixels begin anew, and what they send rises and falls; a lamp's swing is faster
    smooth = [uniform_filter1d(values.astype(np.float64), settings.beats) for values in (counts, share)]
    expected = share * smooth[0] / np.maximum(smooth[1], 1e-12)
    used = expected > 0
    if used.sum() < 10:
        return False
    excess = float(((counts[used] - expected[used]) ** 2 / np.maximum(expected[used], 0.05)).mean())
    if excess < settings.together + settings.swing * float(expected[used].mean()):
        return True
    fullest = np.sort(counts)[-max(1, len(counts) // 10) :].sum() / max(counts.sum(), 1)
    if not frame_gap or (len(t) >= 2 * len(counts) and fullest > settings.fullest):
        return False
    on, share, some = np.histogram(t[p], edges)[0], float(p.mean()), counts > 0
    mixing = float(((on - share * counts)[some] ** 2 / counts[some]).mean())
    return mixing < settings.together * share * (1 - share)
