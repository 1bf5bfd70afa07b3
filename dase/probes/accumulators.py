"""What the kernels have added up, and what is needed of it to work out statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import event_probes as kernels
from dase.kernels import launch

GROUP = 64
"""Neighbours in the list of pixels that form a group; on a CPU one thread works on all of them."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProbeTimes:
    """Times by which events are told apart, of some milliseconds to some tens: those of moving edges."""

    lags: tuple[float, ...] = (
        -0.003, -0.001, 0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.028, 0.044, 0.063,
    )  # fmt: skip
    """Before an event [s] at which its light is looked at; the differences of neighbours are averaged."""

    classes: tuple[float, float] = (0.012, 0.05)
    """Intervals between two events are short, middle or long, divided by these [s]."""

    half: float = 0.064
    """The halves of the time take turns after this [s]."""

    slack: float = 2e-6
    """Files give whole microseconds: an event up to this after a point of the grid belongs to it [s]."""


PROBE_TIMES = ProbeTimes()


@dataclass(frozen=True)
class StatisticsFrame:
    """What statistics refer to; the same for measurement and models.

    Args:
        expected: Counts that the present model expects, shape (N, HALVES).
        zone: Ring of each pixel, shape (N,).
        measured: Statistics of the measurement, which means of a model with few events are drawn to,
            shape (J,); None to work them out.
        seconds: Time that is compared [s].
        first: Step of the grid at which it begins.
        step: Of the grid [s].
        peak: Frequency at which the measured rate swings most [Hz].
        regular: Whether the time stamps of the measurement follow a regularity.
    """

    expected: Array
    zone: NDArray[np.int64]
    seconds: float
    first: int = 0
    step: float = 1e-3
    peak: float = 0.0
    regular: bool = False
    measured: Array | None = None

    @cached_property
    def by_group(self) -> Array:
        """What is expected of each group of pixels, shape (G, HALVES)."""
        return np.add.reduceat(self.expected, np.arange(0, len(self.expected), GROUP))


@dataclass(frozen=True)
class ProbeSums:
    """What the kernels have added up, a row for each model.

    Args:
        sums: Over all pixels, shape (B, SIZE).
        pixels: Counts of each pixel, a Warp array of shape (B, N, HALVES).
        clock: OFF and ON events of each step of time, shape (B, 2 T).
        stamps: Shares of events that follow regularities of the time stamps, shape (B, 2).
        groups: Sums over groups of neighbours in the list of pixels, of the first row, shape (G, SIZE).
        teams: OFF and ON events of each step of these groups, of the first row, shape (G, 2 T).
        frame: What the counts of pixels have been folded for.
        folded: The counts of pixels folded, shape (B, FOLD).
    """

    sums: Array
    pixels: Any
    clock: NDArray[np.int32]
    stamps: Array
    groups: NDArray[np.float32] | None = None
    teams: NDArray[np.int32] | None = None
    frame: StatisticsFrame | None = None
    folded: Array | None = None

    @classmethod
    def join(cls, parts: Sequence[ProbeSums]) -> ProbeSums:
        """Return the rows of all parts; of groups those of the first part's first row."""
        first = parts[0]
        if len(parts) == 1:
            return first
        begins = np.cumsum([0, *(len(p.sums) for p in parts)])
        pixels = wp.empty((int(begins[-1]), *first.pixels.shape[1:]), dtype=float, device=first.pixels.device)
        for part, begin, end in zip(parts, begins, begins[1:], strict=False):
            wp.copy(pixels[int(begin) : int(end)], part.pixels)
        rest = [np.concatenate([getattr(p, name) for p in parts]) for name in ("sums", "clock", "stamps")]
        folded = [part.folded for part in parts if part.folded is not None and part.frame is first.frame]
        whole = len(folded) == len(parts)
        return cls(
            rest[0], pixels, rest[1], rest[2], first.groups, first.teams, first.frame if whole else None,
            np.concatenate(folded) if whole else None,
        )  # fmt: skip

    def select(self, rows: NDArray[np.int64]) -> ProbeSums:
        """Return some rows in a new order; groups stay those of the first row there was.

        Args:
            rows: Their numbers, shape (N,).
        """
        pixels = wp.empty((len(rows), *self.pixels.shape[1:]), dtype=float, device=self.pixels.device)
        for to, row in enumerate(rows.tolist()):
            wp.copy(pixels[to : to + 1], self.pixels[row : row + 1])
        folded = None if self.folded is None else self.folded[rows]
        return replace(
            self, sums=self.sums[rows], pixels=pixels, clock=self.clock[rows], stamps=self.stamps[rows],
            folded=folded,
        )  # fmt: skip

    @property
    def halves(self) -> NDArray[np.float32]:
        """Counts of each pixel, shape (B, N, HALVES)."""
        out: NDArray[np.float32] = self.pixels.numpy()
        return out


@dataclass(frozen=True)
class ProbeTotals:
    """What statistics are worked out from, a row for each model.

    Args:
        sums: Over all pixels, shape (B, SIZE).
        folded: The counts of pixels folded, shape (B, FOLD).
        clock: OFF and ON events of each step of time, shape (B, 2 T).
        stamps: Shares of events that follow regularities of the time stamps, shape (B, 2).
        expected: Sums of what is expected, shape (B or 1, HALVES).
    """

    sums: Array
    folded: Array
    clock: NDArray[np.int32]
    stamps: Array
    expected: Array


def fold_counts(
    pixels: Any, frames: Sequence[StatisticsFrame], which: NDArray[np.int64], *, silent_from: float = 6.0
) -> Any:
    """Fold the counts of pixels where they are.

    Args:
        pixels: Counts, a Warp array of shape (B, N, HALVES).
        frames: What they are compared with; the same pixels and time.
        which: Frame of each row, shape (B,).
        silent_from: Events that are expected of a pixel which is called silent if it sends none: by chance
            a quarter of a percent of such pixels send none.

    Returns:
        A Warp array of shape (B, G, FOLD).
    """
    rows, count, _ = pixels.shape
    groups, to, frame = -(-count // GROUP), pixels.device, frames[0]
    expected = np.stack([f.expected for f in frames]).astype(np.float32)
    out = wp.empty((rows, groups, kernels.FoldPlace.SIZE), dtype=float, device=to)
    inputs = [
        pixels, wp.array(expected, device=to), wp.array(which.astype(np.int32), device=to),
        wp.array(frame.zone.astype(np.int32), device=to), 15.0 * frame.seconds, silent_from, GROUP, out,
    ]  # fmt: skip
    launch.run_kernel(kernels.fold_pixel_counts, groups, inputs, to, batch=rows, slabs=1)
    return out


def sum_over_groups(parts: Any) -> Array:
    """Return the sums over groups of a Warp array (B, G, K), shape (B, K)."""
    rows, _, size = parts.shape
    out = wp.empty((rows, size), dtype=wp.float64, device=parts.device)
    launch.run_kernel(kernels.sum_groups, size, [parts, out], parts.device, batch=rows, slabs=1)
    found: Array = out.numpy()
    return found


def compute_totals(found: ProbeSums, frame: StatisticsFrame) -> ProbeTotals:
    """Return what the statistics of some models are worked out from."""
    folded = found.folded
    if folded is None or found.frame is not frame:
        folded = sum_over_groups(fold_counts(found.pixels, [frame], np.zeros(len(found.sums), np.int64)))
    return ProbeTotals(found.sums, folded, found.clock, found.stamps, frame.by_group.sum(0)[None])


def leave_groups_out(found: ProbeSums, frame: StatisticsFrame) -> ProbeTotals:
    """Return the totals of the first row without one group of pixels after the other, shapes (G, ...)."""
    assert found.groups is not None
    assert found.teams is not None
    parts = fold_counts(found.pixels[:1], [frame], np.zeros(1, np.int64)).numpy()[0].astype(np.float64)
    expected = frame.by_group
    return ProbeTotals(
        found.sums[0] - found.groups, parts.sum(0) - parts, found.clock[0] - found.teams,
        np.repeat(found.stamps[:1], len(parts), 0), expected.sum(0) - expected,
    )  # fmt: skip
