"""Looking for all signatures of a recording, in two passes over its events.

The first pass counts events by time; coupling with frames and flicker come from these. The second counts by
pixel, without the times that coupling explains; hot pixels come first, and are left out of what follows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io.rules import TooLateError
from dase.io.sequence import Sequence
from dase.io.source import CHUNK, ReadOptions
from dase.recordings.recording import Recording
from dase.signatures.calm_events import CalmFilter, CalmShare, row_major_pixels
from dase.signatures.clock import ClockCounts
from dase.signatures.double_events import IntervalCounts, find_double_events
from dase.signatures.fixed_pattern import HalfCounts, find_fixed_pattern
from dase.signatures.flicker import find_flicker
from dase.signatures.frame_coupling import BurstClock, doubt_faint_bursts, find_frame_coupling
from dase.signatures.full_bus import find_even_bus, find_full_bus
from dase.signatures.hot_pixels import CalmCounts, find_hot_pixels
from dase.signatures.kinds import FLICKER, GROUPING
from dase.signatures.opposite_pairs import PairCounts, find_opposite_pairs
from dase.signatures.rate_limit import EventTimes, find_rate_limit
from dase.signatures.result import Signature, Signatures, without_answer
from dase.signatures.row_grouping import GroupCounts, find_grouping
from dase.signatures.time_stamps import StampSettings, find_time_stamps

Source = Recording | Sequence | Events | str | PathLike[str]
Progress = Callable[[int], object]

COUNT = 10
"""Signatures that are tested, for the correction."""

ROWS_IN_TURN = 1.5e-3
"""From the first row to the last [s] from which on bursts group rows by themselves: a shutter that goes from
row to row takes 2 to 6 ms, a bus reads the array within one."""


@dataclass(frozen=True)
class _Passes:
    """Events that can be gone through again and again.

    Args:
        pieces: Gives the events anew, piece by piece.
        begins: When exposures begin [s], shape (F,); None where unknown.
    """

    pieces: Callable[[], Iterable[Events]]
    begins: NDArray[np.float64] | None

    def parts(self, chunk: int, progress: Progress) -> Iterator[Events]:
        """Yield parts of at most `chunk` events, none of them empty, and tell how many they were."""
        for piece in self.pieces():
            for i in range(0, len(piece), chunk):
                part = piece.select(slice(i, i + chunk))
                yield part
                progress(len(part))


class _FirstPass:
    """What is counted before anything is known."""

    def __init__(self, width: int, height: int):
        self.width, self.height = width, height
        self.clock = ClockCounts(width, height)
        self.times = EventTimes()
        self.count = 0
        self.pixels = np.zeros(width * height, np.int64)
        self.begin = self.end = 0.0
        self._first: list[Events] = []

    def push(self, events: Events) -> None:
        """Take events; raises InputError where they are not those of the sensor, or go back in time."""
        if not self.count:
            self.begin = self.end = float(events.t[0])
        if not (np.all(np.isfinite(events.t)) and events.t[0] >= self.end and np.all(np.diff(events.t) >= 0)):
            raise InputError("signatures: times of events must be finite and sorted")
        if int(events.x.max()) >= events.width or int(events.y.max()) >= events.height:
            raise InputError(f"signatures: events must lie on the {events.width}x{events.height} sensor")
        room = StampSettings.most - self.count
        if room > 0:
            self._first.append(events.select(slice(0, room)))
        self.count += len(events)
        self.end = float(events.t[-1])
        self.clock.push(events)
        self.times.push(events)
        self.pixels += np.bincount(row_major_pixels(events), minlength=len(self.pixels))

    def first_events(self) -> Events:
        """Return the first events, of which time stamps are looked at."""
        return Events.concatenate(self._first)

    def flooding(self) -> NDArray[np.bool_]:
        """Return pixels that send a hundred times the usual, shape (H * W,): their like flood any group."""
        active = self.pixels[self.pixels > 0]
        usual = float(active.mean()) if len(active) else 0.0
        return self.pixels > 100 * max(usual, 1.0)


class _SecondPass:
    """What is counted by pixel, free of bursts that come with frames."""

    def __init__(self, first: _FirstPass, bursts: BurstClock | None, rows_in_turn: bool):
        width, height = first.width, first.height
        self._bursts, self._rows_in_turn = bursts, rows_in_turn
        self._filter = CalmFilter(width, height)
        self.quiet = CalmShare(width, height, first.begin, self._filter)
        self.calm = CalmCounts(width, height, (first.begin + first.end) / 2)
        self.pairs = PairCounts(width, height)
        self.halves = HalfCounts(width, height, first.begin, first.end)
        self.groups = GroupCounts(first.count, first.flooding())
        self.groups_between = GroupCounts(first.count, first.flooding())
        self.intervals = IntervalCounts(width, height)

    def push(self, events: Events) -> None:
        """Take events."""
        self.groups.push(events)  # the order in which a burst of all pixels is read tells most of all
        if self._bursts is not None:
            events = events.select(~self._bursts.contains(events.t))
        if self._rows_in_turn:
            self.groups_between.push(events)
        self.halves.push(events)
        self.intervals.push(events)
        self.quiet.push(events)
        self._take_calm(*self._filter.push(events))

    def finish(self) -> None:
        """Take the events that were held back."""
        self._take_calm(*self._filter.flush())
        self.intervals.finish()

    def _take_calm(self, events: Events, calm: NDArray[np.bool_]) -> None:
        chosen = events.select(calm)
        self.calm.push(chosen)
        self.pairs.push(chosen)


def _open_passes(source: Source, notes: list[str] | None, options: ReadOptions) -> _Passes:
    """Return the events of a source, and the begins of its exposures."""
    if isinstance(source, Events):
        return _Passes(lambda: (source,), None)
    if isinstance(source, Recording):
        begins = source.frame_begin if source.frame_begin is not None else source.frame_times
        return _Passes(lambda: (source.events,), begins)
    if isinstance(source, Sequence):
        return _Passes(lambda: (source.events,), _sequence_begins(source))
    if not isinstance(source, str | PathLike):
        raise InputError(
            f"signatures: must be of a recording, a sequence, events or a file, got {type(source).__name__}"
        )
    path = Path(source)
    exposures = np.array([(p.t, p.exposure) for p in io.pictures(path, notes=notes, **options)]).reshape(
        -1, 2
    )
    begins = exposures[:, 0] - exposures[:, 1] / 2
    return _Passes(lambda: io.stream(path, notes=notes, **options), begins)


def _sequence_begins(sequence: Sequence) -> NDArray[np.float64] | None:
    if sequence.frame_times is None:
        return None
    half = 0.0 if sequence.frame_exposure is None else sequence.frame_exposure / 2
    out: NDArray[np.float64] = sequence.frame_times - half
    return out


def _run_first(passes: _Passes, chunk: int, progress: Progress) -> _FirstPass:
    first: _FirstPass | None = None
    for part in passes.parts(chunk, progress):
        first = first or _FirstPass(part.width, part.height)
        first.push(part)
    if first is None:
        raise InputError("signatures: there are no events")
    return first


def _find_grouping_beside(rows_in_turn: bool, counts: _SecondPass, level: float) -> Signature:
    """Return whether lines are read together, told between bursts that come from row to row themselves."""
    grouping = find_grouping(counts.groups, level)
    if not (grouping.found and rows_in_turn):
        return grouping
    between = find_grouping(counts.groups_between, level)
    if between.found:
        return between
    reason = "rows of the bursts come one after the other, and between bursts none stand out"
    return without_answer(GROUPING, reason, p=between.p)


def _without_periods(entry: Signature, limit: Signature) -> Signature:
    """Return a ceiling or a tone as no answer where periods of a limited rate make it.

    Args:
        entry: Of a full bus, or of flicker.
        limit: Of the rate, which is there.
    """
    if not entry.found:
        return entry
    if entry.name == FLICKER:
        turns = entry.details["frequency"] * limit.details["period"]
        if round(turns) < 1 or abs(turns - round(turns)) > 0.02:
            return entry
    elif "scatter" not in entry.details:
        return entry  # no two events come close to each other: no limit does that
    return without_answer(entry.name, "the rate is limited in even periods", p=entry.p)


def find_signatures(
    source: Source,
    *,
    begins: NDArray[np.float64] | None = None,
    notes: list[str] | None = None,
    progress: Progress = lambda count: None,
    level: float = 1e-4,
    chunk: int = CHUNK,
    **options: Unpack[ReadOptions],
) -> Signatures:
    """Say which effects a recording shows by itself, without a scene or a model.

    All events are gone through twice, in memory that does not grow with the recording.

    Args:
        source: A recording, a sequence, events, or the path of a file, which streams through.
        begins: Begins of the exposures of frames on the clock of the events [s], shape (F,); None for those
            of the source.
        notes: Gets sentences about what was skipped, repaired or guessed in a file.
        progress: Is told how many events were looked at since it was told last, in both passes.
        level: Chance that a recording without effects announces any; shared out over the signatures.
        chunk: Events looked at together; the answer does not depend on it.
        options: What the user says about a file, see `dase.io.source.ReadOptions`.

    Returns:
        One answer for each signature, "cannot say" where data are too few.

    Raises:
        InputError: The file cannot be read, or events are not sorted or lie outside the sensor.
    """
    if not 0 < level < 1:
        raise InputError(f"signatures: level must lie between 0 and 1, got {level:g}")
    if chunk < 1:
        raise InputError(f"signatures: chunk must be at least 1 event, got {chunk}")
    passes = _open_passes(source, notes, options)
    try:
        first = _run_first(passes, chunk, progress)
    except TooLateError:  # times go back too far to be sorted on the way
        assert isinstance(source, str | PathLike)
        passes = _open_passes(io.read(source, notes=notes, **options), notes, options)
        first = _run_first(passes, chunk, progress)
    width, height = first.width, first.height
    each, duration = level / COUNT, first.end - first.begin
    begins = passes.begins if begins is None else begins
    if begins is not None and not (len(begins) and np.all(np.isfinite(begins))):
        begins = None  # frames without times
    coupling, bursts = find_frame_coupling(first.clock, each, begins)
    if bursts is not None and begins is None:  # they were seen in the clock's time alone
        bursts = bursts.extend(first.end)
    # bursts alone that nearly keep time: p decides between them and a lamp no better than that
    doubtful = coupling.details.get("interval", 0.0) if bursts is None and begins is None else 0.0
    flicker, lamp = find_flicker(first.clock, each, bursts, doubtful if coupling.p < 0.01 else 0.0)
    # what the whole array follows confounds in the same way, be it a lamp or bursts that are hardly seen
    lit = lamp is not None or (flicker.p < each and flicker.size >= flicker.least)
    rows_in_turn = abs(coupling.details.get("row_delay", 0.0)) >= ROWS_IN_TURN
    second = _SecondPass(first, bursts, rows_in_turn)
    for part in passes.parts(chunk, progress):
        second.push(part)
    second.finish()
    look_for_hot = partial(
        find_hot_pixels, second.calm, second.quiet.share(first.end), duration, each,
        lamp=lamp.frequency if lamp else 0.0,
    )  # fmt: skip
    hot, hot_pixels = look_for_hot()
    even_bus = find_even_bus(first.first_events(), each)
    # what a bus sends evenly comes at multiples of its time for one event
    stamps = find_time_stamps(first.first_events(), hot_pixels, each, repeats=lit or even_bus is not None)
    tick = max(stamps.details.get(name, 0.0) for name in ("step", "period")) if stamps.found else 0.0
    if tick and "packets" not in stamps.details and not hot.found:
        hot, hot_pixels = look_for_hot(tick=tick)
    if "faint" in coupling.details and stamps.found:
        coupling = doubt_faint_bursts(coupling, stamps.details.get("step", 0.0), first.clock)
    limit = find_rate_limit(first.times, int(np.count_nonzero(first.pixels)), each)
    bus = even_bus or find_full_bus(first.clock, first.first_events(), each, tick)
    if limit.found:
        flicker, bus = _without_periods(flicker, limit), _without_periods(bus, limit)
    entries = (
        coupling,
        flicker,
        hot,
        find_opposite_pairs(second.pairs, hot_pixels, duration, each, lamp=lit),
        find_fixed_pattern(second.halves, hot_pixels, each, first.first_events()),
        _find_grouping_beside(rows_in_turn, second, each),
        stamps,
        find_double_events(second.intervals, hot_pixels, each, tick),
        bus,
        limit,
    )
    return Signatures(width, height, first.count, duration, level, entries)
