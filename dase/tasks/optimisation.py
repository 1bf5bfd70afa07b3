"""What trainings of networks share: where batches come from, and how weights are moved."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dase.errors import InputError, checked_integer
from dase.torch.batch import Batch

BatchSource = Callable[[int], Iterable[Batch]]
"""Returns batches, beginning with a number; the same number always gives the same batch."""


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """How any network is trained.

    Args:
        steps: Batches in all; the learning rate is laid out for them.
        window: Duration of the batches' windows [s].
        learning_rate: The largest, after the warm-up.
        warm_up: Steps over which the learning rate rises; it falls as a cosine behind them.
        weight_decay: Of AdamW.
        average: Share of the averaged weights that stays in a step; smaller at first, (1 + n) / (10 + n).
        clip: Largest norm of a step's gradient.
        mixed_precision: Whether layers compute with bfloat16 on a GPU.
        seed: Of the first weights.
        device: `cpu`, or `cuda`; one GPU per process under torchrun.
        save_every: Steps between checkpoints.
        log_every: Steps between lines of the log.
        stop_at: Steps after which this call ends, with a checkpoint; None for all. A later call goes on.

    Raises:
        InputError: A number makes no sense.
    """

    steps: int = 7000
    window: float = 1 / 60
    learning_rate: float = 5e-4
    warm_up: int = 100
    weight_decay: float = 1e-4
    average: float = 0.999
    clip: float = 1.0
    mixed_precision: bool = True
    seed: int = 0
    device: str = "cpu"
    save_every: int = 500
    log_every: int = 20
    stop_at: int | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "save_every", "log_every"):
            checked_integer(name, getattr(self, name), 1)
        for name in ("window", "learning_rate", "clip"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"training: {name} must be > 0, got {getattr(self, name)}")
        if not 0 <= self.average < 1:
            raise InputError(f"training: average must lie in [0, 1), got {self.average}")

    @property
    def last_step(self) -> int:
        """Steps after which this call ends."""
        return self.steps if self.stop_at is None else min(self.stop_at, self.steps)

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0."""
        rise = min(1.0, (step + 1) / max(self.warm_up, 1))
        return self.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * step / self.steps))
