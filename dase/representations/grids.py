"""Representations that add up events: voxel grids, counts, histograms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from dase.errors import InputError, checked_integer
from dase.representations.base import Representation, grid_of
from dase.representations.columns import EventColumns


@dataclass(frozen=True)
class Voxels(Representation):
    """Polarities spread linearly over bins of time, shape (bins, H, W).

    Bin b holds the sum of ±max(0, 1 - |b - (bins - 1) u|) over events, u being 0 at the begin of the window
    and 1 at its end: Zhu et al., Unsupervised event-based learning of optical flow, depth and egomotion,
    2019. That is E2VID's grid, where the window is that from the first event to the last one. tonic's
    `ToVoxelGrid` has (bins, 1, H, W) and spreads over `bins u`, so that what comes late in a window is lost;
    OpenEB's event cube keeps polarities apart.

    Args:
        bins: Number of bins of time.
        normalise: Whether to take the mean of all numbers that are not 0 from them, and to divide them by
            their standard deviation, over all bins of a window, as E2VID does.
    """

    bins: int
    normalise: bool = False
    deposit: ClassVar[str] = "voxels"

    def __post_init__(self) -> None:
        checked_integer("bins", self.bins, 1)

    @property
    def channels(self) -> int:
        """Number of bins."""
        return self.bins

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return the grids, shape (W, bins, H, W), see `Representation.sums`."""
        windows, sign = len(edges) - 1, 2.0 * events.p - 1.0
        at = (self.bins - 1) * share
        low = events.arrays.whole(at)
        # one spare bin takes the zero weight of the end of a window
        index, spare = window * (self.bins + 1) + low, self.bins + 1
        out = grid_of(events, windows, spare, index, sign * (low + 1 - at))
        out = out + grid_of(events, windows, spare, index + 1, sign * (at - low))
        return out[:, : self.bins]

    def finish(self, grids: Any, window: float, before: Any = None) -> Any:
        """Return the grids (W, ..., bins, H, W), normalised if asked for."""
        return normalised(grids) if self.normalise else grids


def normalised(grids: Any) -> Any:
    """Return grids (..., C, H, W) with mean 0 and deviation 1 of the numbers of each that are not 0."""
    flat = grids.reshape(*grids.shape[:-3], -1)
    # 0 and 1 of the kind of the grids: whole numbers would make NumPy's sums double
    there = (flat != 0) + 0 * flat
    number = there.sum(-1)[..., None].clip(1)
    mean = flat.sum(-1)[..., None] / number
    centred = (flat - mean) * there
    deviation = ((centred**2).sum(-1)[..., None] / number) ** 0.5
    # what is all the same has no deviation, and becomes 0
    return (centred / (deviation + (deviation == 0))).reshape(grids.shape)


@dataclass(frozen=True)
class CountImage(Representation):
    """Events of every pixel, shape (2, H, W): OFF, ON.

    OpenEB's `histogram` and a frame of tonic's `ToFrame`; the counts of EV-FlowNet.
    """

    deposit: ClassVar[str] = "counts"

    @property
    def channels(self) -> int:
        """Number of polarities."""
        return 2

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return the counts, shape (W, 2, H, W), see `Representation.sums`."""
        return grid_of(events, len(edges) - 1, 2, 2 * window + events.p, 0.0 * share + 1.0)


@dataclass(frozen=True)
class StackedHistogram(Representation):
    """Events of every pixel in bins of time, shape (2 · bins, H, W): all bins of OFF, then those of ON.

    RVT's `StackedHistogram` (Gehrig and Scaramuzza: Recurrent vision transformers for object detection with
    event cameras, 2023), there in whole numbers of 8 bits: channel p · bins + b.

    Args:
        bins: Number of bins of time, of one duration.
        cutoff: Greatest count, 10 in RVT; None for no bound.
    """

    bins: int
    cutoff: int | None = None
    deposit: ClassVar[str] = "histogram"

    def __post_init__(self) -> None:
        checked_integer("bins", self.bins, 1)
        if self.cutoff is not None and not self.cutoff > 0:
            raise InputError(f"cutoff must be > 0 events, got {self.cutoff}")

    @property
    def channels(self) -> int:
        """Polarities times bins."""
        return 2 * self.bins

    def sums(self, events: EventColumns, window: Any, share: Any, edges: Any) -> Any:
        """Return the counts, shape (W, 2 · bins, H, W), see `Representation.sums`."""
        at = events.arrays.whole(self.bins * share).clip(0, self.bins - 1)
        index = window * self.channels + events.p * self.bins + at
        return grid_of(events, len(edges) - 1, self.channels, index, 0.0 * share + 1.0)

    def finish(self, grids: Any, window: float, before: Any = None) -> Any:
        """Return the counts (W, ..., 2 · bins, H, W), cut off if asked for."""
        return grids if self.cutoff is None else grids.clip(0, self.cutoff)
