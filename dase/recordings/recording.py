"""Recordings of a real camera: events, and where it has them frames, on one clock, checked and reported.

    recording = open_recording("recording.aedat4")
    print(*recording.report.odd, sep="\\n")
    recording = recording.masked(~recording.hot).slice(1.0, 3.0)
    train, held_out = recording.split_time(blocks=10, share=0.3)      # spans of time, for training and beside
    fit, check = recording.split_pixels(share=0.5, seed=1)            # indices of pixels
    events = recording.at_pixels(fit)

What a recording returns from `slice`, `crop` and `masked` is a recording again; its clock stays that of the
file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase import io
from dase.errors import InputError, checked_seed
from dase.events import Events
from dase.formatting import fit_to_screen
from dase.io.sequence import Sequence
from dase.io.source import Kind, Motion, Note, ReadOptions
from dase.recordings.anomalies import find_anomalies
from dase.recordings.statistics import Statistics, survey_sequence


def mask_of_region(region: tuple[int, int, int, int], width: int, height: int) -> NDArray[np.bool_]:
    """Return which pixels of a sensor lie in a region, shape (height, width).

    Args:
        region: First column and row, columns and rows.
        width: Columns of the sensor.
        height: Rows of the sensor.

    Raises:
        InputError: The region is empty or not on the sensor.
    """
    x, y, columns, rows = region
    if min(x, y) < 0 or min(columns, rows) < 1:
        raise InputError(f"a region must be x,y,w,h with w and h at least 1, got {region}")
    if x + columns > width or y + rows > height:
        raise InputError(f"the region {columns}x{rows} from {x},{y} is not on the {width}x{height} sensor")
    mask = np.zeros((height, width), np.bool_)
    mask[y : y + rows, x : x + columns] = True
    return mask


@dataclass(frozen=True, repr=False)
class RecordingReport:
    """What was noticed when a recording was opened.

    Args:
        notes: Sentences, each with the fields `kind`, `rule` and `number`; see `dase.io.Note`.
        statistics: What was counted.
    """

    notes: tuple[Note, ...]
    statistics: Statistics

    def __repr__(self) -> str:
        count = len(self.notes)
        notes = [f"  {note.kind}: {note}" for note in self.notes]
        return fit_to_screen([f"Report of {count} note{'s' if count != 1 else ''}", *notes], rows=20)

    def _of(self, kind: Kind) -> tuple[Note, ...]:
        return tuple(note for note in self.notes if note.kind == kind)

    @property
    def repaired(self) -> tuple[Note, ...]:
        """What was put right: times sorted, clocks continued, sizes turned."""
        return self._of("repaired")

    @property
    def refused(self) -> tuple[Note, ...]:
        """What was left out: damage, events outside the sensor."""
        return self._of("refused")

    @property
    def odd(self) -> tuple[Note, ...]:
        """What looks wrong but was left alone."""
        return self._of("odd")


@dataclass(frozen=True, repr=False)
class Recording:
    """What a camera recorded.

    Args:
        events: The events, sorted by time [s].
        begin: Begin of the recording [s].
        end: End of the recording [s], after its last event.
        mask: Trusted pixels, bool, shape (H, W). Others have no events here and take part in nothing.
        hot: Pixels that flood the recording, bool, shape (H, W). They are trusted until you mask them.
        report: What was noticed when it was opened.
        frames: Grey images, uint8, uint16 or float, shape (F, H, W); None without any.
        frame_times: Middle of each exposure [s], float64, shape (F,); None where unknown.
        frame_begin: Begin of each exposure [s], float64, shape (F,); None where unknown.
        frame_end: End of each exposure [s], float64, shape (F,); None where unknown.
        motion: Samples of the motion sensor, see `dase.io.Motion`; None without any.

    Raises:
        InputError: Shapes disagree, events lie outside the sensor or the time, or exposures run backwards.
    """

    events: Events
    begin: float
    end: float
    mask: NDArray[np.bool_]
    hot: NDArray[np.bool_]
    report: RecordingReport
    frames: NDArray[Any] | None = None
    frame_times: NDArray[np.float64] | None = None
    frame_begin: NDArray[np.float64] | None = None
    frame_end: NDArray[np.float64] | None = None
    motion: Motion | None = None

    def __post_init__(self) -> None:
        shape = (self.height, self.width)
        for name in ("mask", "hot"):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.bool_:
                raise InputError(
                    f"recording: {name} must be bool of shape {shape}, got {array.dtype} {array.shape}"
                )
        t = self.events.t
        if not self.begin <= self.end or (len(t) and not (self.begin <= t[0] and t[-1] < self.end)):
            raise InputError(f"recording: events must lie in {self.begin:g}..{self.end:g} s")
        if len(t) and not (np.all(t[1:] >= t[:-1]) and np.all(np.isfinite(t[[0, -1]]))):
            raise InputError("recording: times must be finite and sorted")
        if len(t) and (int(self.events.x.max()) >= self.width or int(self.events.y.max()) >= self.height):
            raise InputError(f"recording: events must lie on the {self.width}x{self.height} sensor")
        self._check_frames(shape)

    def _check_frames(self, shape: tuple[int, int]) -> None:
        count = 0 if self.frames is None else len(self.frames)
        if self.frames is not None and self.frames.shape != (count, *shape):
            want = f"(F, {shape[0]}, {shape[1]})"
            raise InputError(f"recording: frames must have shape {want}, got {self.frames.shape}")
        for name in ("frame_times", "frame_begin", "frame_end"):
            array = getattr(self, name)
            if array is not None and (array.shape != (count,) or not np.all(np.diff(array) >= 0)):
                raise InputError(f"recording: {name} must be {count} times that do not go back")
        if (self.frame_begin is None) != (self.frame_end is None):
            raise InputError("recording: frame_begin and frame_end go together")
        if (
            self.frame_begin is not None
            and self.frame_end is not None
            and np.any(self.frame_end < self.frame_begin)
        ):
            raise InputError("recording: an exposure must not end before it begins")

    def __repr__(self) -> str:
        frames = "no frames" if self.frames is None else f"{len(self.frames)} frames"
        masked = self.mask.size - int(self.mask.sum())
        lines = [
            f"Recording of {self.width}x{self.height} pixels, {self.begin:.6g} s to {self.end:.6g} s",
            f"  {self.events}",
            f"  {frames}, {'no ' if self.motion is None else ''}samples of the motion sensor",
            f"  {int(self.hot.sum())} hot pixels, {masked} masked",
            *(f"  {note.kind}: {note}" for note in self.report.notes),
        ]
        return fit_to_screen(lines)

    @classmethod
    def of(cls, sequence: Sequence, notes: Iterable[str] = ()) -> Recording:
        """Return the recording of a sequence, with a report of what looks odd.

        Args:
            sequence: Events and frames as a file gives them, or a simulation.
            notes: What reading it said.
        """
        looked = survey_sequence(sequence)
        found = looked.statistics()
        said = [note if isinstance(note, Note) else Note(note) for note in notes]
        # spans are half-open, so that the last event lies in them only if they end behind it
        begin, end = found.begin, np.nextafter(found.begin + found.duration, np.inf)
        if len(sequence.events):
            end = max(end, np.nextafter(sequence.events.t[-1], np.inf))
        times, exposure = sequence.frame_times, sequence.frame_exposure
        first = last = None
        if times is not None and exposure is not None:
            first, last = times - exposure / 2, times + exposure / 2
            begin, end = min(begin, float(first[0])), max(end, float(last[-1]))
        return cls(
            sequence.events,
            float(begin),
            float(end),
            np.ones((sequence.events.height, sequence.events.width), np.bool_),
            looked.hot_pixels(),
            RecordingReport((*said, *find_anomalies(found)), found),
            sequence.frames,
            times,
            first,
            last,
        )

    @property
    def width(self) -> int:
        """Columns of the sensor."""
        return self.events.width

    @property
    def height(self) -> int:
        """Rows of the sensor."""
        return self.events.height

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.end - self.begin

    @property
    def exposures(self) -> NDArray[np.float64] | None:
        """Begin and end of each exposure [s], shape (F, 2); None where unknown."""
        if self.frame_begin is None or self.frame_end is None:
            return None
        return np.stack([self.frame_begin, self.frame_end], axis=1)

    @property
    def pixels(self) -> NDArray[np.int32]:
        """Row-major indices of the trusted pixels, increasing, shape (N,)."""
        return np.flatnonzero(self.mask).astype(np.int32)

    def crop(self, x: int, y: int, width: int, height: int) -> Recording:
        """Return the part of the sensor that begins at column `x` and row `y`.

        Raises:
            InputError: It does not lie on the sensor.
        """
        inside = 0 <= x < x + width <= self.width and 0 <= y < y + height <= self.height
        if not inside:
            part, sensor = f"{width}x{height} at ({x}, {y})", f"{self.width}x{self.height}"
            raise InputError(f"crop: must lie on the {sensor} sensor, got {part}")
        e = self.events
        kept = (e.x >= x) & (e.x < x + width) & (e.y >= y) & (e.y < y + height)
        e = e.select(kept)  # before the shift, which would wrap around below 0 in uint16
        moved = Events(e.t, e.x - np.uint16(x), e.y - np.uint16(y), e.p, width, height, e.label)
        window = (slice(y, y + height), slice(x, x + width))
        frames = None if self.frames is None else self.frames[:, *window]
        return replace(self, events=moved, mask=self.mask[window], hot=self.hot[window], frames=frames)

    def slice(self, begin: float, end: float) -> Recording:
        """Return what happened at begin <= t < end [s]; frames whose whole exposure lies in it.

        Frames whose times are unknown are left out.

        Raises:
            InputError: Nothing of the recording lies in it.
        """
        begin, end = max(begin, self.begin), min(end, self.end)
        if not begin < end:
            raise InputError(f"slice: must overlap {self.begin:g}..{self.end:g} s")
        motion = self.motion
        if motion is not None:
            within = (motion.t >= begin) & (motion.t < end)
            motion = Motion(*(column[within] for column in motion))
        events = self.events.slice(begin, end)
        frames = self._frames_in(begin, end)
        return replace(self, events=events, begin=begin, end=end, motion=motion, **frames)

    def _frames_in(self, begin: float, end: float) -> dict[str, Any]:
        """Return the frames whose exposure lies in a span [s], and what goes with them."""
        names = ("frames", "frame_times", "frame_begin", "frame_end")
        if self.frames is None or self.frame_times is None:
            return dict.fromkeys(names)
        first = self.frame_times if self.frame_begin is None else self.frame_begin
        last = self.frame_times if self.frame_end is None else self.frame_end
        kept = (first >= begin) & (last <= end)
        found = {name: getattr(self, name) for name in names}
        return {name: None if array is None else array[kept] for name, array in found.items()}

    def masked(self, mask: ArrayLike) -> Recording:
        """Return the recording of those trusted pixels for which `mask`, bool of shape (H, W), is true."""
        chosen: NDArray[Any] = np.asarray(mask)
        if chosen.shape != self.mask.shape or chosen.dtype != np.bool_:
            raise InputError(
                f"mask: must be bool of shape {self.mask.shape}, got {chosen.dtype} of shape {chosen.shape}"
            )
        left = self.mask & chosen
        return replace(self, events=self.at_pixels(np.flatnonzero(left)), mask=left, hot=self.hot & left)

    def at_pixels(self, pixels: ArrayLike) -> Events:
        """Return the events of pixels, given by row-major indices, shape (N,)."""
        wanted = np.zeros(self.width * self.height, np.bool_)
        wanted[np.asarray(pixels)] = True
        if wanted.all():
            return self.events
        return self.events.select(wanted[self.events.y.astype(np.int32) * self.width + self.events.x])

    def in_blocks(self, blocks: ArrayLike) -> Events:
        """Return the events in spans of time [s], begin <= t < end, shape (K, 2), in order and apart."""
        edges = np.asarray(blocks, np.float64)
        if edges.ndim != 2 or edges.shape[1] != 2 or np.any(np.diff(edges.reshape(-1)) < 0):
            raise InputError("blocks: must be spans (K, 2) in order of time that do not overlap")
        bounds = np.searchsorted(self.events.t, edges)
        return self.events.select(np.concatenate([np.arange(i, j) for i, j in bounds] or [np.arange(0)]))

    def subsample(self, count: int, seed: int) -> NDArray[np.int32]:
        """Return `count` trusted pixels at random: row-major indices, increasing, shape (count,).

        Raises:
            InputError: There are not so many.
        """
        pixels = self.pixels
        if not 1 <= count <= len(pixels):
            raise InputError(f"subsample: must take 1 to {len(pixels)} of the trusted pixels, got {count}")
        return np.sort(np.random.default_rng(checked_seed(seed)).choice(pixels, count, replace=False))

    def split_pixels(self, share: float, seed: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the trusted pixels in two parts at random, for training and held out.

        Args:
            share: Part of the pixels that is held out, above 0 and below 1.
            seed: Of the random numbers.

        Returns:
            Row-major indices, (N,) and (M,), each increasing.
        """
        _check_share(share)
        pixels = np.random.default_rng(checked_seed(seed)).permutation(self.pixels)
        held = min(max(round(share * len(pixels)), 1), len(pixels) - 1)
        if held < 1:
            raise InputError("split: needs at least 2 trusted pixels")
        return np.sort(pixels[held:]), np.sort(pixels[:held])

    def split_time(self, blocks: int, share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the time in equal blocks, for training and held out; held-out ones are spread evenly.

        Args:
            blocks: How many there are in all, at least 2.
            share: Part of them that is held out, above 0 and below 1.

        Returns:
            Begin and end of the blocks [s], each of shape (K, 2). The first block is never held out: there
            the state of the pixels is not known yet.
        """
        _check_share(share)
        if blocks < 2:
            raise InputError(f"split: blocks must be at least 2, got {blocks}")
        edges = np.linspace(self.begin, self.end, blocks + 1)
        spans = np.stack([edges[:-1], edges[1:]], axis=1)
        held = np.zeros(blocks, np.bool_)
        count = min(max(round(share * blocks), 1), blocks - 1)
        held[1 + np.floor((np.arange(count) + 0.5) * (blocks - 1) / count).astype(np.int64)] = True
        return spans[~held], spans[held]


def _check_share(share: float) -> None:
    if not 0 < share < 1:
        raise InputError(f"split: share must lie between 0 and 1, got {share:g}")


def open_recording(path: str | PathLike[str], **options: Unpack[ReadOptions]) -> Recording:
    """Open any file of a camera that dase reads, check it and report what was repaired and what looks odd.

    Args:
        path: File or folder; its content chooses the format.
        options: What is known about the file, and the part to read, see `dase.io.ReadOptions`.

    Raises:
        InputError: It is missing, of unknown format, damaged beyond use, or needs an optional library.
    """
    notes: list[str] = []
    recording = Recording.of(io.read(path, notes=notes, **options), notes)
    return replace(recording, motion=io.motion(path, notes=notes, **options))
