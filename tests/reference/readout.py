"""Plain twins of readout effects: loops over events, from what the effects say they do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

Event = tuple[int, int, int, int]
"""Time [ns], column, row, polarity."""


@dataclass
class Held:
    """A pixel behind an arbiter: its own events, and when the arbiter let it go."""

    last: Fraction | None = None
    polarity: int = -1
    interval: Fraction = Fraction(0)
    freed: Fraction = Fraction(-(10**18))
    asks: tuple[Fraction, int] | None = None  # late request: when, which
    waits: int | None = None


def until_share(held: Fraction, interval: Fraction, one_before: Fraction) -> Fraction | None:
    """Return in how long light goes on by held / interval of a threshold, None where it turns before [ns].

    The thresholds at -2, -1 and 0 were crossed after `one_before` and `interval`; a parabola goes through.
    Less than a thousandth of a threshold is no matter.
    """
    if 1000 * held < interval:
        return Fraction(0)
    if not one_before or float(interval) > 2.414 * float(one_before):
        return held
    times = np.array([-float((interval + one_before) / interval), -1.0, 0.0])
    bend, speed, _ = np.polyfit(times, [-2.0, -1.0, 0.0], 2)
    roots = (
        np.roots([bend, speed, -float(held / interval)]) if abs(bend) > 1e-12 else [float(held / interval)]
    )
    ahead = [float(np.real(r)) for r in roots if abs(np.imag(r)) < 1e-12 and np.real(r) > 0]
    return Fraction(min(ahead)) * interval if ahead and speed > 0 else None


def read_by_lines(events: list[Event], line: Fraction, event: Fraction, across: bool = False) -> list[Event]:
    """Return what an arbiter sends that takes a row (column, if `across`) at a time.

    Args:
        events: In order of time.
        line: Time to take a row [ns].
        event: Time to send one of its events [ns].
        across: Whether it reads columns.
    """
    pixels: dict[tuple[int, int], Held] = {}
    since: dict[int, Fraction] = {}  # rows with requests, in the order of their first
    free, out, ahead = Fraction(-(10**18)), [], list(events)

    def ask(place: tuple[int, int], at: Fraction, polarity: int) -> None:
        pixels[place].waits, pixels[place].asks = polarity, None
        since.setdefault(place[0], at)

    while True:
        due = min(((p.asks[0], place) for place, p in pixels.items() if p.asks), default=(math.inf, (0, 0)))
        raw = Fraction(ahead[0][0]) if ahead else math.inf
        taken = next(iter(since), None)
        begin = math.inf if taken is None else max(free, since[taken])
        if begin < min(due[0], raw):
            there = sorted(place for place, p in pixels.items() if p.waits is not None and place[0] == taken)
            free = begin + line + len(there) * event
            for place in there:
                x, y = place if across else place[::-1]
                out.append((math.floor(begin), x, y, pixels[place].waits))
                pixels[place].waits, pixels[place].freed = None, free
            del since[taken]
        elif due[0] <= raw and due[0] < math.inf:
            ask(due[1], due[0], pixels[due[1]].asks[1])
        elif ahead:
            _, x, y, polarity = ahead.pop(0)
            place = (x, y) if across else (y, x)
            pixel = pixels.setdefault(place, Held())
            before, again = pixel.last, pixel.polarity == polarity
            one_before = pixel.interval
            pixel.last, pixel.polarity = raw, polarity
            pixel.interval = raw - before if again else Fraction(0)
            if pixel.waits is not None or raw < pixel.freed:
                continue
            if pixel.asks:
                wanted, pixel.asks = pixel.asks[1], None
                if wanted == polarity:
                    ask(place, raw, polarity)
            elif before is not None and again and pixel.freed > before:
                late = until_share(pixel.freed - before, pixel.interval, one_before)
                if late == 0:
                    ask(place, raw, polarity)
                else:
                    pixel.asks = (math.inf if late is None else raw + late, polarity)
            else:
                ask(place, raw, polarity)
        else:
            return out


def watch_light(
    level: np.ndarray, step: float, threshold: float, line: float, event: float, width: int
) -> list[tuple[float, int, int]]:
    """Return what an arbiter sends whose pixels see the light themselves: (t [s], pixel, polarity).

    A pixel compares the light with its memory at each step; while it waits or is read it does not, and its
    memory is the light at the end.

    Args:
        level: Log intensity, in steps short beside all else, shape (K, N), row after row.
        step: [s]
        threshold: Of both polarities [log intensity].
        line: Time to take a row [s].
        event: Time to send one of its events [s].
        width: Pixels of a row.
    """
    memory, held = level[0].copy(), np.full(level.shape[1], -math.inf)
    asks, since = np.zeros(level.shape[1], int), {}
    free, out = -math.inf, []
    for k in range(1, len(level)):
        t = k * step
        while since and max(free, since[next(iter(since))]) <= t:
            row = next(iter(since))
            begin = max(free, since.pop(row))
            there = [i for i in range(row * width, (row + 1) * width) if asks[i]]
            free = begin + line + len(there) * event
            for i in there:
                out.append((begin, i, int(asks[i] > 0)))
                asks[i], held[i] = 0, free
                memory[i] = np.nan  # until it is let go
        let_go = np.isnan(memory) & (held <= t)
        memory[let_go] = level[k, let_go]
        change = np.nan_to_num(level[k] - memory)
        for i in np.flatnonzero((np.abs(change) >= threshold) & (asks == 0)):
            asks[i] = int(np.sign(change[i]))
            since.setdefault(i // width, t)
    return out


def places_in_bursts(events: list[Event], gap: int) -> list[int]:
    """Return each event's place in the burst of its pixel; `gap` [ns] at most between two of a burst."""
    last: dict[tuple[int, int], tuple[int, int, int]] = {}
    out = []
    for t, x, y, p in events:
        before = last.get((x, y))
        place = before[2] + 1 if before and before[1] == p and t - before[0] <= gap else 1
        last[x, y] = t, p, place
        out.append(place)
    return out


def flickering(events: list[Event], low: float, high: float, start: int, stop: int) -> list[bool]:
    """Return of each event whether its region of 4x4 pixels flickers at `low` to `high` [Hz]."""
    regions: dict[tuple[int, int], dict] = {}
    out = []
    for t, x, y, p in events:
        region = regions.setdefault((x // 4, y // 4), {"p": None, "begin": None, "count": 0, "on": False})
        if p and region["p"] != 1:
            if region["begin"] is not None:
                period = (t - region["begin"]) * 1e-9
                fits = 1 / high - 2e-9 <= period <= 1 / low + 2e-9
                region["count"] = min(max(region["count"] + (1 if fits else -1), 0), max(7, start))
            region["begin"] = t
            if region["count"] >= start:
                region["on"] = True
            elif region["count"] < stop:
                region["on"] = False
        region["p"] = p
        out.append(region["on"])
    return out


def within_rate(events: list[Event], most: float, period: int, drop: str, draws: np.ndarray) -> list[bool]:
    """Return of each event whether a controller passes it.

    Args:
        events: In order of time.
        most: Events that may pass in a period.
        period: [ns]
        drop: even, random or last.
        draws: A random number in 0..1 for each event.
    """
    came: dict[int, int] = {}
    out = []
    for (t, *_), draw in zip(events, draws, strict=True):
        turn = t // period
        n = came.get(turn, 0)
        share = Fraction(1)
        if came.get(turn - 1, 0) > most:
            share = Fraction(most) / came[turn - 1]
        if drop == "last":
            out.append(n < most)
        elif drop == "random":
            out.append(bool(draw < share))
        else:
            out.append(math.floor((n + 1) * share) > math.floor(n * share))
        came[turn] = n + 1
    return out


def doubled(
    events: list[Event],
    shares: tuple[float, float],
    delay: float,
    tail: float,
    draws: np.ndarray,
    opposite: bool = False,
    spread: float = 0.0,
) -> list[Event]:
    """Return events and the doubles of some.

    Args:
        events: In order of time.
        shares: Of OFF and ON events that have a double.
        delay: From an event to its double [ns].
        tail: Mean of what is added to it [ns].
        draws: Two random numbers for each event, shape (N, 2).
        opposite: Whether doubles have the other polarity.
        spread: What is added evenly, at most [ns].
    """
    out = [(event[0], 0, n, event) for n, event in enumerate(events)]
    for n, (event, (chance, more)) in enumerate(zip(events, draws, strict=True)):
        if chance < shares[event[3]]:
            late = delay + min(-math.log(1 - more), 20.0) * tail + more * spread
            later = event[0] + max(round(late), 1)
            polarity = 1 - event[3] if opposite else event[3]
            out.append((later, 1, n, (later, *event[1:3], polarity)))
    return [event for *_, event in sorted(out)]
