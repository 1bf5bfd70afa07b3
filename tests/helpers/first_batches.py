"""An endless stream of batches with an end, in a module that a spawned process can import."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

from torch.utils.data import IterableDataset

import dase.torch


class FirstBatches(IterableDataset):
    """The first `count` batches of a stream, of each process that asks it."""

    def __init__(self, stream: dase.torch.Stream, count: int):
        self.stream, self.count = stream, count

    def __iter__(self) -> Iterator[dase.torch.Batch]:
        return islice(iter(self.stream), self.count)
