"""One process of several that train together: `python -m torch.distributed.run THIS FOLDER`."""

from __future__ import annotations

import os
import sys

import torch

from dase.tasks.event_networks import FireNet
from dase.tasks.reconstruction_training import ReconstructionTraining, train_reconstruction
from dase.torch.batch import Batch

RANK, COUNT = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def batches(first):
    """Yield the slots of this process, all of them in one that is alone."""
    while True:
        frames = torch.rand(3, 2, 1, 16, 16, generator=torch.Generator().manual_seed(first))
        some = frames[:, RANK : RANK + 1] if COUNT > 1 else frames
        slots = some.shape[1]
        reset = torch.zeros(3, slots, dtype=torch.bool)
        yield Batch(
            some.expand(3, slots, 5, 16, 16),
            some,
            torch.zeros(3, slots, 2, 16, 16),
            reset,
            torch.ones(slots, 2),
        )
        first += 1


def train(folder):
    """Train for three steps into a folder."""
    settings = ReconstructionTraining(steps=3, warm_up=1, average=0.5)
    train_reconstruction(FireNet(5, 4), batches, folder, settings)


if __name__ == "__main__":
    torch.set_num_threads(1)
    train(sys.argv[1])
