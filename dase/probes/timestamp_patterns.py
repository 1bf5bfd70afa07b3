"""Regularities of time stamps: clocks that tick slowly, readouts that go from row to row."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from dase.events import Events


@dataclass(frozen=True)
class PatternSettings:
    """What counts as a regularity of time stamps."""

    file_step: float = 1e-6
    """Files give whole microseconds: stamps are off by half of it [s]."""

    shortest: float = 3e-6
    """Shorter regularities cannot be told from the file's own [s]."""

    pause: float = 0.02
    """Share of a scan by which lines may be off: readouts pause between scans, which the lines here share
    out."""

    certain: float = 0.97
    """Share of events that must follow a regularity."""

    repeats: float = 30e-6
    """Shorter gaps of a line may be those of events that are repeated at once [s]."""

    multiples: int = 6
    """Scans in the shortest gap of a line, at most: pixels that send once in a frame skip some."""

    scanned: int = 50_000
    """Events in which a readout's lines are looked for."""

    ticked: int = 1_000_000
    """Events in which ticks are looked for: of a slow clock, thousands of events share one."""

    gaps: int = 50
    """Gaps between stamps that differ, at most, where their common divisor is looked at."""

    in_turns: float = 0.8
    """Least share of events one step behind the one before that tells a bus from a clock, which has at most
    0.41 of them by chance."""


PATTERNS = PatternSettings()


@dataclass(frozen=True)
class TimestampStructure:
    """Regularities found in the time stamps of a measurement.

    Args:
        step: Time between the ticks of the clock [s]; 0 for none that is seen.
        line: Time from row to row of the readout [s]; 0 for none that is seen.
        direction: Where the readout goes.
    """

    NAMES: ClassVar = (
        "share of times at ticks of one clock",
        "share of times at which the pixel's line is read",
    )

    step: float = 0.0
    line: float = 0.0
    direction: str = "down"

    def shares(self, events: Events) -> NDArray[np.float64]:
        """Return the shares of events that follow each regularity, shape (2,); 0 where there is none."""
        out = np.zeros(2)
        if len(events) == 0:
            return out
        if self.step:
            out[0] = share_at(events.t, self.step)
        if self.line:
            lines, place = readout_lines(events, self.direction)
            out[1] = share_at(*scan_begins(events.t, place, self.line, lines))
        return out


def share_at(t: NDArray[np.float64], step: float, slack: float = 0.0) -> float:
    """Return the share of times whole steps apart, but for `slack` and the rounding of the file [s]."""
    turn = t / step
    phase = np.angle(np.exp(2j * np.pi * (turn - np.floor(turn))).mean()) / (2 * np.pi)
    late = turn - phase
    off = np.abs(late - np.round(late)) * step
    return float(np.mean(off <= _tolerance(step, slack)))


def is_certain(t: NDArray[np.float64], step: float, slack: float = 0.0) -> bool:
    """Whether times are as often whole steps apart as is certain, but for `slack` and rounding [s].

    If so, few of every fourth time are off, and the others are at nearly one phase. Where these are not, the
    rest is not looked at.
    """
    off = 4 * (1 - PATTERNS.certain)
    least = (1 - off) * math.cos(2 * math.pi * _tolerance(step, slack) / step) - off
    turn = t[::4] / step
    angle = (2 * np.pi * (turn - np.floor(turn))).astype(np.float32)  # exact enough
    if math.hypot(np.cos(angle).mean(), np.sin(angle).mean()) < least - 0.05:
        return False
    return share_at(t, step, slack) >= PATTERNS.certain


def _tolerance(step: float, slack: float) -> float:
    return max(min(1.1 * PATTERNS.file_step, 0.2 * step), slack)


def scan_begins(
    t: NDArray[np.float64], place: NDArray[np.float64], line: float, lines: int
) -> tuple[NDArray[np.float64], float, float]:
    """Return when scans begin, (N,), what one takes, and by how much it may be late [s].

    As the times tell at which a readout that goes from line to line is at the pixel's.

    Args:
        t: Times of events [s], shape (N,).
        place: Their lines in the order of the readout, shape (N,).
        line: Time of a line [s].
        lines: In a scan.
    """
    return t - place * line, lines * line, PATTERNS.pause * lines * line


def readout_lines(events: Events, direction: str) -> tuple[int, NDArray[np.float64]]:
    """Return the number of lines, and the line of each event in the order of the readout, (N,)."""
    upright = direction in ("down", "up")
    lines = events.height if upright else events.width
    place = (events.y if upright else events.x).astype(np.float64)
    return lines, lines - 1 - place if direction in ("up", "left") else place


def find_structure(events: Events) -> TimestampStructure:
    """Return the regularities of a measurement's time stamps: seen in the first events, true of all."""
    first = events.select(slice(PATTERNS.scanned))
    best = TimestampStructure()
    for direction in ("down", "up", "right", "left"):
        line = line_time(first, direction)
        if line > best.line:
            best = TimestampStructure(line=line, direction=direction)
    # all of them tell its length better
    if best.line:
        scan = best.line * readout_lines(events, best.direction)[0]
        best = replace(best, line=line_time(events, best.direction, scan))
    elif step := clock_period(events.t[: PATTERNS.ticked]):  # the lines of a scan are read at ticks too
        best = TimestampStructure(step=clock_period(events.t) if len(events) > PATTERNS.ticked else step)
    return best if best.shares(events).max() >= PATTERNS.certain else TimestampStructure()


def clock_period(t: NDArray[np.float64]) -> float:
    """Return the time between the ticks that all stamps are multiples of [s], 0 where there is none."""
    gaps = np.diff(t)
    gaps = gaps[gaps > PATTERNS.shortest]
    if len(gaps) < 50:
        return 0.0
    step = float(np.quantile(gaps, 0.02))
    step = refine_period(t, step)
    if not is_certain(t, step):
        step = common_divisor(gaps)
    regular = step > 0 and is_certain(t, step) and spread_over(t, step)
    return step if regular and not in_turns(t, step) else 0.0


def common_divisor(gaps: NDArray[np.float64]) -> float:
    """Return the time of which all gaps are multiples [s], where these are few; 0 where there is none.

    Where events come together, as those of a simulator do at each frame, no gap between stamps may be as
    short as a tick of the clock.

    Args:
        gaps: Between successive stamps [s], shape (N,).
    """
    each = np.unique(np.rint(gaps / PATTERNS.file_step).astype(np.int64))
    if not 2 <= len(each) <= PATTERNS.gaps:
        return 0.0
    step = int(np.gcd.reduce(each))
    told = step > 1 and step < each[0] and np.diff(each).min() == step
    return step * PATTERNS.file_step if told and step * PATTERNS.file_step > PATTERNS.shortest else 0.0


def in_turns(t: NDArray[np.float64], step: float) -> bool:
    """Whether stamps take one multiple after the other, each once: a bus that is never free sends so.

    To a clock, events come by chance: where there is one per tick in the mean, many ticks have several.
    """
    ticks_ = np.round((t - t[0]) / step)
    return float(np.mean(np.diff(ticks_) == 1)) >= PATTERNS.in_turns


def refine_period(t: NDArray[np.float64], step: float) -> float:
    """Return the step [s] near `step` that stamps (N,) in order are multiples of, from ever longer parts."""
    for span in np.geomspace(30 * step, max(float(t[-1]), 60 * step), 12):
        gone = t[: np.searchsorted(t, t[0] + span, side="right")] - t[0]
        ticks_ = np.round(gone / step)
        if ticks_[-1] > 0:
            step = float((ticks_ * gone).sum() / (ticks_ * ticks_).sum())
    return step


def spread_over(t: NDArray[np.float64], step: float) -> bool:
    """Whether stamps (N,) [s] at multiples of `step` are no accident of few distinct times."""
    return len(np.unique(np.round(t / step))) >= 20


def line_time(events: Events, direction: str, scan: float = 0.0) -> float:
    """Return the time from line to line of a readout [s], 0 where there is none in this direction.

    Args:
        events: In order of time.
        direction: In which it goes.
        scan: What a scan takes [s], where that is known; 0 where not.
    """
    lines, place = readout_lines(events, direction)
    order = np.argsort(place.astype(np.uint16), kind="stable")  # times are in order
    t, where = events.t[order], place[order]
    gaps = np.diff(t)[where[1:] == where[:-1]]
    gaps = gaps[gaps > PATTERNS.shortest]
    if len(gaps) < 50:
        return 0.0
    longer = gaps[gaps > PATTERNS.repeats]
    shortest = {float(np.quantile(some, 0.02)) for some in (gaps, longer) if len(some) >= 50}
    tried = [gap / many for many in range(1, PATTERNS.multiples + 1) for gap in sorted(shortest)]
    # all stamps of a line are at one phase of the scan; phases of lines follow each other
    busiest = t[where == np.bincount(where.astype(np.int64), minlength=lines).argmax()]
    for start in [scan] if scan else tried:
        line = refine_period(busiest, start) / lines
        if line > 0 and is_certain(*scan_begins(events.t, place, line, lines)):
            return line
    return 0.0
