"""A full bus: the rate of events stays at a ceiling, whatever happens in the scene.

Below the ceiling, counts of events scatter as the scene and chance have it. At the ceiling one event follows
the other as fast as the bus sends, and hardly anything scatters.

Where time stamps are fine enough, a bus shows however full it is: it sends one event at a time, so events of
different pixels never come closer than the time it takes for one. Pixels know nothing of each other: without
a bus, how far apart they send is as in a Poisson process over any short time. While events wait for it, they
come as evenly as it sends, also where a tick of the time stamps is as long as that takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.events import Events
from dase.formatting import format_count, format_metric, format_percent, format_seconds
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.clock import ClockCounts
from dase.signatures.kinds import FULL_BUS
from dase.signatures.result import Answer, Signature, judge_signature, without_answer


@dataclass(frozen=True)
class BusSettings:
    """What is a ceiling."""

    least: float = 0.01  # share of the time at the ceiling
    quantile: float = 0.995  # of the counts per step: the ceiling, if there is one
    errors: float = 3.0  # of a Poisson count, to each side of the ceiling: chance would fill this band
    slack: float = 0.01  # at least, relative
    above: float = 0.002  # share of the time that may exceed the ceiling
    fewest: int = 20  # steps at the ceiling, and as many below 0.8 of it
    fewest_events: float = 50.0  # per step at the ceiling, for its scatter to be seen
    steps: int = 8  # of the clock at most that are taken together where fewer events come
    enough: float = 400.0  # events per step for a ceiling that is narrow
    scatter: float = 0.2  # of that of chance or below the ceiling, at most: a full bus leaves hardly any
    closer: float = 0.001  # share of the intervals that may be shorter than the time for one event
    expected: float = 0.05  # share of them that must be shorter by chance, for their absence to be seen
    missing: float = 0.1  # of those expected that may be there
    ticks: float = 2.5  # of the time stamps that the time for one event must last
    local: int = 64  # intervals over which the rate is taken as even
    run: int = 64  # events that come evenly or not
    straight: float = 0.02  # of the time for one event: how far from evenly they may come, or a tick
    wander: float = 5.0  # ticks that as many events at random must wander off at least, to be told from those
    alike: float = 0.9  # of the runs that are even, share of which must be equally fast
    own: float = 0.01  # how far from a tick, relative: converters move equal stamps apart by one
    shortest: float = 2e-8  # time for one event [s]: below, stamps were moved apart by next to nothing
    others: float = 0.5  # of the events of such a run, share at least that another pixel sent before


def _scatter_of(counts: NDArray[np.float64], chosen: NDArray[np.bool_]) -> tuple[float, int]:
    """Return the scatter of successive counts relative to that of chance, and how many pairs there are."""
    both = chosen[1:] & chosen[:-1]
    a, b = counts[1:][both], counts[:-1][both]
    return float(((a - b) ** 2 / np.maximum(a + b, 1)).mean()) if len(a) else 1.0, len(a)


def find_even_bus(first: Events, level: float, settings: BusSettings | None = None) -> Signature | None:
    """Look for runs of events that come as evenly as a bus sends them, all at one rate.

    The null is a Poisson process whose rate is even over a run: events wander about the straight line from
    the first to the last as a Brownian bridge does, whose largest distance has Kolmogorov's distribution.

    Args:
        first: The first events.
        level: p below which it is there.
        settings: What comes evenly.

    Returns:
        None where no bus is seen.
    """
    s = settings or BusSettings()
    tick, many = _file_tick(first), len(first) // s.run
    if many < s.fewest:
        return None
    t = first.t[: many * s.run].reshape(many, s.run)
    gone = t - t[:, :1]
    service = gone[:, -1] / (s.run - 1)
    off = np.abs(gone - service[:, None] * np.arange(s.run)).max(1)
    slack = 1.01 * np.maximum(tick, s.straight * service)
    even = (off <= slack) & (service > s.shortest) & (service * np.sqrt(s.run) >= s.wander * tick)
    even &= np.abs(service - tick) > s.own * tick
    # a pixel that is hot sends evenly by itself
    pixel = row_major_pixels(first)[: many * s.run].reshape(many, s.run)
    even &= (np.diff(pixel) != 0).mean(1) >= s.others
    if not even.any():
        return None
    usual = float(np.median(service[even]))
    # stamps at both ends are rounded
    alike = even & (np.abs(service - usual) <= 2 * tick / (s.run - 1) + 1e-3 * usual)
    count = int(alike.sum())
    if count < max(s.fewest, s.alike * even.sum()):
        return None
    service_time = float(np.mean(service[alike]))
    wide = max(slack[alike].max() / service_time, s.straight) / np.sqrt(s.run)
    p = float(stats.binom.sf(count - 1, many, stats.kstwobign.cdf(wide)))
    low, high = stats.beta.interval(0.9, count + 0.5, many - count + 0.5)
    entry = Signature(
        name=FULL_BUS, answer=Answer.NOT_SEEN, p=p, size=count / many, low=float(low), high=float(high),
        unit="share of the events", least=s.least,
        sentence=f"{format_percent(count / many)} of the events come one after the other at even times, each "
        f"{format_seconds(service_time)}: a bus of {format_metric(1 / service_time, 'events/s')}",
        details={"rate": 1 / service_time},
    )  # fmt: skip
    entry = judge_signature(entry, level, "")
    return entry if entry.found else None


def find_full_bus(
    clock: ClockCounts, first: Events, level: float, tick: float = 0.0, settings: BusSettings | None = None
) -> Signature:
    """Look for a ceiling of the rate, or else for a time within which no second event comes.

    The null of the ceiling has counts there scatter, relative to chance, as those below: an F distribution.

    Args:
        clock: The events by time.
        first: The first events, of which intervals are looked at.
        level: p below which it is there.
        tick: Of the time stamps [s], if they are known to have one.
        settings: What is a ceiling, and what a time for one event.
    """
    s = settings or BusSettings()
    ceiling = _find_ceiling(clock, level, s)
    if ceiling.found:
        return ceiling
    spacing = _find_spacing(first, level, tick, s)
    return ceiling if spacing is None else spacing


def _find_spacing(events: Events, level: float, tick: float, s: BusSettings) -> Signature | None:
    """Return the signature of a bus that sends one event at a time; None where none is seen.

    The null is a Poisson process whose rate is even over `local` intervals. One that is not even there has
    more short intervals, not fewer. Events of one pixel are left out: its dead time keeps them apart.
    """
    intervals = np.diff(events.t)
    apart = (np.diff(events.x.astype(np.int64)) != 0) | (np.diff(events.y.astype(np.int64)) != 0)
    many = len(intervals) // s.local * s.local
    if many < 4 * s.fewest * s.local:
        return None
    intervals, apart = intervals[:many], apart[:many]
    slot = float(np.quantile(intervals[apart], s.closer)) if apart.any() else 0.0
    if not slot > s.ticks * max(tick, _file_tick(events)):
        return None
    rate = s.local / np.maximum(intervals.reshape(-1, s.local).sum(1), 1e-12)
    pairs = apart.reshape(-1, s.local).sum(1)
    expected = float((pairs * -np.expm1(-rate * slot)).sum())
    closer = int((intervals[apart] < 0.99 * slot).sum())
    share = expected / max(int(pairs.sum()), 1)
    if share < s.expected or closer > s.missing * expected:
        return None
    p = float(stats.poisson.cdf(closer, expected))
    low, high = stats.beta.interval(0.9, expected + 0.5, max(pairs.sum() - expected, 0) + 0.5)
    entry = Signature(
        name=FULL_BUS, answer=Answer.NOT_SEEN, p=p, size=share, low=float(low), high=float(high),
        unit="share of the intervals that would be shorter by chance", least=s.expected,
        sentence=f"one event at a time: no two pixels send within {format_metric(slot, 's')}, as of a bus of "
        f"{format_metric(1 / slot, 'events/s')}",
        details={"rate": 1 / slot, "closer": closer, "expected": expected},
    )  # fmt: skip
    entry = judge_signature(entry, level, "")
    return entry if entry.found else None


def _file_tick(events: Events) -> float:
    """Return the tick of whole microseconds [s], as most files have it; 0 where stamps are finer."""
    us = 1e6 * (events.t - events.t[0])
    return 1e-6 if np.all(np.abs(us - np.rint(us)) < 0.01) else 0.0


def _find_ceiling(clock: ClockCounts, level: float, s: BusSettings) -> Signature:
    """Return the signature of a rate that stays at a ceiling."""
    step = clock.settings.step
    counts = clock.counts.sum((1, 2), dtype=np.float64)[:-1]  # the last step is not whole
    if len(counts) < 4 * s.fewest:
        return without_answer(FULL_BUS, f"{len(counts)} steps of {step * 1e3:g} ms are too few")
    ceiling = float(np.quantile(counts, s.quantile))
    together = int(np.clip(np.ceil(s.enough / max(ceiling, 1.0)), 1, s.steps))
    if together > 1:
        counts = counts[: len(counts) // together * together].reshape(-1, together).sum(1)
        step *= together
        ceiling = float(np.quantile(counts, s.quantile))
    most = f"at most {format_metric(ceiling / step, 'events/s')}"
    if ceiling < s.fewest_events:
        return without_answer(FULL_BUS, f"{most}, too few to tell a ceiling from chance")
    slack = max(s.errors * np.sqrt(ceiling), s.slack * ceiling)
    at = np.abs(counts - ceiling) <= slack
    below = (counts < 0.8 * ceiling) & (counts > 0.1 * ceiling) & ~at
    full, steps = _scatter_of(counts, at)
    usual, others = _scatter_of(counts, below)
    share = float(at.mean())
    p = 1.0
    if min(steps, others) >= s.fewest and np.mean(counts > ceiling + slack) <= s.above:
        # successive differences share their counts: two thirds of them are free
        p = float(stats.f.cdf(full / max(min(usual, 1.0), 1e-9), 2 * steps / 3, 2 * others / 3))
        if full > s.scatter * min(usual, 1.0):
            p = 1.0
    if full < s.scatter and steps >= s.fewest > others:
        rate = format_metric(ceiling / step, "events/s")
        reason = f"the rate hardly leaves {rate}: a full bus, or an even scene"
        return without_answer(FULL_BUS, reason)
    if p == 1.0:
        share, at = 0.0, np.zeros_like(at)  # whatever the rate does there, it is no ceiling
    low, high = stats.beta.interval(0.9, at.sum() + 0.5, len(at) - at.sum() + 0.5)
    entry = Signature(
        name=FULL_BUS, answer=Answer.NOT_SEEN, p=p, size=share, low=float(low), high=float(high),
        unit="share of the time", least=s.least,
        sentence=f"the rate stays at {format_metric(ceiling / step, 'events/s')} "
        f"{format_percent(share)} of the time",
        details={"rate": ceiling / step, "scatter": full, "usual_scatter": usual},
    )  # fmt: skip
    return judge_signature(
        entry, level, f"no ceiling, {most} ({format_count(int(ceiling))} per {step * 1e3:g} ms)"
    )
