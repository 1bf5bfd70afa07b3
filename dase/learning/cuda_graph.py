"""Steps of a fixed shape, recorded once on a GPU as a CUDA graph and replayed.

A step of training launches a thousand small kernels, which takes the processor longer than the GPU needs for
them. Recorded, they are one launch.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import torch

from dase.learning import distributed

T = TypeVar("T")


class GraphReplay:
    """Runs steps, on a GPU from recordings of them.

    What a step reads that differs from one to the next has to lie in tensors that stay where they are, and
    what it leaves has to be written in place.

    Args:
        device: Where steps run; on a CPU they are simply called.
        generators: Random numbers that steps draw.
        plain_runs: Times that a kind of step runs as usual before it is recorded: libraries make their
            choices meanwhile.
    """

    def __init__(self, device: torch.device, generators: Sequence[torch.Generator], *, plain_runs: int = 3):
        self.device, self.generators, self.plain_runs = device, generators, plain_runs
        self.seen: dict[Hashable, int] = {}
        self.recorded: dict[Hashable, tuple[torch.cuda.CUDAGraph, Any]] = {}
        # steps follow one another, so they may use the same memory
        self.pool = torch.cuda.graph_pool_handle() if device.type == "cuda" else None

    def __call__(self, kind: Hashable, step: Callable[[], T]) -> T:
        """Run `step`; return what it returns, in memory that the next one of its kind writes again.

        Args:
            kind: Steps of one kind do the same; None for one that is not to be recorded.
            step: What to run.
        """
        if kind is None or self.device.type != "cuda" or distributed.process_count() > 1:
            return step()
        if kind not in self.recorded:
            self.seen[kind] = self.seen.get(kind, 0) + 1
            if self.seen[kind] <= self.plain_runs:
                return step()
            self.recorded[kind] = self._record(step)
        values: T
        graph, values = self.recorded[kind]
        graph.replay()
        return values

    def _record(self, step: Callable[[], T]) -> tuple[torch.cuda.CUDAGraph, T]:
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator)
        # gradients are made by another thread, so calls of others cannot be forbidden
        recording = torch.cuda.graph(graph, pool=self.pool, capture_error_mode="relaxed")
        with torch.cuda.device(self.device), recording:
            values = step()
        return graph, values
