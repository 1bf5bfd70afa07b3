"""Columns of decoded events in one stretch of memory, which one copy brings from a device to the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import host_blocks, launch

# wider types first, so that every column begins at a multiple of what its numbers take
COLUMN_TYPES = {
    "t": wp.float64,
    "row": wp.int32,
    "x": wp.uint16,
    "y": wp.uint16,
    "p": wp.uint8,
    "label": wp.int8,
}
"""Columns in the order in which they lie in memory."""


class EventColumns:
    """Where a device leaves decoded events, and how they come to the host.

    Args:
        device: Of the kernel that decodes.
        absent: Columns that nobody asks for; they have no length.
    """

    def __init__(self, device: wp.Device, absent: frozenset[str] = frozenset()):
        self.device, self.absent = device, absent
        self._kept: wp.array | None = None  # on a GPU, from chunk to chunk
        self._lent: NDArray[np.uint8] = np.empty(0, np.uint8)

    def take(self, count: int) -> dict[str, wp.array]:
        """Return columns for `count` events, each of shape (count,) or (0,), to be written by a kernel."""
        offsets, size = self._offsets(count)
        if self.device.is_cpu:
            # new memory each time: it becomes the caller's
            self._lent = np.empty(max(size, 1), np.uint8)
            self._kept = wp.array(self._lent, dtype=wp.uint8, device=self.device, copy=False)
        elif self._kept is None or self._kept.shape[0] < max(size, 1):
            self._kept = launch.new_array(size + size // 4 + 1, wp.uint8, self.device)
        assert self._kept is not None
        return {
            name: wp.array(
                ptr=self._kept.ptr + offsets[name],
                dtype=kind,
                shape=self._length(name, count),
                device=self.device,
            )
            for name, kind in COLUMN_TYPES.items()
        }

    def bring(self, count: int) -> dict[str, NDArray[Any]]:
        """Return what `take` gave as arrays (count,) of the host; on a GPU a copy, for which it waits."""
        offsets, size = self._offsets(count)
        if self.device.is_cpu:
            # the caller's from now on, who may let go of it before the next chunk
            lent, self._lent, self._kept = self._lent, np.empty(0, np.uint8), None
        else:
            block, lent = host_blocks.lend_block(max(size, 1))
            if size:
                wp.copy(block, self._kept, count=size)
                wp.synchronize_stream(self.device.stream)
        return {
            name: lent[offsets[name] : offsets[name] + self._length(name, count) * _bytes_of(kind)].view(
                wp.dtype_to_numpy(kind)
            )
            for name, kind in COLUMN_TYPES.items()
        }

    def _length(self, name: str, count: int) -> int:
        return 0 if name in self.absent else count

    def _offsets(self, count: int) -> tuple[dict[str, int], int]:
        """Return where columns begin [bytes], and where the last one ends."""
        found, end = {}, 0
        for name, kind in COLUMN_TYPES.items():
            found[name] = end
            end += self._length(name, count) * _bytes_of(kind)
        return found, end


def _bytes_of(kind: Any) -> int:
    return int(np.dtype(wp.dtype_to_numpy(kind)).itemsize)
