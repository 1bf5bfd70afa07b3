"""A full bus: the rate of events stays at a ceiling, whatever happens in the scene.

Below the ceiling, counts of events scatter as the scene and chance have it. At the ceiling one event follows
the other as fast as the bus sends, and hardly anything scatters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.formatting import format_count, format_metric, format_percent
from dase.signatures.clock import ClockCounts
from dase.signatures.result import Answer, Signature, judge_signature, without_answer

NAME = "full bus"


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


def _scatter_of(counts: NDArray[np.float64], chosen: NDArray[np.bool_]) -> tuple[float, int]:
    """Return the scatter of successive counts relative to that of chance, and how many pairs there are."""
    both = chosen[1:] & chosen[:-1]
    a, b = counts[1:][both], counts[:-1][both]
    return float(((a - b) ** 2 / np.maximum(a + b, 1)).mean()) if len(a) else 1.0, len(a)


def find_full_bus(clock: ClockCounts, level: float, settings: BusSettings | None = None) -> Signature:
    """Look for a ceiling of the rate.

    The null has counts at the ceiling scatter, relative to chance, as those below: an F distribution.

    Args:
        clock: The events by time.
        level: p below which it is there.
        settings: What is a ceiling.
    """
    s = settings or BusSettings()
    step = clock.settings.step
    counts = clock.counts.sum((1, 2), dtype=np.float64)[:-1]  # the last step is not whole
    if len(counts) < 4 * s.fewest:
        return without_answer(NAME, f"{len(counts)} steps of {step * 1e3:g} ms are too few")
    ceiling = float(np.quantile(counts, s.quantile))
    together = int(np.clip(np.ceil(s.enough / max(ceiling, 1.0)), 1, s.steps))
    if together > 1:
        counts = counts[: len(counts) // together * together].reshape(-1, together).sum(1)
        step *= together
        ceiling = float(np.quantile(counts, s.quantile))
    most = f"at most {format_metric(ceiling / step, 'events/s')}"
    if ceiling < s.fewest_events:
        return without_answer(NAME, f"{most}, too few to tell a ceiling from chance")
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
        return without_answer(NAME, reason)
    if p == 1.0:
        share, at = 0.0, np.zeros_like(at)  # whatever the rate does there, it is no ceiling
    low, high = stats.beta.interval(0.9, at.sum() + 0.5, len(at) - at.sum() + 0.5)
    entry = Signature(
        name=NAME, answer=Answer.NOT_SEEN, p=p, size=share, low=float(low), high=float(high),
        unit="share of the time", least=s.least,
        sentence=f"the rate stays at {format_metric(ceiling / step, 'events/s')} "
        f"{format_percent(share)} of the time",
        details={"rate": ceiling / step, "scatter": full, "usual_scatter": usual},
    )  # fmt: skip
    return judge_signature(
        entry, level, f"no ceiling, {most} ({format_count(int(ceiling))} per {step * 1e3:g} ms)"
    )
