"""The bank of critics of "How to Learn a Domain-Adaptive Event Simulator?" (2021), section 4.3."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch

from dase.kernels import autograd_critics as bridge
from dase.networks.threshold_network import LEAKY_SLOPE


@dataclass(frozen=True, kw_only=True)
class BankShape:
    """Sizes of a bank of critics.

    Args:
        classes: Number of critics.
        inputs: Numbers in a patch; a multiple of 8, as products of groups on a GPU ask for.
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
class SortedRows:
    """Rows in the order of their critics.

    Args:
        order: Which row comes where, int64 (R,).
        of: Critic of each row in that order, int32 (R,); the number of critics for rows of none.
        end: Where the rows of each critic end, int32 (C,).
    """

    order: torch.Tensor
    of: torch.Tensor
    end: torch.Tensor

    @classmethod
    def of_classes(cls, classes: torch.Tensor, critics: int) -> SortedRows:
        """Sort rows of these classes, int64 (R,); nothing waits for the GPU."""
        of, order = bridge.sort_keys(classes, below=critics + 1)
        number = classes.new_zeros(critics + 1).index_add_(0, classes, torch.ones_like(classes))
        return cls(order, of, number[:-1].cumsum(0).int())


@dataclass
class CriticStep:
    """What one step of the bank found.

    Args:
        distance: Weighted difference of the critics' means, real minus fake, a scalar: what Eq. 10 maximises.
        penalty: Weighted mean of (|∇D| - steepness)² between the domains, a scalar.
    """

    distance: torch.Tensor
    penalty: torch.Tensor


@dataclass
class Activations:
    """What the critics make of rows.

    Args:
        first: Sums of the first layer, float32 (R, wide).
        hidden: The same behind its rectifiers, (R, wide) in the type of the products.
        second: Sums of the second layer, float32 (R, narrow).
        by_first: Derivative of the scores by the sums of the first layer, (R, wide).
        by_second: Derivative of the scores by the sums of the second layer, (R, narrow).
    """

    first: torch.Tensor
    hidden: torch.Tensor
    second: torch.Tensor
    by_first: torch.Tensor
    by_second: torch.Tensor


@dataclass(frozen=True)
class CriticOptimizer:
    """How critics are moved.

    Args:
        decay: Of the mean square of gradients, or of what they stray from their mean by.
        momentum: Decay of the mean of gradients.
        belief: Whether it is AdaBelief, along the mean, and not Adam without momentum.
        tiny: Added to the root of the mean square.
    """

    decay: float = 0.9
    momentum: float = 0.0
    belief: bool = False
    tiny: float = 1e-8


OPTIMIZERS = {
    "adam": CriticOptimizer(),
    "adabelief": CriticOptimizer(decay=0.999, momentum=0.9, belief=True, tiny=1e-16),
}
"""By their names in recipes; AdaBelief as its paper has it."""


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
        optimizer: How they are moved.

    Attributes:
        w1, b1: Weights and biases of the first layer, float32 (C, wide, inputs) and (C, wide).
        w2, b2: Those of the second layer, (C, narrow, wide) and (C, narrow).
        w3, b3: Those of the last layer, (C, narrow) and (C, 1).
        square: The optimiser's mean square of each, by its name and of its shape.
        mean: AdaBelief's mean of the gradient of each, likewise; nothing for Adam.
        steps: Steps that each critic has made, float32 (C,).
        copies: w1 and w2 as bfloat16, which products on a GPU read; as new as the weights after every step.
    """

    def __init__(
        self,
        shape: BankShape,
        *,
        device: str | torch.device = "cpu",
        generator: torch.Generator | None = None,
        optimizer: CriticOptimizer = OPTIMIZERS["adam"],
    ):
        self.shape, self.device, self.optimizer = shape, torch.device(device), optimizer
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
        self.square = {name: torch.zeros_like(getattr(self, name)) for name in self.parameter_names()}
        self.mean = {name: torch.zeros_like(one) for name, one in self.square.items() if optimizer.belief}
        self.steps = torch.zeros(shape.classes, device=self.device)
        self._refresh_copies()

    def _refresh_copies(self) -> None:
        self.copies = {"w1": self.w1.bfloat16(), "w2": self.w2.bfloat16()}

    @staticmethod
    def parameter_names() -> tuple[str, ...]:
        """Return the names of the weights and biases."""
        return ("w1", "b1", "w2", "b2", "w3", "b3")

    def state(self) -> dict[str, Any]:
        """Return everything that the next step depends on."""
        weights = {name: getattr(self, name) for name in self.parameter_names()}
        return {"weights": weights, "square": self.square, "mean": self.mean, "steps": self.steps}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        for name in self.parameter_names():
            getattr(self, name).copy_(state["weights"][name])
            self.square[name].copy_(state["square"][name])
        for name, mean in self.mean.items():
            mean.copy_(state["mean"][name])
        self.steps.copy_(state["steps"])
        self._refresh_copies()

    def _working_weights(self, name: str) -> torch.Tensor:
        """Return a layer's weights in the type that products are taken in, (C, outputs, inputs)."""
        out: torch.Tensor = self.copies[name] if self.working == torch.bfloat16 else getattr(self, name)
        return out

    def _forward(self, rows: torch.Tensor, of: torch.Tensor, end: torch.Tensor) -> Activations:
        """Return what critics make of rows (R, inputs).

        Args:
            rows: Critic by critic.
            of: The critic of each, int32 (R,), the number of critics for none.
            end: Where the rows of each critic end, int32 (C,).
        """
        w2 = self._working_weights("w2")
        product = multiply_groups(rows, self._working_weights("w1").transpose(1, 2), end)
        first, hidden = bridge.first_layer(product, of, self.b1, slope=LEAKY_SLOPE)
        product = multiply_groups(hidden, w2.transpose(1, 2), end)
        second, by_second, back = bridge.second_layer(product, of, self.b2, self.w3, slope=LEAKY_SLOPE)
        product = multiply_groups(back, w2, end)
        by_first = bridge.back_through_first_layer(
            product, of, first, critics=self.shape.classes, slope=LEAKY_SLOPE
        )
        return Activations(first, hidden, second, by_first, by_second)

    def _scores(self, at: Activations, of: torch.Tensor) -> torch.Tensor:
        return bridge.score_rows(at.second, of, self.w3, self.b3, slope=LEAKY_SLOPE)

    def scores(self, patches: torch.Tensor, classes: torch.Tensor) -> torch.Tensor:
        """Return the score of each patch (N, inputs) by the critic of its class (N,)."""
        by = SortedRows.of_classes(classes, self.shape.classes)
        score = self._scores(self._forward(patches.to(self.working)[by.order], by.of, by.end), by.of)
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
        gains = torch.cat([gain, gain.new_zeros(1)])
        # a class without gain is none: its critic's weights need not be read
        classes = torch.where(gains[classes] != 0, classes, self.shape.classes)
        by = SortedRows.of_classes(classes, self.shape.classes)
        at = self._forward(patches.to(self.working)[by.order], by.of, by.end)
        gains = gains[by.of.long()]
        slopes = multiply_groups(
            (at.by_first * gains[:, None]).to(self.working), self._working_weights("w1"), by.end
        )
        slopes = torch.where((by.of < self.shape.classes)[:, None], slopes.float(), 0.0)
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
        steepness: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> CriticStep:
        """Move the critics of the classes that both domains have, once.

        The loss is Σ weight · (mean fake score - mean real score + penalty · mean (|∇D| - steepness)²), the
        gradient taken half way (by a uniform share) between the i-th fake and real patch of the class.

        Args:
            fake: Patches of the simulator, shape (N, inputs).
            fake_classes: Theirs, int64 (N,); the number of critics for patches to be left out.
            real: Patches of the target, shape (M, inputs).
            real_classes: Theirs, int64 (M,).
            weights: Of each class, shape (C,), Eq. 13.
            rate: Learning rate.
            penalty: Weight of the penalty.
            steepness: Length of the gradient that is not penalised.
            generator: Draws the shares.
        """
        # as many numbers whatever the classes, so that a step that is replayed draws as one that is not
        share = torch.rand(len(fake), 1, device=self.device, generator=generator)
        batch = CriticBatch(self, fake, fake_classes, real, real_classes, weights, share)
        critique = batch.differentiate(penalty, steepness)
        speed = rate if isinstance(rate, torch.Tensor) else torch.full((1,), rate, device=self.device)
        how = self.optimizer
        decays = {"decay": how.decay, "momentum": how.momentum}
        paces = bridge.count_steps(batch.layout, speed, self.steps, **decays)
        for name, (left, right) in batch.outer.items():
            bridge.move_critics(
                getattr(self, name), self.square[name], self.copies[name], left, right, batch.layout.end[0],
                *paces, mean=self.mean.get(name), tiny=how.tiny, **decays,
            )  # fmt: skip
        for name, gradient in batch.sums.items():
            bridge.move_sums(
                getattr(self, name), self.square[name], gradient, *paces,
                mean=self.mean.get(name), tiny=how.tiny, **decays,
            )  # fmt: skip
        return critique

    def one_launch(self) -> bool:
        """Return whether a layer of all critics is one launch on a GPU, and nothing waits for it."""
        return self.device.type == "cuda" and _has_grouped_products(self.device)

    def least_traffic(self, active: int) -> int:
        """Return the bytes that one step has to move at least, `active` critics being in use.

        Per weight of the first two layers: the forward pass, the penalty's gradient and its derivative read a
        bfloat16 copy, the update reads and writes the weight, its mean square and the mean of AdaBelief, and
        writes the copy.
        """
        layers = self.shape.wide * (self.shape.inputs + self.shape.narrow)
        kept = 3 if self.mean else 2
        return active * layers * (3 * 2 + 2 * 4 * kept + 2)


class CriticBatch:
    """The rows of one step, and the gradients of the loss.

    Args:
        bank: The critics.
        fake: Patches of the simulator, shape (N, inputs).
        fake_classes: Their classes, int64 (N,).
        real: Patches of the target, shape (M, inputs).
        real_classes: Their classes, int64 (M,).
        weights: Of each class, shape (C,).
        share: Where between fake and real the penalty is taken, in [0, 1], shape (N, 1).

    Attributes:
        layout: Where the rows of each critic lie: fake, real, and half way between.
        rows: All rows in that order, (R, inputs).
        outer: By the name of a layer, left (R, outputs) and right rows (R, inputs) whose outer products,
            summed over the rows of a critic, are the gradient of its weights.
        sums: Gradients of all other weights, by name and of their shapes.
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
        self.bank, self.layout = bank, bridge.lay_out_rows(fake_classes, real_classes, weights)
        self.rows = bridge.gather_rows(fake, real, share, self.layout, bank.working)

    def differentiate(self, penalty: float, steepness: float = 0.0) -> CriticStep:
        """Set `outer` and `sums`; return the distance and the penalty.

        Args:
            penalty: Weight of the gradient penalty.
            steepness: Length of the gradient that is not penalised.
        """
        bank, layout, working = self.bank, self.layout, self.bank.working
        w1, w2 = bank._working_weights("w1"), bank._working_weights("w2")
        at = bank._forward(self.rows, layout.of, layout.end[0])
        distance = -(layout.gain * bank._scores(at, layout.of)).sum()
        left_first, left_second, last = bridge.weigh_rows(
            at.second, at.by_first, at.by_second, layout, slope=LEAKY_SLOPE, penalty=penalty
        )
        # the penalty: g = slope of the first layer times its weights, loss = penalty · held (|g| - s)²;
        # what comes back from it passes the same matrices as the scores, and the kinks add nothing
        ends = layout.end[1]
        g = multiply_groups(bridge.rows_half_way(at.by_first, layout, working), w1, ends)
        bent, rest = _pull_towards(steepness, g, layout)
        by_g = bridge.penalise_gradient(g, bent, self.rows)
        product = multiply_groups(by_g, w1.transpose(1, 2), ends)
        by_first, square = bridge.penalty_through_first_layer(
            product, at.first, at.by_first, layout, at.hidden, slope=LEAKY_SLOPE, penalty=penalty
        )
        product = multiply_groups(by_first, w2.transpose(1, 2), ends)
        bridge.penalty_through_second_layer(product, at.second, layout, last, slope=LEAKY_SLOPE)
        self.outer = {"w1": (left_first, self.rows), "w2": (left_second, at.hidden)}
        self.sums = {
            "b1": bridge.sum_rows(left_first, layout, between=False),
            "b2": bridge.sum_rows(left_second, layout, between=False),
            "w3": bridge.sum_rows(last, layout, between=True),
            "b3": bridge.sum_rows(layout.gain[:, None], layout, between=False),
        }
        return CriticStep(distance, square.sum() + rest)


def _pull_towards(
    steepness: float, gradient: torch.Tensor, layout: bridge.RowLayout
) -> tuple[bridge.RowLayout, torch.Tensor]:
    """Return a layout whose mean square of g has the derivative of (|g| - steepness)², and what it lacks.

    The derivative of held (|g| - s)² is that of a square, 2 held g, times 1 - s / |g|.

    Args:
        steepness: s.
        gradient: g half way, shape (N, K).
        layout: Where rows lie.
    """
    if steepness == 0:
        return layout, gradient.new_zeros((), dtype=torch.float32)
    there = layout.place >= 0  # of other rows the gradient is anything
    length = torch.linalg.vector_norm(gradient, dim=1, dtype=torch.float32).clamp_min(1e-12)
    bent = torch.where(there, layout.held * (1 - steepness / length), 0.0)
    rest = torch.where(there, layout.held * steepness * (steepness - length), 0.0).sum()
    return replace(layout, held=bent), rest


def multiply_groups(
    rows: torch.Tensor, weights: torch.Tensor, end: torch.Tensor, *, few: int = 4
) -> torch.Tensor:
    """Multiply each group of rows with a matrix of its own.

    Args:
        rows: Shape (R, K), group by group.
        weights: Shape (C, K, N).
        end: Where groups end, int32 (C,).
        few: Rows of a group, in the mean, up to which a kernel of our own is faster than PyTorch's grouped
            product: with 2 of them that reads the weights at 45 % of a copy on an H200, since its tiles are
            for many.

    Returns:
        Shape (R, N) in the type of the rows; anything in rows behind the last group.
    """
    if rows.is_cuda and weights.stride(2) == 1 and len(rows) <= few * len(weights):
        return bridge.multiply_by_critic(rows, weights, end)
    if rows.is_cuda and _has_grouped_products(rows.device):
        return torch._grouped_mm(rows, weights, offs=end)
    # slow but right: on a CPU, and on GPUs whose PyTorch lacks the product
    out = rows.new_zeros(len(rows), weights.shape[2])
    begin = 0
    for critic, stop in enumerate(end.tolist()):
        if stop > begin:
            torch.mm(rows[begin:stop], weights[critic], out=out[begin:stop])
        begin = stop
    return out


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
