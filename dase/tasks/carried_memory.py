"""What a network remembers from batch to batch of a training."""

from __future__ import annotations

import torch

from dase.tasks.event_networks import EventNetwork, Memory
from dase.torch.batch import Batch


class CarriedMemory:
    """Hands what a network remembers behind a batch to the next one; gradients end between them.

    A recording goes on for thousands of windows and a batch for some ten. Networks that always begin anew
    with a batch have never seen what they remember after a hundred windows, and may drift away there; those
    that go on learn from memories of any age (truncated backpropagation through time: Williams, Peng: An
    efficient gradient-based algorithm for on-line training of recurrent network trajectories, 1990). Where
    `Batch.reset` says that a scene begins, nothing is remembered.

    Attributes:
        tensors: For each shape (B, C, H, W) of windows, what is remembered. They stay where they are, so that
            a step that is replayed on a GPU finds them.
    """

    def __init__(self) -> None:
        self.tensors: dict[tuple[int, ...], Memory] = {}

    def sequence(self, network: EventNetwork, batch: Batch) -> torch.Tensor:
        """Return what a network makes of a batch, shape (T, B, C, H, W), and keep what it remembers then."""
        shape = tuple(batch.inputs.shape[1:])
        made, after = network.sequence(batch.inputs, batch.reset, self.tensors.get(shape))
        if after is not None:
            kept = self.tensors.setdefault(shape, [one.detach().clone() for one in after])
            for mine, now in zip(kept, after, strict=True):
                mine.copy_(now.detach())
        return made
