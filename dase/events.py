"""Events, the currency between sensor, files and comparison."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError

LARGEST_SIDE = 16384
"""Columns or rows of a sensor that is simulated, at most; coordinates of events have 16 bits."""

LABELS = ("signal", "leak", "shot", "hot")
"""What an event came from: a change of light, the leak of the pixel's memory, the noise of few photons, a
hot pixel. An ON event is the leak's when, since the pixel's memory was last set, the leak brought it nearer
to the threshold than the light did."""


def _whole_coordinates(values: NDArray[Any], name: str) -> NDArray[np.uint16]:
    """Return coordinates (N,) as uint16; raises InputError where they would wrap or lose a fraction."""
    if values.dtype.kind not in "iu":
        raise InputError(f"events: {name} must be whole numbers, got {values.dtype}")
    if len(values) and not 0 <= int(values.min()) <= int(values.max()) < 1 << 16:
        raise InputError(f"events: {name} must lie in 0..65535, got {values.min()}..{values.max()}")
    return values.astype(np.uint16)


def _polarities(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return polarities (N,) as bool; raises InputError where they are not 0 and 1: -1 would become ON."""
    if values.dtype.kind not in "iuf" or np.any((values != 0) & (values != 1)):
        raise InputError(f"events: p must be bool, True for ON, got {values.dtype} with other numbers")
    return values.astype(np.bool_)


def read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return the same array, of any shape, as one that cannot be changed: who keeps it need not copy it."""
    view = values.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, repr=False)
class Events:
    """A stream of events of one sensor, sorted by time.

    Args:
        t: Times [s], float64, shape (N,), not decreasing.
        x: Columns, uint16, shape (N,).
        y: Rows, uint16, shape (N,).
        p: Polarities, bool, shape (N,): True is ON.
        width: Columns of the sensor, at most 65536.
        height: Rows of the sensor, at most 65536.
        label: Places in `LABELS`, int8, shape (N,); None where unknown.

    Columns of other types are converted where that loses nothing: whole numbers in 0..65535, polarities 0 and
    1, any real times.

    Raises:
        InputError: Shapes differ, the sensor has no size, or a column cannot be converted.
    """

    t: NDArray[np.float64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    width: int
    height: int
    label: NDArray[np.int8] | None = None

    def __post_init__(self) -> None:
        sizes = {name: getattr(self, name).shape for name in "txyp"}
        if self.label is not None and self.label.shape != self.t.shape:
            raise InputError(
                f"events: label must have the shape of t, {self.t.shape}, got {self.label.shape}"
            )
        if len(set(sizes.values())) != 1 or self.t.ndim != 1:
            raise InputError(f"events: t, x, y and p must have one common shape (N,), got {sizes}")
        if not 1 <= min(self.width, self.height) <= max(self.width, self.height) <= 1 << 16:
            size = f"{self.width}x{self.height}"
            raise InputError(f"events: sensor size must lie between 1x1 and 65536x65536, got {size}")
        # one comparison of types each where nothing is to be done, as almost always
        if self.t.dtype != np.float64:
            if self.t.dtype.kind not in "iuf":
                raise InputError(f"events: t must be numbers [s], got {self.t.dtype}")
            object.__setattr__(self, "t", self.t.astype(np.float64))
        for name in "xy":
            if getattr(self, name).dtype != np.uint16:
                object.__setattr__(self, name, _whole_coordinates(getattr(self, name), name))
        if self.p.dtype != np.bool_:
            object.__setattr__(self, "p", _polarities(self.p))

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: object) -> None:
        # else Python itself would say no more than that it cannot be done
        raise TypeError("events: take events.select(index) for some of them, events.t[index] for a column")

    def __repr__(self) -> str:
        size = f"{self.width}x{self.height}"
        if not len(self):
            return f"Events(none of {size} pixels)"
        span = f"{self.t[0]:.6g} s to {self.t[-1]:.6g} s"
        return f"Events({len(self)} of {size} pixels, {span}, {100 * self.p.mean():.0f} % ON)"

    @classmethod
    def empty(cls, width: int, height: int) -> Events:
        """Return a stream without events."""
        return cls(
            np.empty(0, np.float64),
            np.empty(0, np.uint16),
            np.empty(0, np.uint16),
            np.empty(0, np.bool_),
            width,
            height,
        )

    @classmethod
    def concatenate(cls, parts: Iterable[Events]) -> Events:
        """Join streams of one sensor that follow each other in time; raises InputError without a part.

        Labels are kept when every part that has events has labels.
        """
        parts = list(parts)
        if not parts:
            raise InputError("events: nothing to concatenate")
        first = parts[0]
        t, x, y, p = (np.concatenate([getattr(part, name) for part in parts]) for name in "txyp")
        labels = [part.label for part in parts if len(part) or part.label is not None]
        known = [label for label in labels if label is not None]
        label = np.concatenate(known) if known and len(known) == len(labels) else None
        return cls(t, x, y, p, first.width, first.height, label)

    def select(self, index: slice | NDArray[Any]) -> Events:
        """Return the events that a slice, a mask (N,) or indices (K,) choose, in order of time."""
        if not isinstance(index, slice) and index.dtype == np.bool_:
            index = np.flatnonzero(index)  # once, not for each column
        label = None if self.label is None else self.label[index]
        t, x, y, p = (getattr(self, name)[index] for name in "txyp")
        return Events(t, x, y, p, self.width, self.height, label)

    def read_only(self) -> Events:
        """Return the same events in columns that cannot be changed through it."""
        label = None if self.label is None else read_only(self.label)
        t, x, y, p = (read_only(getattr(self, name)) for name in "txyp")
        return Events(t, x, y, p, self.width, self.height, label)

    def slice(self, begin: float, end: float) -> Events:
        """Return the events with begin <= t < end [s]."""
        i, j = np.searchsorted(self.t, (begin, end))
        return self.select(slice(i, j))

    def counts(self, edges: ArrayLike) -> NDArray[np.int32]:
        """Count events per time window and pixel.

        Args:
            edges: Window edges [s], increasing, shape (W + 1,); a window holds edge <= t < next edge.

        Returns:
            Shape (W, 2, height, width): OFF counts in channel 0, ON counts in channel 1.
        """
        edges = np.asarray(edges, np.float64)
        bounds = np.searchsorted(self.t, edges)
        out = np.zeros((len(edges) - 1, 2, self.height, self.width), np.int32)
        size = 2 * self.height * self.width
        for window, (i, j) in enumerate(pairwise(bounds)):
            flat = (self.p[i:j] * self.height + self.y[i:j].astype(np.int64)) * self.width + self.x[i:j]
            out[window] = np.bincount(flat, minlength=size).reshape(2, self.height, self.width)
        return out
