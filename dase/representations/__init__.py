"""What networks are given instead of events: grids of numbers, one for each window of time.

    grid = dase.Voxels(5)(events, 0.0, 0.05)                    (5, H, W)
    grids = dase.Voxels(5)(events, edges=[0.0, 0.05, 0.1])      (2, 5, H, W)

They take `Events`, or columns `(t, x, y, p)` as NumPy arrays or as PyTorch tensors, whose device keeps them.
"""

from __future__ import annotations

from dase.representations.base import Representation as Representation
from dase.representations.grids import CountImage as CountImage
from dase.representations.grids import StackedHistogram as StackedHistogram
from dase.representations.grids import Voxels as Voxels
from dase.representations.surfaces import AveragedTimeSurface as AveragedTimeSurface
from dase.representations.surfaces import EventFrame as EventFrame
from dase.representations.surfaces import TimeSurface as TimeSurface
