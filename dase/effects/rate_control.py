"""The controller of a camera's own logic that keeps its event rate below a limit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Observations, choice, parameter
from dase.effects.made_signatures import Makes
from dase.effects.stream import (
    Others,
    SharedReader,
    StreamEffect,
    random_numbers,
    to_nanosecond,
    to_nanoseconds,
)
from dase.errors import InputError
from dase.events import Events


class Dropper(SharedReader):
    """Passes a share of the events of each period, by how many came in the period before.

    Args:
        period: [ns]
        most: Events that may pass in a period.
        drop: How events are chosen: "even", "random" or "last".
        random: Random numbers, in the order of the events.
    """

    def __init__(self, period: int, most: float, drop: str, random: np.random.Generator):
        self._period, self._most, self._drop, self._random = period, most, drop, random
        self._turn = -(1 << 62)  # number of the last period that had events
        self._before, self._came = 0.0, 0.0  # events of the period before that one, and of it so far

    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Give the events that pass, at once."""
        return self.beside(events, Others.none(), np.ones(2)), until

    def beside(self, events: Events, others: Others, weight: NDArray[np.float64]) -> Events:
        """Return those of some events that pass beside others, see `SharedReader.beside`.

        Args:
            events: Sorted by time.
            others: They count for the rate, and are not returned.
            weight: How many OFF and ON events each of the others stands for, shape (2,).
        """
        draws = self._random.random(len(events))
        own = to_nanoseconds(events.t)
        at = np.concatenate([own, others.time // 1000])
        if not len(at):
            return events
        order = np.argsort(at, kind="stable")
        turn = at[order] // self._period
        each = np.concatenate([np.ones(len(own)), weight[others.polarity]])[order]
        first = np.flatnonzero(np.diff(turn, prepend=turn[0] - 1))  # event with which each period begins
        periods, number = turn[first], np.cumsum(np.diff(turn, prepend=turn[0]) != 0)
        sums = np.add.reduceat(each, first)
        goes_on = periods[0] == self._turn
        came = sums + np.r_[self._came if goes_on else 0.0, np.zeros(len(sums) - 1)]
        before = np.r_[0.0, came[:-1]]
        before[0] = self._before if goes_on else self._came
        after_a_pause = (
            np.diff(periods, prepend=periods[0] if goes_on else self._turn + 1)
            != (np.r_[0, np.ones(len(periods) - 1)])
        )
        before[after_a_pause] = 0.0
        so_far = np.cumsum(each) - each - (np.cumsum(sums) - sums)[number]
        so_far += np.where(number == 0, self._came if goes_on else 0.0, 0.0)
        share = np.minimum(1.0, self._most / np.maximum(before, 1e-9))[number]
        self._turn, self._before, self._came = int(periods[-1]), float(before[-1]), float(came[-1])
        if self._drop == "last":
            passes = so_far < self._most
            if len(others.time):
                self._draw_ties(passes, at[order], each, so_far)
        elif self._drop == "even":
            # a hair more, so that a share of 1 is not less by rounding
            passes = np.floor((so_far + 1) * share + 1e-9) > np.floor(so_far * share + 1e-9)
        else:
            passes = np.concatenate([draws, np.zeros(len(others.time))])[order] < share
        kept = np.zeros(len(at), np.bool_)
        kept[order] = passes
        return events.select(kept[: len(own)])

    def _draw_ties(
        self,
        passes: NDArray[np.bool_],
        at: NDArray[np.int64],
        each: NDArray[np.float64],
        so_far: NDArray[np.float64],
    ) -> None:
        """Let chance say which of the events at one time pass where some of them do.

        Else some events would always pass before others, where many are of one time, as those of a frame.

        Args:
            passes: Which events do, as they are in order; changed in place, shape (N,).
            at: Their times, ascending [ns], shape (N,).
            each: How many events each stands for, shape (N,).
            so_far: How many came before it in its period, shape (N,).
        """
        begins = np.flatnonzero(np.diff(at, prepend=at[0] - 1))
        # only where some of one time pass and others do not
        mixed = np.logical_or.reduceat(passes, begins) & ~np.logical_and.reduceat(passes, begins)
        if not mixed.any():
            return
        run = np.cumsum(np.diff(at, prepend=at[0]) > 0)
        some = np.flatnonzero(mixed[run])
        some = some[np.lexsort((self._random.random(len(some)), run[some]))]
        before = np.cumsum(each[some]) - each[some]
        starts = np.flatnonzero(np.diff(run[some], prepend=run[some[0]] - 1))
        room = self._most - so_far[begins[run[some[starts]]]]
        length = np.diff(np.append(starts, len(some)))
        passes[some] = before - np.repeat(before[starts], length) < np.repeat(room, length)


@dataclass(frozen=True, kw_only=True)
class RateControl(StreamEffect):
    """A camera's controller that keeps its event rate below a limit (ERC).

    So that its output never stalls, a Prophesee sensor counts its events and leaves some out as soon as they
    are too many, spread evenly in time rather than all of a burst. Users set the limit, 20 million events per
    second unless they do.

    Time is cut into periods of `period` seconds, in which `rate` · `period` events may pass. When n events
    came in the period before, the share min(1, `rate` · `period` / n) of them passes: every so manieth
    (`drop = "even"`) or each at random (`"random"`). So a steady stream leaves at `rate`, and a sudden one
    passes whole for one period. With `drop = "last"` those pass that come first in each period, a hard limit.

    The reference period (200 us) and the count of events in it (4000) are published as OpenEB sets them; that
    the share comes from the period before is the plainest rule with such a reference, not published. Sensors
    can also leave out rows and columns, which is off unless it is switched on, and not modelled.
    """

    name: ClassVar[str] = "rate_control"
    source: ClassVar[str] = (
        "Prophesee: Metavision documentation, Event Signal Processing (event rate control), 2024; OpenEB, "
        "facility I_ErcModule and its defaults for Gen4.1, 2024; Finateu et al.: A 1280x720 back-illuminated "
        "stacked temporal contrast event-based vision sensor with 4.86 um pixels, 1.066 GEPS readout, "
        "programmable event-rate controller and compressive data-formatting pipeline, 2020"
    )
    per_pixel: ClassVar[bool] = False
    # a share that comes from the period before is no number of events that none exceeds
    signatures: ClassVar = (Makes("rate limit", tells=True, absence=False),)

    rate: float = parameter(
        2e7,
        unit="Hz",
        off=math.inf,
        bounds=(1.0, math.inf),
        plausible=(1e5, 3e8),
        about="most events per second, of the whole sensor",
        fitted=False,  # set by the user
    )
    period: float = parameter(
        2e-4,
        unit="s",
        bounds=(1e-9, 10.0),
        plausible=(1e-4, 1e-2),
        about="in which events are counted",
        fitted=False,
    )
    drop: str = choice("even", among=("even", "random", "last"), about="which events are left out")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate * self.period < 1:
            raise InputError(
                f"rate_control.rate must let an event pass in each period of {self.period:g} s, "
                f"got {self.rate:g} Hz"
            )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return nothing: a limit is seen, and a bus explains what a share does."""
        return []

    def is_idle(self, highest_rate: float) -> bool:
        """Whether it lets everything pass, in periods with several times the mean of events, too."""
        return highest_rate < 0.2 * self.rate

    def for_share(self, share: float) -> RateControl:
        """Return the controller of a share of the pixels: periods in which as many events may pass."""
        period = max(self.period, 1.0 / (self.rate * share)) if self.rate < math.inf else self.period
        return replace(self, rate=self.rate * share, period=period)

    def reader(self, width: int, height: int, seed: int) -> Dropper:
        """Return the controller of one sensor."""
        most = round(self.rate * self.period, 6)  # a whole number of events may be a bit off
        return Dropper(to_nanosecond(self.period), most, self.drop, random_numbers(seed, self.name))
