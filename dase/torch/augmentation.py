"""What is done to batches beside simulating them; by name those of S2R's training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from dase.torch.batch import Batch
from dase.torch.scene_numbers import Augment


def augmented(batch: Batch, how: Augment, flips: torch.Tensor, seed: Sequence[int]) -> Batch:
    """Return a batch with mirrored slots, noise and hot pixels.

    Args:
        batch: As it was simulated.
        how: What to do.
        flips: Whether a slot is mirrored left to right and top to bottom, bool, shape (B, 2), on the device.
        seed: Of the noise.
    """
    if how.flips:
        batch = mirrored(batch, flips)
    if not (how.noise or how.hot):
        return batch
    device, shape = batch.inputs.device, batch.inputs.shape
    numbers = np.random.SeedSequence(list(seed)).generate_state(1)
    generator = torch.Generator(device).manual_seed(int(numbers[0]))
    inputs = batch.inputs.clone()
    if how.noise:
        inputs += how.noise * torch.randn(shape, device=device, generator=generator)
    if how.hot:
        # the same pixels in all windows, with one number each
        slots = shape[1], 1, *shape[3:]
        share = how.hot * torch.rand(shape[1], 1, 1, 1, device=device, generator=generator)
        hot = torch.rand(slots, device=device, generator=generator) < share
        inputs += hot * how.hot_noise * torch.randn(slots, device=device, generator=generator)
    return replace(batch, inputs=inputs)


def mirrored(batch: Batch, flips: torch.Tensor) -> Batch:
    """Return a batch with some slots mirrored; flow turns its sign.

    Args:
        batch: Any.
        flips: Left to right and top to bottom, bool, shape (B, 2).
    """
    inputs, frames, flow = batch.inputs, batch.frames, batch.flow
    for axis, flipped in zip((-1, -2), flips.T, strict=True):
        chosen = flipped.view(1, -1, 1, 1, 1)
        inputs = torch.where(chosen, inputs.flip(axis), inputs)
        frames = torch.where(chosen, frames.flip(axis), frames)
        # x is the first channel, y the second
        sign = torch.ones(2, device=flow.device)
        sign[-1 - axis] = -1
        flow = torch.where(chosen, flow.flip(axis) * sign.view(2, 1, 1), flow)
    return replace(batch, inputs=inputs, frames=frames, flow=flow)
