"""How busy a bus can have been, and whether a scan has room for one event, by the time stamps alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.probes.timestamp_patterns import PATTERNS, TimestampStructure
from dase.signatures.calm_events import row_major_pixels


@dataclass(frozen=True)
class BusUse:
    """What a bus, if there is one, can have done at most: it sends at least as fast as it is seen to.

    Args:
        rate: Events per second that it can send at least, one after the other [Hz].
        loss: Share of the events that found it busy.
        load: Share of the busiest time in which it sent one event after the other.
        row_load: The same of an arbiter that takes rows.
        column_load: The same of one that takes columns.
        stamped_again: Share of the events that a scan has stamped like the one before of their pixel; 0
            without a scan.
    """

    rate: float = 0.0
    loss: float = 1.0
    load: float = math.inf
    row_load: float = math.inf
    column_load: float = math.inf
    stamped_again: float = 0.0

    @classmethod
    def of(cls, events: Events, structure: TimestampStructure, *, span: float) -> BusUse:
        """Return what the events of a sensor tell.

        Args:
            events: In order of time.
            structure: Regularities of their time stamps.
            span: Time for which events are counted to see how fast they come [s].
        """
        if structure.line or len(events) < 2:
            # stamps tell when a line was read, not when it was sent
            return cls(stamped_again=share_stamped_again(events) if structure.line else 0.0)
        slack = max(PATTERNS.file_step, structure.step)
        counts = _counts_of_spans(events.t, span)
        most, least = float(counts.max()) / span, least_bus_rate(events, structure)
        # without a queue, of random arrivals the share is lost for which the bus is busy; most events come
        # when many do
        usual = float(np.square(counts).sum() / counts.sum()) / span
        rows, columns = (
            _load_of_lines(events, lines, span, slack, ticks=structure.step > 0)
            for lines in (events.y, events.x)
        )
        return cls(least, usual / least, most / least, rows, columns)


def share_stamped_again(events: Events) -> float:
    """Return the share of events with the time stamp of the one before of their pixel."""
    if not len(events):
        return 0.0
    stamp = np.concatenate([[0], np.cumsum(np.diff(events.t) > 0)])
    return 1 - len(np.unique(stamp * (events.width * events.height) + row_major_pixels(events))) / len(events)


def highest_event_rate(events: Events, span: float) -> float:
    """Return the most events per second of a span of time [Hz]: the rate of a bus that was full so long."""
    return float(_counts_of_spans(events.t, span).max()) / span


def least_bus_rate(events: Events, structure: TimestampStructure) -> float:
    """Return the events per second that a bus can send at least [Hz], as it has sent some as fast as that."""
    if structure.line:
        return 0.0  # stamps tell when a line was read
    return _fastest(events.t, np.ones(len(events)), max(PATTERNS.file_step, structure.step))


def _counts_of_spans(t: NDArray[np.float64], span: float) -> NDArray[np.float64]:
    return np.bincount(((t - t[0]) / span).astype(np.int64)).astype(np.float64)


def _fastest(t: NDArray[np.float64], many: NDArray[np.float64], slack: float) -> float:
    """Return the most per second that went by in a run [Hz].

    Args:
        t: When each was taken [s], shape (N,).
        many: How many of them each stands for, shape (N,).
        slack: By which times are rounded [s].
    """
    gone = np.concatenate([[0.0], np.cumsum(many)])
    # runs of all lengths: the time of short ones is rounded by the clock, long ones have pauses
    runs = (2**n for n in range(13) if 2**n < len(t))
    return max(
        (float(((gone[n:-1] - gone[: -n - 1]) / (t[n:] - t[:-n] + slack)).max()) for n in runs), default=0.0
    )


def _load_of_lines(
    events: Events, line: NDArray[np.uint16], span: float, slack: float, *, ticks: bool
) -> float:
    """Return the largest share of a span for which an arbiter can have been busy with lines and their events.

    Events of a line that is taken share a time stamp, and the next line is taken when all of them are sent.
    So no run of lines was faster than the time for its lines alone, nor than that for its events alone.

    Args:
        events: In order of time.
        line: In which each lies, shape (N,).
        span: Time for which they are counted [s].
        slack: By which times are rounded [s].
        ticks: Whether that hides how often a line was taken.
    """
    stamp = np.concatenate([[0], np.cumsum(np.diff(events.t) > 0)])
    _, first, many = np.unique((stamp << 16) + line, return_index=True, return_counts=True)
    t = events.t[first]
    taken = events.t if ticks else t  # each event may have been a line of its own
    lines = float(_counts_of_spans(taken, span).max()) / _fastest(t, np.ones(len(t)), slack)
    sent = float(_counts_of_spans(events.t, span).max()) / _fastest(t, many.astype(np.float64), slack)
    return (lines + sent) / span
