"""What a readout effect is to dase: it acts on the stream of events between the pixels and the file."""

from __future__ import annotations

import math
import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase.effects.base import Effect
from dase.errors import checked_seed
from dase.events import Events
from dase.kernels import launch

FOREVER = 1 << 62
"""A time that never comes [ns]."""


class Reader(ABC):
    """One readout effect at work on one stream; remembers what it needs from part to part."""

    @abstractmethod
    def push(self, events: Events, until: float) -> tuple[Events, float]:
        """Take a part of the stream and return what can leave.

        Args:
            events: Sorted by time; they follow those of the parts before.
            until: No later part begins earlier [s]; infinity after the last one, when everything must leave.

        Returns:
            Events in order of time, none earlier than any returned before, and the time before which none
            will come any more [s].
        """


@dataclass(frozen=True, eq=False)
class Others:
    """Events that take their turns on a bus and are not looked at.

    Args:
        time: When they get there, not decreasing [ps], shape (M,).
        polarity: 1 for ON, shape (M,).
        x: Columns of their pixels, shape (M,).
        y: Rows of their pixels, shape (M,).
    """

    time: NDArray[np.int64]
    polarity: NDArray[np.uint8]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]

    @classmethod
    def of(cls, events: Events) -> Others:
        """Return events as such that are not looked at."""
        time, polarity = 1000 * to_nanoseconds(events.t), events.p.astype(np.uint8)
        return cls(time, polarity, events.x, events.y)

    @classmethod
    def none(cls) -> Others:
        """Return no others."""
        return cls.of(Events.empty(1, 1))


class SharedReader(Reader):
    """A readout effect in which the events of all pixels take turns: those of some depend on the others'."""

    @abstractmethod
    def beside(self, events: Events, others: Others, weight: NDArray[np.float64]) -> Events:
        """Return those of some events that find room beside others that go the same way.

        Args:
            events: Sorted by time.
            others: They take room and time, and are not returned.
            weight: How many OFF and ON events each of the others stands for, shape (2,).
        """


@dataclass(frozen=True)
class StampPattern:
    """A regularity that a readout gives to time stamps.

    Args:
        period: From tick to tick of a clock [s], 0 for none.
        line_time: From line to line of a readout that visits them in turn [s], 0 for none.
        direction: Where that readout goes: down, up, right or left.
    """

    period: float = 0.0
    line_time: float = 0.0
    direction: str = "down"


@dataclass(frozen=True, kw_only=True)
class StreamEffect(Effect):
    """A physical effect between the pixels and the file.

    Its stages are empty; `reader` gives the object that works on the stream. What comes out must not depend
    on how the stream is cut into parts. Its parameters have no place in a parameter vector, for the pixels of
    a batch do not know of them.
    """

    stages: ClassVar = {}
    per_pixel: ClassVar[bool] = True
    """Whether what becomes of an event does not depend on other pixels, so that some of them can be
    simulated alone; what all pixels share is left out where events are counted pixel by pixel."""

    def longest_delay(self, lines: int) -> float:
        """Return about how late it makes events of a sensor of so many lines [s]; infinity for any time.

        Where that is far below the steps in which statistics see time, a fit leaves the effect out.
        """
        return math.inf

    def is_idle(self, highest_rate: float) -> bool:
        """Whether it does nothing that statistics see while events never come faster than this [Hz].

        A fit then leaves the effect out, and its parameters as they are unless they are named.
        """
        return False

    def for_share(self, share: float) -> StreamEffect:
        """Return this effect as a share of the pixels feels it, where all others are left out."""
        return self

    def clock_period(self) -> float | None:
        """Return the ticks to which times are rounded down [s], None where the effect does anything else.

        Kernels stamp events by such a clock themselves, ten times as fast as events are stored and read out;
        counts leave it out.
        """
        return None

    def stamp_pattern(self) -> StampPattern | None:
        """Return the regularity that the time stamps get, None for none."""
        return None

    @abstractmethod
    def reader(self, width: int, height: int, seed: int) -> Reader:
        """Return a reader for one stream of a sensor of `width` columns and `height` rows."""


def random_numbers(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of the readout effect `name`; they come in the order of the events."""
    return np.random.default_rng([checked_seed(seed), zlib.crc32(name.encode())])


def to_nanoseconds(seconds: ArrayLike) -> NDArray[np.int64]:
    """Return times [s], of any shape, as whole nanoseconds, in which readers reckon without rounding."""
    return np.rint(np.multiply(seconds, 1e9)).astype(np.int64)


def to_nanosecond(seconds: float) -> int:
    """Return a time in whole nanoseconds; infinity becomes `FOREVER`."""
    return FOREVER if seconds == math.inf else round(seconds * 1e9)


def to_seconds(nanoseconds: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return whole nanoseconds, of any shape, in seconds as the pixels do, to the bit."""
    out: NDArray[np.float64] = 1e-9 * nanoseconds.astype(np.float64)
    return out


def order_events(*columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices that sort by the first column, then the second and so on, then the index.

    Args:
        columns: Whole numbers, shape (N,) each.
    """
    count = len(columns[0])
    key, bits = np.zeros(2 * count, np.int64), 0  # the second half is room for the sort
    for column in columns if count else ():
        least = int(column.min())
        width = (int(column.max()) - least).bit_length()
        bits += width
        if bits > 62:
            return np.lexsort(columns[::-1])
        key[:count] = (key[:count] << width) | (column - least)
    # 20 ns per event, where np.argsort takes 35 to 60
    index, cpu = np.arange(2 * count, dtype=np.int32), launch.find_device("cpu")
    pairs = (wp.array(a, dtype=d, device=cpu, copy=False) for a, d in ((key, wp.int64), (index, wp.int32)))
    wp.utils.radix_sort_pairs(*pairs, count, begin_bit=0, end_bit=max(bits, 1))
    return index[:count].astype(np.int64)
