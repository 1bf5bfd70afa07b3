"""AdaBelief, the optimiser of the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch


class AdaBelief(torch.optim.Optimizer):
    """Adam whose step is divided by how far gradients stray from their mean.

    Zhuang et al., AdaBelief optimizer: adapting stepsizes by the belief in observed gradients, 2020.

    Args:
        params: Parameters or groups of them.
        lr: Learning rate; a tensor may be changed between steps that are replayed.
        betas: Decay of the mean, and of the mean square deviation from it.
        eps: Added to the mean square deviation, and to its root.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float | torch.Tensor = 4e-4,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-16,
    ):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:
        """Move all parameters that have a gradient; `closure` is not used."""
        for group in self.param_groups:
            first, second = group["betas"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state.update(step=p.new_zeros(()), mean=torch.zeros_like(p), spread=torch.zeros_like(p))
                state["step"] += 1
                mean, spread = state["mean"], state["spread"]
                mean.lerp_(p.grad, 1 - first)
                stray = p.grad - mean
                spread.mul_(second).addcmul_(stray, stray, value=1 - second).add_(group["eps"])
                root = (spread / (1 - second ** state["step"])).sqrt_().add_(group["eps"])
                p.sub_(mean / root * (group["lr"] / (1 - first ** state["step"])))
