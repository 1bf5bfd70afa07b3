"""Bursts of the whole array in step with the frames of the same camera.

A DAVIS exposes frames with the photodiodes that make its events. In some, opening and closing the shutter
couples into all pixels: a burst of one polarity at one time after each frame's begin, once per pixel, over
light and dark alike. Where the times of frames are unknown, the bursts tell them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from dase.formatting import format_percent, format_seconds
from dase.signatures.chance import mean_interval
from dase.signatures.clock import ClockCounts
from dase.signatures.faint_bursts import FAINT, find_faint_bursts, find_row_delay
from dase.signatures.kinds import FRAME_COUPLING
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class CouplingSettings:
    """What counts as a burst, and as a clock."""

    least: float = 2.0  # times the usual rate
    # the same, at which bursts are looked for: lower where there are none, for a lamp may reach that as well
    high: tuple[float, ...] = (4.0, 2.5)
    fewest_frames: int = 7  # with less not even the same moment in each frame is significant
    fewest_events: float = 50.0  # per frame interval and polarity
    usual: float = 0.02  # [s] its median is the usual rate: longer than a burst, shorter than a scene
    even: float = 0.002  # [s] over which that rate is taken
    shortest: float = 0.014  # [s] what repeats sooner is a lamp: it has 100 or 120 cycles per second
    windows: tuple[float, ...] = (0.03, 0.06, 0.12)  # of a period, in which bursts in step with frames come
    periods: int = 24  # that lie between most pairs of bursts are tried
    bursts: int = 200  # of these the first tell the period, the others how exactly
    margin: float = 0.003  # [s] left out on both sides of a burst
    faint_margin: float = 0.0015  # [s] the same, of bursts that hold few events
    most_margin: float = 0.1  # share of the interval, so that short ones keep time between their bursts
    tiles: float = 0.4  # share of the active tiles that take part in a burst of the whole array
    lamp: float = 0.5  # peaks this high relative to the highest, evenly over the frame, belong to a lamp
    wide: float = 0.25  # share of the interval above which a burst is light that swings: a sine takes half


@dataclass(frozen=True)
class BurstClock:
    """When bursts come.

    Args:
        begins: Begins of the frames [s], shape (F,); where they are unknown, times of the bursts of a phase.
        interval: Time from one to the next [s].
        bursts: Spans after each begin in which events are left out [s], shape (B, 2).
    """

    begins: NDArray[np.float64]
    interval: float
    bursts: NDArray[np.float64]

    @classmethod
    def of(cls, details: Mapping[str, Any]) -> BurstClock:
        """Return the clock that the details of a signature tell."""
        return cls(np.asarray(details["begins"]), details["interval"], np.asarray(details["bursts"]))

    def extend(self, end: float) -> BurstClock:
        """Return the clock with as many more frames as begin before `end` [s], at even distances."""
        more = np.arange(1, max(int((end - self.begins[-1]) / self.interval), 0) + 1)
        return replace(self, begins=np.concatenate((self.begins, self.begins[-1] + more * self.interval)))

    def contains(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which times [s], shape (N,), lie in a burst."""
        out = np.zeros(len(t), np.bool_)
        if not len(self.begins) or not len(t):
            return out
        spans = (self.begins[:, None, None] + self.bursts).reshape(-1, 2)
        spans = spans[np.argsort(spans[:, 0])]
        # every time lies in a span that began before it, the last of those that reach farthest
        at = np.searchsorted(spans[:, 0], t, side="right") - 1
        reach = np.maximum.accumulate(spans[:, 1])
        return (at >= 0) & (t < reach[at])


@dataclass(frozen=True)
class _Folded:
    """The rate over the interval between frames, for one polarity."""

    score: NDArray[np.float64]  # (F, M) log of rate / usual rate
    p: float
    at: int
    excess: NDArray[np.float64]  # (M,) events above the usual, all frames together

    @property
    def mean(self) -> NDArray[np.float64]:
        out: NDArray[np.float64] = self.score.mean(0)
        return out


def _weigh_tiles(counts: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return the events of a polarity by step, each tile weighted by one over its rate, shape (K,).

    What couples into all pixels alike is lost where a scene moves and stands out where none does: weights of
    one over a tile's rate give it the least variance. They are scaled so that the variance is the mean again.

    Args:
        counts: Events by step and tile, shape (K, T).
    """
    rate = counts.mean(0)
    weight = 1 / (rate + 1 / len(counts))
    weight *= (weight @ rate) / max(weight**2 @ rate, 1e-12)
    out: NDArray[np.float64] = counts @ weight
    return out


def _usual_rate(counts: NDArray[np.float64], step: float, settings: CouplingSettings) -> NDArray[np.float64]:
    # a simulator's events may come at every other step alone
    even = uniform_filter1d(counts, max(round(settings.even / step), 1), mode="nearest")
    out: NDArray[np.float64] = median_filter(even, 2 * round(settings.usual / step / 2) + 1, mode="nearest")
    return out


def _fold(
    counts: NDArray[np.uint32],
    first: NDArray[np.int64],
    length: int,
    step: float,
    weighted: bool,
    s: CouplingSettings,
) -> _Folded | None:
    """Fold the counts of a polarity on the frames that begin at steps `first`, and test their common phase.

    In each frame the phases are ranked by their rate. If the frames had nothing to do with it, their clocks
    could be turned by any amount, so ranks of one phase are independent and uniform over the frames: minus
    the sum of their logarithms is gamma distributed (Fisher's combination), for each of the phases.

    Args:
        counts: Events by step and tile, shape (K, T).
        first: Steps at which frames begin, shape (F,).
        length: Steps of a frame.
        step: Of the clock [s].
        weighted: Whether each tile is weighted by one over its rate.
        s: What counts as a burst.
    """
    total = counts.sum(1, dtype=np.float64)
    weighed = _weigh_tiles(counts) if weighted else total
    # bursts come some tenths of a millisecond early or late
    smooth = maximum_filter1d(np.convolve(weighed, np.ones(3) / 3, "same"), 3)
    usual = _usual_rate(weighed, step, s)
    places = first[:, None] + np.arange(length)
    kept = weighed[places].sum(1) >= s.fewest_events
    if kept.sum() < s.fewest_frames:
        return None
    places = places[kept]
    score = np.log((smooth[places] + 1) / (usual[places] + 1))
    order = np.sort(score, axis=1)
    above = np.stack([length - np.searchsorted(o, v) for o, v in zip(order, score, strict=True)])
    p = stats.gamma.sf(-np.log(above / length).sum(0), len(score))
    at = int(p.argmin() if p.min() > 0 else score.mean(0).argmax())
    excess = (total - _usual_rate(total, step, s))[places].sum(0)
    return _Folded(score, min(1.0, length * float(p.min())), at, excess)


def _is_lamp(mean: NDArray[np.float64], at: int, step: float, s: CouplingSettings) -> bool:
    """Whether the rate over a frame is that of light that swings.

    It has the same peak at even distances, where several cycles fit into the frame, or rises for a good part
    of the frame, where one does. Bursts of real cameras last 2 to 3 ms.
    """
    length = len(mean)
    if (mean > 0.5 * mean[at]).mean() > s.wide:
        return True
    wide = maximum_filter1d(mean, 5, mode="wrap")
    for cycles in range(2, int(length * step / 0.0025) + 1):
        mates = (at + np.round(np.arange(1, cycles) * length / cycles).astype(int)) % length
        if wide[mates].min() > s.lamp * mean[at]:
            return True
    return False


def _find_bursts(
    counts: NDArray[np.uint32], step: float, high: float, weighted: bool, s: CouplingSettings
) -> list[NDArray[np.int64]]:
    """Return the steps of bursts of the whole array, OFF and ON: many tiles, and `high` times the usual."""
    out = []
    for polarity in range(2):
        per_tile = counts[:, polarity].astype(np.float64)
        total = per_tile.sum(1)
        plain = usual = _usual_rate(total, step, s)
        share = per_tile.mean(0) / max(per_tile.mean(), 1e-12) / per_tile.shape[1]
        active = share > 0.1 / len(share)
        if weighted:
            total = _weigh_tiles(counts[:, polarity])
            usual = _usual_rate(total, step, s)
            active = per_tile.sum(0) >= s.fewest_events
        rows = np.flatnonzero((total > high * usual + 20) & (total - usual > 10 * np.sqrt(usual + 1)))
        peaks = []
        for group in np.split(rows, np.flatnonzero(np.diff(rows) > 4) + 1):
            if not len(group):
                continue
            wanted = 2 * plain[group].sum() * share + 2
            wide = (per_tile[group].sum(0) > wanted)[active]
            if len(wide) and wide.mean() > s.tiles:
                peaks.append(group[total[group].argmax()])
        out.append(np.array(peaks, np.int64))
    return out


def _find_period(times: NDArray[np.float64], step: float, s: CouplingSettings) -> tuple[float, float]:
    """Return the period of bursts [s] and the chance of one as good.

    Of n bursts without a period, at least k come within a window of w turns of one of them with a chance of
    at most n times that of k - 1 of the n - 1 others doing so. Periods are looked for: no more of them than
    there are pairs of bursts, as finely as windows are wide, and for a few windows.

    Args:
        times: Of the bursts, ascending [s], shape (n,).
        step: Of the clock that tells them [s].
        s: Which periods and windows are tried.
    """
    few = times[: s.bursts]
    apart = (few[None] - few[:, None])[np.triu_indices(len(few), 1)]
    apart = apart[(apart >= 2 * step) & (apart <= (few[-1] - few[0]) / (s.fewest_frames - 1) + step)]
    near = np.bincount(np.round(apart / step).astype(np.int64)) if len(apart) else np.zeros(1)
    often = np.argsort(near + np.roll(near, 1) + np.roll(near, -1))[::-1][: s.periods]
    about = [float(np.median(np.diff(few))), *(step * float(one) for one in often if near[one])]
    period, turn, window, p = min(
        (_refine_period(few, one, step, s) for one in about), key=lambda one: one[3]
    )
    # bursts that keep step tell the period better than the grid does, and the more the longer they do
    for count in sorted({min(len(few) << n, len(times)) for n in range(32)}):
        off = (times[:count] - times[0]) / period - turn
        cycle = np.round(off)
        steady = np.abs(off - cycle) <= 0.5 * window
        if steady.sum() > 2 and np.ptp(cycle[steady]) > 0:
            period = float(np.polyfit(cycle[steady], times[:count][steady], 1)[0])
    return period, min(1.0, 0.5 * len(few) ** 2 * p)


def _refine_period(
    times: NDArray[np.float64], about: float, step: float, s: CouplingSettings
) -> tuple[float, float, float, float]:
    """Return the period near one by which most bursts keep step, and the chance of as many at one period.

    Args:
        times: Of the bursts, ascending [s], shape (n,).
        about: The period, to a step of the clock [s].
        step: Of the clock [s].
        s: Which windows are tried.

    Returns:
        The period [s], the phase of the bursts after the first one and the window in which they come [turns],
        and the chance.
    """
    count, lasts = len(times), float(times[-1] - times[0])
    # fine enough that the first and the last keep step
    reach = max(0.03 * about, step)
    tried = np.arange(-reach, reach, 0.1 * about**2 / (lasts + about)) + about
    phases = np.sort((times - times[0])[None] / tried[:, None] % 1.0, axis=1)
    # one after the other, so that all of them are looked up at once
    apart = 3.0 * np.arange(len(tried))[:, None]
    turns = (np.concatenate([phases, phases + 1], axis=1) + apart).ravel()
    ahead = 2 * count * np.arange(len(tried))[:, None] + np.arange(count)
    out = about, 0.0, 0.0, 1.0
    for window in sorted({max(one, 1.5 * step / about) for one in s.windows}):
        inside = (
            np.searchsorted(turns, (phases + apart + window).ravel(), "right").reshape(phases.shape) - ahead
        )
        most = inside.max(1)
        best = int(most.argmax())
        chance = count * float(stats.binom.sf(most[best] - 2, count - 1, window))
        chance *= len(s.windows) * max(lasts / about, 1.0) / window
        if most[best] >= s.fewest_frames and chance < out[3]:
            turn = float(phases[best, int(inside[best].argmax())]) + 0.5 * window
            out = float(tried[best]), turn, window, chance
    return out


def find_frame_coupling(
    clock: ClockCounts,
    level: float,
    begins: NDArray[np.float64] | None = None,
    settings: CouplingSettings | None = None,
) -> tuple[Signature, BurstClock | None]:
    """Look for bursts in step with frames.

    Args:
        clock: The events by time.
        level: p below which they are there.
        begins: When exposures begin [s], shape (F,); None where unknown.
        settings: What counts as a burst.

    Returns:
        The signature, and when the bursts are, where there are any.
    """
    s = settings or CouplingSettings()
    frames: tuple[NDArray[np.float64], float, float | None] | None = None
    if begins is not None and len(begins) >= 2:
        frames = np.asarray(begins, np.float64), float(np.median(np.diff(begins))), None
    said: tuple[Signature, BurstClock | None] | None = None
    for weighted, high in product((False, True), s.high[:1] if frames else s.high):
        if weighted and said is not None and said[0].answer is Answer.CANNOT_SAY:
            break
        found = frames or _search_bursts(clock, high, weighted, s)
        entry = _look_in_step(clock, *found, weighted, level, s) if found else _without_bursts(clock, s)
        if entry[0].found and not frames:
            return _with_row_delay(clock, entry[0]), entry[1]
        if entry[0].found:
            return entry
        # what else is met by a lower limit, or where little moves, is not the frames'
        said = said or entry
        if weighted and entry[0].answer is Answer.CANNOT_SAY:
            break  # three swings of a lamp look like bursts of frames, once a scene no longer hides them
    assert said is not None
    return said if frames else _look_for_faint_bursts(clock, level, s) or said


def _look_for_faint_bursts(
    clock: ClockCounts, level: float, s: CouplingSettings
) -> tuple[Signature, BurstClock] | None:
    """Return the bursts of which no single one is seen; None where all of them together show none either."""
    bursts = find_faint_bursts(clock)
    if bursts is None or bursts.p >= level or bursts.tiles < FAINT.tiles or bursts.lasts > FAINT.lasts:
        return None
    step, interval = clock.settings.step, bursts.interval
    if abs(interval / FAINT.screen - 1) < FAINT.near_screen or _is_lamp(bursts.mean, bursts.at, step, s):
        return None
    mean, low, high = mean_interval(np.log(bursts.rates))
    count = math.floor((clock.times[-1] - bursts.first) / interval) + 1
    begins = bursts.first - 0.25 * interval + interval * np.arange(max(count, 1))
    first, last = sorted((0.0, bursts.delay))
    spans = [[0.25 * interval + first - s.faint_margin, 0.25 * interval + last + s.faint_margin]]
    share = max(bursts.excess, 0.0) * len(begins) / max(int(clock.counts.sum()), 1)
    name = "ON" if bursts.polarity else "OFF"
    said = f"faint bursts of the whole array every {1e3 * interval:.2f} ms ({name}), "
    said += f"{math.exp(mean):.3g} times the rate, {format_percent(share)} of the events"
    if abs(bursts.delay) >= FAINT.apart:
        after = "after" if bursts.delay > 0 else "before"
        said += f", the last row {1e3 * abs(bursts.delay):.0f} ms {after} the first"
    details = {
        "interval": interval, "phases": {name: 0.25 * interval}, "share": share, "exposure": math.nan,
        "clock": "bursts", "bursts": spans, "begins": begins.tolist(), "row_delay": bursts.delay,
        "faint": True, "doubtful": any(_is_whole(interval * lamp) for lamp in FAINT.lamps),
    }  # fmt: skip
    entry = Signature(
        name=FRAME_COUPLING, answer=Answer.FOUND, p=bursts.p, size=math.exp(mean), low=math.exp(low),
        high=math.exp(high), unit="times the usual rate", least=1.0, sentence=said, details=details,
    )  # fmt: skip
    return entry, BurstClock(begins, interval, np.array(spans))


def _is_whole(cycles: float) -> bool:
    return abs(cycles - round(cycles)) < FAINT.near_lamp


def _with_row_delay(clock: ClockCounts, entry: Signature) -> Signature:
    """Return bursts that were seen with how much later they come in the last row than in the first."""
    delay = find_row_delay(clock, entry.details["interval"])
    return replace(entry, details={**entry.details, "row_delay": delay})


def doubt_faint_bursts(entry: Signature, tick: float, clock: ClockCounts) -> Signature:
    """Return faint bursts as they were found, or no answer where ticks of time stamps [s] may make them.

    Ticks that are about as long as steps of the clock leave out one of some, at even times.
    """
    if tick < 0.25 * clock.settings.step:
        return entry
    reason = f"stamps are multiples of {format_seconds(tick)}, too coarse for bursts that no single one shows"
    return without_answer(FRAME_COUPLING, reason)


def _without_bursts(clock: ClockCounts, s: CouplingSettings) -> tuple[Signature, None]:
    """Return the answer where the whole array never sends at once."""
    lasts = len(clock.counts) * clock.settings.step
    if lasts < 0.3:
        reason = f"{format_seconds(lasts)} without known frame times, too short"
        return without_answer(FRAME_COUPLING, reason), None
    unseen = "no frame times known, no regular bursts of the whole array"
    return Signature(name=FRAME_COUPLING, answer=Answer.NOT_SEEN, p=1.0, least=s.least, sentence=unseen), None


def _look_in_step(
    clock: ClockCounts,
    begins: NDArray[np.float64],
    interval: float,
    p: float | None,
    weighted: bool,
    level: float,
    s: CouplingSettings,
) -> tuple[Signature, BurstClock | None]:
    """Look for bursts in step with frames whose times are known, or told by bursts.

    Args:
        clock: The events by time.
        begins: When frames begin [s], shape (F,).
        interval: Time from one to the next [s].
        p: Chance of bursts that tell as even times; None where frames tell them.
        weighted: Whether each tile is weighted by one over its rate.
        level: p below which they are there.
        s: What counts as a burst.
    """
    told = "frames" if p is None else "bursts"
    step, counts = clock.settings.step, clock.counts
    if interval < s.shortest:
        reason = f"{told} come every {format_seconds(interval)}, as often as lamps flicker"
        return without_answer(FRAME_COUPLING, reason), None
    length = round(interval / step)
    first = np.round((begins - clock.begin) / step).astype(np.int64)
    whole = (first >= 0) & (first + length <= len(counts))
    folded = [_fold(counts[:, k], first[whole], length, step, weighted, s) for k in range(2)]
    known = [(k, f) for k, f in enumerate(folded) if f is not None]
    if not known:
        frames = int(whole.sum())
        reason = f"{frames} whole frames with {s.fewest_events:g} events of a polarity, too few"
        return without_answer(FRAME_COUPLING, reason), None
    return _judge_folds(known, begins, interval, step, p, int(counts.sum()), level, s, told)


def _search_bursts(
    clock: ClockCounts, high: float, weighted: bool, s: CouplingSettings
) -> tuple[NDArray[np.float64], float, float] | None:
    """Return times in step with bursts of the whole array [s], their interval [s], and its p."""
    best = None
    for peaks in _find_bursts(clock.counts, clock.settings.step, high, weighted, s):
        if len(peaks) < s.fewest_frames:
            continue
        times = clock.times[peaks]
        period, p = _find_period(times, clock.settings.step, s)
        if best is None or p < best[2]:
            turn = float(np.angle(np.exp(2j * np.pi * times / period).sum()) / (2 * np.pi))
            last = clock.times[-1]
            # a quarter after the begin: the burst is not cut in two
            begins = np.arange(math.ceil(clock.begin / period - turn), last / period - turn) + turn - 0.25
            best = begins * period, period, min(1.0, 2 * p)
    return best


def _judge_folds(
    known: list[tuple[int, _Folded]],
    begins: NDArray[np.float64],
    interval: float,
    step: float,
    p: float | None,
    events: int,
    level: float,
    s: CouplingSettings,
    told: str,
) -> tuple[Signature, BurstClock | None]:
    """Return the answer of the polarity that shows it best, and all bursts of both."""
    _, best = min(known, key=lambda pair: (pair[1].p, -pair[1].mean.max()))
    p = min(1.0, 2 * best.p) if p is None else p
    mean, low, high = mean_interval(best.score[:, best.at])
    entry = Signature(
        name=FRAME_COUPLING, answer=Answer.NOT_SEEN,
        p=p, size=math.exp(mean), low=math.exp(low), high=math.exp(high),
        unit="times the usual rate", least=s.least,
    )  # fmt: skip
    size = f"at most {entry.size:.2f} times the usual rate in step with the {told}"
    entry = judge_signature(entry, level, size)
    if not entry.found:
        if entry.size >= s.least:
            reason = f"the rate rises {entry.size:.3g} times, in step with the {told} by chance (p {p:.1g})"
            return without_answer(
                FRAME_COUPLING, reason, p=p, details={"interval": interval, "clock": told}
            ), None
        return entry, None
    if _is_lamp(best.mean, best.at, step, s):
        reason = (
            f"the rate peaks evenly over the {format_seconds(interval)} between frames: light that flickers"
        )
        return without_answer(FRAME_COUPLING, reason, p=p), None
    return _describe_bursts(entry, known, begins, interval, step, events, told, s)


def _describe_bursts(
    entry: Signature,
    known: list[tuple[int, _Folded]],
    begins: NDArray[np.float64],
    interval: float,
    step: float,
    events: int,
    told: str,
    s: CouplingSettings,
) -> tuple[Signature, BurstClock]:
    """Return the signature with what is known of the bursts, and when they are."""
    length = len(known[0][1].mean)
    bursty = np.zeros(length, np.bool_)
    peaks: dict[str, float] = {}
    extra = 0.0
    for polarity, fold in known:
        error = fold.score.std(0, ddof=1) / math.sqrt(len(fold.score))
        high = fold.mean > np.maximum(math.log(entry.least), 4 * error)
        extra += float(fold.excess[high].clip(0).sum())
        bursty |= high
        if high.any():
            at = int(fold.mean.argmax())
            peaks["ON" if polarity else "OFF"] = (at + 0.5) * step
    margin = round(min(s.margin, s.most_margin * interval) / step)
    wide = maximum_filter1d(bursty, 2 * margin + 1, mode="wrap")
    edges = np.flatnonzero(np.diff(np.concatenate(([False], wide, [False])).astype(np.int8)))
    spans = edges.reshape(-1, 2).astype(np.float64) * step
    share = extra / max(events, 1)
    exposure = (peaks["OFF"] - peaks["ON"]) % interval if len(peaks) == 2 else math.nan
    where = ", ".join(f"{name} at {1e3 * at:.1f} ms" for name, at in peaks.items())
    said = f"bursts of the whole array every {1e3 * interval:.2f} ms ({where}), "
    said += f"{entry.size:.3g} times the rate, {format_percent(share)} of the events"
    details = {
        "interval": interval, "phases": peaks, "share": share, "exposure": exposure, "clock": told,
        "bursts": spans.tolist(), "begins": begins.tolist(),
    }  # fmt: skip
    return replace(entry, sentence=said, details=details), BurstClock(begins, interval, spans)
