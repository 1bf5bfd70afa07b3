"""The bank of critics of "How to Learn a Domain-Adaptive Event Simulator?" (2021), section 4.3."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch.nn import functional as F

from dase.kernels import autograd_training as bridge
from dase.networks import SLOPE


@dataclass(frozen=True, kw_only=True)
class BankShape:
    """Sizes of a bank of critics.

    Args:
        classes: Number of critics.
        inputs: Numbers in a patch; a multiple of 8.
        wide: Outputs of the first layer; a multiple of 8.
        narrow: Outputs of the second layer; a multiple of 8.
    """

    classes: int
    inputs: int = 6400
    wide: int = 256
    narrow: int = 128

    def weights(self) -> int:
        """Return the number of weights of all critics."""
        return self.classes * (self.inputs * self.wide + self.wide * (self.narrow + 1) + 2 * self.narrow + 1)


@dataclass
class Sorted:
    """Rows in the order of their critics.

    Args:
        order: Which row comes where, int64 (R,).
        classes: Critic of each row in that order, int64 (R,); the number of critics for rows of none.
        end: Where the rows of each critic end, int32 (C,).
        number: How many each has, int64 (C,).
    """

    order: torch.Tensor
    classes: torch.Tensor
    end: torch.Tensor
    number: torch.Tensor

    @classmethod
    def by(cls, classes: torch.Tensor, critics: int) -> Sorted:
        """Sort rows of these classes, int64 (R,); nothing waits for the GPU."""
        # a GPU's sort goes over all bits of a key
        keys = classes.short() if critics < 2**15 else classes
        ordered, order = torch.sort(keys, stable=True)
        number = classes.new_zeros(critics + 1).index_add_(0, classes, torch.ones_like(classes))
        return cls(order, ordered.long(), number[:-1].cumsum(0).int(), number[:-1])


@dataclass
class Critique:
    """What one step of the bank found.

    Args:
        distance: Weighted difference of the critics' means, real minus fake: what Eq. 10 maximises.
        penalty: Weighted mean squared gradient between the domains.
    """

    distance: torch.Tensor
    penalty: torch.Tensor


@dataclass
class Activations:
    """What the critics make of rows: sums of both layers, scores, and slopes of the scores by the sums."""

    first: torch.Tensor
    second: torch.Tensor
    score: torch.Tensor
    by_first: torch.Tensor
    by_second: torch.Tensor


class CriticBank:
    """Critics inputs→wide→narrow→1 with leaky rectifiers, one for each class of patches, worked as one.

    Patches are sorted by critic, so that every layer is one grouped product. Gradients are written out: that
    of the penalty on |∇D|² needs no second backward pass, because a network of rectifiers is linear between
    its kinks. The gradient of a layer is never stored: it is a sum of outer products of few rows, which the
    optimiser's kernel takes. On a GPU layers are read as bfloat16 copies of float32 weights.

    Args:
        shape: Sizes.
        device: PyTorch device.
        generator: Draws the weights.
        decay: Of Adam's mean square; there is no momentum.
    """

    def __init__(
        self,
        shape: BankShape,
        *,
        device: str | torch.device = "cpu",
        generator: torch.Generator | None = None,
        decay: float = 0.9,
    ):
        self.shape, self.device, self.decay = shape, torch.device(device), decay
        self.working = torch.bfloat16 if self.device.type == "cuda" else torch.float32

        def drawn(outputs: int, inputs: int) -> tuple[torch.Tensor, torch.Tensor]:
            # as nn.Linear does
            bound = 1 / math.sqrt(inputs)
            sizes = (shape.classes, outputs, inputs), (shape.classes, outputs)
            w, b = (
                torch.empty(s, device=self.device).uniform_(-bound, bound, generator=generator) for s in sizes
            )
            return w, b

        self.w1, self.b1 = drawn(shape.wide, shape.inputs)
        self.w2, self.b2 = drawn(shape.narrow, shape.wide)
        w3, self.b3 = drawn(1, shape.narrow)
        self.w3 = w3[:, 0].contiguous()
        self.square = {name: torch.zeros_like(getattr(self, name)) for name in self.names()}
        self.steps = torch.zeros(shape.classes, device=self.device)
        self._copy()

    def _copy(self) -> None:
        self.copies = {"w1": self.w1.bfloat16(), "w2": self.w2.bfloat16()}

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the weights and biases."""
        return ("w1", "b1", "w2", "b2", "w3", "b3")

    def state(self) -> dict[str, Any]:
        """Return everything that the next step depends on."""
        weights = {name: getattr(self, name) for name in self.names()}
        return {"weights": weights, "square": self.square, "steps": self.steps}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        for name in self.names():
            getattr(self, name).copy_(state["weights"][name])
            self.square[name].copy_(state["square"][name])
        self.steps.copy_(state["steps"])
        self._copy()

    def _layer(self, name: str) -> torch.Tensor:
        """Return a layer's weights in the type that products are taken in, (C, outputs, inputs)."""
        out: torch.Tensor = self.copies[name] if self.working == torch.bfloat16 else getattr(self, name)
        return out

    def _forward(self, rows: torch.Tensor, by: Sorted) -> Activations:
        """Return what critics make of sorted rows (R, inputs); rows of no critic get anything finite."""
        # rows of no critic borrow the last one's biases
        classes = by.classes.clamp_max(self.shape.classes - 1)
        first = grouped(rows, self._layer("w1").transpose(1, 2), by.end) + self.b1[classes]
        hidden = F.leaky_relu(first, SLOPE).to(self.working)
        second = grouped(hidden, self._layer("w2").transpose(1, 2), by.end) + self.b2[classes]
        last = self.w3[classes]
        score = (F.leaky_relu(second, SLOPE) * last).sum(1) + self.b3[classes, 0]
        by_second = last * _slope(second)
        by_first = grouped(by_second.to(self.working), self._layer("w2"), by.end) * _slope(first)
        return Activations(first, second, score, by_first, by_second)

    def scores(self, patches: torch.Tensor, classes: torch.Tensor) -> torch.Tensor:
        """Return the score of each patch (N, inputs) by the critic of its class (N,)."""
        by = Sorted.by(classes, self.shape.classes)
        score = self._forward(patches.to(self.working)[by.order], by).score
        return torch.empty_like(score).index_copy_(0, by.order, score)

    @torch.no_grad()
    def input_gradient(
        self, patches: torch.Tensor, classes: torch.Tensor, gain: torch.Tensor
    ) -> torch.Tensor:
        """Return the gradient of Σ gain · score by the patches, shape (N, inputs) float32.

        Args:
            patches: Shape (N, inputs).
            classes: Theirs, int64 (N,); the number of critics for patches of none, whose gradient is 0.
            gain: Of every class, shape (C,).
        """
        by = Sorted.by(classes, self.shape.classes)
        at = self._forward(patches.to(self.working)[by.order], by)
        gains = torch.cat([gain, gain.new_zeros(1)])[by.classes]
        slopes = grouped((at.by_first * gains[:, None]).to(self.working), self._layer("w1"), by.end)
        slopes = torch.where((by.classes < self.shape.classes)[:, None], slopes, 0.0)
        return torch.empty_like(slopes).index_copy_(0, by.order, slopes)

    @torch.no_grad()
    def step(
        self,
        fake: torch.Tensor,
        fake_classes: torch.Tensor,
        real: torch.Tensor,
        real_classes: torch.Tensor,
        weights: torch.Tensor,
        *,
        rate: float | torch.Tensor,
        penalty: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Critique:
        """Move the critics of the classes that both domains have, once.

        The loss is Σ weight · (mean fake score - mean real score + penalty · mean |∇D|²), the gradient taken
        half way (by a uniform share) between the i-th fake and the i-th real patch of the class.

        Args:
            fake: Patches of the simulator, shape (N, inputs).
            fake_classes: Theirs, int64 (N,); the number of critics for patches to be left out.
            real: Patches of the target, shape (M, inputs).
            real_classes: Theirs, int64 (M,).
            weights: Of each class, shape (C,), Eq. 13.
            rate: Learning rate.
            penalty: Weight of the penalty.
            generator: Draws the shares.
        """
        share = torch.rand(len(fake), 1, device=self.device, generator=generator)
        batch = _Batch(self, fake, fake_classes, real, real_classes, weights, share)
        critique = batch.differentiate(penalty)
        self.steps += batch.active
        correction = 1 / (1 - self.decay ** self.steps.clamp_min(1))
        rates = torch.where(batch.active, rate, 0.0)
        for name, (left, right) in batch.outer.items():
            bridge.move_critics(
                getattr(self, name), self.square[name], self.copies[name], left, right, batch.by.end,
                rates, correction, decay=self.decay,
            )  # fmt: skip
        for name, gradient in batch.sums.items():
            bridge.move_sums(
                getattr(self, name), self.square[name], gradient, rates, correction, decay=self.decay
            )
        return critique

    def one_launch(self) -> bool:
        """Return whether a layer of all critics is one launch on a GPU, and nothing waits for it."""
        return self.device.type == "cuda" and _has_grouped_products(self.device)

    def traffic(self, active: int) -> int:
        """Return the bytes that one step has to move at least, `active` critics being in use.

        Per weight of the first two layers: the forward pass, the penalty's gradient and its derivative read a
        bfloat16 copy, the update reads and writes the weight and its mean square and writes the copy.
        """
        layers = self.shape.wide * (self.shape.inputs + self.shape.narrow)
        return active * layers * (3 * 2 + 4 * 4 + 2)


class _Batch:
    """The rows of one step, and the gradients of the loss.

    Attributes:
        active: Which critics have patches of both domains, bool (C,).
        by: Order of all rows: fake, real, and half way between.
        outer: Layer to the left and right rows of its gradient.
        sums: Gradients of all other weights.
    """

    def __init__(
        self,
        bank: CriticBank,
        fake: torch.Tensor,
        fake_classes: torch.Tensor,
        real: torch.Tensor,
        real_classes: torch.Tensor,
        weights: torch.Tensor,
        share: torch.Tensor,
    ):
        self.bank, critics = bank, bank.shape.classes
        fakes, reals = Sorted.by(fake_classes, critics), Sorted.by(real_classes, critics)
        # the i-th fake patch of a class is paired with its i-th real one
        rank = torch.arange(len(fake), device=bank.device)
        first_fake, first_real = (_padded(s.end - s.number) for s in (fakes, reals))
        rank = torch.empty_like(rank).index_copy_(0, fakes.order, rank - first_fake[fakes.classes])
        paired = rank < _padded(reals.number)[fake_classes]
        partner = reals.order[(first_real[fake_classes] + rank).clamp_max(len(real) - 1)]
        fake, real = fake.to(bank.working), real.to(bank.working)
        between = torch.lerp(real[partner], fake, share.to(bank.working))
        between_classes = torch.where(paired, fake_classes, critics)
        classes = torch.cat([fake_classes, real_classes, between_classes])
        self.by = Sorted.by(classes, critics)
        self.rows = torch.cat([fake, real, between])[self.by.order]
        # the rows half way, in the order of their critics, and where they lie among all
        self.between = Sorted.by(between_classes, critics)
        inverse = torch.empty_like(self.by.order).index_copy_(
            0, self.by.order, torch.arange(len(classes), device=bank.device)
        )
        self.place = inverse[len(fake) + len(real) + self.between.order]
        self.active = (fakes.number > 0) & (reals.number > 0)
        sides = ((fakes.number, 1), (reals.number, -1), (self.between.number, 0))
        gains = [
            sign * _padded(torch.where(self.active, weights / number.clamp_min(1), 0.0))
            for number, sign in sides
        ]
        every = torch.cat([gains[0][fake_classes], gains[1][real_classes], gains[2][between_classes]])
        self.gain = every[self.by.order]
        held = torch.where(self.active, weights / self.between.number.clamp_min(1), 0.0)
        self.held = _padded(held)[self.between.classes]

    def differentiate(self, penalty: float) -> Critique:
        """Set `outer` and `sums`."""
        bank, by, place = self.bank, self.by, self.place
        at = bank._forward(self.rows, by)
        known = (by.classes < bank.shape.classes)[:, None]
        score = torch.where(known[:, 0], at.score, 0.0)
        distance = -(self.gain * score).sum()
        plain = torch.where(known, self.gain[:, None], 0.0)
        left_first = torch.where(known, at.by_first, 0.0) * plain
        left_second = torch.where(known, at.by_second, 0.0) * plain
        by_bias, by_bias2 = left_first.clone(), left_second.clone()
        # the penalty: g = slope of the first layer times its weights, loss = held |g|²
        inside = (self.between.classes < bank.shape.classes)[:, None]
        first = torch.where(inside, at.by_first[place], 0.0)
        second = torch.where(inside, at.by_second[place], 0.0)
        g = grouped(first.to(bank.working), bank._layer("w1"), self.between.end)
        g = torch.where(inside, g, 0.0)
        by_g = ((2 * penalty) * self.held[:, None] * g).to(bank.working)
        slope_first, slope_second = (_slope(sums[place]) for sums in (at.first, at.second))
        ends = self.between.end
        by_first = grouped(by_g, bank._layer("w1").transpose(1, 2), ends) * slope_first
        by_first = torch.where(inside, by_first, 0.0)
        by_second = grouped(by_first.to(bank.working), bank._layer("w2").transpose(1, 2), ends) * slope_second
        by_second = torch.where(inside, by_second, 0.0)
        hidden = torch.where(known, F.leaky_relu(at.first, SLOPE), 0.0).to(bank.working)
        last = torch.where(known, F.leaky_relu(at.second, SLOPE), 0.0) * plain
        self.rows[place], left_first[place] = by_g, first
        hidden[place], left_second[place] = by_first.to(bank.working), second
        last[place] = by_second
        self.outer = {"w1": (left_first, self.rows), "w2": (left_second, hidden)}
        parts = {"b1": by_bias, "b2": by_bias2, "w3": last, "b3": plain}
        self.sums = {name: self._per_critic(value) for name, value in parts.items()}
        return Critique(distance, (self.held * g.square().sum(1)).sum())

    def _per_critic(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the sums of rows over each critic's, (C, ...)."""
        out = rows.new_zeros(self.bank.shape.classes + 1, rows.shape[1])
        return out.index_add_(0, self.by.classes, rows)[:-1]


def _padded(values: torch.Tensor) -> torch.Tensor:
    """Add a zero for rows of no critic."""
    return torch.cat([values, values.new_zeros(1)])


def _slope(sums: torch.Tensor) -> torch.Tensor:
    """Return the slope of the leaky rectifier."""
    return torch.where(sums > 0, 1.0, SLOPE)


def grouped(rows: torch.Tensor, weights: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Multiply each group of rows with a matrix of its own.

    Args:
        rows: Shape (R, K), group by group.
        weights: Shape (C, K, N).
        end: Where groups end, int32 (C,).

    Returns:
        Shape (R, N) float32; anything in rows behind the last group.
    """
    if rows.is_cuda and _has_grouped_products(rows.device):
        return torch._grouped_mm(rows, weights, offs=end).float()
    out = rows.new_zeros(len(rows), weights.shape[2])
    begin = 0
    for critic, stop in enumerate(end.tolist()):
        if stop > begin:
            torch.mm(rows[begin:stop], weights[critic], out=out[begin:stop])
        begin = stop
    return out.float()


@lru_cache
def _has_grouped_products(device: torch.device) -> bool:
    """Return whether PyTorch multiplies groups in one launch on this GPU; without, it is slow but right."""
    try:
        end = torch.tensor([8, 8, 16], dtype=torch.int32, device=device)
        rows = torch.ones(24, 16, dtype=torch.bfloat16, device=device)
        for weights in (rows.new_ones(3, 16, 8), rows.new_ones(3, 8, 16).transpose(1, 2)):
            out = torch._grouped_mm(rows, weights, offs=end)
            if not bool((out[:16] == 16).all()):
                return False
    except (AttributeError, RuntimeError):
        return False
    return True
