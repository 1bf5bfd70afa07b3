"""Batches of recordings: those of cameras and those that dase has written."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from dase import io
from dase.errors import InputError, checked_integer, checked_seed
from dase.events import Events
from dase.io.source import Part, Source
from dase.representations import Representation
from dase.representations.columns import event_columns
from dase.torch.batch import Batch
from dase.torch.stream import VOXELS, choose_device


class Window(NamedTuple):
    """One window of time of a recording."""

    events: Events
    begin: float  # [s]
    end: float  # [s]
    frame: NDArray[np.float32] | None  # (H, W) in [0, 1]
    flow: NDArray[np.float32] | None  # (2, H, W) [px/s]


@dataclass
class Slot:
    """What a slot of batches is reading.

    Args:
        windows: Of the recording, or of none any more.
        thresholds: OFF, ON; not a number where unknown.
        fresh: Whether its next window is the recording's first.
        before: What networks were given for the window before.
        frame: Label of the window before.
    """

    windows: Iterator[Window]
    thresholds: tuple[float, float]
    fresh: bool = True
    before: torch.Tensor | None = None
    frame: NDArray[np.float32] | None = None


class Recordings(IterableDataset[Batch]):
    """Batches of recordings, as `Stream` gives them of random scenes: real ones, and those dase has written.

        for batch in dase.torch.Recordings(["a.aedat4", "b.h5"], batch=2, steps=40):
            ...

    Each slot reads one file after the other, in memory that does not grow. Frames and flow are those of the
    file at the ends of windows: `valid` says where there is one, and where a file has none, or is over, they
    repeat the last frame, or are 0. Without `window` windows go from frame to frame. Flow that a file does
    not have is not a number, and so are thresholds.

    Args:
        files: Any files that dase reads.
        batch: Slots B.
        steps: Windows T of a batch.
        size: Columns and rows of a part of the sensor, anywhere, another one for every file; None for all of
            it, of which all files must then have the same.
        window: Duration of a window [s]; None for windows from frame to frame (middles of exposures).
        represent: Representation of the events of a window.
        device: PyTorch device that represents events; None for a GPU where there is one, else the CPU.
        seed: Of the order of files and of their parts.
        passes: How often each file is read; None for ever.
        shuffle: Whether files come in another order in every pass.

    Raises:
        InputError: There is no file, one cannot be read, or has another size than the others.
    """

    def __init__(
        self,
        files: Sequence[str | PathLike[str]] | str | PathLike[str],
        *,
        batch: int = 1,
        steps: int = 40,
        size: tuple[int, int] | None = None,
        window: float | None = None,
        represent: Representation = VOXELS,
        device: str | torch.device | None = None,
        seed: int = 0,
        passes: int | None = 1,
        shuffle: bool = False,
    ):
        given = [files] if isinstance(files, str | PathLike) else list(files)
        self.files = tuple(Path(one) for one in given)
        if not self.files:
            raise InputError("recordings need at least one file, got none")
        for path in self.files:
            io.find_format(path)
        if window is not None and not (window > 0 and math.isfinite(window)):
            raise InputError(f"window must be a number > 0 s, got {window}")
        self.batch, self.steps = checked_integer("batch", batch, 1), checked_integer("steps", steps, 1)
        self.size, self.window, self.represent = size, window, represent
        self.device, self.seed, self.shuffle = choose_device(device), checked_seed(seed), shuffle
        self.passes = None if passes is None else checked_integer("passes", passes, 1)

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches until all files have been read; slots that are done wait for the others."""
        worker = get_worker_info()
        if worker is not None and worker.num_workers > 1:
            raise InputError(
                "recordings go on from batch to batch and need one worker, "
                f"got num_workers={worker.num_workers}"
            )
        files = self._files_in_order()
        slots = [self._next_slot(files) for _ in range(self.batch)]
        while True:
            parts = []
            for place, slot in enumerate(slots):
                part, slots[place] = self._read_steps(slot, files)
                parts.append(part)
            if not any(part.read for part in parts):
                return
            yield _joined(parts, self.device)

    def _files_in_order(self) -> Iterator[tuple[Path, np.random.Generator]]:
        """Yield files and what draws their parts."""
        number = 0
        while self.passes is None or number < self.passes:
            rng = np.random.default_rng([self.seed, number])
            order = rng.permutation(len(self.files)) if self.shuffle else np.arange(len(self.files))
            for index in order:
                yield self.files[index], np.random.default_rng([self.seed, number, int(index)])
            number += 1

    def _next_slot(self, files: Iterator[tuple[Path, np.random.Generator]]) -> Slot | None:
        """Return a slot that begins the next file; None after the last one."""
        found = next(files, None)
        if found is None:
            return None
        path, rng = found
        part = None
        if self.size is not None:
            first = next(io.stream(path, chunk=1))
            room = first.width - self.size[0], first.height - self.size[1]
            if min(room) < 0:
                raise InputError(
                    f"{path}: size must lie on the {first.width}x{first.height} sensor, "
                    f"got {self.size[0]}x{self.size[1]}"
                )
            x, y = (int(rng.integers(one + 1)) for one in room)
            part = Part(region=(x, y, *self.size))
        return Slot(read_windows(path, self.window, part), _nominal_thresholds(path))

    def _read_steps(
        self, slot: Slot | None, files: Iterator[tuple[Path, np.random.Generator]]
    ) -> tuple[SlotPart, Slot | None]:
        """Return the next T windows of a slot, and the slot that goes on behind them."""
        part = SlotPart(self.steps)
        while slot is not None and part.read < self.steps:
            found = []
            for window in slot.windows:
                found.append(window)
                if part.read + len(found) == self.steps:
                    break
            if found:
                part.add(slot, found, self._grids(slot, found))
            if part.read < self.steps:
                slot = self._next_slot(files)
        return part, slot

    def _grids(self, slot: Slot, windows: list[Window]) -> torch.Tensor:
        """Return the representations of windows that follow each other, shape (W, C, H, W)."""
        events = Events.concatenate([window.events for window in windows])
        origin = windows[0].begin
        edges = np.array([origin, *(window.end for window in windows)]) - origin
        kinds = (
            (events.t - origin, np.float64),
            (events.x, np.int64),
            (events.y, np.int64),
            (events.p, np.bool_),
        )
        columns = [torch.from_numpy(np.asarray(a, kind)).to(self.device) for a, kind in kinds]
        taken = event_columns(tuple(columns), (events.width, events.height))
        grids = self.represent.raw_grids(taken, edges)
        grids = self.represent.finish(grids, float(edges[-1]) / len(windows), slot.before)
        slot.before = grids[-1]
        return grids


class SlotPart:
    """The windows of one slot in a batch.

    Args:
        steps: Windows of a batch.
    """

    def __init__(self, steps: int):
        self.steps, self.read = steps, 0
        self.grids: list[torch.Tensor] = []
        self.frames: list[NDArray[np.float32]] = []
        self.flow: list[NDArray[np.float32]] = []
        self.reset = np.ones(steps, np.bool_)
        self.valid = np.zeros(steps, np.bool_)
        self.thresholds = (math.nan, math.nan)

    def add(self, slot: Slot, windows: list[Window], grids: torch.Tensor) -> None:
        """Append windows (W) with their representations, shape (W, C, H, W)."""
        shape = windows[0].events.height, windows[0].events.width
        self.reset[self.read : self.read + len(windows)] = False
        self.reset[self.read] = slot.fresh
        slot.fresh = False
        self.thresholds = slot.thresholds
        for number, window in enumerate(windows):
            self.valid[self.read + number] = window.frame is not None
            slot.frame = slot.frame if window.frame is None else window.frame
            self.frames.append(np.zeros(shape, np.float32) if slot.frame is None else slot.frame)
            unknown = np.full((2, *shape), np.nan, np.float32)
            self.flow.append(unknown if window.flow is None else window.flow)
        self.grids.append(grids)
        self.read += len(windows)


def _joined(parts: list[SlotPart], device: torch.device) -> Batch:
    """Return the batch of its slots; what no file fills is 0, fresh and not valid."""
    shapes = {part.grids[0].shape[1:] for part in parts if part.read}
    if len(shapes) != 1:
        sizes = ", ".join(sorted(f"{shape[2]}x{shape[1]}" for shape in shapes))
        raise InputError(f"recordings of a batch must have one size, got {sizes}: take size=(columns, rows)")
    channels, height, width = next(iter(shapes))
    steps = parts[0].steps
    inputs = torch.zeros(steps, len(parts), channels, height, width, device=device)
    frames = np.zeros((steps, len(parts), 1, height, width), np.float32)
    flow = np.full((steps, len(parts), 2, height, width), np.nan, np.float32)
    for slot, part in enumerate(parts):
        if part.read:
            inputs[: part.read, slot] = torch.cat(part.grids)
            frames[: part.read, slot, 0] = np.stack(part.frames)
            flow[: part.read, slot] = np.stack(part.flow)

    def send(values: Any) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    return Batch(
        inputs=inputs,
        frames=send(frames),
        flow=send(flow),
        reset=send(np.stack([part.reset for part in parts], 1)),
        thresholds=send(np.array([part.thresholds for part in parts], np.float32)),
        valid=send(np.stack([part.valid for part in parts], 1)),
    )


def _nominal_thresholds(path: Path) -> tuple[float, float]:
    """Return the middle OFF and ON threshold of a file that says so; not a number for others."""
    maps = io.find_format(path).beside(Source(path))[0]
    if maps is None:
        return math.nan, math.nan
    return float(np.median(maps[0])), float(np.median(maps[1]))


def read_windows(path: Path, window: float | None, part: Part | None) -> Iterator[Window]:
    """Yield the windows of a recording, one after the other, in memory that does not grow.

    Args:
        path: What to read.
        window: Duration [s]; None for windows from frame to frame.
        part: The part of the sensor to read; None for all.

    Raises:
        InputError: It cannot be read, or has no frames at known times although windows ask for them.
    """
    pictures = (found for found in io.pictures(path, part=part) if math.isfinite(found.t))
    events = EventQueue(io.stream(path, part=part))
    first = next(pictures, None)
    if window is None:
        if first is None:
            raise InputError(f"{path}: has no frames with times for windows to end at: take window=seconds")
        begin = float(first.t)
        events.take(begin)
        for one in pictures:
            end = float(one.t)
            if end > begin:
                yield Window(events.take(end), begin, end, to_light(one.grey), one.flow)
                begin = end
        return
    begin = events.first if first is None else float(first.t)
    events.take(begin)
    number, picture = 1, first
    while not events.over or picture is not None:
        start, end = begin + (number - 1) * window, begin + number * window
        label: io.Picture | None = None
        # the frame nearest to the end, if it is less than half a window away
        while picture is not None and float(picture.t) < end + 0.5 * window:
            if float(picture.t) >= end - 0.5 * window:
                nearer = label is None or abs(picture.t - end) < abs(label.t - end)
                label = picture if nearer else label
            picture = next(pictures, None)
        taken = events.take(end)
        if not events.over or label is not None:
            frame = None if label is None else to_light(label.grey)
            yield Window(taken, start, end, frame, None if label is None else label.flow)
        number += 1


def to_light(grey: NDArray[Any]) -> NDArray[np.float32]:
    """Return a picture (H, W) of whole numbers in [0, 1]: cameras' frames are linear."""
    return np.asarray(grey / np.float32(np.iinfo(grey.dtype).max), np.float32)


class EventQueue:
    """Events of a file, taken piece by piece.

    Args:
        chunks: That follow each other in time.
    """

    def __init__(self, chunks: Iterator[Events]):
        self._chunks = chunks
        self._rest = next(chunks)
        while not len(self._rest) and self._fetch():
            pass

    @property
    def first(self) -> float:
        """Time of the next event [s], 0 where there is none."""
        return float(self._rest.t[0]) if len(self._rest) else 0.0

    @property
    def over(self) -> bool:
        """Whether there is no event left."""
        return not len(self._rest) and not self._fetch()

    def take(self, end: float) -> Events:
        """Return the next events, before `end` [s]."""
        taken = []
        while True:
            count = int(np.searchsorted(self._rest.t, end))
            taken.append(self._rest.select(slice(count)))
            whole = count == len(self._rest)
            self._rest = self._rest.select(slice(count, None))
            if not (whole and self._fetch()):
                return Events.concatenate(taken)

    def _fetch(self) -> bool:
        """Get the next chunk, if there is one."""
        chunk = next(self._chunks, None)
        if chunk is None:
            return False
        self._rest = chunk
        return True
