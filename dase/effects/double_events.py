"""Events that are sent twice."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.stream import (
    FOREVER,
    Reader,
    StreamEffect,
    order_events,
    random_numbers,
    to_nanosecond,
    to_nanoseconds,
    to_seconds,
)
from dase.events import Events


class Doubler(Reader):
    """Sends some events a second time.

    Args:
        shares: Of OFF and of ON events.
        delay: From an event to its double [ns].
        tail: Mean of what may be added to it [ns].
        spread: What may be added to it evenly, at most [ns].
        opposite: Whether a double has the other polarity.
        random: Random numbers, in the order of the events.
        empty: A stream without events.
    """

    longest: ClassVar[float] = 20.0
    """Largest addition in units of its mean; one in half a billion would be larger."""

    def __init__(
        self,
        shares: tuple[float, float],
        delay: float,
        tail: float,
        spread: float,
        opposite: bool,
        random: np.random.Generator,
        empty: Events,
    ):
        self._shares, self._delay, self._random = np.array(shares), delay, random
        self._tail, self._spread, self._opposite = tail, spread, opposite
        self._waiting, self._at, self._second = empty, np.empty(0, np.int64), np.empty(0, np.int64)

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give events, and the doubles that are due before `until`."""
        chance, more = self._random.random((len(events), 2)).T
        again = np.flatnonzero(chance < self._shares[events.p.astype(np.int64)])
        late = np.minimum(-np.log1p(-more[again]), self.longest) * self._tail + self._delay
        late += more[again] * self._spread
        own = to_nanoseconds(events.t)
        doubles = own[again] + np.maximum(np.rint(late), 1).astype(np.int64)
        second_time = events.select(again)
        if self._opposite:
            second_time = replace(second_time, p=~second_time.p.astype(np.bool_))
        joined = Events.concatenate([self._waiting, events, second_time])
        at: NDArray[np.int64] = np.concatenate([self._at, own, doubles])
        # of one time, events go before doubles, however the stream is cut
        second = np.concatenate([self._second, np.zeros(len(own), np.int64), np.ones(len(doubles), np.int64)])
        bound = to_nanosecond(until)
        leaves = (at < bound) | (bound == FOREVER)
        stays, index = np.flatnonzero(~leaves), np.flatnonzero(leaves)
        index = index[order_events(at[index], second[index])]
        self._waiting, self._at, self._second = joined.select(stays), at[stays], second[stays]
        return replace(joined.select(index), t=to_seconds(at[index])), until


@dataclass(frozen=True, kw_only=True)
class DoubleEvents(StreamEffect):
    """Events that are sent twice.

    Where the handshake between a pixel and its arbiter is slow, a pixel asks again before it is reset: an
    event has a double of the same pixel and polarity a microsecond or two later (some ten to some thousand,
    of either polarity, where a simulator makes them; where a clip's light does not change, those up to 5 ms
    are looked for). In two recordings of a
    DVS128 2.3 and 3.2 % of the events are such doubles, within 2 us, nearly all of them OFF; in one of a
    DAVIS240B 0.4 %, after 1 to 5 us. They tell nothing of the light, and count in all rates.

    An OFF event has a double with the probability `share`, an ON event with `share` · `on`. It comes `delay`
    later, and an exponentially distributed time of mean `tail` beyond, cut at 20 `tail`, or one that is drawn
    evenly up to `spread`, as simulators do (of both, the longer one beside the longer one). So the rate grows
    by the factor 1 + `share` (of OFF events), and in the histogram of intervals `share` is at `delay`.
    """

    name: ClassVar[str] = "double_events"
    source: ClassVar[str] = (
        "Seen in recordings of DVS128 and DAVIS240B; Boahen: Point-to-point connectivity between "
        "neuromorphic chips using address events, 2000 (the handshake)"
    )
    signatures: ClassVar = (Makes("double events", tells=True),)

    share: float = parameter(
        0.02,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.001, 0.1),
        about="of OFF events that have a double",
    )
    on: float = parameter(
        1.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 1.0),
        about="share of ON events that have one, relative to that of OFF events",
    )
    delay: float = parameter(
        6e-7,
        unit="s",
        bounds=(0.0, 1e-2),
        plausible=(1e-7, 2e-5),
        about="from an event to its double, at least",
        fitted=False,  # far below the steps in which statistics see time
    )
    tail: float = parameter(
        0.0,
        unit="s",
        bounds=(0.0, 1e-3),
        plausible=(0.0, 5e-6),
        about="mean of what is added to it",
        fitted=False,
    )
    spread: float = parameter(
        0.0,
        unit="s",
        bounds=(0.0, 1e-2),
        plausible=(0.0, 2e-5),
        about="what is added to it evenly, at most",
        fitted=False,
    )
    polarity: str = choice(
        "same", among=("same", "opposite"), about="of the double, relative to that of its event"
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return them where they are seen in the events themselves, see the signature of double events."""
        polarity = "opposite" if observed.double_opposite else "same"
        if not observed.double_gap:
            return []
        spread = observed.double_spread
        return [cls(delay=observed.double_gap - 0.5 * spread, spread=spread, polarity=polarity)]

    def longest_delay(self, lines: int) -> float:
        """Return infinity where there are doubles: they are more events, however soon they come."""
        return math.inf if self.share else 0.0

    def reader(self, width: int, height: int, seed: int) -> Doubler:
        """Return what doubles the events of one sensor."""
        return Doubler(
            (self.share, self.share * self.on), 1e9 * self.delay, 1e9 * self.tail, 1e9 * self.spread,
            self.polarity == "opposite", random_numbers(seed, self.name), Events.empty(width, height),
        )  # fmt: skip
