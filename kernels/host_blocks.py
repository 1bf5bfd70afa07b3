"""Memory of the host that a GPU copies into at full speed, beside its kernels.

Only page-locked memory takes a copy without the driver's own detour through such memory, which costs ten
times as much. To lock pages costs more than the copy, so blocks are kept, and lent again as soon as nobody
holds an array that lies in them.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

SMALLEST_BLOCK = 1 << 20
"""[bytes] of a block; sizes are powers of 2, so that blocks fit again."""


class BlockPool:
    """Blocks of page-locked memory that are lent as NumPy arrays.

    Args:
        most: Memory that is locked at most [bytes]; who asks for more gets memory of the usual kind.
        pinned: Whether memory is page-locked, which needs a GPU.
    """

    def __init__(self, most: int = 1 << 30, *, pinned: bool = True):
        self.most, self.pinned = most, pinned
        self.locked = 0
        # by size; `append` and `pop` of a deque need no lock, and blocks come back on any thread
        self._idle: dict[int, deque[wp.array]] = {}

    def lend(self, size: int) -> tuple[wp.array, NDArray[np.uint8]]:
        """Return `size` bytes for a device to copy to, and as an array (size,) whose life is the loan."""
        whole = max(SMALLEST_BLOCK, 1 << (size - 1).bit_length())
        idle = self._idle.setdefault(whole, deque())
        try:
            block = idle.pop()
        except IndexError:
            if self.locked + whole > self.most:
                self._release_idle()
            if self.locked + whole > self.most:
                plain = np.empty(size, np.uint8)
                return wp.array(plain, dtype=wp.uint8, device="cpu", copy=False), plain
            block = wp.empty(whole, dtype=wp.uint8, device="cpu", pinned=self.pinned)
            self.locked += whole
        return block[:size], np.asarray(_Loan(block, size, idle))

    def _release_idle(self) -> None:
        """Give blocks back that nobody holds: those of other sizes may be what is in the way."""
        for whole, idle in self._idle.items():
            while idle:
                idle.pop()
                self.locked -= whole


class _Loan:
    """What arrays in a block refer to; when the last of them is gone, the block is idle again."""

    def __init__(self, block: wp.array, size: int, idle: deque[wp.array]):
        self._block, self._idle = block, idle
        # NumPy's way to share memory: the array keeps this object alive
        self.__array_interface__ = {
            "data": (block.ptr, False),
            "shape": (size,),
            "typestr": "|u1",
            "version": 3,
        }

    def __del__(self) -> None:
        self._idle.append(self._block)


_pool = BlockPool()


def lend_block(size: int) -> tuple[wp.array, NDArray[np.uint8]]:
    """Return `size` bytes, also as an array (size,), of the pool that all share: `BlockPool.lend`."""
    return _pool.lend(size)


def copy_to_host(values: wp.array) -> NDArray[Any]:
    """Return an array of a device as one of the host: of a GPU a copy, on a CPU the memory itself.

    Its shape is the same.
    """
    if values.device.is_cpu:
        return np.asarray(values.numpy())
    kind = np.dtype(wp.dtype_to_numpy(values.dtype))
    size = values.size * kind.itemsize
    block, lent = lend_block(max(size, 1))
    if size:
        wp.copy(block, wp.array(ptr=values.ptr, dtype=wp.uint8, shape=size, device=values.device))
        wp.synchronize_stream(values.device.stream)
    return lent[:size].view(kind).reshape(values.shape)
