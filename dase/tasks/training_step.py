"""A step of a training: forward, back, the optimiser, the mean of the weights; on a GPU one launch."""

from __future__ import annotations

from collections.abc import Callable

import torch

from dase.learning import distributed
from dase.learning.cuda_graph import GraphReplay
from dase.tasks.optimisation import Optimisation
from dase.torch.batch import Batch

Losses = dict[str, torch.Tensor]
"""Scalars by name, `loss` among them."""


class TrainingStep:
    """Moves a network, and the average of its weights, by one batch after the other.

    A step launches thousands of small kernels, which takes the processor longer than the GPU needs for them.
    Batches of one shape are therefore recorded once and replayed, see `dase.learning.cuda_graph`: the loss
    must not ask for a number on the processor.

    Args:
        network: What learns.
        averaged: The same network, which gets the average of the weights.
        settings: How it is trained.
        device: PyTorch's.
        forward: Returns what the network makes of a batch; its layers may compute with bfloat16.
        losses: Returns the losses of that, in float32, and the batch.

    Attributes:
        optimizer: AdamW; what a checkpoint keeps.
    """

    def __init__(
        self,
        network: torch.nn.Module,
        averaged: torch.nn.Module,
        settings: Optimisation,
        device: str,
        forward: Callable[[Batch], torch.Tensor],
        losses: Callable[[torch.Tensor, Batch], Losses],
    ):
        self.network, self.averaged, self.settings = network, averaged, settings
        self.forward, self.losses = forward, losses
        self.device = torch.device(device)
        self._cuda = self.device.type == "cuda"
        # tensors, which a step that is replayed can read
        self._rate, self._learn = (torch.zeros((), device=self.device) for _ in range(2))
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self._replay = GraphReplay(self.device, [])
        self._held: dict[tuple[object, ...], Batch] = {}

    def __call__(self, batch: Batch, step: int) -> Losses:
        """Do a step, counted from 0; return the losses and the norm of the gradient, until the next step."""
        for group in self.optimizer.param_groups:
            # what a checkpoint brought is that of another device, or of an earlier version
            group["lr"], group["capturable"] = self._rate, self._cuda
        self._rate.fill_(self.settings.rate(step))
        # the first steps are forgotten soon, as if the mean had begun later
        self._learn.fill_(1 - min(self.settings.average, (1 + step) / (10 + step)))
        kind = batch.inputs.shape, batch.valid is None, *batch.parameters
        held = self._hold(kind, batch)
        return self._replay(kind, lambda: self._step_on_device(held))

    def _hold(self, kind: tuple[object, ...], batch: Batch) -> Batch:
        """Return a batch on the device, where the last one of its shape lay."""
        if not self._cuda:
            return batch.to(self.device)
        if kind not in self._held:
            self._held[kind] = batch.to(self.device).map(torch.clone)
        else:
            batch.copy_to(self._held[kind])
        return self._held[kind]

    def _step_on_device(self, batch: Batch) -> Losses:
        """Do what a step does on the device; nothing here may wait for it, or a recording would fail."""
        half = self.settings.mixed_precision and self._cuda
        with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
            made = self.forward(batch)
        losses = self.losses(made.float(), batch)
        self.optimizer.zero_grad(set_to_none=True)
        losses["loss"].backward()
        self._mean_gradients()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
        self.optimizer.step()
        self._average_weights()
        return {name: value.detach() for name, value in losses.items()} | {"gradient": norm.detach()}

    def _mean_gradients(self) -> None:
        """Replace the gradients by their means over all processes."""
        count = distributed.process_count()
        if count > 1:
            distributed.sum_gradients(self.network.parameters())
            for parameter in self.network.parameters():
                if parameter.grad is not None:
                    parameter.grad /= count

    @torch.no_grad()
    def _average_weights(self) -> None:
        mine, theirs = list(self.averaged.parameters()), list(self.network.parameters())
        apart = torch._foreach_sub(theirs, mine)
        torch._foreach_mul_(apart, self._learn)
        torch._foreach_add_(mine, apart)
