"""Columns of events as arrays of NumPy or PyTorch, and what representations do with either."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dase.errors import InputError
from dase.events import Events


@dataclass(frozen=True)
class EventColumns:
    """Events as columns of shape (N,), arrays of NumPy or tensors of one device.

    Args:
        t: Times, float64, in any one unit.
        place: Row-major indices of pixels, int64.
        p: Polarities, int64: 1 for ON, 0 for OFF.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].
        arrays: What sums up arrays of this kind.
    """

    t: Any
    place: Any
    p: Any
    width: int
    height: int
    arrays: NumpyArrays | TorchArrays

    def __len__(self) -> int:
        return int(self.t.shape[0])


class NumpyArrays:
    """Sums over events in NumPy."""

    module = np

    def whole(self, values: Any) -> Any:
        """Return numbers (N,) rounded down, as indices."""
        return np.floor(values).astype(np.int64)

    def sums(self, index: Any, weight: Any, size: int) -> Any:
        """Return the sums of weights (N,) that have one index (N,), shape (size,) float32."""
        return np.bincount(index, weight, minlength=size)[:size].astype(np.float32)

    def largest(self, index: Any, values: Any, size: int) -> Any:
        """Return the largest of the values (N,) that have one index (N,), shape (size,); -inf for none."""
        out = np.full(size, -np.inf)
        np.maximum.at(out, index, values)
        return out

    def order(self, keys: Any) -> Any:
        """Return the order (N,) that sorts keys (N,); equal ones stay as they are."""
        return np.argsort(keys, kind="stable")

    def edges(self, values: Any) -> Any:
        """Return numbers (W,) as an array in double precision."""
        return np.asarray(values, np.float64)


class TorchArrays:
    """Sums over events in PyTorch, on the device of the columns."""

    def __init__(self, device: Any):
        # whoever has a tensor has loaded it; `import dase` does not
        self.module: Any = sys.modules["torch"]
        self.device = device

    def whole(self, values: Any) -> Any:
        """Return numbers (N,) rounded down, as indices."""
        return values.floor().to(self.module.int64)

    def sums(self, index: Any, weight: Any, size: int) -> Any:
        """Return the sums of weights (N,) that have one index (N,), shape (size,) float32."""
        out = self.module.zeros(size, dtype=self.module.float64, device=self.device)
        return out.index_add_(0, index, weight.to(self.module.float64)).to(self.module.float32)

    def largest(self, index: Any, values: Any, size: int) -> Any:
        """Return the largest of the values (N,) that have one index (N,), shape (size,); -inf for none."""
        out = self.module.full((size,), -float("inf"), dtype=self.module.float64, device=self.device)
        return out.scatter_reduce_(0, index, values, "amax")

    def order(self, keys: Any) -> Any:
        """Return the order (N,) that sorts keys (N,); equal ones stay as they are."""
        return self.module.argsort(keys, stable=True)

    def edges(self, values: Any) -> Any:
        """Return numbers (W,) as a tensor in double precision."""
        return self.module.as_tensor(values, dtype=self.module.float64, device=self.device)


def event_columns(events: Any, size: tuple[int, int] | None = None) -> EventColumns:
    """Return the columns of events.

    Args:
        events: `Events`; or columns t, x, y, p of shape (N,) in a tuple, in a mapping or in the fields of a
            structured array, arrays or tensors; polarities are truth values, 0 and 1, or -1 and 1.
        size: Width and height of the sensor [px]; `Events` know it.

    Raises:
        InputError: A column is missing or of another shape, or an event lies outside of the sensor.
    """
    if isinstance(events, Events):
        columns = [getattr(events, name) for name in "txyp"]
        size = (events.width, events.height)
    else:
        columns = _named_columns(events)
    if size is None:
        raise InputError("columns of events need size=(width, height) of their sensor")
    shapes = {tuple(column.shape) for column in columns}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        raise InputError(f"columns of events must have one shape (N,), got {', '.join(map(str, shapes))}")
    t, x, y, p = columns
    arrays: NumpyArrays | TorchArrays
    if isinstance(t, np.ndarray):
        arrays = NumpyArrays()
        t, x, y, p = t.astype(np.float64), x.astype(np.int64), y.astype(np.int64), (p > 0).astype(np.int64)
    else:
        arrays = TorchArrays(t.device)
        kinds = arrays.module.float64, arrays.module.int64
        t, x, y, p = t.to(kinds[0]), x.to(kinds[1]), y.to(kinds[1]), (p > 0).to(kinds[1])
    width, height = size
    if len(t) and (min(int(x.min()), int(y.min())) < 0 or int(x.max()) >= width or int(y.max()) >= height):
        raise InputError(
            f"events must lie on the {width}x{height} sensor, got columns {int(x.min())}..{int(x.max())} "
            f"and rows {int(y.min())}..{int(y.max())}"
        )
    return EventColumns(t, y * width + x, p, width, height, arrays)


def _named_columns(events: Any) -> list[Any]:
    """Return t, x, y, p of a tuple, a mapping or a structured array; lists become arrays."""
    names = events.dtype.names if isinstance(events, np.ndarray) else None
    if isinstance(events, Mapping) or names:
        missing = [name for name in "txyp" if name not in (names or events)]
        if missing:
            raise InputError(f"events need the columns t, x, y and p, lack {', '.join(missing)}")
        found = [events[name] for name in "txyp"]
    elif isinstance(events, tuple | list) and len(events) == 4:
        found = list(events)
    else:
        raise InputError(f"events must be Events or columns (t, x, y, p), got {type(events).__name__}")
    return [c if hasattr(c, "device") and not isinstance(c, np.ndarray) else np.asarray(c) for c in found]
