"""Memory that is lent while arrays lie in it."""

import numpy as np
import warp as wp

from dase.kernels.event_columns import COLUMN_TYPES, EventColumns
from dase.kernels.host_blocks import SMALLEST_BLOCK, BlockPool


def make_pool(most):
    return BlockPool(most, pinned=wp.is_cuda_available())


def test_a_block_is_lent_again_when_the_last_view_is_gone():
    pool = make_pool(4 * SMALLEST_BLOCK)
    block, lent = pool.lend(1000)
    place, column = block.ptr, lent[8:16].view(np.float64)
    assert lent.ctypes.data == place
    assert lent.shape == (1000,)
    lent[:] = 7
    assert np.all(block.numpy() == 7)
    del lent, block
    other, held = pool.lend(1000)  # a column of the first one is still held
    assert other.ptr != place
    del column
    again, back = pool.lend(2000)
    assert again.ptr == place
    assert back.shape == (2000,)
    assert pool.locked == 2 * SMALLEST_BLOCK
    assert held.ctypes.data == other.ptr


def test_no_more_is_locked_than_allowed():
    pool = make_pool(2 * SMALLEST_BLOCK)
    held = [pool.lend(SMALLEST_BLOCK)[1] for _ in range(2)]
    block, plain = pool.lend(10)
    assert pool.locked == 2 * SMALLEST_BLOCK
    assert plain.ctypes.data == block.ptr
    assert plain.shape == (10,)
    held.clear()
    _, large = pool.lend(2 * SMALLEST_BLOCK)  # what nobody holds makes room for another size
    assert pool.locked == 2 * SMALLEST_BLOCK
    assert len(large) == 2 * SMALLEST_BLOCK


def test_columns_come_to_the_host_as_they_were_written(device):
    columns = EventColumns(wp.get_device(device), frozenset({"label"}))
    rng = np.random.default_rng(1)
    kept = []
    for count in (1000, 0, 300):
        written = columns.take(count)
        values = {
            name: rng.integers(0, 100, count).astype(wp.dtype_to_numpy(kind))
            for name, kind in COLUMN_TYPES.items()
            if name != "label"
        }
        for name, value in values.items():
            assert written[name].shape == (count,)
            if count:
                written[name].assign(value)
        assert written["label"].shape == (0,)
        kept.append((columns.bring(count), values))
    for got, values in kept:  # a later chunk leaves what was given before alone
        assert len(got["label"]) == 0
        for name, value in values.items():
            np.testing.assert_array_equal(got[name], value)
            assert got[name].dtype == value.dtype
